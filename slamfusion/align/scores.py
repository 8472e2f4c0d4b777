"""Evidence of each piece of wall for each motion.

The cells of one wall fall on another wall all together, or not at all, so they are not independent.
So the evidence of cells (see ``likelihood``) is summed over pieces, squares of ``PIECE_M`` of the
map that the walls belong to. A piece is the same under every motion, so two motions can be compared
piece by piece.
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

# Side of a piece, metres, for walls of this width; wider walls have larger pieces.
PIECE_M, PIECE_WIDTH_M = 1.0, 0.15
PIECE_POINTS = 8192
# Sampled wall points of each map; each stands for its share.
SCORED_POINTS = 4096
# Factor on the unexplained evidence if at most a quarter is unexplained and both maps may be good.
# With 1 a large common ground that fits badly outweighs a small right one.
GOOD_DOUBT = 2.0
FIELD_TOP = 255


@dataclass(frozen=True, eq=False)
class WallPieces:
    """The evidence of each piece of wall of both maps under each motion.

    Attributes:
        evidence: (P, B) nats times metres of wall.
        most: (P, B) the greatest possible evidence of the pieces where the other map is known, or
            near a wall.
        share_most: (P, B) the reference value for ``share``. For good maps only where the other map
            is known; elsewhere what the pieces give, since unseen ground contradicts nothing.
        seen_m: (P,) metres of wall where the other map has seen something.
        doubt: weight of the unexplained evidence against a motion. The table of evidence suits bent
            and old maps; two good maps of one place leave little unexplained.
    """

    evidence: F64
    most: F64
    share_most: F64
    seen_m: F64
    doubt: float = 0.0

    @cached_property
    def weighed(self) -> F64:
        """(P, B) the evidence less ``doubt`` times the unexplained part."""
        if self.doubt == 0.0:
            return self.evidence
        return np.asarray(self.evidence - self.doubt * (self.most - self.evidence))

    @cached_property
    def total(self) -> F64:
        """(P,) the weighed evidence of all pieces, nats times metres, mean of both maps."""
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
        """Return the number of pieces of equal weight that prefer motion k to the other."""
        return float(pieces_for(self.weighed[k] - self.weighed[other]))


def pieces_for(values: F64, noise: float = 0.0) -> F64:
    """Return (sum)^2 / sum of squares of ``values`` (..., B), with the sign of the sum.

    This is the equivalent number of pieces of equal weight. ``noise`` is added to the sum of
    squares, so that small values of many pieces do not count.
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
    """Return the evidence of each piece of wall for each motion.

    Args:
        motions: (P, 3) where the moving centre lands, cells, and yaw.
        sigma: width of a wall in cells.
        scales: (P,) enlarge the moving map about its centre; None: 1.
        points: at most this number of wall points of each grid; each stands for its share.
        sided: for good maps: a wall seen from another side is another wall, and unknown ground
            lowers no share. Bent or old maps are too inaccurate for that.
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
    # Half, since both maps' walls are counted.
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
        points: at most this number of wall points of each grid; each stands for its share.
        scales: (P,) enlarge the moving map about its centre; None: 1.
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
    """Return the evidence (P,) for the reference's walls in the moving map; see ``wall_pieces``."""
    _, back = fixed_similarities(motions, pair.moving.centre, scales)
    found, *_ = _side(pair.reference, back, pair.moving, sigma, points, pair.device, sided=False)
    return np.asarray(found.sum(axis=1))
