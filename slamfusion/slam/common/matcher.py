"""A bounded Monte-Carlo search for the pose under which a scan fits the map best.

The first look draws poses widely around each hypothesis (the odometry; the motion so far) and
scores them on wide basins, in one launch. From the best of them hill climbing continues in rounds
of ever narrower random steps, in one more launch. It maximises the mean wall value under the hits
less a small loss for the distance from the nearest hypothesis. If the response falls off steeply
around its peak the place is certain; along a corridor it stays level: that direction is degenerate.

Sources: [H16] (Monte-Carlo matcher with a bounded number of tries), [O09] (the response).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import CLIMBERS
from slamfusion.compute.scan_match import FieldWindow, upload_hits
from slamfusion.geometry import F32, F64, corners, wrap_angle, wrap_angles

# Distance, metres, between the five cells whose maximum the first look uses: the draws' spacing.
WIDE_REACH_M = 0.15
# Share of the poses' box by which the copied part of the field is wider on each side.
WINDOW_ROOM = 0.5
# Number of different cells with hits below which a scan has less weight than the hypotheses assume.
TELLING_CELLS = 100.0
# Larger than any column: combines a row and a column into one number.
_ROW_STRIDE = 1 << 32
# Poses of the first look, the best of them from which a climb starts, and rounds of a climb.
FIRST_POSES, STARTS, ROUNDS = 256, 6, 4
# Score lost one spread from the expected place, and from the expected heading.
PRIOR_WEIGHT_XY, PRIOR_WEIGHT_YAW = 0.04, 0.005
# Share of the spread that hill climbing begins with, and share that is left of a step after each
# round: by the last one steps are far below a cell.
FIRST_NARROWING, NARROWING = 0.4, 0.5


def spread_of(xy_m: float, yaw_rad: float) -> F64:
    """Return (3,) standard deviations of x, y and yaw."""
    return np.array([xy_m, xy_m, yaw_rad])


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """Where the robot may have gone.

    Attributes:
        pose: (3,) x, y in metres and yaw in radians, map frame.
        spread: (3,) standard deviations of x, y and yaw.
        loss: cost of accepting it, in units of the score.
        trust: factor on the loss for leaving its place, see ``search_pose``.
    """

    pose: F64
    spread: F64
    loss: float = 0.0
    by_odometry: bool = False
    trust: float = 1.0


@dataclass(frozen=True)
class Match:
    """The best pose found.

    Attributes:
        pose: (3,) x, y in metres and yaw in radians, map frame.
        score: mean wall value under the hits there, 0 to 1.
        moved: how far the pose lies from the first hypothesis, in spreads, along the worst axis.
        hessian: (3, 3) negative Hessian of the response there, see ``response_hessian``; None: not
            measured.
    """

    pose: F64
    score: float
    moved: float
    hessian: F64 | None = None


class FieldMap(NamedTuple):
    """A tiled score field, and where it lies.

    Attributes:
        field: (T, TILE, TILE) uint8 wall values, on the device.
        pages: (PH, PW) int32, on the device.
        corner: (2,) x and y of the window's lower-left corner in the map frame, cells.
        resolution: metres per cell.
        whole: a dense copy of all of it, if there is one.
    """

    field: DeviceArray[Any]
    pages: DeviceArray[Any]
    corner: F64
    resolution: float
    whole: FieldWindow | None = None


class ScanOnTiles:
    """One scan's hits over a tiled map, in ``cells`` different cells, and the scores of poses."""

    def __init__(
        self, device: ComputeDevice, walls: FieldMap, points: F64, most_points: int
    ) -> None:
        """Upload hits (P, 2), metres in the robot's frame, thinned to at most ``most_points``."""
        self._device = device
        self._walls = walls
        self._cell = resolution = walls.resolution
        self._corner = walls.corner
        hits = points / resolution
        every = -(-len(points) // most_points)
        seconds = hits[:: 2 * every], hits[every :: 2 * every]
        looked_at = np.concatenate(seconds).astype(np.float32)
        self._points = upload_hits(looked_at, device)
        # The first, wide look takes every second of them.
        self._few_points = self._points[: -(-len(looked_at) // 2)]
        col, row = np.floor(hits).astype(np.int64).T
        cells = np.sort(col * _ROW_STRIDE + row)
        self.cells = 1 + int(np.count_nonzero(cells[1:] != cells[:-1]))
        self._reach = max(1, round(WIDE_REACH_M / resolution))
        # A dense copy of the field around the poses so far, and the corners of their box, in cells
        # of the pages.
        self._window: FieldWindow
        self._box = (math.inf, math.inf, -math.inf, -math.inf)
        self._range = float(np.hypot(*looked_at.T).max()) + self._reach + 2.0

    def scores(self, poses: F64, *, wide: bool = False) -> F64:
        """Return (N,) scores, 0 to 1, of poses (N, 3): mean wall value under the hits.

        If ``wide``, on wide basins, by half of the hits.
        """
        points = self._few_points if wide else self._points
        table = pose_table(poses, self._cell, self._corner)
        window, reach = self._window_at(table, 0.0), self._reach if wide else 0
        sums = self._device.score_poses(window, points, table, reach=reach)
        return np.asarray(sums * _scale(points))

    def unseen_share(self, pose: F64, unseen: int) -> float:
        """Return the share of the hits at a pose (3,) whose field value is ``unseen``."""
        table = np.zeros(256, dtype=np.int32)
        table[unseen] = 1
        poses = pose_table(pose[None], self._cell, self._corner)
        window = self._window_at(poses, 0.0)
        sums = self._device.score_poses(window, self._points, poses, table=table)
        return float(sums[0] / self._points.shape[0])

    def hill_climb(
        self, starts: F64, steps: F64, hypotheses: tuple[F64, F64, F64], weights: F64
    ) -> tuple[F64, float]:
        """Run hill climbing by rounds of random steps; return the best pose and its objective.

        Args:
            starts: (G, 3) poses.
            steps: (R, G, CLIMBERS, 3) in metres and radians.
            hypotheses: (K, 3) poses, (K, 3) spreads and (K,) losses.
            weights: (3,) loss at one spread from a hypothesis, along x, y and yaw.
        """
        cell, corner, (centres, sigmas, own) = self._cell, self._corner, hypotheses
        # In cells of the pages; headings near 0, within float32's precision.
        poses, yaw0 = np.concatenate((starts, centres)), centres[0, 2]
        yaws = poses[:, 2]
        turned = (wrap_angles(yaws - yaw0), np.cos(yaws), np.sin(yaws))
        first = np.column_stack((poses[:, :2] / cell - corner, *turned))
        losses = np.empty((len(centres), 7), dtype=np.float32)
        losses[:, :3], losses[:, 6] = first[len(starts) :, :3], own
        losses[:, 3:6] = weights / (sigmas / (cell, cell, 1.0)) ** 2
        first = first[: len(starts)]
        table = np.empty((*steps.shape[:3], 5), dtype=np.float32)
        table[..., :2], table[..., 2] = steps[..., :2] / cell, steps[..., 2]
        table[..., 3], table[..., 4] = np.cos(steps[..., 2]), np.sin(steps[..., 2])
        farthest = np.abs(table[..., 0]), np.abs(table[..., 1])
        farther = np.array([one.max(axis=(1, 2)).sum() for one in farthest])
        found = self._device.climb(
            self._window_at(first, farther),
            self._points,
            losses,
            first.astype(np.float32),
            table,
            scale=_scale(self._points),
        )
        x, y, yaw, _, _, objective = found[found[:, 5].argmax()].tolist()
        place = (np.array((x, y)) + corner) * cell
        return np.append(place, wrap_angle(yaw + yaw0)), objective

    def _window_at(self, poses: npt.NDArray[Any], farther: F64 | float) -> FieldWindow:
        """Return a window with all that hits reach at poses (N, 2 or more), cells, and around."""
        if self._walls.whole is not None:
            return self._walls.whole
        low, high = corners(poses)
        (left, bottom), (right, top) = (low - farther).tolist(), (high + farther).tolist()
        west, south, east, north = self._box
        if left < west or bottom < south or right > east or top > north:
            # Room for the climb that follows a first look.
            x, y = WINDOW_ROOM * (right - left), WINDOW_ROOM * (top - bottom)
            self._box = west, south, east, north = left - x, bottom - y, right + x, top + y
            self._window = self._device.field_window(
                self._walls.field,
                self._walls.pages,
                (west - self._range, south - self._range),
                (east + self._range, north + self._range),
            )
        return self._window


def pose_table(poses: F64, cell: float, corner: F64) -> F32:
    """Return poses (..., 3), metres and radians in the map frame, as (..., 4) float32 for kernels.

    ``cell`` is in metres; ``corner`` is the window's lower-left corner (2,) in cells.
    """
    table = np.empty((*poses.shape[:-1], 4), dtype=np.float32)
    table[..., :2] = poses[..., :2] / cell - corner
    table[..., 2], table[..., 3] = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return table


def _scale(points: DeviceArray[Any]) -> float:
    """Return the factor from a sum over points (P, 2) to a mean of 0 to 1."""
    return 1.0 / (255.0 * int(points.shape[0]))


def search_pose(
    scan: ScanOnTiles,
    hypotheses: Sequence[PoseHypothesis],
    rng: np.random.Generator,
    trust: float = 1.0,
    *,
    first_poses: int = FIRST_POSES,
    climbs: int = STARTS,
) -> Match:
    """Search around at least one hypothesis, with equal numbers of first poses."""
    centres = np.array([one.pose for one in hypotheses])
    sigmas = np.array([one.spread for one in hypotheses])
    weights = np.array([PRIOR_WEIGHT_XY, PRIOR_WEIGHT_XY, PRIOR_WEIGHT_YAW])
    # A mean over few cells is less certain, so the hypotheses weigh more.
    weights *= max(1.0, TELLING_CELLS / scan.cells)
    weights[:2] *= trust

    own = np.array([one.loss for one in hypotheses])

    def loss(poses: F64) -> F64:
        away = poses[:, None, :] - centres
        away[..., 2] = wrap_angles(away[..., 2])
        return reduce(np.minimum, ((away / sigmas) ** 2 @ weights + own).T)

    # The first look, and the hypotheses themselves.
    each = -(-first_poses // len(hypotheses))
    draws = rng.standard_normal((len(hypotheses), each, 3))
    poses = (centres[:, None, :] + draws * sigmas[:, None, :]).reshape(-1, 3)
    order = np.argsort(loss(poses) - scan.scores(poses, wide=True), kind="stable")
    starts = np.concatenate((poses[order[:climbs]], centres))
    # Hill climbing; each round's first step is zero, which keeps the best pose so far.
    widths = sigmas.max(axis=0) * FIRST_NARROWING * NARROWING ** np.arange(ROUNDS)[:, None]
    steps = rng.standard_normal((ROUNDS, len(starts), CLIMBERS, 3))
    steps *= widths[:, None, None, :]
    steps[:, :, 0] = 0.0
    pose, objective = scan.hill_climb(starts, steps, (centres, sigmas, own), weights)
    away = pose - centres[0]
    away[2] = wrap_angle(away[2])
    return Match(
        pose=pose,
        score=objective + float(loss(pose[None])[0]),
        moved=float(np.abs(away / sigmas[0]).max()),
    )


# Steps of the finite differences, metres and radians: a cell's width, and what moves a hit at 5 m
# by as much.
SURFACE_M, SURFACE_RAD = 0.05, 0.01
# Inverse of the response's loss (a share, 0 to 1) at which a pose is e^-0.5 times as likely.
RESPONSE_GAIN = 240.0
# Least and greatest standard deviation of a match, metres (of yaw: at ``_ARM_M``): a tenth of a
# cell, and a limit that keeps the equations solvable.
LEAST_SIGMA, MOST_SIGMA = 0.005, 0.5
# Standard deviation, metres, above which a direction is degenerate and follows odometry; in rooms
# even the weakest direction has half of it.
DEGENERATE_SIGMA_M = 0.06
# Distance of a typical hit, metres: there a radian weighs as a metre in the limits.
_ARM_M = 5.0
_UNITS = np.outer([1.0, 1.0, 1.0 / _ARM_M], [1.0, 1.0, 1.0 / _ARM_M])


def information_of(hessian: F64) -> F64:
    """Return (3, 3) the information of a match from the response's negative Hessian, (3, 3).

    Both are along the axes of the match's map.
    """
    values, vectors = np.linalg.eigh(RESPONSE_GAIN * hessian * _UNITS)
    kept = np.clip(values, MOST_SIGMA**-2.0, LEAST_SIGMA**-2.0)
    is_place = np.hypot(vectors[0], vectors[1]) > np.abs(vectors[2])
    kept[is_place & (values < DEGENERATE_SIGMA_M**-2.0)] = MOST_SIGMA**-2.0
    return np.asarray((vectors * kept) @ vectors.T / _UNITS)


def keep_degenerate_prior(hessian: F64, pose: F64, expected: F64) -> F64:
    """Return a match (3,) moved to the expected pose (3,) along its degenerate direction.

    Along walls new readings are sparser than old ones, which pulls a match back; odometry is
    better. Without a degenerate direction the same array is returned.
    """
    values, vectors = np.linalg.eigh(RESPONSE_GAIN * hessian[:2, :2])
    if values[0] >= DEGENERATE_SIGMA_M**-2.0:
        return pose
    moved, along = pose.copy(), vectors[:, 0]
    moved[:2] += along * (along @ (expected[:2] - pose[:2]))
    return moved


def response_hessian(scan: ScanOnTiles, pose: F64) -> F64:
    """Return (3, 3) the negative Hessian of the response at a match (3,), metres and radians.

    Measured along x and y and then once more along their own axes: a wall's response is no
    parabola, and differences along other axes show a curvature across it that does not exist.
    """
    flat = _hessian_along(scan, pose, np.eye(3), _FLAT)
    turn = 0.5 * math.atan2(2.0 * flat[0, 1], flat[0, 0] - flat[1, 1])
    cos, sin = math.cos(turn), math.sin(turn)
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return _hessian_along(scan, pose, axes, _FULL)


def _hessian_along(scan: ScanOnTiles, pose: F64, axes: F64, stencil: _Stencil) -> F64:
    """Return the Hessian by differences along the columns of ``axes``, (3, 3)."""
    scores = scan.scores(pose + stencil.steps @ axes.T)
    local = -(stencil.weights @ scores).reshape(3, 3)
    return np.asarray(axes @ local @ axes.T)


class _Stencil(NamedTuple):
    """Finite differences: steps (K, 3) in metres and radians, weights (9, K) of their values."""

    steps: F64
    weights: F64


def _stencil() -> _Stencil:
    """Return the stencil of all second derivatives."""
    axes = np.eye(3)
    places, weights = [np.zeros(3)], [np.diag([-2.0, -2.0, -2.0])]
    for axis in axes:
        for sign in (1.0, -1.0):
            places.append(sign * axis)
            weights.append(np.diag(axis))
    for one, other in itertools.combinations(axes, 2):
        both = np.outer(one, other) + np.outer(other, one)
        for a, b in itertools.product((1.0, -1.0), repeat=2):
            places.append(a * one + b * other)
            weights.append(0.25 * a * b * both)
    sizes = np.array([SURFACE_M, SURFACE_M, SURFACE_RAD])
    seconds = np.array(weights) / np.outer(sizes, sizes)
    return _Stencil(np.array(places) * sizes, seconds.reshape(-1, 9).T.copy())


_FULL = _stencil()
# The places where the yaw stays: enough for x and y alone.
_STAYS = _FULL.steps[:, 2] == 0.0
_FLAT = _Stencil(_FULL.steps[_STAYS], _FULL.weights[:, _STAYS])
