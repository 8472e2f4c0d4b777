"""Which inputs agree: the largest group whose pairwise transforms close.

A pair that was rejected connects nothing, but the others of a group imply a transform for it. Where
that lays much of the two maps on one ground, their walls must support it there.

Maps that share little may each fit a third: the pair is rejected, the group stands. Few poses are
left to chance under an implied transform, so far less evidence does than a search would need.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slamfusion.align.align import track_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.hypotheses import is_distinct
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.geometry import Pose2, wrap_angle

CLOSURE_CELLS = 12.0
CLOSURE_YAW_RAD = math.radians(3.0)
# Statistic of a pair whose paths were held against each other and agree: their median gap, metres.
PATH_GAP = "path_gap_m"
# Ground that both maps know, as a share of the smaller one's: on less their walls need not meet.
MUCH_GROUND = 0.3


@dataclass(frozen=True, eq=False)
class MapGroup:
    """Inputs that fit together.

    Attributes:
        members: their names, in input order.
        score: sum of the scores of the accepted pairs inside.
        poses: of each map's frame in that of the first member, metres, where all alignments were
            solved together; None: each alignment is taken as it is.
    """

    members: tuple[str, ...]
    score: float
    poses: Mapping[str, Pose2] | None = None


def motion_from(pair: Alignment, source: str) -> Pose2:
    """Return the transform from ``source``'s frame into the other's."""
    return pair.transform if pair.moving == source else pair.transform.inverse()


def closure_error(
    a_to_b: Pose2, b_to_c: Pose2, c_to_a: Pose2, point: tuple[float, float]
) -> tuple[float, float]:
    """Return how far a point of a's frame lands from itself after a to b to c to a: m and rad."""
    around = c_to_a.compose(b_to_c).compose(a_to_b)
    landed = around.transform(point)
    return math.dist(landed, point), abs(wrap_angle(around.yaw_rad))


def largest_group(
    names: Sequence[str],
    pairs: Sequence[Alignment],
    centres: dict[str, tuple[float, float]],
    resolution: float,
    implied: ImpliedPairs | None = None,
) -> MapGroup:
    """Return the largest connected group of inputs whose accepted triangles all close.

    A triangle whose three pairs have paths that agree is closed by them: bent maps of one drive
    lock on each other here in one pair and there in the next. Of a group in which a pair was
    rejected the walls of the pair must not contradict it.

    Of equally large groups the one with the greater sum of scores, then the earlier inputs.

    Args:
        names: all inputs, in order. pairs: every alignment, accepted or not. centres: centre of
        each input's known box in its map frame, metres. resolution: metres per cell; a triangle
        closes within 12 cells and 3 degrees, the sum of what
            three alignments of bent maps may each be off.
        implied: looks at each rejected pair inside a group that closes; None: rejected pairs break
            nothing.
    """
    edges = {frozenset((p.reference, p.moving)): p for p in pairs if p.accepted}
    for size in range(len(names), 1, -1):
        best: MapGroup | None = None
        for members in itertools.combinations(names, size):
            inside = {key: pair for key, pair in edges.items() if key <= set(members)}
            if len(_reached(members[0], members, inside)) < size:
                continue
            if not _closes(members, inside, centres, resolution):
                continue
            if not _stands(members, pairs, implied):
                continue
            group = MapGroup(members, math.fsum(pair.score for pair in inside.values()))
            if best is None or group.score > best.score:
                best = group
        if best is not None:
            return best
    return MapGroup(tuple(names[:1]), 0.0)


def _closes(
    members: Sequence[str],
    edges: dict[frozenset[str], Alignment],
    centres: dict[str, tuple[float, float]],
    resolution: float,
) -> bool:
    """Whether every triangle of accepted pairs among the members closes."""
    for a, b, c in itertools.combinations(members, 3):
        sides = [edges.get(frozenset(side)) for side in ((a, b), (b, c), (c, a))]
        if any(side is None for side in sides):
            continue
        if all(side is not None and PATH_GAP in side.statistics for side in sides):
            continue
        ab, bc, ca = (side for side in sides if side is not None)
        shift, turn = closure_error(
            motion_from(ab, a), motion_from(bc, b), motion_from(ca, c), centres[a]
        )
        if shift > CLOSURE_CELLS * resolution or turn > CLOSURE_YAW_RAD:
            return False
    return True


def _stands(
    members: Sequence[str], pairs: Sequence[Alignment], implied: ImpliedPairs | None
) -> bool:
    """Whether no rejected pair among the members contradicts them."""
    if implied is None:
        return True
    for pair in pairs:
        if pair.accepted or not {pair.reference, pair.moving} <= set(members):
            continue
        over = path_transform(pair.moving, pair.reference, members, pairs)
        if over is not None and not implied.look(pair.reference, pair.moving, over).stands:
            return False
    return True


def rank_of(group: MapGroup, names: Sequence[str]) -> tuple[int, float, list[int]]:
    """Return what the better of two groups has more of: members, score, early inputs."""
    return len(group.members), group.score, [-names.index(name) for name in group.members]


def path_transform(
    source: str, target: str, members: Sequence[str], pairs: Sequence[Alignment]
) -> Pose2 | None:
    """Return the transform from source to target over the fewest accepted pairs of the group.

    Of equally short paths the first by input order; None when there is none.
    """
    edges = {
        frozenset((p.reference, p.moving)): p
        for p in pairs
        if p.accepted and p.reference in members and p.moving in members
    }
    return _reached(source, members, edges).get(target)


def _reached(
    source: str, members: Sequence[str], edges: Mapping[frozenset[str], Alignment]
) -> dict[str, Pose2]:
    """Return the transform to each member that accepted pairs reach, over the fewest of them."""
    found = {source: Pose2()}
    fresh = [source]
    while fresh:
        following = []
        for here in fresh:
            for name in members:
                pair = edges.get(frozenset((here, name)))
                if name not in found and pair is not None:
                    found[name] = motion_from(pair, here).compose(found[here])
                    following.append(name)
        fresh = following
    return found


@dataclass(frozen=True)
class Implied:
    """The outcome for a rejected pair under the transform that others imply.

    Attributes:
        alignment: refined from there.
        stands: whether the pair contradicts no group.
        words: why, in a few words.
        is_borne_out: whether walls on common ground, be it much or little, say that it lies there.
    """

    alignment: Alignment
    stands: bool
    words: str
    is_borne_out: bool = False


class ImpliedPairs:
    """Looks at rejected pairs under implied transforms, at each only once."""

    def __init__(self, features: dict[str, GridFeatures], pairs: int) -> None:
        """Keep the maps by name, and how many pairs the job has."""
        self.features, self.pairs = features, pairs
        self.seen: dict[tuple[str, str, Pose2], Implied] = {}

    def look(self, reference: str, moving: str, transform: Pose2) -> Implied:
        """Return what the walls of two maps say of a transform that others imply.

        Args:
            reference, moving: names of the maps.
            transform: moving map frame to the reference's, metres.
        """
        key = reference, moving, transform
        if key not in self.seen:
            self.seen[key] = self._look(reference, moving, transform)
        return self.seen[key]

    def words_against(self, pair: Alignment) -> str:
        """Return what walls say against a pair where others put it, to end a reason; or nothing."""
        for (reference, moving, _), found in self.seen.items():
            if (reference, moving) == (pair.reference, pair.moving) and not found.stands:
                return f"; where the others put it, it gives {found.words}"
        return ""

    def _look(self, still: str, moved: str, transform: Pose2) -> Implied:
        pair = Pair(self.features[still], self.features[moved])
        found = track_pair(pair, transform, self.pairs)
        little = ""
        if found.overlap < MUCH_GROUND:
            little = f"{found.overlap:.0%} of the ground in common"
        evidence = found.evidence
        if evidence is None:
            return Implied(found, bool(little), little or "no walls")
        went = is_distinct(pair.motion_of(found.transform), pair.motion_of(transform))
        words = f"{evidence.share:.0%} of what {evidence.common_m:.0f} m of common walls could give"
        is_borne_out = found.accepted and not went
        return Implied(found, is_borne_out or bool(little), little or words, is_borne_out)


def words_over(name: str, found: Alignment) -> str:
    """Return why an input stands that no accepted pair joins to the reference, in one line.

    Args:
        name: of the input.
        found: its alignment to the reference where the pairs between imply it.
    """
    said = f"accepted over others: as a pair with {found.reference}, {name} was rejected"
    if found.evidence is None:
        return said
    share, metres = found.evidence.share, found.evidence.common_m
    return f"{said}; here they give {share:.0%} of what {metres:.0f} m of common walls could"
