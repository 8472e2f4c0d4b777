"""What the scans say of paths without a truth, and what to use: the recommendation.

``score_paths`` scores each path by how well what was seen at other times predicts what was seen
now, with beams, chunks and stamps that no path has a say in; ``with_path`` scores one more path
beside those. ``PathEvidence.compare`` tells better paths from those that cannot be told apart,
``find_displacements`` says where the walls of a path stand beside themselves, and ``recommend``
gives the one answer: which map and path, which SLAM alone, what to check.
``fuse_paths`` makes one path of several, each believed as far as the scans bear it out,
``refine_path`` lays all scans of the drive on each other along it, and ``refine_borne_out`` does so
where the scans do not contradict what comes of it.
"""

from __future__ import annotations

from slamfusion.evidence.beams import (
    CoveredPath,
    JudgedScans,
    ScanHits,
    cover_stamps,
    judged_hits,
    judged_scans,
    scan_hits,
)
from slamfusion.evidence.conditions import CONDITIONS, Condition, drive_conditions
from slamfusion.evidence.displacement import (
    Contradiction,
    Displacement,
    find_contradiction,
    find_displacements,
)
from slamfusion.evidence.fused_path import fuse_paths, trust_in_paths
from slamfusion.evidence.predictive import (
    Comparison,
    PathEvidence,
    PathScore,
    score_paths,
    with_path,
)
from slamfusion.evidence.recommendation import (
    Check,
    RankedPath,
    Recommendation,
    choose_path,
    recommend,
)
from slamfusion.evidence.refined_path import refine_path
from slamfusion.evidence.refinement import RefinedPath, refine_borne_out

__all__ = [
    "CONDITIONS",
    "Check",
    "Comparison",
    "Condition",
    "Contradiction",
    "CoveredPath",
    "Displacement",
    "JudgedScans",
    "PathEvidence",
    "PathScore",
    "RankedPath",
    "Recommendation",
    "RefinedPath",
    "ScanHits",
    "choose_path",
    "cover_stamps",
    "drive_conditions",
    "find_contradiction",
    "find_displacements",
    "fuse_paths",
    "judged_hits",
    "judged_scans",
    "recommend",
    "refine_borne_out",
    "refine_path",
    "scan_hits",
    "score_paths",
    "trust_in_paths",
    "with_path",
]
