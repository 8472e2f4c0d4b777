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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import CLIMBERS, FIELD_ONE, START_FLOATS, TABLE_LAST
from slamfusion.compute.scan_match import SAME, upload_hits
from slamfusion.compute.tiles import FieldWindow
from slamfusion.geometry import F32, F64, I32, I64, corners, wrap_angle

# Distance, metres, between the five cells whose maximum the first look uses: the draws' spacing.
WIDE_REACH_M = 0.15
# Number of different cells with hits below which a scan has less weight than the hypotheses assume.
TELLING_CELLS = 100.0
# Combines a column and a row into one number, exact in float64.
_CELL_NUMBER = np.array([2.0**32, 1.0])
# Poses of the first look, the best of them from which a climb starts, and rounds of a climb.
FIRST_POSES, STARTS, ROUNDS = 256, 6, 4
# Score lost one spread from the expected place, and from the expected heading.
PRIOR_WEIGHT_XY, PRIOR_WEIGHT_YAW = 0.04, 0.005
# Shares of the spread that the steps of a climb have, by round: by the last one far below a cell.
NARROWINGS = tuple(0.4 * 0.5**k for k in range(ROUNDS))


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
    """A score field, and where it lies.

    Attributes:
        window: returns its part between two corners, x and y each in cells.
        corner: (2,) x and y of its lower-left corner in the map frame, cells.
        resolution: metres per cell.
    """

    window: Callable[[Sequence[float], Sequence[float]], FieldWindow]
    corner: F64
    resolution: float


class ScanOnTiles:
    """One scan's hits over a tiled map, in ``cells`` different cells, and the scores of poses."""

    def __init__(
        self, device: ComputeDevice, walls: FieldMap, points: F64, most_points: int
    ) -> None:
        """Upload hits (P, 2), metres in the robot's frame, thinned to at most ``most_points``."""
        self.walls = walls
        self._device = device
        hits = points / walls.resolution
        every = -(-len(points) // most_points)
        # The first, wide look takes every second of them.
        looked_at = np.concatenate((hits[:: 2 * every], hits[every :: 2 * every]))
        self._points = upload_hits(looked_at, device)
        cells = np.sort(np.floor(hits) @ _CELL_NUMBER)
        self.cells = 1 + int(np.count_nonzero(cells[1:] != cells[:-1]))
        self._reach = max(1, round(WIDE_REACH_M / walls.resolution))
        # How far from a pose hits are looked at, in cells.
        self._range = math.sqrt(np.square(hits).dot((1.0, 1.0)).max()) + self._reach + 2.0

    def scores(self, poses: F64) -> F64:
        """Return (N,) scores, 0 to 1, of poses (N, 3): mean wall value under the hits."""
        return np.asarray(self._sums(poses) * (1.0 / (FIELD_ONE * self._points.shape[0])))

    def unseen_share(self, pose: F64, unseen: int) -> float:
        """Return the share of the hits at a pose (3,) whose field value is ``unseen``."""
        table = np.zeros(TABLE_LAST + 1, dtype=np.int32)
        table[unseen] = 1
        return float(self._sums(pose[None], table)[0] / self._points.shape[0])

    def _sums(self, poses: F64, table: I32 = SAME) -> I64:
        at = pose_table(poses, self.walls.resolution, self.walls.corner)
        low, high = corners(at)
        window = self._window_at(low.tolist(), high.tolist())
        return self._device.score_poses(window, self._points, at, table=table)

    def search(
        self, losses: Sequence[tuple[float, ...]], poses: F32, steps: F32, away: float
    ) -> tuple[float, float, float, float]:
        """Return x, y, yaw and the objective of the best pose; see ``ScanMatchDevice.search``.

        ``losses`` are its hypotheses, and ``away`` how far from one poses may lie, in cells.
        """
        x, y, *_ = zip(*losses, strict=True)
        window = self._window_at([min(x) - away, min(y) - away], [max(x) + away, max(y) + away])
        given = np.array(losses, dtype=np.float32)
        found = self._device.search(window, self._points, given, poses, steps, reach=self._reach)
        x, y, yaw, _, _, objective = found[found[:, 5].argmax()].tolist()
        return x, y, yaw, objective

    def _window_at(self, low: list[float], high: list[float]) -> FieldWindow:
        """Return a window with all that hits reach at poses in a box, in cells of the pages."""
        reach = self._range
        return self.walls.window([at - reach for at in low], [at + reach for at in high])


def pose_table(poses: F64, cell: float, corner: F64) -> F32:
    """Return poses (..., 3), metres and radians in the map frame, as (..., 4) float32 for kernels.

    ``cell`` is in metres; ``corner`` is the window's lower-left corner (2,) in cells.
    """
    table = np.empty((*poses.shape[:-1], 4), dtype=np.float32)
    table[..., :2] = poses[..., :2] / cell - corner
    table[..., 2], table[..., 3] = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return table


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
    # A mean over few cells is less certain, so the hypotheses weigh more.
    weight = max(1.0, TELLING_CELLS / scan.cells)
    weights = PRIOR_WEIGHT_XY * weight * trust, PRIOR_WEIGHT_YAW * weight
    # Places in cells of the pages; headings near 0, within float32's precision.
    cell, (west, south) = scan.walls.resolution, scan.walls.corner.tolist()
    centres = [one.pose.tolist() for one in hypotheses]
    spreads = [one.spread.tolist() for one in hypotheses]
    yaw0 = centres[0][2]
    places = [(x / cell - west, y / cell - south, wrap_angle(yaw - yaw0)) for x, y, yaw in centres]
    sigmas = [(x / cell, y / cell, yaw) for x, y, yaw in spreads]
    losses = [
        (*place, weights[0] / x**2, weights[0] / y**2, weights[1] / yaw**2, one.loss)
        for place, (x, y, yaw), one in zip(places, sigmas, hypotheses, strict=True)
    ]
    # The first look around the hypotheses, and the steps of the climbs.
    own, each = len(hypotheses), -(-first_poses // len(hypotheses))
    looked, shape = own * each, (ROUNDS, climbs + own, CLIMBERS)
    rows = rng.standard_normal((looked + math.prod(shape), 3))
    widest = [max(sizes) for sizes in zip(*sigmas, strict=True)]
    farthest = float(np.abs(rows).max()) * max(widest[:2]) * (1.0 + sum(NARROWINGS))
    widths = [[share * size for size in widest] for share in NARROWINGS]
    counts = [each] * own + [math.prod(shape[1:])] * ROUNDS
    rows *= np.array(sigmas + widths).repeat(counts, axis=0)
    rows[:looked] += np.array(places).repeat(each, axis=0)
    rows[looked::CLIMBERS] = 0.0  # each round's first step keeps the best pose so far
    yaws = rows[:, 2].copy()
    yaws[:looked] += yaw0
    table = np.empty((own + len(rows), START_FLOATS), dtype=np.float32)
    table[:own] = [
        (*place, math.cos(yaw), math.sin(yaw))
        for place, (_, _, yaw) in zip(places, centres, strict=True)
    ]
    table[own:, :3], table[own:, 3], table[own:, 4] = rows, np.cos(yaws), np.sin(yaws)
    poses, steps = table[: own + looked], table[own + looked :].reshape(*shape, START_FLOATS)
    x, y, turn, objective = scan.search(losses, poses, steps, farthest)
    x, y, yaw = (x + west) * cell, (y + south) * cell, wrap_angle(turn + yaw0)
    # Distances from the hypotheses, in spreads.
    distances = [
        ((x - at[0]) / sigma[0], (y - at[1]) / sigma[1], wrap_angle(yaw - at[2]) / sigma[2])
        for at, sigma in zip(centres, spreads, strict=True)
    ]
    loss = min(
        weights[0] * (dx * dx + dy * dy) + weights[1] * dyaw * dyaw + one.loss
        for (dx, dy, dyaw), one in zip(distances, hypotheses, strict=True)
    )
    return Match(
        pose=np.array((x, y, yaw)), score=objective + loss, moved=max(map(abs, distances[0]))
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
