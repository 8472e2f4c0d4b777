"""Evidence of each piece of wall for each motion.

The cells of one wall fall on another wall all together, or not at all, so they are not independent.
So the evidence of cells (see ``likelihood``) is summed over pieces, squares of ``PIECE_M`` of the
map that the walls belong to. A piece is the same under every motion, so two motions can be compared
piece by piece. Pieces are not independent either, see ``lines``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slamfusion.align.features import FIELD_TOP, FINE_TABLE, GridFeatures
from slamfusion.align.lines import PieceLines
from slamfusion.align.pair import Pair
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.compute.search import STEPS, CountedSide, ScoredSide
from slamfusion.compute.wall_pieces import PieceSide
from slamfusion.geometry import F64, I32, I64

# Side of a piece, metres, for walls of this width; wider walls have larger pieces.
PIECE_M, PIECE_WIDTH_M = 1.0, 0.15
# From this number of pieces apart two pieces of good maps are no neighbours: 3 m, the size of large
# furniture or of a small room.
ALIKE = 3
# Sampled wall points of each map for pieces; each stands for its share.
PIECE_POINTS = 8192
# Sampled wall points of each map; each stands for its share.
SCORED_POINTS = 4096
# Factor on the unexplained evidence if at most a quarter is unexplained and both maps may be good.
# With 1 a large common ground that fits badly outweighs a small right one.
GOOD_DOUBT = 2.0


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
        lines: how the pieces depend on each other, of the moving map's and the reference's.
        doubt: weight of the unexplained evidence against a motion. The table of evidence suits bent
            and old maps; two good maps of one place leave little unexplained.
    """

    evidence: F64
    most: F64
    share_most: F64
    seen_m: F64
    lines: tuple[PieceLines, PieceLines]
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
        """Return (P,) the evidence, if any, as a share of what the common ground could give."""
        most = np.maximum(self.share_most.sum(axis=1), 1e-9)
        return np.asarray(np.maximum(self.evidence.sum(axis=1), 0.0) / most)

    def count(self, values: F64, noise: float = 0.0, left: F64 | float = 1.0) -> F64:
        """Return the number of independent pieces of equal weight among values (..., B).

        This is (sum)^2 / (the sum of r v w over all pairs of pieces) with values v and w and their
        correlation r; it has the sign of the sum. ``noise`` is added to the divisor, so that small
        values of many pieces do not count. Of a positive number only the share counts that is
        ``left`` (B,) of the values.
        """
        squares = np.asarray(noise)
        for part, lines in zip(self._by_map(values), self.lines, strict=True):
            squares = squares + lines.squares(part)
        total = values.sum(axis=-1)
        kept = np.where(total > 0.0, np.clip((values * left).sum(axis=-1), 0.0, total), -total)
        return np.asarray(total * kept / np.where(squares > 0.0, squares, 1.0))

    def left(self, row: int) -> F64:
        """Return (B,) the share of each piece that proves something, see ``lines``."""
        parts = zip(self._by_map(self.weighed[row]), self.lines, strict=True)
        return np.concatenate([lines.left(part) for part, lines in parts])

    def _by_map(self, values: F64) -> list[F64]:
        """Return values (..., B) of the moving map's pieces, and the reference's."""
        return np.split(values, [len(self.lines[0].straight)], axis=-1)


def start_pieces(
    pair: Pair, motions: F64, sigma: float, *, scales: F64 | None = None, sided: bool = False
) -> Callable[[], WallPieces]:
    """Start to weigh each piece of wall for each motion.

    Args:
        motions: (P, 3) where the moving centre lands, cells, and yaw.
        sigma: width of a wall in cells.
        scales: (P,) enlarge the moving map about its centre; None: 1.
        sided: for good maps: a wall seen from another side is another wall, unknown ground lowers
            no share, and what stays unexplained contradicts. Bent or old maps are too inaccurate
            for that.

    Returns:
        A function that waits for the device, and returns the evidence.
    """
    sides = list(pair.sides(motions, scales=scales))
    started = _start_pieces(pair, sides, sigma, PIECE_POINTS, sided=sided)
    lines, others = (_piece_lines(own, pair, sigma, sided=sided) for own, _, _ in sides)

    def weighed() -> WallPieces:
        evidence, most, share_most, seen_m = zip(*started(), strict=True)
        return WallPieces(
            np.concatenate(evidence, axis=1),
            np.concatenate(most, axis=1),
            np.concatenate(share_most, axis=1),
            np.asarray(seen_m[0] + seen_m[1]),
            (lines, others),
            GOOD_DOUBT if sided else 0.0,
        )

    return weighed


def cut_pieces(pair: Pair, sigma: float) -> None:
    """Make what the host makes of each map for ``start_pieces`` of good maps."""
    for own in pair:
        own.pieces(_piece_sides(pair, sigma), PIECE_POINTS)
        _piece_lines(own, pair, sigma, sided=True)


def _piece_lines(own: GridFeatures, pair: Pair, sigma: float, *, sided: bool) -> PieceLines:
    """Return how the pieces of a map depend on each other."""
    apart = ALIKE if sided else 1
    return own.piece_lines(_piece_sides(pair, sigma), PIECE_POINTS, sigma, apart)


def _piece_sides(pair: Pair, sigma: float) -> float:
    """Return half a cell in sides of a piece."""
    size = pair.resolution
    return size / (2.0 * (PIECE_M * max(1.0, sigma * size / PIECE_WIDTH_M)))


def _start_pieces(
    pair: Pair,
    sides: Sequence[tuple[GridFeatures, F64, GridFeatures]],
    sigma: float,
    most_points: int,
    *,
    sided: bool,
) -> Callable[[], list[tuple[F64, F64, F64, F64]]]:
    """Start on what ``WallPieces`` has of each map's pieces.

    Of each side: a map, motions (4, P), and the other map.
    """
    cut = _piece_sides(pair, sigma), most_points
    looked_up, facts = [], []
    for own, motions, other in sides:
        table, words = other.piece_words(sigma)
        looked_up.append(PieceSide(own.pieces(*cut), motions, words, table.base))
        facts.append((table, len(own.level(1).points)))
    started = pair.device.start_piece_sums(*looked_up, sided=sided)

    def weighed() -> list[tuple[F64, F64, F64, F64]]:
        found = []
        for (table, walls), (given, could, met) in zip(facts, started(), strict=True):
            # Half, since both maps' walls are counted.
            metres = 0.5 * pair.resolution * walls / max(1, min(walls, most_points))
            unit = table.unit * metres
            most = met * (table.span * unit)
            share_most = could * unit if sided else most
            seen_m = met.sum(axis=1) * metres
            found.append((given * unit, most, share_most, seen_m))
        return found

    return weighed


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
    ways = pair.sides(motions, step, scales)
    return _scored(pair.device.pose_scores, ways, step, sigma, points, doubt)


def score_neighbours(
    pair: Pair, motions: F64, step: int, *, shift: float, turn: float, sigma: float, points: int
) -> F64:
    """Return ``score_motions`` (P, 27) of motions and their neighbours, see ``neighbour_offsets``.

    Args:
        shift, turn: to the next neighbour, fine cells and rad.
    """
    turned = (motions + np.array([0.0, 0.0, turn]) * np.array(STEPS)[:, None, None]).reshape(-1, 3)
    (mov, there, _), (ref, back, _) = pair.sides(turned, step)
    # A step along x of the reference, half cells, on either map.
    own, along = 2.0 * shift / step, np.zeros((2, len(turned)))
    along[0] = np.rint(own * FIXED_ONE)
    ways = (
        (mov, np.concatenate((there, along)), ref),
        (ref, np.concatenate((back, np.rint(-own * back[:2]))), mov),
    )
    found = _scored(pair.device.neighbour_scores, ways, step, sigma, points)
    return found.reshape(len(STEPS), len(motions), -1).transpose(1, 2, 0).reshape(len(motions), -1)


def neighbour_offsets(shift: float, turn: float) -> F64:
    """Return (27, 3) the steps to a motion and its neighbours: x slowest, turns fastest."""
    steps = np.stack(np.meshgrid(STEPS, STEPS, STEPS, indexing="ij"), axis=-1)
    return np.asarray(steps.reshape(-1, 3) * np.array([shift, shift, turn]))


def _scored(
    score: Callable[..., list[I32]],
    ways: Iterable[tuple[GridFeatures, F64, GridFeatures]],
    step: int,
    sigma: float,
    points: int,
    doubt: float = 0.0,
) -> F64:
    """Return the evidence for the walls of each map on the other's field, nats, of both maps."""
    sides, units = [], []
    for own, motions, other in ways:
        table, field = other.field(step, sigma, FIELD_TOP, doubt)
        sample = own.wall_planes(step, points)
        sides.append(ScoredSide(sample, motions, field, table.base))
        units.append(table.unit * (len(own.level(step).points) / sample.count))
    parts = zip(score(*sides), sides, units, strict=True)
    ours, theirs = ((values - side.points.count * side.base) * unit for values, side, unit in parts)
    return ours + theirs


def rank(pair: Pair, met: Sequence[I64]) -> F64:
    """Return the symmetric wall score (P,) of motions by what walls meet; 1 for identical maps."""
    walls = [len(own.level(1).points) for own in (pair.moving, pair.reference)]
    total = np.zeros(len(met[0]))
    for counts, wall in zip(met, walls, strict=True):
        mean = counts[:, 0] / min(wall, SCORED_POINTS)
        total += wall * ((mean - FINE_TABLE.base) / FINE_TABLE.span)
    return total / float(sum(walls))


def count_met(
    pair: Pair,
    motions: F64,
    most: int,
    limits2: Sequence[int] = (),
    *,
    solid: Sequence[bool] = (False,),
) -> list[I64]:
    """Return what ``most`` sampled walls of each map, the moving first, meet on the other.

    See ``wall_sample`` and ``pose_counts``; the worth is that of ``rank``. All that are ``solid``
    follow the others where both are wanted.
    """
    sides = [
        CountedSide(own.wall_sample(most, solid=kind), ways, other.cells, other.level(1).distance2)
        for kind in solid
        for own, ways, other in pair.sides(motions)
    ]
    worths, base = FINE_TABLE.worths, FINE_TABLE.base
    return pair.device.pose_counts(*sides, worths=worths, base=base, limits2=limits2)


def walls_found(pair: Pair, motions: F64, sigma: float, scales: F64, points: int) -> F64:
    """Return the evidence (P,) for the reference's walls in the moving map; see ``WallPieces``."""
    _, side = pair.sides(motions, scales=scales)
    ((found, *_),) = _start_pieces(pair, [side], sigma, points, sided=False)()
    return np.asarray(found.sum(axis=1))
