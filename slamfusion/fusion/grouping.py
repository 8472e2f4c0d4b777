"""Groups of maps that fit together, of two maps or of a thousand, and the poses of their maps.

Alignments join maps to groups: a spanning tree, the strongest first if all pairs were aligned, else
the most promising. Then loops are closed. An alignment between two maps of a group must agree with
the tree. A pair without one, on ground that both maps know, must have walls that agree there
(``GroupSearch.look``); if they contradict, it is aligned in full, and a different or missing result
contradicts the links of its path (``AlignmentGraph``). The most contradicted links are removed, and
the groups are grown again. The poses are those that fit all links of a group best.

Many pairs are ranked by the lead of their best shift at parallel walls over the best shift
elsewhere (``shifts``), and a map that shares nothing with the others is given up after a few
rejections: N^2 coarse comparisons, about N alignments and 2 N checks of a known transform.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slamfusion.align.align import THREADS, align_pair, track_pair
from slamfusion.align.answer import conclude
from slamfusion.align.features import GridFeatures
from slamfusion.align.hypotheses import is_distinct
from slamfusion.align.pair import Pair, displacement
from slamfusion.align.records import Alignment
from slamfusion.align.search import SearchResult
from slamfusion.align.shifts import parallel_shifts
from slamfusion.align.starts import Starts
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import cells_at
from slamfusion.config import AlignConfig, FusionConfig
from slamfusion.fleet import tasks_ahead
from slamfusion.geometry import F64, Pose2, pose_of, row_of
from slamfusion.grid import UNKNOWN
from slamfusion.io.files import return_freed_memory
from slamfusion.pose_graph.graph import PoseGraph
from slamfusion.pose_graph.optimize import optimize
from slamfusion.pose_graph.uncertainty import inverted, moved

# The poses of maps that fit together, in that of the first of them, metres; in input order.
MapGroup = Mapping[str, Pose2]
# Progress callback: stage, steps done, total steps.
Progress = Callable[[str, float, int], None]
# Receives an alignment and its two maps; returns the alignment to use.
SecondLook = Callable[[Alignment, Pair], Alignment]

CLOSURE_CELLS = 12.0
CLOSURE_YAW_RAD = math.radians(3.0)
# Statistic of a pair whose paths were compared and agree: their median gap, metres.
PATH_GAP = "path_gap_m"
# Common ground as a share of the smaller map's, above which walls must meet.
MUCH_GROUND = 0.3
# A group of maps is given up after this number of successive rejections with larger groups.
TRIES = 3
# Least ratio of the best place to the best one elsewhere of a promising pair.
RATIO_MIN = 1.05
# Common ground, as a share of the smaller map's, on which walls may close a loop; they contradict
# one only on much of it (``GroupSearch.look``).
LOOP_GROUND = 0.12
# Wanted loops over each link of the trees, and links of each map.
LOOPS, LINKS = 3, 4
# Points on each side of a map for finding common ground.
GROUND_POINTS = 24
# Factor on the tolerance of a loop of three alignments.
TRIANGLE = 3.0
# Of equally contradicted alignments the weakest is false, and those up to this factor stronger.
NEARLY_AS_STRONG = 2.0
# Deviation of an alignment in the middle between two maps, metres and radians: maps are bent by a
# few cells.
SHIFT_SIGMA_M, YAW_SIGMA_RAD = 0.1, math.radians(0.4)
# With more pairs only promising ones are aligned, and rejected ones are not searched again.
THOROUGH_PAIRS = 15
# An input of more cells keeps no fields after its last pair: they are some 30 bytes a cell.
KEPT_CELLS = 1 << 22


@dataclass(frozen=True, eq=False)
class FusionSetup:
    """What all steps of a fusion take; see ``fuse_grids``.

    Attributes:
        is_stored: the vote runs tile by tile: no fused map stays in memory, and only one input at a
            time.
    """

    config: FusionConfig
    device: ComputeDevice
    progress: Progress | None = None
    second_look: SecondLook | None = None
    starts: Starts | None = None
    executor: Executor | None = None
    is_stored: bool = False


@dataclass(frozen=True)
class Candidate:
    """A pair of maps that may be aligned.

    Attributes:
        a, b: names.
        ratio: evidence for the best place over that for the best one elsewhere, at least 1.
        lead: the difference of the two, in square roots of the latter: so large and small maps
            compare.
    """

    a: str
    b: str
    ratio: float
    lead: float = 0.0

    @property
    def key(self) -> Key:
        """The two names."""
        return frozenset((self.a, self.b))


class GroupSearch:
    """Finds the groups of maps that fit together, and aligns pairs for that.

    The larger known box is aligned to the smaller, in an executor or two threads; each pair once.
    Which pair is next depends on the results so far, but most pairs are predictable and started in
    advance. One that is never requested costs time and changes nothing: an alignment depends on its
    two maps only.
    """

    def __init__(self, features: dict[str, GridFeatures], setup: FusionSetup) -> None:
        """Start with every map alone."""
        self.features, self.setup = features, setup
        self.count = count = math.comb(len(features), 2)
        self.starts, executor = setup.starts or Starts(), setup.executor
        self.is_thorough, self.last = count <= THOROUGH_PAIRS, next(reversed(features), "")
        self.done, self.steps = 0, count if self.is_thorough else len(features) - 1
        self.is_here, self.executor = executor is None, executor or ThreadPoolExecutor(THREADS)
        self.tasks: dict[tuple[str, str], Future[Alignment]] = {}
        self._looked_at: dict[tuple[str, str, Pose2], Implied] = {}
        self.graph = AlignmentGraph(tuple(features))
        self.found: dict[Key, Alignment] = {}
        self.words: dict[Key, str] = {}
        self.ground = {name: _ground(item) for name, item in features.items()}
        self.candidates = self._ranked()

    def run(self) -> tuple[list[MapGroup], list[Alignment]]:
        """Return every group, single maps too, the largest first, and every examined pair.

        Of equally large groups the one with the greater sum of scores is first.
        """
        if self.is_thorough:
            for item in self.candidates:
                self._aligned(item)
            self.candidates.sort(key=lambda item: -_strength(self.found[item.key]))
        self.grow()
        self.close_loops()
        while self.graph.drop_false():
            self.grow()
            self.close_loops()
        accepted = [pair for pair in self.found.values() if pair.accepted]
        if accepted and not self.graph.links:
            # If all alignments contradict each other, the strongest stays.
            strongest = max(accepted, key=_strength)
            del self.graph.false[key_of(strongest)]
            self.graph.believe(strongest)

        def rank(group: tuple[str, ...]) -> tuple[int, float]:
            return len(group), math.fsum(pair.score for pair in self.graph.links_inside(group))

        groups = sorted(self.graph.groups(), key=rank, reverse=True)
        return [self.solved(group) for group in groups], self.told()

    def grow(self) -> None:
        """Join groups by the most promising pairs between them, until nothing promising is left."""
        refused: Counter[str] = Counter()
        is_joined = True
        while is_joined:
            is_joined = False
            for item in self.candidates:
                if self._is_known(item) or not self._is_promising(item):
                    continue
                if any(refused[name] >= TRIES for name in self._smaller(item)):
                    continue
                pair = self._aligned(item)
                if pair.accepted:
                    self.graph.believe(pair)
                    refused.subtract({name: refused[name] for name in self.graph.mates(item.a)})
                    is_joined = True
                else:
                    refused.update(self._smaller(item))

    def close_loops(self) -> None:
        """Check pairs on common ground until every link is in loops, or no pair is left."""
        for group in self.graph.groups():
            if len(group) <= 2:
                break
            poses = self.graph.poses(group)
            shares = {
                (a, b): self._common(a, b, poses[a].inverse().compose(poses[b]))
                for a, b in itertools.combinations(group, 2)
            }
            loops = self.graph.loops()
            links: Counter[str] = Counter()
            for pair in self.graph.links_inside(group):
                links.update((pair.reference, pair.moving))
            for (a, b), share in sorted(shares.items(), key=lambda item: -item[1]):
                key = frozenset((a, b))
                if key in self.graph.links or key in self.graph.false:
                    continue
                path = self.graph.path(a, b)
                if not self._is_accepted(key):
                    is_wanted = any(loops[part] < LOOPS for part in path)
                    is_wanted |= min(links[a], links[b]) < LINKS
                    if share < LOOP_GROUND or not is_wanted:
                        continue
                if self._closes(a, b, poses[a].inverse().compose(poses[b])):
                    loops.update(path)
                    links.update((a, b))

    def solved(self, group: tuple[str, ...]) -> MapGroup:
        """Return the poses of a group that fit all its links best; links that do not fit are false.

        Source: ``pose_graph.robust``, graduated non-convexity.
        """
        links, start = self.graph.links_inside(group), self.graph.poses(group)
        if len(links) < len(group):
            return {name: start[name] for name in group}
        number = {name: index for index, name in enumerate(group)}
        middles = {name: Pose2(*self.features[name].middle) for name in group}
        motions, covariances = [], []
        for pair in links:
            motion = middles[pair.reference].inverse().compose(pair.transform)
            motion = motion.compose(middles[pair.moving])
            between = motion.inverse()
            covariance = np.diag([SHIFT_SIGMA_M, SHIFT_SIGMA_M, YAW_SIGMA_RAD]) ** 2
            way = -0.5 * np.array([[between.x, between.y]])
            covariances.append(moved(covariance[None], way)[0])
            motions.append(row_of(motion))
        information = inverted(np.array(covariances))
        graph = PoseGraph(
            poses=np.array([row_of(start[name].compose(middles[name])) for name in group]),
            edges=np.array([(number[pair.reference], number[pair.moving]) for pair in links]),
            motions=np.array(motions),
            information=0.5 * (information + information.transpose(0, 2, 1)),
            is_closure=np.ones(len(links), dtype=np.bool_),
        )
        solved = optimize(graph, robust="gnc", start="given")
        for pair, is_out in zip(links, solved.is_outlier, strict=True):
            if is_out:
                why = "taken back: the other alignments together contradict it"
                self.graph.false[key_of(pair)] = why
        poses = {
            name: pose_of(row).compose(middles[name].inverse())
            for name, row in zip(group, solved.poses, strict=True)
        }
        first = poses[group[0]].inverse()
        return {name: first.compose(pose) for name, pose in poses.items()}

    def told(self) -> list[Alignment]:
        """Return every examined pair with its final decision."""
        told = []
        for key, pair in {**self.found, **self.graph.links}.items():
            why = self.graph.false.get(key)
            if why is None and pair.accepted and key not in self.graph.links:
                why = "taken back: loops over other maps put it elsewhere"
            if why is not None:
                told.append(replace(pair, accepted=False, reason=why, decision="different place"))
            elif pair.accepted:
                told.append(pair)
            else:
                told.append(replace(pair, reason=self.words.get(key, pair.reason)))
        return told

    def close(self) -> None:
        """End the own threads, and cancel what no one waits for."""
        if self.is_here:
            self.executor.shutdown(cancel_futures=True)

    def tell(self, what: str, done: int) -> None:
        """Report the stage and the number of alignments done."""
        if self.setup.progress is not None:
            self.setup.progress(what, done, max(self.steps, done))

    def align(self, a: str, b: str) -> Alignment:
        """Align two inputs by name, and apply what else is known of them."""
        pair = self._pair(a, b)
        self.tell("aligning pairs", self.done)
        found = self._task(pair).result()
        self.done += 1
        self.tell("aligning pairs", self.done)
        large = self.features[a]
        if self.is_thorough and b == self.last and math.prod(large.shape) > KEPT_CELLS:
            large.release()
            return_freed_memory()
        look = self.setup.second_look
        return found if look is None else look(found, pair)

    def ahead(self, coming: Iterable[tuple[str, str]]) -> None:
        """Start the first of the pairs that are likely to be requested next."""
        most = THREADS if self.is_here else tasks_ahead(self.executor)
        for a, b in itertools.islice(coming, most):
            if sum(not task.done() for task in self.tasks.values()) < most:
                self._task(self._pair(a, b))

    def _pair(self, a: str, b: str) -> Pair:
        """Return two inputs, the smaller one as the reference."""
        pair = Pair(self.features[a], self.features[b])
        if math.prod(pair.reference.shape) > math.prod(pair.moving.shape):
            pair = Pair(pair.moving, pair.reference)
        return pair

    def _task(self, pair: Pair) -> Future[Alignment]:
        """Return the task of a pair; start it if it was not started yet."""
        names = pair.reference.grid.name, pair.moving.grid.name
        if names not in self.tasks:
            task = partial(align_pair, thorough=self.is_thorough)
            given = pair, self.setup.config.align, self.starts.between(*names), self.count
            self.tasks[names] = self.executor.submit(task, *given)
        return self.tasks[names]

    def _ranked(self) -> list[Candidate]:
        """Return the pairs that may be aligned, the most promising first; of few inputs all.

        Of many inputs, pairs that cannot meet by their starts are left out, and the nearest come
        first.
        """
        if self.is_thorough:
            return [Candidate(a, b, math.inf) for a, b in itertools.combinations(self.features, 2)]
        self.tell("rank pairs", 0)
        near, others = [], []
        for item in rank_pairs(self.features):
            start = self.starts.between(item.a, item.b)
            if start is None:
                others.append(item)
                continue
            pair = Pair(self.features[item.a], self.features[item.b])
            reach_m = sum(math.hypot(*one.shape) for one in pair) / 2.0 * pair.resolution
            # How far apart the start puts the two, from 1 on too far to meet.
            there = start.pose.transform(pair.moving.middle)
            apart_m = math.dist(pair.reference.middle, there) - math.sqrt(2.0) * start.metres
            apart = max(0.0, apart_m) / reach_m
            if apart < 1.0:
                near.append((apart, replace(item, ratio=math.inf)))
        near.sort(key=lambda item: item[0])
        return [*(candidate for _, candidate in near), *others]

    def _aligned(self, item: Candidate) -> Alignment:
        if item.key not in self.found:
            self.ahead(self._coming(item))
            self.found[item.key] = self.align(item.a, item.b)
        return self.found[item.key]

    def _coming(self, item: Candidate) -> Iterator[tuple[str, str]]:
        """Yield a pair, and the pairs that follow if all of them are accepted."""
        group = {name: self.graph.mates(name)[0] for name in self.features}
        for other in (item, *self.candidates):
            if other is not item and other.ratio < RATIO_MIN:
                continue
            one, two = group[other.a], group[other.b]
            if other.key in self.found or (one == two and other is not item):
                continue
            yield other.a, other.b
            group = {name: one if first == two else first for name, first in group.items()}

    def _is_promising(self, item: Candidate) -> bool:
        """Whether a pair is worth an alignment; the best pair of an unused map always is."""
        tried = set().union(*self.found)
        return item.ratio >= RATIO_MIN or not tried.issuperset((item.a, item.b))

    def _is_known(self, item: Candidate) -> bool:
        """Whether the two maps are joined, or were tried."""
        if self.graph.is_joined(item.a, item.b) or item.key in self.graph.false:
            return True
        found = self.found.get(item.key)
        return found is not None and not found.accepted

    def _smaller(self, item: Candidate) -> tuple[str, ...]:
        """Return the maps of the smaller of two groups, of both where they are equal."""
        a, b = self.graph.mates(item.a), self.graph.mates(item.b)
        if len(a) == len(b):
            return (*a, *b)
        return min(a, b, key=len)

    def _common(self, a: str, b: str, transform: Pose2) -> float:
        """Return how much of the smaller map's ground lies in the other's box, 0..1."""
        if self.features[a].known_cells < self.features[b].known_cells:
            a, b, transform = b, a, transform.inverse()
        still, points = self.features[a].grid, self.ground[b]
        row, col = still.grid.cell_indices(transform.transform(points))
        known = np.count_nonzero(cells_at(still.cells, row, col, UNKNOWN) != UNKNOWN)
        return known / max(1, len(points))

    def _is_accepted(self, key: Key) -> bool:
        """Whether two maps were aligned in full, and it was accepted."""
        return key in self.found and self.found[key].accepted

    def _closes(self, a: str, b: str, transform: Pose2) -> bool:
        """Whether a pair agrees with the tree; record contradictions."""
        key = frozenset((a, b))
        if not self._is_accepted(key):
            look = self.look(a, b, transform)
            if look.is_supported:
                link = look.alignment
                if key in self.found:
                    said = f"accepted over others: as a pair with {a}, {b} was rejected; here they"
                    link = replace(link, reason=f"{said} give {look.words}")
                self.graph.believe(link)
                return True
            if look.stands:
                return False
            pair = self._aligned(Candidate(a, b, math.inf))
            if not pair.accepted:
                self.words[key] = f"{pair.reason}; where the others put it, it gives {look.words}"
                self.graph.against[key] = None
                return False
        pair = self.found[key]
        if pair.moving != b:
            transform = transform.inverse()
        if self._agrees(pair, transform, self.graph.path(a, b)):
            self.graph.believe(pair)
            return True
        self.graph.against[key] = pair
        return False

    def look(self, reference: str, moving: str, transform: Pose2) -> Implied:
        """Return the evidence of walls for an implied transform, metres; of each only once."""
        key = reference, moving, transform
        if key in self._looked_at:
            return self._looked_at[key]
        pair = Pair(self.features[reference], self.features[moving])
        found = track_pair(pair, transform, self.count)
        evidence, is_supported, words = found.evidence, False, "no walls"
        if evidence is not None:
            went = is_distinct(pair.motion_of(found.transform), pair.motion_of(transform))
            is_supported = found.accepted and not went
            words = (
                f"{evidence.share:.0%} of what {evidence.common_m:.0f} m of common walls could give"
            )
        is_little = found.overlap < MUCH_GROUND
        if is_little:
            words = f"{found.overlap:.0%} of the ground in common"
        self._looked_at[key] = Implied(found, is_supported or is_little, words, is_supported)
        return self._looked_at[key]

    def _agrees(self, pair: Alignment, transform: Pose2, path: Sequence[Key]) -> bool:
        """Whether an alignment agrees with a path of others.

        Bent maps of one drive fit at different places in different pairs, so pairs with agreeing
        paths close a loop in any case.
        """
        if all(
            PATH_GAP in one.statistics for one in (pair, *(self.graph.links[key] for key in path))
        ):
            return True
        maps = Pair(self.features[pair.reference], self.features[pair.moving])
        shift, turn = displacement(maps.motion_of(pair.transform), maps.motion_of(transform))
        parts = (1 + len(path)) / TRIANGLE
        return shift <= CLOSURE_CELLS * parts and turn <= CLOSURE_YAW_RAD * parts


def _ground(features: GridFeatures) -> F64:
    """Return (N, 2) points spread over the known ground of a map, metres."""
    rows, cols = (
        np.linspace(0.0, side - 1.0, min(side, GROUND_POINTS)).round().astype(np.int64)
        for side in features.shape
    )
    known = np.argwhere(features.grid.cells[np.ix_(rows, cols)] >= 0)
    return features.grid.grid.cell_centres(rows[known[:, 0]], cols[known[:, 1]])


@dataclass(frozen=True)
class Implied:
    """The outcome for a rejected pair under the transform that others imply.

    Attributes:
        stands: whether the pair contradicts no group.
        is_supported: whether walls on common ground, much or little, support the transform.
    """

    alignment: Alignment
    stands: bool
    words: str
    is_supported: bool = False


# The names of two maps.
Key = frozenset[str]


def key_of(pair: Alignment) -> Key:
    """Return the names of the two maps of a pair."""
    return frozenset((pair.reference, pair.moving))


class AlignmentGraph:
    """Maps, accepted alignments (links), and pairs that contradict them.

    The first links make a spanning tree of each group of maps; every further link closes a loop
    with the links of the tree between its two maps, its path. A contradiction is a pair of one
    group that does not agree with the tree: one link of its path may be false, or the pair's own
    alignment.

    Attributes:
        links: accepted alignments, by the names of their maps.
        against: contradictions, noted by the search; the alignment is None if the pair has none
            that could be true.
        false: removed alignments, by the names of their maps, and the reason.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Start with every map alone."""
        self.names = tuple(names)
        self.links: dict[Key, Alignment] = {}
        self.against: dict[Key, Alignment | None] = {}
        self.false: dict[Key, str] = {}
        self._tree: dict[str, dict[str, Alignment]] = {name: {} for name in names}
        self._group = {name: index for index, name in enumerate(names)}

    def believe(self, pair: Alignment) -> None:
        """Add a link."""
        self.links[key_of(pair)] = pair
        self._grow_tree(pair)

    def is_joined(self, a: str, b: str) -> bool:
        """Whether links join two maps."""
        return self._group[a] == self._group[b]

    def mates(self, name: str) -> tuple[str, ...]:
        """Return the maps that are joined to one, itself among them, in order."""
        return tuple(other for other in self.names if self._group[other] == self._group[name])

    def groups(self) -> list[tuple[str, ...]]:
        """Return the maps that are joined, each group in order, the largest first."""
        groups: dict[int, list[str]] = {}
        for name in self.names:
            groups.setdefault(self._group[name], []).append(name)
        return [tuple(group) for group in sorted(groups.values(), key=len, reverse=True)]

    def path(self, a: str, b: str) -> list[Key]:
        """Return the links of the tree from one map to another of its group."""
        before: dict[str, str] = {a: a}
        fresh = [a]
        while b not in before:
            here = fresh.pop()
            for other in self._tree[here]:
                if other not in before:
                    before[other] = here
                    fresh.append(other)
        keys = []
        while b != a:
            keys.append(frozenset((b, before[b])))
            b = before[b]
        return keys

    def poses(self, group: Sequence[str]) -> dict[str, Pose2]:
        """Return the pose of each map's frame in that of the group's first, along the tree."""
        poses = {group[0]: Pose2()}
        fresh = [group[0]]
        while fresh:
            here = fresh.pop()
            for other, pair in self._tree[here].items():
                if other not in poses:
                    is_there = pair.moving == other
                    motion = pair.transform if is_there else pair.transform.inverse()
                    poses[other] = poses[here].compose(motion)
                    fresh.append(other)
        return poses

    def links_inside(self, group: Sequence[str]) -> list[Alignment]:
        """Return the links of a group, those of its tree first."""
        inside = [pair for key, pair in self.links.items() if key <= set(group)]
        return sorted(inside, key=lambda pair: not self._is_in_tree(key_of(pair)))

    def loops(self) -> Counter[Key]:
        """Return how many loops close over each link of the trees."""
        return Counter(
            itertools.chain.from_iterable(
                self.path(*sorted(key)) for key in self.links if not self._is_in_tree(key)
            )
        )

    def drop_false(self) -> bool:
        """Remove the links with most contradictions; return whether there were any.

        A contradiction counts against each link of its path, a loop that closes supports it.
        """
        blame = Counter[Key]()
        for key in self.against:
            blame.update(self.path(*sorted(key)))
        own = {key: pair for key, pair in self.against.items() if pair is not None}
        blame.subtract(self.loops())
        blame.update(dict.fromkeys(own, 1))
        most = max(blame.values(), default=0)
        if most <= 0:
            return False
        blamed = [key for key, value in blame.items() if value == most]
        strength = {key: _strength(own.get(key) or self.links[key]) for key in blamed}
        limit = NEARLY_AS_STRONG * max(0.0, min(strength.values()))
        for key in blamed:
            if strength[key] <= limit:
                self.links.pop(key, None)
                self.false[key] = "taken back: loops over other maps do not close with it"
        # New trees, without the contradictions of the old ones.
        self._tree = {name: {} for name in self.names}
        self._group = {name: index for index, name in enumerate(self.names)}
        self.against.clear()
        for pair in self.links.values():
            self._grow_tree(pair)
        return True

    def _grow_tree(self, pair: Alignment) -> None:
        a, b = pair.reference, pair.moving
        old, new = self._group[a], self._group[b]
        if old == new:
            return
        self._tree[a][b] = self._tree[b][a] = pair
        self._group = {name: old if group == new else group for name, group in self._group.items()}

    def _is_in_tree(self, key: Key) -> bool:
        a, b = key
        return b in self._tree[a]


def _strength(pair: Alignment) -> float:
    """Return the number of pieces of wall that prefer an alignment to any other."""
    return 0.0 if pair.evidence is None else pair.evidence.better


def rank_pairs(maps: Mapping[str, GridFeatures]) -> list[Candidate]:
    """Return every pair of maps that have walls, the most promising first; decide nothing."""
    pairs = []
    able = [name for name, item in maps.items() if len(item.wall_points)]
    for a, b in itertools.combinations(able, 2):
        pair = Pair(maps[a], maps[b])
        top, second = (max(evidence, 1.0) for evidence in parallel_shifts(pair).best_two())
        pairs.append(Candidate(a, b, top / second, (top - second) / math.sqrt(second)))
    return sorted(pairs, key=lambda pair: -pair.lead)


def placed(pair: Pair, transform: Pose2) -> Alignment:
    """Return the record of a map at a transform from other alignments, with its wall statistics."""
    found = SearchResult(pair.motion_of(transform)[None], None, "tracked")
    began = time.perf_counter()
    measured = conclude(pair, AlignConfig(), found, transform, 1, began)
    reason = "its place follows from alignments with other maps"
    return replace(measured, transform=transform, accepted=True, reason=reason, decision="accepted")
