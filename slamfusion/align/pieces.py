"""What each piece of wall says of each motion: evidence counted by what is independent.

The cells of one wall come to lie on another wall all together, or not at all: a thousand of them
are no thousand witnesses. So the evidence of the cells (see ``wall_evidence``) is summed over
pieces, squares of ``PIECE_M`` of the map that the walls belong to, and pieces are what counts.
A piece is the same piece under every motion, so two motions can be compared piece by piece.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from slamfusion.align.accept import RIVAL_RATIO
from slamfusion.align.cancel import CancelToken, check_cancelled
from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import fixed_similarities
from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import FACING_PARTS

F64 = npt.NDArray[np.float64]

# Side of a piece, metres, where a wall is as wide as this; wider walls have larger pieces.
PIECE_M, PIECE_WIDTH_M = 1.0, 0.15
PIECE_POINTS = 8192
# Where an answer leaves at most a quarter unexplained both maps may be good: then so many times
# what an answer leaves unexplained speaks against it. With 1 a large common ground that fits badly
# holds a small right one back (of 90 halves that share a fifth 60 are believed, with 2 and with 3
# about 70); the highest counts of 156 wrong answers between recorded maps were 0.9, 1.8 and 3.5.
GOOD_DOUBT = 2.0
# A piece fits whole where it gives this share of what it could.
WHOLE = 0.7
FIELD_TOP = 255


@dataclass(frozen=True, eq=False)
class WallPieces:
    """The evidence of each piece of wall of both maps under each motion.

    Attributes:
        evidence: (P, B) nats times metres of wall.
        most: (P, B) what the pieces could have given at most where the other map has seen
            something: it is known, or near a wall.
        share_most: (P, B) the same of which the evidence is a share. Of good maps only where the
            other map knows its ground; elsewhere what the pieces give, since what was not seen
            contradicts nothing: a strip of common ground ends in cuts through walls.
        seen_m: (P,) metres of wall that lie where the other map has seen something.
        doubt: how much what a piece could have given and does not give speaks against a motion.
            The table of evidence is kind to maps that are bent or old; of two good maps of one
            place little stays unexplained, and 1 doubts each motion that leaves more.
    """

    evidence: F64
    most: F64
    share_most: F64
    seen_m: F64
    doubt: float = 0.0

    @cached_property
    def weighed(self) -> F64:
        """(P, B) the evidence less ``doubt`` times what stays unexplained."""
        if self.doubt == 0.0:
            return self.evidence
        return np.asarray(self.evidence - self.doubt * (self.most - self.evidence))

    @cached_property
    def total(self) -> F64:
        """(P,) what is weighed, of all pieces: nats times metres, the mean of both maps' walls."""
        return np.asarray(self.weighed.sum(axis=1))

    def take(self, order: npt.NDArray[np.intp]) -> WallPieces:
        """Return the same of some motions, in another order."""
        return replace(
            self,
            evidence=self.evidence[order],
            most=self.most[order],
            share_most=self.share_most[order],
            seen_m=self.seen_m[order],
        )

    def joined(self, other: WallPieces) -> WallPieces:
        """Return the same of further motions, of the same pieces."""
        return replace(
            self,
            evidence=np.concatenate((self.evidence, other.evidence)),
            most=np.concatenate((self.most, other.most)),
            share_most=np.concatenate((self.share_most, other.share_most)),
            seen_m=np.concatenate((self.seen_m, other.seen_m)),
        )

    def share(self) -> F64:
        """Return (P,) the evidence as a share of what the common ground could give."""
        most = np.maximum(self.share_most.sum(axis=1), 1e-9)
        return np.asarray(self.evidence.sum(axis=1) / most)

    def whole(self, k: int = 0) -> float:
        """Return the share of what common ground could give motion k in pieces that fit whole.

        Of sharp maps a piece fits or it does not; of maps that are bent most fit in part.
        """
        most = self.most[k]
        fits = self.evidence[k] >= WHOLE * most
        return float(most[fits].sum() / max(float(most.sum()), 1e-9))

    def witnesses(self, k: int = 0) -> float:
        """Return how many pieces of equal weight would say what the pieces say of motion k."""
        return _witnesses(self.weighed[k])

    def better(self, k: int, other: int) -> float:
        """Return how many pieces of equal weight would say that k is better than the other."""
        weighed = self.weighed
        return _witnesses(weighed[k] - weighed[other])

    def against(self, rival: int) -> float:
        """Return how many pieces the first motion has for it against a rival, as a judge counts.

        Where the maps are taken for good ones (``doubt``) and the rival gives more than
        ``RIVAL_RATIO`` of the evidence, fewer than ``better``; none where both give the same.
        """
        better, total = self.better(0, rival), self.total
        if self.doubt == 0.0 or better <= 0.0 or total[0] <= 0.0:
            return better
        lead = 1.0 - max(0.0, float(total[rival] / total[0]))
        return better * min(1.0, lead / (1.0 - RIVAL_RATIO))


def _witnesses(values: F64) -> float:
    """Return (sum)^2 / sum of squares, with the sign of the sum."""
    squares = float(np.sum(values * values))
    total = float(values.sum())
    return 0.0 if squares == 0.0 else total * abs(total) / squares


def wall_pieces(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    sigma: float,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
    *,
    scales: F64 | None = None,
    points: int = PIECE_POINTS,
    sided: bool = False,
) -> WallPieces:
    """Return what each piece of wall says of each motion.

    Args:
        reference, moving: the two grids.
        motions: (P, 3) where the moving centre lands, cells, and yaw.
        sigma: width of a wall in cells.
        device: holds the fields.
        cancel: asked before each operation.
        scales: (P,) how much longer the moving map's metre is taken, about its centre; None: 1.
        points: at most this many wall points of each grid are looked at; each stands for its share.
        sided: as of good maps: a wall that was seen from another side is another wall, and where
            a map knows nothing no more could be given than is. Maps that are bent, or old, draw
            walls too badly for that.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    there, back = fixed_similarities(motions, moving.centre, scales)
    sides = ((moving, there, reference), (reference, back, moving))
    found = []
    for own, pose, other in sides:
        check_cancelled(cancel)
        found.append(_side(own, pose, other, sigma, points, device, cancel, sided=sided))
    evidence, most, share_most, seen_m = zip(*found, strict=True)
    return WallPieces(
        np.concatenate(evidence, axis=1),
        np.concatenate(most, axis=1),
        np.concatenate(share_most, axis=1),
        np.asarray(seen_m[0] + seen_m[1]),
    )


def _side(
    own: GridFeatures,
    poses: npt.NDArray[np.int64],
    other: GridFeatures,
    sigma: float,
    most_points: int,
    device: ComputeDevice,
    cancel: CancelToken | None,
    *,
    sided: bool,
) -> tuple[F64, F64, F64, F64]:
    """Return (P, B) evidence, ``most`` and ``share_most`` of one map's pieces, (P,) metres seen."""
    size = own.grid.grid.resolution
    level = own.level(1, cancel)
    side = PIECE_M * max(1.0, sigma * size / PIECE_WIDTH_M)
    points, starts = own.pieces(size / (2.0 * side), most_points, cancel)
    # Half: both maps' walls are counted.
    metres = 0.5 * size * len(level.points) / max(1, len(points))
    table = other.evidence_table(1, sigma, FIELD_TOP, cancel)
    seen = other.seen(int((2.0 * sigma) ** 2), cancel)
    field, most_field, facing = other.field(1, table, cancel), seen, seen
    sides = np.zeros(len(points), dtype=np.uint8)
    if sided:
        check_cancelled(cancel)
        facing = other.facing(cancel)
        sides = device.download(own.facing(cancel))[points[:, 1] // 2, points[:, 0] // 2]
        most_cells = device.download(field) - np.uint8(table.base)
        most_cells[other.grid.cells >= 0] = table.span
        most_field = device.upload(most_cells)
    check_cancelled(cancel)
    turns = np.rint(np.arctan2(poses[:, 1], poses[:, 0]) * (FACING_PARTS / (2.0 * math.pi)))
    sums = device.piece_sums(
        points,
        starts,
        sides,
        poses,
        turns.astype(np.int32),
        field,
        most_field,
        seen,
        facing,
        table.base,
    )
    most = sums[:, :, 1].astype(np.float64)
    given, could, met = (sums[:, :, k].astype(np.float64) for k in range(3))
    unit = table.unit * metres
    most = met * (table.span * unit)
    return given * unit, most, could * unit if sided else most, met.sum(axis=1) * metres
