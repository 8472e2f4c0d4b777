"""``GraphHealth``: how well the graph SLAM is doing, in JSON under its published names."""

from __future__ import annotations

from dataclasses import dataclass, field

from slamfusion.slam.common.mapper import Health
from slamfusion.slam.records import HealthJson

# Time without a scan, seconds, from which on the pause is named: the robot may have been moved.
PAUSE_S = 60.0


@dataclass
class GraphHealth(Health):
    """How well the graph is doing.

    Attributes:
        nodes: scans that became nodes.
        submaps: of which each holds some of them.
        kidnappings: times that the robot was taken to be kidnapped and a map component of its own
            began; ``restarts`` in JSON.
        tracking_failures: times that scans fitted badly for a while, and only odometry tells how
            what came after lies to what was before, until a closure does; ``breaks`` in JSON.
        relocalizations: times that a kidnapped robot was found on submaps of before; ``refound``
            in JSON.
        map_components: of the map, that nothing but odometry holds together; 1 for a whole one;
            ``parts`` in JSON.
        closures_tried: searches of an older submap.
        closures_accepted: of these, the ones that became an edge.
        closures_rejected: by reason.
        closure_outliers: edges outside the inlier set of the last solution; ``closures_doubted``
            in JSON.
        largest_correction_m: how far a closure has moved the robot at most.
        pauses: times that no scan came for more than ``PAUSE_S``.
        longest_pause_s: the longest of them.
        chi2: of the graph after the last solution.
        solutions: how often it was solved.
        solve_s: duration of the last solution.
    """

    nodes: int = 0
    submaps: int = 0
    kidnappings: int = 0
    tracking_failures: int = 0
    relocalizations: int = 0
    map_components: int = 1
    closures_tried: int = 0
    closures_accepted: int = 0
    closures_rejected: dict[str, int] = field(default_factory=dict)
    closure_outliers: int = 0
    largest_correction_m: float = 0.0
    pauses: int = 0
    longest_pause_s: float = 0.0
    chi2: float | None = None
    solutions: int = 0
    solve_s: float | None = None

    def to_json(self) -> HealthJson:
        """Return the record for a JSON document."""
        return {
            **super().to_json(),
            "graph": {
                "nodes": self.nodes,
                "submaps": self.submaps,
                "restarts": self.kidnappings,
                "breaks": self.tracking_failures,
                "refound": self.relocalizations,
                "parts": self.map_components,
                "closures_tried": self.closures_tried,
                "closures_accepted": self.closures_accepted,
                "closures_rejected": self.closures_rejected,
                "closures_doubted": self.closure_outliers,
                "largest_correction_m": self.largest_correction_m,
                "pauses": self.pauses,
                "longest_pause_s": self.longest_pause_s,
                "chi2": self.chi2,
                "solutions": self.solutions,
                "solve_s": self.solve_s,
            },
        }

    def warnings(self) -> tuple[str, ...]:
        """Return what speaks against the map; see ``Health.warnings``."""
        sentences = []
        if self.map_components > 1:
            sentences.append(
                f"the map is in {self.map_components} components: the robot was kidnapped "
                f"{self.kidnappings} times and relocalized {self.relocalizations} times; only "
                "odometry tells how the components lie"
            )
        elif self.kidnappings:
            sentences.append(
                f"the robot was kidnapped {self.kidnappings} times, and relocalized in the map "
                "each time; look at the map"
            )
        if self.tracking_failures:
            sentences.append(
                f"tracking failed {self.tracking_failures} times, scans fitted badly for a while: "
                "there only odometry and later closures tell how the map goes on; look at the map"
            )
        return tuple(sentences)

    def count_pause(self, pause_s: float) -> None:
        """Count the time since the last scan, seconds, if it was long."""
        if pause_s > PAUSE_S:
            self.pauses += 1
            self.longest_pause_s = max(self.longest_pause_s, pause_s)

    def reject_closure(self, reason: str) -> None:
        """Count a closure that was not accepted."""
        self.closures_rejected[reason] = self.closures_rejected.get(reason, 0) + 1
