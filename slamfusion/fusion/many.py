"""Many maps: cheap evidence first, alignments where it is promising, loops that must close.

Every pair is ranked (``pair_ranking``). The most promising pair between two groups is aligned in
full, and where it is believed the groups are one: a spanning tree by promise. A group that shares
nothing with the others is given up after a few refusals. Then loops are closed: pairs that lie on
common ground where the tree puts them must have walls that bear it out there (``implied``); one
that has not is aligned in full, and what it says, or that nothing is found, contradicts the
links of its path (``alignment_graph``). What is contradicted most is taken back, and the groups are
grown again without it.

Cost: N^2 products of spectra, about N alignments and 2 N looks at a known transform.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.align.decide import DecisionKind
from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair, displacement
from slamfusion.align.records import Alignment
from slamfusion.fusion.alignment_graph import AlignmentGraph, Key, key_of
from slamfusion.fusion.consistency import CLOSURE_CELLS, CLOSURE_YAW_RAD
from slamfusion.fusion.implied import ImpliedPairs
from slamfusion.fusion.placement import solve_poses
from slamfusion.geometry import Pose2

# Aligns two maps, by name, in full.
AlignPair = Callable[[str, str], Alignment]
# Told the pairs that are likely to be asked for next; takes as many as it wants.
Ahead = Callable[[Iterable[tuple[str, str]]], None]

# A group of maps is given up after so many of its pairs with larger ones were refused in a row.
TRIES = 3
# Below this ratio of the best place to the best one elsewhere a pair is not promising.
RATIO_MIN = 1.05
# Ground in common, as a share of the smaller map's, on which walls may close a loop. They speak
# against one on much of it alone (``implied``).
LOOP_GROUND = 0.12
# Loops over each link of the trees, and links of each map, that are looked for.
LOOPS, LINKS = 3, 4
# Points on each side of a map at which common ground is looked for.
GROUND_POINTS = 24
# Alignments in a triangle that may each be off by a share of what it may be.
TRIANGLE = 3.0


@dataclass(frozen=True)
class Candidate:
    """A pair of maps that may be aligned.

    Attributes:
        a, b: names.
        ratio: see ``pair_ranking.RankedPair``.
    """

    a: str
    b: str
    ratio: float

    @property
    def key(self) -> Key:
        """The two names."""
        return frozenset((self.a, self.b))


@dataclass(frozen=True, eq=False)
class SolvedGroup:
    """Maps whose places are known to each other.

    Attributes:
        members: names, in input order.
        poses: of each map's frame in the first member's, metres.
    """

    members: tuple[str, ...]
    poses: Mapping[str, Pose2]


def align_many(
    features: Mapping[str, GridFeatures],
    candidates: Sequence[Candidate],
    align: AlignPair,
    implied: ImpliedPairs,
    ahead: Ahead | None = None,
) -> tuple[list[SolvedGroup], list[Alignment]]:
    """Find the groups of maps that fit together, and where their maps lie.

    Args:
        features: of the maps, by name, in input order.
        candidates: every pair that may be aligned, the most promising first.
        align: aligns a pair in full.
        implied: looks at pairs under transforms that others imply.
        ahead: told, before a pair is aligned, what will be after it; None: nobody wants to know.

    Returns:
        Every group, single maps too, the largest first; and every pair that was looked at, in
        that order: those that are believed, and why the others are not.
    """
    search = _Search(features, candidates, align, implied, ahead)
    search.grow()
    search.close_loops()
    while search.graph.drop_false():
        # What was said of contradictions is of other trees.
        search.words.clear()
        search.grow()
        search.close_loops()
    groups = [search.solved(group) for group in search.graph.groups()]
    return groups, search.told()


class _Search:
    """The state of one search."""

    def __init__(
        self,
        features: Mapping[str, GridFeatures],
        candidates: Sequence[Candidate],
        align: AlignPair,
        implied: ImpliedPairs,
        ahead: Ahead | None,
    ) -> None:
        self.features, self.candidates = features, candidates
        self.align, self.implied, self.ahead = align, implied, ahead
        self.graph = AlignmentGraph(tuple(features))
        self.found: dict[Key, Alignment] = {}
        self.words: dict[Key, str] = {}
        self.ground = {name: _Ground(item) for name, item in features.items()}

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
        """Look at pairs on common ground until every link is in loops, or nothing is left."""
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
                if share < LOOP_GROUND:
                    break
                key = frozenset((a, b))
                if key in self.graph.links or key in self.graph.false:
                    continue
                path = self.graph.path(a, b)
                is_wanted = any(loops[part] < LOOPS for part in path)
                if not is_wanted and min(links[a], links[b]) >= LINKS:
                    continue
                if self._closes(a, b, poses[a].inverse().compose(poses[b])):
                    loops.update(path)
                    links.update((a, b))

    def solved(self, group: tuple[str, ...]) -> SolvedGroup:
        """Return where the maps of a group lie by all its links; those that do not fit are out."""
        links = self.graph.links_inside(group)
        poses, out = solve_poses(group, self.graph.poses(group), links, self.features)
        for pair in out:
            self.words[key_of(pair)] = "taken back: the other alignments together contradict it"
        return SolvedGroup(group, poses)

    def told(self) -> list[Alignment]:
        """Return every pair that was looked at, as it is believed in the end."""
        pairs = {**self.found, **self.graph.links}
        unused = [
            key for key, pair in pairs.items() if pair.accepted and key not in self.graph.links
        ]
        words = dict.fromkeys(unused, "taken back: loops over other maps put it elsewhere")
        words |= self.words | self.graph.false
        return [
            pair
            if key not in words
            else replace(
                pair, accepted=False, reason=words[key], decision=_refused(pair, words[key])
            )
            for key, pair in pairs.items()
        ]

    def _aligned(self, item: Candidate) -> Alignment:
        if item.key not in self.found:
            if self.ahead is not None:
                self.ahead(self._coming(item))
            self.found[item.key] = self.align(item.a, item.b)
        return self.found[item.key]

    def _coming(self, item: Candidate) -> Iterator[tuple[str, str]]:
        """Yield a pair, and those that grow groups after it if all of them are believed."""
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
        """Whether a pair is worth an alignment; the best of a map that was in none always is."""
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
        return self.ground[a].share_of(self.ground[b], transform)

    def _closes(self, a: str, b: str, transform: Pose2) -> bool:
        """Whether the walls of a pair bear out where the tree puts it; note what speaks against."""
        look = self.implied.look_at(a, b, transform)
        key = frozenset((a, b))
        if look.is_borne_out:
            self.graph.believe(look.alignment)
            return True
        if look.stands:
            return False
        pair = self._aligned(Candidate(a, b, math.inf))
        if not pair.accepted:
            self.words[key] = f"{pair.reason}; where the others put it, it gives {look.words}"
            self.graph.contradict(key, None)
            return False
        if pair.moving != b:
            transform = transform.inverse()
        if self._agrees(pair, transform, len(self.graph.path(a, b))):
            self.graph.believe(pair)
            return True
        self.graph.contradict(key, pair)
        return False

    def _agrees(self, pair: Alignment, transform: Pose2, steps: int) -> bool:
        """Whether an alignment is where a path of so many others puts it."""
        maps = Pair(self.features[pair.reference], self.features[pair.moving])
        shift, turn = displacement(
            maps.motion_of(pair.transform),
            maps.motion_of(transform),
        )
        parts = (1 + steps) / TRIANGLE
        return shift <= CLOSURE_CELLS * parts and turn <= CLOSURE_YAW_RAD * parts


class _Ground:
    """Points of the known ground of a map, and where its box lies."""

    def __init__(self, features: GridFeatures) -> None:
        grid = features.grid.grid
        height, width = grid.cells.shape
        rows, cols = (
            np.linspace(0.0, side - 1.0, min(side, GROUND_POINTS)).round().astype(np.int64)
            for side in (height, width)
        )
        known = np.argwhere(features.grid.cells[np.ix_(rows, cols)] >= 0)
        self.points = grid.cell_centres(rows[known[:, 0]], cols[known[:, 1]])
        self.grid, self.cells = grid, features.grid.cells

    def share_of(self, moving: _Ground, transform: Pose2) -> float:
        """Return the share of another map's ground that this one knows too, 0..1.

        Args:
            moving: the other map.
            transform: its map frame to this one's, metres.
        """
        if not len(moving.points):
            return 0.0
        row, col = self.grid.cell_indices(transform.transform(moving.points))
        height, width = self.cells.shape
        inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        known = self.cells[row[inside], col[inside]] >= 0
        return float(np.count_nonzero(known)) / len(moving.points)


def _refused(pair: Alignment, words: str) -> DecisionKind:
    """Return the decision of a pair with a reason of its own."""
    return "different place" if words.startswith("taken back") else pair.decision
