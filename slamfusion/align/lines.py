"""How pieces of wall depend on each other: neighbours, one straight wall, and the fitted motion.

A straight wall that fits at one piece fits along all its length. So the fits of two pieces are
correlated by how straight both are, where they lie on one line. Of good maps few pieces are enough,
and two parts of one piece of furniture or of one room fit together by chance, so neighbours are
correlated too; the greater of both counts.

A search fits a shift and a turn, so three lines of any two maps can be made to agree. What the
motion took to agree proves nothing: of each straight piece the leverage of a least squares fit is
spent. A piece holds the motion across its wall; a crooked one in both directions, and with a shape
that no motion can make agree. Other than good maps are held by many more walls than a motion takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.geometry import F64

# Pairs of pieces that are compared at once: they fit into the processor's cache.
COMPARED = 1 << 17


@dataclass(frozen=True, eq=False)
class PieceLines:
    """How the pieces of wall of one map depend on each other.

    Attributes:
        middles: (B, 2) x and y of the mean point of each piece, cells.
        across: (B, 2) the unit vector across its wall.
        straight: (B,) from 0 for a crooked piece to 1 for a straight one: 1 less the ratio of the
            spreads of its points across and along.
        squares, width, apart: see ``piece_lines``.
    """

    middles: F64
    across: F64
    straight: F64
    squares: npt.NDArray[np.int64]
    width: float
    apart: int

    @cached_property
    def alike(self) -> Any:
        """(B, B) sparse, the correlation of the fits of two pieces."""
        count, squares = len(self.squares), self.squares
        some = max(1, COMPARED // max(1, count))
        (x, y), (to_x, to_y) = (of.T.astype(np.float32) for of in (self.middles, self.across))
        at = to_x * x + to_y * y
        cols, rows = squares.T.astype(np.int16)
        # Farther off it is less than a hundredth.
        limit = 6.1 * self.width
        found = [np.empty(0, np.intp)]
        for first in range(0, count, some):
            own = slice(first, first + some)
            # Products of such thin matrices only make the threads of BLAS wait.
            is_near = np.abs(to_x[own, None] * x + to_y[own, None] * y - at[own, None]) < limit
            is_near &= np.abs(x[own, None] * to_x + y[own, None] * to_y - at) < limit
            is_next = np.abs(cols[own, None] - cols) < self.apart
            is_near |= is_next & (np.abs(rows[own, None] - rows) < self.apart)
            found.append(np.flatnonzero(is_near) + first * count)
        a, b = np.divmod(np.concatenate(found), max(1, count))
        near = np.clip(1.0 - np.abs(squares[a] - squares[b]) / self.apart, 0.0, None).prod(axis=1)
        between = self.middles[a] - self.middles[b]
        off = np.maximum(*(np.abs((between * self.across[one]).sum(axis=1)) for one in (a, b)))
        line = self.straight[a] * self.straight[b] * np.exp(-0.5 * (off / (2.0 * self.width)) ** 2)
        both = np.maximum(near, line)
        kept = both >= 0.01
        return scipy.sparse.csr_array((both[kept], (a[kept], b[kept])), shape=(count, count))

    def left(self, evidence: F64) -> F64:
        """Return (B,) the share of each piece that a motion fitted to this evidence (B,) leaves."""
        given = np.maximum(evidence, 0.0)
        if not given.any():
            return np.ones(len(given))
        arms = self.middles - given @ self.middles / given.sum()
        arms /= max(math.sqrt(given @ (arms * arms).sum(axis=1) / given.sum()), 1.0)
        along = self.across[:, ::-1] * (1.0, -1.0)
        # How a shift along x and y and a turn move each piece, in both directions.
        moved_across, moved_along = (
            np.column_stack((way, arms[:, 0] * way[:, 1] - arms[:, 1] * way[:, 0]))
            for way in (self.across, along)
        )
        held = np.divide(given, self.alike @ given, out=np.zeros_like(given), where=given > 0.0)
        crooked = held * (1.0 - self.straight)
        fitted = np.linalg.pinv(
            (moved_across.T * held) @ moved_across + (moved_along.T * crooked) @ moved_along,
            hermitian=True,
        )
        spent = ((moved_across @ fitted) * moved_across).sum(axis=1)
        return np.asarray(1.0 - self.straight * np.clip(spent, 0.0, 1.0))


def piece_lines(
    points: npt.NDArray[np.int32],
    starts: npt.NDArray[np.int32],
    squares: npt.NDArray[np.int64],
    width: float,
    apart: int,
) -> PieceLines:
    """Return how pieces of wall depend on each other.

    Args:
        points: (N, 2) in half cells, piece by piece.
        starts: (B,) the first point of each piece.
        squares: (B, 2) column and row of each piece, in pieces.
        width: of a wall, cells; walls whose lines are two widths apart are hardly one.
        apart: from this number of pieces apart two pieces are no neighbours; 1: none are.
    """
    counts = np.diff(starts, append=len(points))
    places = points / 2.0
    middles = np.add.reduceat(places, starts, axis=0) / counts[:, None]
    x, y = (places - np.repeat(middles, counts, axis=0)).T
    xx, yy, xy = (np.add.reduceat(part, starts) for part in (x * x, y * y, x * y))
    mean, half = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    spread = np.maximum(mean - half, 0.0) / np.maximum(mean + half, 1e-9)
    # Two points always lie on a line.
    straight = np.where(counts > 2, 1.0 - np.sqrt(spread), 0.0)
    angle = np.arctan2(2.0 * xy, xx - yy) / 2.0
    across = np.stack((-np.sin(angle), np.cos(angle)), axis=1)
    return PieceLines(middles, across, straight, squares, width, apart)
