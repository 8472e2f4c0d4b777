"""``Pair``, two maps made ready on one device, and rigid motions of one onto the other, in cells.

A motion is in cells of the common lattice: (x, y, yaw) maps the moving grid's lattice into the
reference's, as x_ref = R(yaw) (x - centre of moving) + (x, y): (x, y) is where the centre lands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import NormalizedGrid
from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.geometry import B8, F64, Pose2, wrap_angle

Columns = tuple[F64, F64, F64, F64]
# Motions that are compared with each other at once.
TOGETHER = 48


def both_ways(
    motions: F64, centre: tuple[float, float], scales: F64 | None = None
) -> tuple[Columns, Columns]:
    """Return cos, sin, x and y (P,), cells, to the reference's lattice, and back."""
    # Contiguous columns are faster for many poses.
    x, y, yaw = np.ascontiguousarray(motions.T)
    cos, sin = np.cos(yaw), np.sin(yaw)
    if scales is not None:
        cos, sin = scales * cos, scales * sin
    x = x - cos * centre[0] + sin * centre[1]
    y = y - sin * centre[0] - cos * centre[1]
    there = cos, sin, x, y
    if scales is not None:
        cos, sin = cos / scales**2, sin / scales**2
    return there, (cos, -sin, -(cos * x + sin * y), sin * x - cos * y)


def turned_about(motion: F64, middle: F64, turns: F64, scales: F64 | float = 1.0) -> F64:
    """Return (P, 3) a motion turned by ``turns`` (rad) and scaled about ``middle`` (cells)."""
    x, y = motion[:2] - middle
    cos, sin = np.cos(turns) * scales, np.sin(turns) * scales
    return np.stack(
        (middle[0] + cos * x - sin * y, middle[1] + sin * x + cos * y, motion[2] + turns), axis=1
    )


def displacement(a: F64, b: F64) -> tuple[float, float]:
    """Return how far two motions carry the moving centre apart (cells), and the turn (rad)."""
    turn = (a[2] - b[2] + math.pi) % (2.0 * math.pi) - math.pi
    return float(math.hypot(a[0] - b[0], a[1] - b[1])), abs(float(turn))


def distinct(
    motions: F64, shift: float, turn: float, most: int | None = None
) -> npt.NDArray[np.intp]:
    """Return rows of motions (P, 3), best first, but those within shift and turn of a better one.

    ``shift`` is in cells, ``turn`` in rad; at most ``most`` rows are returned, ascending.
    """
    kept: list[int] = []
    left = np.arange(len(motions))
    while len(left) and (most is None or len(kept) < most):
        # A few at once: the best of these, then what is left of the others.
        some, left = left[:TOGETHER], left[TOGETHER:]
        is_far = _are_apart(motions[some], motions[some], shift, turn)
        chosen: list[int] = []
        is_free = np.ones(len(some), dtype=np.bool_)
        while is_free.any() and (most is None or len(kept) + len(chosen) < most):
            best = int(is_free.argmax())
            chosen.append(best)
            is_free &= is_far[best]
            is_free[best] = False
        kept += some[chosen].tolist()
        left = left[_are_apart(motions[left], motions[some[chosen]], shift, turn).all(axis=1)]
    return np.array(kept, dtype=np.intp)


def _are_apart(a: F64, b: F64, shift: float, turn: float) -> B8:
    """Return (A, B) whether motions are farther from each other than shift or turn."""
    x, y = (a[:, None, k] - b[:, k] for k in range(2))
    turned = np.abs(np.mod(a[:, None, 2], 2.0 * math.pi) - np.mod(b[:, 2], 2.0 * math.pi))
    is_turned = np.minimum(turned, 2.0 * math.pi - turned) >= turn
    return np.asarray((x * x + y * y >= shift * shift) | is_turned)


# Widths of a wall at full resolution, metres, and the minimum in cells: the narrow one for maps
# with the same walls in the same places, the broad one for bent maps.
WIDTHS_M, WALL_CELLS_MIN = (0.15, 0.45), 1.5


@dataclass(frozen=True, eq=False)
class Pair:
    """A reference map and a moving map at one resolution, on one device."""

    reference: GridFeatures
    moving: GridFeatures

    def __iter__(self) -> Iterator[GridFeatures]:
        """Yield the reference, then the moving map."""
        yield self.reference
        yield self.moving

    @property
    def device(self) -> ComputeDevice:
        """Computes, and holds both maps."""
        return self.reference.device

    @property
    def resolution(self) -> float:
        """Metres per cell of both maps."""
        return self.reference.grid.grid.resolution

    @property
    def widths(self) -> tuple[float, float]:
        """Widths of a wall, cells: the narrow one of good maps, and the broad one of bent ones."""
        narrow, broad = (max(width / self.resolution, WALL_CELLS_MIN) for width in WIDTHS_M)
        return narrow, broad

    @property
    def longest(self) -> int:
        """The longest side of both maps, cells."""
        return max(*self.reference.shape, *self.moving.shape)

    def mirrored(self) -> Pair:
        """Return the same with the mirror image of the moving map, about its own x axis."""
        given = self.moving.grid
        image = NormalizedGrid(
            replace(given.grid, cells=np.ascontiguousarray(given.grid.cells[::-1])),
            np.ascontiguousarray(given.cells[::-1]),
            np.ascontiguousarray(given.solid[::-1]),
        )
        return Pair(self.reference, GridFeatures(image, self.device))

    def sides(
        self, motions: F64, step: int = 1, scales: F64 | None = None
    ) -> Iterator[tuple[GridFeatures, F64, GridFeatures]]:
        """Yield each map, motions that bring its walls onto the other map, and that map.

        Args:
            motions: (P, 3), fine cells.
            step: of the level whose cells are moved, fine cells a cell.
            scales: (P,) enlarge the moving map about its centre; None: 1.

        Yields:
            The motions as (4, P) columns of ``fixed_poses``, whole numbers in float64.
        """
        centre = (self.moving.centre[0] / step, self.moving.centre[1] / step)
        there, back = (
            np.rint(np.array((cos, sin, 2.0 * x, 2.0 * y)) * float(FIXED_ONE))
            for cos, sin, x, y in both_ways(motions / np.array([step, step, 1.0]), centre, scales)
        )
        yield self.moving, there, self.reference
        yield self.reference, back, self.moving

    def motion_of(self, transform: Pose2) -> F64:
        """Return a transform of map frames, metres, as a motion (3,), see ``pair``."""
        ref, mov = self.reference.grid.grid, self.moving.grid.grid
        lattice = ref.origin.inverse().compose(transform).compose(mov.origin)
        centre = np.array(self.moving.centre) * mov.resolution
        landed = lattice.transform(centre) / ref.resolution
        return np.array([landed[0], landed[1], lattice.yaw_rad])

    def transform_of(self, motion: F64) -> Pose2:
        """Return a motion (3,) as the transform of map frames, metres."""
        ref, mov = self.reference.grid.grid, self.moving.grid.grid
        (_, _, (x,), (y,)), _ = both_ways(motion[None], self.moving.centre)
        yaw_rad = wrap_angle(float(motion[2]))
        lattice = Pose2(float(x) * ref.resolution, float(y) * ref.resolution, yaw_rad)
        return ref.origin.compose(lattice).compose(mov.origin.inverse())
