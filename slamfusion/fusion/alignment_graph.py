"""Maps joined by alignments: what loops of them close, and which alignment is false where not."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

from slamfusion.align.records import Alignment
from slamfusion.fusion.consistency import motion_from
from slamfusion.geometry import Pose2

# The names of two maps.
Key = frozenset[str]

# Of alignments that loops speak against alike the weakest is false, and those up to so many times
# as strong: of them none is known to be right.
NEARLY_AS_STRONG = 2.0


def key_of(pair: Alignment) -> Key:
    """Return the names of the two maps of a pair."""
    return frozenset((pair.reference, pair.moving))


class AlignmentGraph:
    """Maps, alignments that are believed (links), and pairs that contradict them.

    Links in the order in which they came make a spanning tree of each group of maps; every further
    link closes a loop with the links of the tree between its two maps, its path. A contradiction
    is a pair of one group that cannot lie as the tree has it. Each link of its path may be
    the false one, and so may be the pair's own alignment, where it has one.

    Attributes:
        names: of the maps, in order.
        links: believed alignments, by the names of their maps.
        against: contradictions; the alignment is None where the pair has none that could be true.
        false: alignments that were taken back, by the names of their maps, and why.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Begin with every map alone."""
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

    def contradict(self, key: Key, own: Alignment | None) -> None:
        """Note a pair that does not lie as the links have it, and its own alignment if it has."""
        self.against[key] = own

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
                    poses[other] = poses[here].compose(motion_from(pair, other))
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
        """Take back the links that contradictions speak against most; tell whether there was one.

        A contradiction speaks against each link of its path, a loop that closes speaks for it.
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
        self._rebuild()
        return True

    def _rebuild(self) -> None:
        """Lay the trees out anew; contradictions are of the trees before."""
        self._tree = {name: {} for name in self.names}
        self._group = {name: index for index, name in enumerate(self.names)}
        self.against.clear()
        for pair in self.links.values():
            self._grow_tree(pair)

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
    """Return the pieces of wall that say that an alignment is better than any other."""
    return 0.0 if pair.evidence is None else pair.evidence.better
