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
from typing import Any

import numpy as np
import scipy

from slamfusion.geometry import F64, I32, I64

# Pairs of pieces that are compared at once: they fit into the processor's cache, and of larger
# products the threads of BLAS only wait for each other.
COMPARED = 1 << 16


@dataclass(frozen=True, eq=False)
class PieceLines:
    """How the pieces of wall of one map depend on each other.

    Attributes:
        middles: (B, 2) x and y of the mean point of each piece, cells.
        across: (B, 2) the unit vector across its wall.
        straight: (B,) from 0 for a crooked piece to 1 for a straight one: 1 less the ratio of the
            spreads of its points across and along.
        alike: (B, B) sparse, the correlation of the fits of two pieces, above the diagonal.
    """

    middles: F64
    across: F64
    straight: F64
    alike: Any

    def squares(self, values: F64) -> F64:
        """Return (...) the sum of r v w over all pairs of values (..., B), r their correlation."""
        others = (values * (self.alike @ values.T).T).sum(axis=-1)
        return np.asarray((values * values).sum(axis=-1) + 2.0 * others)

    def left(self, evidence: F64) -> F64:
        """Return (B,) the share of each piece that a motion fitted to this evidence (B,) leaves."""
        given = np.maximum(evidence, 0.0)
        if not given.any():
            return np.ones(len(given))
        middles, across = self.middles, self.across
        arms = middles - given @ middles / given.sum()
        arms /= max(math.sqrt(given @ (arms * arms).sum(axis=1) / given.sum()), 1.0)
        along = across[:, ::-1] * (1.0, -1.0)
        # How a shift along x and y and a turn move each piece, in both directions.
        moved_across, moved_along = (
            np.column_stack((way, arms[:, 0] * way[:, 1] - arms[:, 1] * way[:, 0]))
            for way in (across, along)
        )
        shared = given + self.alike @ given + self.alike.T @ given
        held = np.divide(given, shared, out=np.zeros_like(given), where=given > 0.0)
        crooked = held * (1.0 - self.straight)
        fitted = np.linalg.pinv(
            (moved_across.T * held) @ moved_across + (moved_along.T * crooked) @ moved_along,
            hermitian=True,
        )
        spent = ((moved_across @ fitted) * moved_across).sum(axis=1)
        return np.asarray(1.0 - self.straight * np.clip(spent, 0.0, 1.0))


def relate_pieces(points: I32, starts: I32, squares: I64, width: float, apart: int) -> PieceLines:
    """Return how the pieces of a map depend on each other.

    Args:
        points: (N, 2) int32 in half cells, piece by piece.
        starts: (B,) the first point of each piece.
        squares: (B, 2) int64 column and row of each piece, in pieces.
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

    # Which later pieces lie near each other's lines; farther off it is less than a hundredth.
    count, (x, y), (to_x, to_y) = len(squares), middles.T, across.T
    places = np.stack((x, y, np.ones(count)), dtype=np.float32)
    lines = np.stack((to_x, to_y, -to_x * x - to_y * y), dtype=np.float32)
    is_near = np.zeros((count, count), dtype=np.bool_)
    some = max(1, COMPARED // max(1, count))
    for first in range(0, count, some):
        here, there = (
            np.abs(one[:, first : first + some].T @ other[:, first:]) < 6.1 * width
            for one, other in ((lines, places), (places, lines))
        )
        np.logical_and(here, there, out=is_near[first : first + some, first:])
    # And the later neighbours, found by their squares, with a margin of squares without a piece.
    col, row = (squares - squares.min(axis=0, initial=0) + apart).T
    shape = col.max(initial=0) + apart + 1, row.max(initial=0) + apart + 1
    piece_at = np.full(shape, -1, np.int32)
    piece_at[col, row] = np.arange(count)
    steps = np.arange(1 - apart, apart)
    around = (steps[:, None] * shape[1] + steps).ravel()
    others = piece_at.ravel()[(col * shape[1] + row)[:, None] + around[around > 0]]
    a, place = np.nonzero(others >= 0)
    is_near[a, others[a, place]] = True
    pairs = np.flatnonzero(is_near)
    a = pairs // max(1, count)
    b = pairs - a * count
    shares = 1.0 - np.arange(apart + 1) / apart
    near = shares[np.minimum(np.abs(col[a] - col[b]), apart)]
    near *= shares[np.minimum(np.abs(row[a] - row[b]), apart)]
    dx, dy = x[a] - x[b], y[a] - y[b]
    off = np.maximum(*(np.abs(dx * to_x[one] + dy * to_y[one]) for one in (a, b)))
    line = straight[a] * straight[b] * np.exp(-0.5 * (off / (2.0 * width)) ** 2)
    both = np.maximum(near, line)
    kept = (both >= 0.01) & (a < b)
    ends = np.searchsorted(a[kept], np.arange(count + 1)).astype(np.int32)
    alike = scipy.sparse.csr_array(
        (both[kept], b[kept].astype(np.int32), ends), shape=(count, count)
    )
    return PieceLines(middles, across, straight, alike)
