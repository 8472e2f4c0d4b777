"""``Submap``: a small map of scans that follow each other, rigid in itself, for the graph SLAM.

A submap lies in the frame of its first node, its anchor. While it grows, scans are matched against
its tiles; when it is finished it only answers searches for loop closures.

Sources: Hess et al., ICRA 2016 [H16c] (submaps); Olson, ICRA 2009 [O09] (likelihood of a hit).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.cell_means import LikelihoodRule
from slamfusion.compute.layout import BEAM_ONE, TILE
from slamfusion.compute.tiles import FieldWindow
from slamfusion.geometry import F64, U8, Pose2, wrap_angles
from slamfusion.slam.common.matcher import FieldMap
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.common.tile_map import TileMap

# Distance between hits, metres, above which they are not joined: there may be a door.
MOST_GAP_M = 1.5
# Distance of the neighbouring hits from the line through a gap, metres and a share of the gap,
# within which they are on one wall: the noise of a laser.
STRAIGHT_M, STRAIGHT_SHARE = 0.03, 0.05
# Angle between two neighbouring beams, in the median one: none is missing.
NEIGHBOUR_STEPS = 1.5


def fill_walls(points: F64, laser: F64, step_m: float) -> F64:
    """Return hits (P, 2), metres in beam order, followed by further ones between those on one wall.

    The laser (2,) is in the same frame; on a wall hits are at most ``step_m`` apart.
    """
    if len(points) < 4:
        return points
    away = points - laser
    turn = np.abs(wrap_angles(np.diff(np.arctan2(away[:, 1], away[:, 0]))))
    along = np.diff(points, axis=0)
    gap = np.hypot(along[:, 0], along[:, 1])
    is_next = turn <= NEIGHBOUR_STEPS * np.median(turn)
    # The gap from hit i + 1 to hit i + 2, by the hits i and i + 3.
    gaps, lines = gap[1:-1], along[1:-1]
    # Shorter gaps than a step are not filled in.
    normal = np.column_stack((-lines[:, 1], lines[:, 0])) / np.maximum(gaps, step_m)[:, None]
    before = np.abs(np.einsum("ij,ij->i", normal, along[:-2]))
    after = np.abs(np.einsum("ij,ij->i", normal, along[2:]))
    is_wall = (
        (is_next[:-2] & is_next[1:-1] & is_next[2:])
        & ((gaps > step_m) & (gaps <= MOST_GAP_M))
        & (np.maximum(before, after) <= STRAIGHT_M + STRAIGHT_SHARE * gaps)
    )
    first = np.flatnonzero(is_wall)
    if len(first) == 0:
        return points
    counts = np.ceil(gaps[first] / step_m).astype(np.int64) - 1
    owner = np.repeat(first, counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    share = number / np.repeat(counts + 1, counts)
    return np.concatenate((points, points[owner + 1] + share[:, None] * lines[owner]))


# Likelihood, of 255, of an unknown cell: a little, so that new space does not repel scans.
UNSEEN_WALL = 20
# Standard deviations around a hit within which its likelihood is written: 5 % are beyond.
REACH_SIGMAS = 2.0
# Most cells around a hit for its likelihood: the kernels' time grows with the square.
MOST_REACH = 6
# Entries of the likelihood's table by squared distance.
TABLE_STEPS = 256
# Observations that a cell remembers: some seconds of scans, so that what has moved is forgotten.
MEMORY = 64


class Pyramid:
    """A finished submap as dense fields, each cell the greatest of a square that starts there.

    Attributes:
        windows: sides of the squares in cells, the largest first, 1 last.
        fields: (H, W) uint8 handles, one for each window.
        corner: (2,) x and y of the first cell's lower-left corner in the submap's frame, cells.
    """

    windows = (16, 8, 4, 2, 1)  # each half of the one before

    def __init__(self, device: ComputeDevice, values: U8, corner: F64) -> None:
        """Pool the field (H, W) of a submap; cells outside it are no wall."""
        pad = self.windows[0] - 1
        padded = np.pad(values, ((pad, 0), (pad, 0)))
        self.corner = corner - pad
        self.fields: list[DeviceArray[Any]] = [device.upload(padded)]
        for window in self.windows[:0:-1]:
            self.fields.insert(0, device.max_ahead(self.fields[0], window))


class Submap(Stateful):
    """A map of scans in the frame of its anchor node.

    ``low`` and ``high`` (2,) are the corners of the robot's places in it, metres.
    """

    STATE = ("anchor", "scans", "low", "high", "is_finished", "_tiles")

    def __init__(
        self, device: ComputeDevice, anchor: int, resolution: float, sigma_m: float
    ) -> None:
        """Start empty, with a likelihood of deviation ``sigma_m``, metres, around a hit."""
        self.anchor = anchor
        self.scans = 0
        self.low = np.zeros(2)
        self.high = np.zeros(2)
        self._device = device
        self._cell = resolution
        sigma = sigma_m / resolution
        reach = min(MOST_REACH, max(1, math.ceil(REACH_SIGMAS * sigma)))
        farthest = 2.0 * ((reach + 0.5) * BEAM_ONE) ** 2
        shift = max(0, math.ceil(math.log2(farthest / TABLE_STEPS)))
        squared = np.arange(TABLE_STEPS) * 2.0**shift / BEAM_ONE**2
        table = np.rint(255.0 * np.exp(-0.5 * squared / sigma**2)).astype(np.uint8)
        self._rule = LikelihoodRule(table, shift, reach, MEMORY)
        self._tiles = TileMap(
            device,
            {
                "observed": (np.uint32, 0),
                "states": (np.uint32, 0),
                "field": (np.uint8, UNSEEN_WALL),
            },
        )
        # Dense copies, made when they are asked for; only a finished submap keeps them.
        self._pyramid: Pyramid | None = None
        self._window: FieldWindow | None = None
        self.is_finished = False

    @property
    def memory_bytes(self) -> int:
        """Bytes of its tiles and pyramid."""
        fields = [] if self._pyramid is None else [*self._pyramid.fields]
        if self._window is not None:
            fields.append(self._window.cells)
        return self._tiles.memory_bytes + sum(field.size for field in fields)

    def walls(self) -> FieldMap:
        """Return it as the matcher sees it; poses are in the anchor's frame."""
        tiles = self._tiles
        if not self.is_finished:
            return FieldMap(tiles.window, tiles.origin, self._cell)
        if self._window is None:
            field, (low, high) = tiles.pools["field"], tiles.used_box()
            self._window = self._device.field_window(
                field, tiles.page_tables, low - TILE, high + TILE
            )
        whole = self._window
        return FieldMap(lambda *_: whole, tiles.origin, self._cell)

    def insert(self, points: F64, laser: F64, pose: Pose2) -> None:
        """Add a scan of the submap's own; see ``draw``."""
        self.draw(points, laser, pose)
        place = np.array([pose.x, pose.y])
        self.low = np.minimum(self.low, place)
        self.high = np.maximum(self.high, place)
        self.scans += 1

    def draw(self, points: F64, laser: F64, pose: Pose2) -> None:
        """Update the likelihood field by hits (P, 2), at least one, in metres in the robot's frame.

        The laser (2,) is in the robot's frame, the pose in the anchor's.
        """
        cell = self._cell
        start = (pose.transform(laser) / cell).tolist()
        self._tiles.write(pose.transform(points) / cell, start, self._rule)

    def finish(self) -> None:
        """Free what only a growing submap needs."""
        self._tiles.keep_only("field")
        self.is_finished = True

    def forget_dense(self) -> None:
        """Free the dense copies."""
        self._pyramid = self._window = None

    def pyramid(self) -> Pyramid:
        """Return its dense fields; a finished submap keeps them."""
        if self._pyramid is not None:
            return self._pyramid
        values, first = self._tiles.cells("field")
        field = values.astype(np.uint8)
        field[field == UNSEEN_WALL] = 0
        pyramid = Pyramid(self._device, field, first.astype(np.float64))
        if self.is_finished:
            self._pyramid = pyramid
        return pyramid


def seen_score(score: float, unseen_share: float) -> float:
    """Return the mean score, 0 to 1, of the hits on known cells; ``unseen_share`` is below 1."""
    return (score - unseen_share * UNSEEN_WALL / 255.0) / (1.0 - unseen_share)
