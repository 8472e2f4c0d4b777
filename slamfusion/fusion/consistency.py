"""Which inputs agree: the largest group whose pairwise transforms close.

A pair that was rejected connects nothing, but the others of a group imply a transform for it. Where
that lays much of the two maps on one ground, the group needs a reason to stand: see ``Stands``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slamfusion.align.records import Alignment
from slamfusion.geometry import Pose2, wrap_angle

# Told a rejected pair and the transform that the accepted pairs of a group imply for it (moving map
# frame to the reference's): whether the group may stand although the pair was rejected.
Stands = Callable[[Alignment, Pose2], bool]

CLOSURE_CELLS = 12.0
CLOSURE_YAW_RAD = math.radians(3.0)
EXHAUSTIVE_INPUTS = 12
# Statistic of a pair whose paths were held against each other and agree: their median gap, metres.
PATH_GAP = "path_gap_m"


@dataclass(frozen=True)
class Group:
    """Inputs that fit together.

    Attributes:
        members: their names, in input order.
        score: sum of the scores of the accepted pairs inside.
    """

    members: tuple[str, ...]
    score: float


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
    stands: Stands | None = None,
) -> Group:
    """Return the largest connected group of inputs whose accepted triangles all close.

    A triangle whose three pairs have paths that agree is closed by them: bent maps of one drive
    lock on each other here in one pair and there in the next. Of a group in which a pair was
    rejected ``stands`` must hold.

    Of equally large groups the one with the greater sum of scores, then the earlier inputs.

    Args:
        names: all inputs, in order. pairs: every alignment, accepted or not. centres: centre of
        each input's known box in its map frame, metres. resolution: metres per cell; a triangle
        closes within 12 cells and 3 degrees, the sum of what
            three alignments of bent maps may each be off.
        stands: asked of each rejected pair inside a group that closes; None: rejected pairs break
            nothing.
    """
    edges = {frozenset((p.reference, p.moving)): p for p in pairs if p.accepted}
    is_many = len(names) > EXHAUSTIVE_INPUTS
    for size in range(len(names), 1, -1):
        if is_many and size < len(names) - 2:
            break
        best: Group | None = None
        for members in itertools.combinations(names, size):
            inside = {key: pair for key, pair in edges.items() if key <= set(members)}
            if not _is_connected(members, inside):
                continue
            if not _closes(members, inside, centres, resolution):
                continue
            if not _stands(members, pairs, stands):
                continue
            group = Group(members, _sum_of_scores(inside))
            if best is None or group.score > best.score:
                best = group
        if best is not None:
            return best
    if is_many:
        return _grown_group(names, pairs, centres, resolution, stands)
    return Group(tuple(names[:1]), 0.0)


def _is_connected(members: Sequence[str], edges: dict[frozenset[str], Alignment]) -> bool:
    """Whether every member is reached from the first over accepted pairs."""
    reached, fresh = {members[0]}, [members[0]]
    while fresh:
        here = fresh.pop()
        for key in edges:
            if here in key:
                (other,) = key - {here}
                if other not in reached:
                    reached.add(other)
                    fresh.append(other)
    return len(reached) == len(members)


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


def _stands(members: Sequence[str], pairs: Sequence[Alignment], stands: Stands | None) -> bool:
    """Whether no rejected pair among the members speaks against them."""
    if stands is None:
        return True
    for pair in pairs:
        if pair.accepted or not {pair.reference, pair.moving} <= set(members):
            continue
        implied = path_transform(pair.moving, pair.reference, members, pairs)
        if implied is not None and not stands(pair, implied):
            return False
    return True


def _grown_group(
    names: Sequence[str],
    pairs: Sequence[Alignment],
    centres: dict[str, tuple[float, float]],
    resolution: float,
    stands: Stands | None,
) -> Group:
    """Return a group grown from the best pairs, for more inputs than can be tried exhaustively."""
    edges = {frozenset((p.reference, p.moving)): p for p in pairs if p.accepted}
    best = Group(tuple(names[:1]), 0.0)
    for seed in sorted(edges.values(), key=lambda pair: -pair.score)[: len(names)]:
        members = [name for name in names if name in {seed.reference, seed.moving}]
        for name in names:
            if name in members:
                continue
            trial = [*members, name]
            inside = {key: pair for key, pair in edges.items() if key <= set(trial)}
            is_one = _is_connected(trial, inside) and _closes(trial, inside, centres, resolution)
            if is_one and _stands(trial, pairs, stands):
                members = trial
        inside = {key: pair for key, pair in edges.items() if key <= set(members)}
        ordered = tuple(name for name in names if name in members)
        group = Group(ordered, _sum_of_scores(inside))
        if rank_of(group, names) > rank_of(best, names):
            best = group
    return best


def _sum_of_scores(pairs: dict[frozenset[str], Alignment]) -> float:
    """Return the sum, rounded once: the same in whatever order the pairs come."""
    return math.fsum(pair.score for pair in pairs.values())


def rank_of(group: Group, names: Sequence[str]) -> tuple[int, float, list[int]]:
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
    found = {source: Pose2()}
    fresh = [source]
    while fresh and target not in found:
        following = []
        for here in fresh:
            for name in members:
                pair = edges.get(frozenset((here, name)))
                if name not in found and pair is not None:
                    found[name] = motion_from(pair, here).compose(found[here])
                    following.append(name)
        fresh = following
    return found.get(target)
