"""Errors of maps and trajectories against the truth, measured distances or known relations.

Pure functions on value types.
"""

from __future__ import annotations

from slamfusion.evaluation.distances import (
    DistanceComparison,
    DistanceRow,
    MeasuredDistance,
    compare_distances,
    load_distances,
)
from slamfusion.evaluation.doubled_walls import doubled_wall_share, fused_doubled_shares
from slamfusion.evaluation.map_error import (
    AGREE_FREE,
    AGREE_UNKNOWN,
    AGREE_WALL,
    EXTRA_FREE,
    EXTRA_WALL,
    MISSING_FREE,
    MISSING_WALL,
    MapError,
    compare_to_truth,
    maps_of_differences,
)
from slamfusion.evaluation.measured import (
    FIGURES,
    Figure,
    Row,
    error_kinds,
    error_series,
    face_figures,
    figure_of,
    how_counted,
    map_figures,
    path_figures,
    path_series,
    result_rows,
    shown_figures,
)
from slamfusion.evaluation.odometry import DensePoses, poses_by_odometry
from slamfusion.evaluation.relations import (
    REVISIT_S,
    RelationErrors,
    Relations,
    errors_at_scans,
    read_relations,
    relation_errors,
)
from slamfusion.evaluation.statistics import (
    ErrorStatistics,
    correct_by_holm,
    difference_test,
    mean_interval,
)
from slamfusion.evaluation.trajectory_error import TrajectoryErrors, on_clock, trajectory_errors
from slamfusion.evaluation.wall_faces import (
    FaceAgreement,
    WallDistance,
    WallFaces,
    WallThickness,
    wall_thickness,
)

__all__ = [
    "AGREE_FREE",
    "AGREE_UNKNOWN",
    "AGREE_WALL",
    "EXTRA_FREE",
    "EXTRA_WALL",
    "FIGURES",
    "MISSING_FREE",
    "MISSING_WALL",
    "REVISIT_S",
    "DensePoses",
    "DistanceComparison",
    "DistanceRow",
    "ErrorStatistics",
    "FaceAgreement",
    "Figure",
    "MapError",
    "MeasuredDistance",
    "RelationErrors",
    "Relations",
    "Row",
    "TrajectoryErrors",
    "WallDistance",
    "WallFaces",
    "WallThickness",
    "compare_distances",
    "compare_to_truth",
    "correct_by_holm",
    "difference_test",
    "doubled_wall_share",
    "error_kinds",
    "error_series",
    "errors_at_scans",
    "face_figures",
    "figure_of",
    "fused_doubled_shares",
    "how_counted",
    "load_distances",
    "map_figures",
    "maps_of_differences",
    "mean_interval",
    "on_clock",
    "path_figures",
    "path_series",
    "poses_by_odometry",
    "read_relations",
    "relation_errors",
    "result_rows",
    "shown_figures",
    "trajectory_errors",
    "wall_thickness",
]
