"""What each piece of wall says of each motion: evidence counted by what is independent.

The cells of one wall come to lie on another wall all together, or not at all: a thousand of them
are no thousand witnesses. So the evidence of the cells (see ``likelihood``) is summed over
pieces, squares of ``PIECE_M`` of the map that the walls belong to, and pieces are what counts.
A piece is the same piece under every motion, so two motions can be compared piece by piece.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.likelihood import ScoreTable
from slamfusion.align.pair import Pair, fixed_similarities, invert, to_lattice
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import FACING_PARTS
from slamfusion.compute.search import ScoredSide
from slamfusion.geometry import F64

# Side of a piece, metres, where a wall is as wide as this; wider walls have larger pieces.
PIECE_M, PIECE_WIDTH_M = 1.0, 0.15
PIECE_POINTS = 8192
# Wall points of each map by which motions are compared, each stands for its share.
SCORED_POINTS = 4096
# Where an answer leaves at most a quarter unexplained both maps may be good: then so many times
# what an answer leaves unexplained contradicts it. With 1 a large common ground that fits badly
# holds a small right one back (of 90 halves that share a fifth 60 are believed, with 2 and with 3
# about 70); the highest counts of 156 wrong answers between recorded maps were 0.9, 1.8 and 3.5.
GOOD_DOUBT = 2.0
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
        doubt: how much what a piece could have given and does not give contradicts a motion.
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

    def better(self, k: int, other: int) -> float:
        """Return how many pieces of equal weight would say that k is better than the other."""
        return float(pieces_for(self.weighed[k] - self.weighed[other]))


def pieces_for(values: F64, noise: float = 0.0) -> F64:
    """Return how many pieces of equal weight would say what pieces say, with the sign of their sum.

    Args:
        values: (..., B) what each piece says.
        noise: added to the sum of squares, so that little that many say is not much.

    Returns:
        (...,) (sum)^2 / sum of squares.
    """
    squares, total = np.sum(values * values, axis=-1) + noise, values.sum(axis=-1)
    return np.asarray(total * np.abs(total) / np.where(squares > 0.0, squares, 1.0))


def wall_pieces(
    pair: Pair,
    motions: F64,
    sigma: float,
    *,
    scales: F64 | None = None,
    points: int = PIECE_POINTS,
    sided: bool = False,
) -> WallPieces:
    """Return what each piece of wall says of each motion.

    Args:
        motions: (P, 3) where the moving centre lands, cells, and yaw.
        sigma: width of a wall in cells.
        scales: (P,) how much longer the moving map's metre is taken, about its centre; None: 1.
        points: at most this many wall points of each grid are looked at; each stands for its share.
        sided: as of good maps: a wall that was seen from another side is another wall, and where
            a map knows nothing no more could be given than is. Maps that are bent, or old, draw
            walls too badly for that.
    """
    there, back = fixed_similarities(motions, pair.moving.centre, scales)
    sides = ((pair.moving, there, pair.reference), (pair.reference, back, pair.moving))
    found = []
    for own, pose, other in sides:
        found.append(_side(own, pose, other, sigma, points, pair.device, sided=sided))
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
    *,
    sided: bool,
) -> tuple[F64, F64, F64, F64]:
    """Return (P, B) evidence, ``most`` and ``share_most`` of one map's pieces, (P,) metres seen."""
    size = own.grid.grid.resolution
    level = own.level(1)
    side = PIECE_M * max(1.0, sigma * size / PIECE_WIDTH_M)
    points, starts = own.pieces(size / (2.0 * side), most_points)
    # Half: both maps' walls are counted.
    metres = 0.5 * size * len(level.points) / max(1, len(points))
    table = other.evidence_table(1, sigma, FIELD_TOP)
    seen = other.seen(int((2.0 * sigma) ** 2))
    field, most_field, facing = other.field(1, table), seen, seen
    sides = np.zeros(len(points), dtype=np.uint8)
    if sided:
        facing = other.facing()
        sides = device.download(own.facing())[points[:, 1] // 2, points[:, 0] // 2]
        most_cells = device.download(field) - np.uint8(table.base)
        most_cells[other.grid.cells >= 0] = table.span
        most_field = device.upload(most_cells)
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


def score_motions(
    pair: Pair,
    motions: F64,
    step: int,
    *,
    sigma: float,
    points: int = SCORED_POINTS,
    scales: F64 | None = None,
    doubt: float = 0.0,
) -> F64:
    """Return the evidence (P,) for motions at a level, nats summed over cells of wall of both maps.

    Args:
        motions: (P, 3) where the moving centre lands, fine cells, and yaw.
        step: level to work on, fine cells a cell.
        sigma: width of a wall, cells of the level.
        points: at most this many wall points of each grid are looked at; each stands for its share.
        scales: (P,) how much longer the moving map's metre is taken, about its centre; None: 1.
        doubt: see ``likelihood.evidence_table``.
    """
    ref, mov = pair.reference.level(step), pair.moving.level(step)
    local = motions / np.array([step, step, 1.0])
    centre = (pair.moving.centre[0] / step, pair.moving.centre[1] / step)
    there, back = fixed_similarities(local, centre, scales)
    sides, units = [], []
    for own, pose, features in ((mov, there, pair.reference), (ref, back, pair.moving)):
        table = features.evidence_table(step, sigma, FIELD_TOP, doubt)
        field = features.field(step, table)
        sample = spread_sample(own.points, points)
        sides.append(ScoredSide(sample, pose, field, table.base))
        units.append(table.unit * (len(own.points) / len(sample)))
    total = np.zeros(len(motions))
    for values, side, unit in zip(pair.device.pose_scores(*sides), sides, units, strict=True):
        total += (values - len(side.points) * side.base) * unit
    return total


def rank(
    pair: Pair, motions: F64, step: int, table: ScoreTable, *, points: int = SCORED_POINTS
) -> F64:
    """Return the symmetric wall score (P,) of motions at a level; 1 for identical maps."""
    ref, mov = pair.reference.level(step), pair.moving.level(step)
    from_mov = spread_sample(mov.points, points)
    from_ref = spread_sample(ref.points, points)
    local = motions / np.array([step, step, 1.0])
    poses = to_lattice(local, (pair.moving.centre[0] / step, pair.moving.centre[1] / step))
    sides = (
        (from_mov, poses, pair.reference, ref, len(mov.points)),
        (from_ref, invert(poses), pair.moving, mov, len(ref.points)),
    )
    total = np.zeros(len(motions))
    weight = 0.0
    for sample, own, features, level, count in sides:
        field = features.field(level.step, table)
        counts = pair.device.pose_counts(
            sample,
            fixed_poses(own),
            field,
            level.distance2,
            level.free,
            base=table.base,
            near2=0,
            far2=0,
        )
        mean = (counts[:, 0] / len(sample) - table.base) / table.span
        total += mean * count
        weight += count
    return total / weight


def walls_found(pair: Pair, motions: F64, sigma: float, scales: F64, points: int) -> F64:
    """Return the evidence (P,) that the reference's walls are in the moving map, nats and metres.

    Args:
        pair, motions, sigma, scales, points: see ``wall_pieces``.
    """
    _, back = fixed_similarities(motions, pair.moving.centre, scales)
    found, *_ = _side(pair.reference, back, pair.moving, sigma, points, pair.device, sided=False)
    return np.asarray(found.sum(axis=1))
