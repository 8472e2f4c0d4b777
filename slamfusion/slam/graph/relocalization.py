"""``Relocalization``: the search for a kidnapped robot in the map of before.

It is searched near where odometry has it; after that in vain, where hypotheses have it, and all
over. It is relocalized when a hypothesis has been borne out over a distance and no other is left,
and every old submap has been searched.
"""

from __future__ import annotations

from slamfusion.geometry import Pose2
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.hypotheses import RelocalizationHypotheses
from slamfusion.slam.graph.local_map import LocalMap
from slamfusion.slam.graph.loop_candidates import LoopCandidate
from slamfusion.slam.graph.map_graph import MapGraph
from slamfusion.slam.graph.pending_closures import PendingClosure

# Submaps that are searched all over at a node; and once each has been, nodes until the next round.
SEARCHED_AT_NODE, ROUND_NODES = 3, 4
# How far off the robot may be, metres: where odometry has a kidnapped one, more for each metre that
# it travels from there; and where a hypothesis has it.
KIDNAPPED_DRIFT_M, DRIFT_SHARE, HYPOTHESIS_DRIFT_M = 1.2, 0.02, 0.6
# Searches in vain where odometry has it, one for each node, after which it may be anywhere.
LOCAL_SEARCHES = 12
# A hypothesis is tested on an old submap where the robot was this near to where it is now, metres.
INSIDE_M = 0.5


class Relocalization(Stateful):
    """The search for a kidnapped robot in the map components that it is not in.

    Attributes:
        hypotheses: where it may be.
    """

    STATE = ("hypotheses", "_searched", "_failed_searches", "_kidnapped_m")

    def __init__(self) -> None:
        """Start with nothing searched."""
        self.hypotheses = RelocalizationHypotheses()
        # How often submaps of other components were searched all over.
        self._searched: dict[int, int] = {}
        # Searches where odometry has it, and the distance travelled when it was kidnapped.
        self._failed_searches = 0
        self._kidnapped_m = 0.0

    def begin(self, travelled_m: float) -> None:
        """Begin for a robot that was kidnapped after a distance travelled, metres."""
        self.forget()
        self._failed_searches = 0
        self._kidnapped_m = travelled_m

    def forget(self) -> None:
        """Forget what was searched, and every hypothesis: the robot is somewhere else now."""
        self._searched = {}
        self.hypotheses = RelocalizationHypotheses()

    def candidates(self, graph: MapGraph, local_map: LocalMap, pose: Pose2) -> list[LoopCandidate]:
        """Return the submaps that a kidnapped robot is searched in at a node.

        Args:
            graph: with the node as its last.
            local_map: the submaps.
            pose: of the robot if it were where odometry alone has it, in the map frame.
        """
        if local_map.component_count < 2:
            return []
        others = local_map.in_other_components()
        away_m = local_map.distances_m(pose, graph.poses)
        # First near where odometry has it.
        drift_m = KIDNAPPED_DRIFT_M + DRIFT_SHARE * (graph.travelled_m - self._kidnapped_m)
        nearest = others[int(away_m[others].argmin())]
        candidates = [LoopCandidate(nearest, pose, drift_m, "odometry")]
        self._failed_searches += 1
        if self._failed_searches <= LOCAL_SEARCHES:
            return candidates
        # Then where hypotheses have it.
        for hypothesis in self.hypotheses.to_test():
            hypothesis.tested = len(graph.nodes)
            expected = hypothesis.correction.compose(pose)
            outside_m = local_map.distances_m(expected, graph.poses)[others]
            place = int(outside_m.argmin())
            if outside_m[place] < INSIDE_M:
                candidates.append(
                    LoopCandidate(
                        others[place], expected, HYPOTHESIS_DRIFT_M, "anywhere", hypothesis
                    )
                )
        # Then anywhere: submaps that have not been searched yet first, and of these the near ones.
        rounds = sorted(
            (self._searched.get(index, 0), float(away_m[index]), index)
            for index in _covering(others)
        )
        for times, _, index in rounds[:SEARCHED_AT_NODE]:
            if times == 0 or len(graph.nodes) % ROUND_NODES == 0:
                self._searched[index] = times + 1
                candidates.append(LoopCandidate(index, None, 0.0, "anywhere"))
        return candidates

    def confirmed(
        self, closure: PendingClosure, pose: Pose2, local_map: LocalMap
    ) -> list[PendingClosure]:
        """Return the closures found anywhere that may be believed now; often none.

        Args:
            closure: a new one, found ``anywhere``.
            pose: of its node in the map frame, before any correction.
            local_map: the submaps.
        """
        self.hypotheses.add(closure, pose)
        winner = self.hypotheses.winner()
        to_search = _covering(local_map.in_other_components())
        if winner is None or any(index not in self._searched for index in to_search):
            return []
        return winner.hits


def _covering(submaps: list[int]) -> list[int]:
    """Return those of some submaps that together hold every scan: all overlap by half."""
    known = set(submaps)
    return [
        index
        for place, index in enumerate(submaps)
        if place % 2 == 0 or not {index - 1, index + 1} <= known
    ]
