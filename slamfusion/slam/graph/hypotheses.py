"""Hypotheses about a kidnapped robot: the right one outlives look-alikes, none is believed early.

Rooms look alike. A place where a scan fits is a hypothesis; so is every other place where one fits.
Each says where the next scans must fit too. One that is right goes on fitting; one that is not
fails where the look-alikes differ.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from slamfusion.geometry import Pose2
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.pending_closures import PendingClosure, is_same_place

# Hypotheses that are tested at a node, and that are kept: what a node may cost.
TESTED, MOST_HYPOTHESES = 2, 12
# A hypothesis is accepted after this number of nodes that fit over this way, metres: longer than
# rooms look alike. It is given up after this number of misses in a row: a door or a person may hide
# a place once or twice.
BORNE_OUT_NODES, BORNE_OUT_M, MISSES = 14, 4.0, 3
# One with fewer hits, or a smaller share of the best one's, is no rival.
RIVAL_HITS, RIVAL_SHARE = 2, 0.4


@dataclass(eq=False)
class RelocalizationHypothesis:
    """Where the robot's map component may lie.

    Attributes:
        correction: what would move the component there, in the map frame.
        hits: closures that say so.
        misses: tests in a row that it has failed.
        tested: node at which it was tested last.
    """

    correction: Pose2
    hits: list[PendingClosure] = field(default_factory=list)
    misses: int = 0
    tested: int = -1

    @property
    def is_borne_out(self) -> bool:
        """Whether enough scans have fitted over a long enough distance."""
        nodes = {hit.constraint.end for hit in self.hits}
        travelled = [hit.travelled_m for hit in self.hits]
        driven_m = max(travelled) - min(travelled)
        return len(nodes) >= BORNE_OUT_NODES and driven_m >= BORNE_OUT_M


class RelocalizationHypotheses(Stateful):
    """The hypotheses about one kidnapped robot.

    Attributes:
        kept: that are not given up.
    """

    STATE = ("kept",)

    def __init__(self) -> None:
        """Start with none."""
        self.kept: list[RelocalizationHypothesis] = []

    def to_test(self) -> list[RelocalizationHypothesis]:
        """Return the hypotheses whose turn it is."""
        return sorted(self.kept, key=lambda one: one.tested)[:TESTED]

    def add(self, hit: PendingClosure, pose: Pose2) -> RelocalizationHypothesis:
        """Take a closure as a hit of the hypothesis that says the same, or of a new one.

        Args:
            hit: the closure.
            pose: of its node in the map frame, before any correction.
        """
        place = hit.correction.compose(pose)
        for one in self.kept:
            if is_same_place(one.correction.compose(pose), place):
                break
        else:
            one = RelocalizationHypothesis(hit.correction)
            self.kept.append(one)
        one.hits.append(hit)
        one.correction, one.misses = hit.correction, 0
        if len(self.kept) > MOST_HYPOTHESES:
            self.kept.remove(min(self.kept, key=lambda other: len(other.hits)))
        return one

    def miss(self, one: RelocalizationHypothesis) -> None:
        """Count that a scan did not fit where a hypothesis says that it must."""
        one.misses += 1
        if one.misses >= MISSES and one in self.kept:
            self.kept.remove(one)

    def winner(self) -> RelocalizationHypothesis | None:
        """Return the hypothesis that is borne out and has no rival left."""
        if not self.kept:
            return None
        best = max(self.kept, key=lambda one: len(one.hits))
        enough = max(RIVAL_HITS, RIVAL_SHARE * len(best.hits))
        has_rival = any(len(one.hits) >= enough for one in self.kept if one is not best)
        return best if best.is_borne_out and not has_rival else None
