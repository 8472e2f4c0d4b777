"""``refine_borne_out``: the refined path, where the scans do not say that it is the worse one.

Laying all scans on each other can pull walls together that are two. Both paths are scored by
predictive consistency, and the refined one is taken unless what was seen is surely less likely
by it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.comparison import Comparison
from slamfusion.evidence.predictive import PathEvidence, with_path
from slamfusion.evidence.records import RefinementJson
from slamfusion.evidence.refined_path import refine_path
from slamfusion.trajectory import Trajectory

__all__ = ["RefinedPath", "refine_borne_out"]

# What the refined path is called while it is held against the given one.
_REFINED = "refined"


@dataclass(frozen=True, eq=False)
class RefinedPath:
    """A path, and whether laying all scans on each other has bettered it.

    Attributes:
        given: the path of before.
        path: the refined one where it was taken, else the given one.
        is_taken: whether it was.
        comparison: what the scans say of the refined path against the given one.
        evidence: what they say of the paths of before, and of ``path`` as the last one.
    """

    given: Trajectory
    path: Trajectory
    is_taken: bool
    comparison: Comparison
    evidence: PathEvidence

    def to_json(self) -> RefinementJson:
        """Return what a JSON document says of it."""
        found = self.comparison
        return {
            "taken": self.is_taken,
            "verdict": found.verdict,
            "difference": found.difference,
            "difference_95": (found.low, found.high),
            "p_value": found.p_value,
        }


def refine_borne_out(
    evidence: PathEvidence, path: Trajectory, device: ComputeDevice
) -> RefinedPath:
    """Lay the scans of a drive on each other along a path, unless they speak against what comes.

    Args:
        evidence: of other paths of the drive; none has the name of ``path``.
        path: near the right one.
        device: scores both.

    Raises:
        TrajectoryError: see ``score_paths``.
    """
    with_given = with_path(evidence, path.name, path, device)
    refined = refine_path(evidence.scans, path)
    both = with_path(with_given, _REFINED, refined, device)
    found = both.compare(_REFINED, path.name)
    if found.verdict == "worse":
        return RefinedPath(path, path, False, found, with_given)
    scores = dict(both.scores)
    scores[path.name] = replace(scores.pop(_REFINED), name=path.name)
    return RefinedPath(path, refined, True, found, replace(both, scores=scores))
