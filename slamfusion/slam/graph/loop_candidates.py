"""``LoopCandidate``: an older submap that a node is to be searched in."""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.geometry import Pose2
from slamfusion.slam.graph.hypotheses import RelocalizationHypothesis
from slamfusion.slam.graph.pending_closures import How


@dataclass(frozen=True)
class LoopCandidate:
    """A submap that is to be searched.

    Attributes:
        index: of the submap.
        expected: pose of the robot in the map frame; None: anywhere.
        drift_m: how far off that may be.
        how: it is searched.
        hypothesis: that this is to test; None for none.
    """

    index: int
    expected: Pose2 | None
    drift_m: float
    how: How = "known"
    hypothesis: RelocalizationHypothesis | None = None
