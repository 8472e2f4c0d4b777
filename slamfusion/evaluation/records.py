"""What a JSON document says of errors: typed records, made by the ``to_json`` of the classes here.

The text below a key is its meaning and unit; the published JSON Schema carries it. A figure that
is not defined (a map without a wall, a single repetition) is None, in JSON null.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypedDict


class ErrorStatisticsJson(TypedDict):
    """Figures of absolute errors, in the unit of the key that holds them."""

    mean: float
    """Mean of the errors."""
    std: float
    """Their standard deviation (divided by N)."""
    rmse: float
    """Root of the mean square."""
    median: float
    """The middle one."""
    min: float
    """The smallest."""
    max: float
    """The largest."""


class WallDistanceJson(TypedDict):
    """Distances from each wall cell of one map to the nearest wall cell of another, metres."""

    mean: float
    """Mean, metres."""
    p95: float
    """95th percentile, metres."""
    max: float
    """The largest, metres."""


class FaceAgreementJson(TypedDict):
    """How the faces of walls (wall cells beside free ones) agree with the true ones."""

    tolerance_m: float
    """A face this near counts as found, metres."""
    precision: float | None
    """Share of the map's face cells with a true one within the tolerance; null without a face."""
    recall: float | None
    """Share of the true face cells with one of the map within it; null without a face."""
    f1: float | None
    """Harmonic mean of the two; null when one of them is."""


class WallFacesJson(TypedDict):
    """The faces of a map's walls against the true ones; thickness counts for nothing."""

    agreements: Sequence[FaceAgreementJson]
    """At each tolerance, the narrowest first."""
    map_to_truth_m: WallDistanceJson | None
    """From each face cell of the map to the nearest true one; null when a side has none."""
    truth_to_map_m: WallDistanceJson | None
    """From each true face cell to the nearest of the map; null when a side has none."""


class WallThicknessJson(TypedDict):
    """How thick walls are, measured through each cell beside a free one, metres."""

    mean: float
    """Mean, metres."""
    median: float
    """The middle one, metres."""
    p95: float
    """95th percentile, metres."""


class MapErrorJson(TypedDict):
    """How a map differs from the truth."""

    name: str
    """The map."""
    error: float
    """[F16]: root of the sum of squared differences of -1, 0, 1 over the truth's known box."""
    truth: str
    """The true map."""
    cells: int
    """Cells of the truth's known box."""
    coverage: float
    """Share of the truth's known cells that the map knows, 0 to 1."""
    tolerance_m: float
    """A wall this near counts as found, metres."""
    wall_precision: float | None
    """Share of the map's walls with a true wall within the tolerance; null without a wall."""
    wall_recall: float | None
    """Share of the true walls with a wall of the map within the tolerance; null without a wall."""
    wall_f1: float | None
    """Harmonic mean of the two; null when one of them is."""
    iou_occupied: float | None
    """Cells occupied in both over cells occupied in either; null when there are none."""
    iou_free: float | None
    """Cells free in both over cells free in either; null when there are none."""
    map_to_truth_m: WallDistanceJson | None
    """From each wall of the map to the nearest true wall; null when a side has none."""
    truth_to_map_m: WallDistanceJson | None
    """From each true wall to the nearest wall of the map; null when a side has none."""
    faces: WallFacesJson
    """The faces of the map's walls against the true ones."""
    wall_thickness_m: WallThicknessJson | None
    """How thick the map's walls are; null when no wall is beside a free cell."""
    doubled_wall_share: float
    """Share of the map's wall cells that have a parallel wall close by, 0 to 1."""
    outside_m2: float
    """Area that the map knows outside of the truth's outline, square metres."""
    ssim: float
    """Mean structural similarity of the trinary images, at most 1."""
    confusion: Mapping[str, Mapping[str, int]]
    """Cells by the truth's class, then the map's: unknown, free, occupied."""
    dx_m: float
    """Transform from the map's frame into the truth's: x, metres."""
    dy_m: float
    """Its y, metres."""
    yaw_rad: float
    """Its heading, radians."""


class DistanceRowJson(TypedDict):
    """A distance that was measured in the building, and the map's."""

    name: str
    """What was measured."""
    distance_m: float
    """As measured, metres."""
    map_m: float | None
    """The map's, metres; null when a point has no wall nearby."""
    error_m: float | None
    """The map's minus the measured one, metres."""
    error_percent: float | None
    """The same in percent of the measured one."""
    reason: str
    """Why the map has none; else empty."""


class DistanceComparisonJson(TypedDict):
    """All measured distances against one map."""

    name: str
    """The map."""
    search_radius_m: float
    """How far from its point a wall was looked for, metres."""
    rows: Sequence[DistanceRowJson]
    """The distances, in the order given."""
    rows_used: int
    """Of these, the ones whose walls were found."""
    rows_total: int
    """All of them."""
    mean_absolute_error_m: float | None
    """Mean of the absolute errors, metres; null when no walls were found."""
    mean_absolute_error_percent: float | None
    """The same in percent of the measured distances."""


class TrajectoryAlignmentJson(TypedDict):
    """What laid an estimated trajectory on the true one."""

    kind: str
    """How it was found: the setting trajectory.alignment."""
    dx_m: float
    """Pose of the estimate's frame in the truth's: x, metres."""
    dy_m: float
    """Its y, metres."""
    yaw_rad: float
    """Its heading, radians."""


class TrajectoryErrorsJson(TypedDict):
    """Errors of a trajectory against the true one."""

    ate: ErrorStatisticsJson
    """Absolute errors of place, metres."""
    ate_rotation_deg: ErrorStatisticsJson
    """Absolute errors of heading, degrees."""
    rpe: ErrorStatisticsJson | None
    """Relative errors of place, metres a pair; null where the path is too short for a pair."""
    rpe_rotation_deg: ErrorStatisticsJson | None
    """Relative errors of heading, degrees a pair; null where there is no pair."""
    rpe_pairs: int
    """Pairs that the relative errors rest on."""
    rpe_delta: float
    """What a pair spans."""
    rpe_unit: str
    """Unit of what a pair spans: the setting trajectory.rpe_unit."""
    alignment: TrajectoryAlignmentJson
    """What laid the estimate on the truth."""
    poses: int
    """Poses of the estimate."""
    poses_matched: int
    """Of these, the ones that met a true pose in time."""
    tolerance_s: float
    """Poses further apart in time than this do not meet, seconds."""


class RelationErrorsJson(TypedDict):
    """Errors of a trajectory on known relations [K09]."""

    translation: ErrorStatisticsJson
    """Remaining translations, metres."""
    rotation_deg: ErrorStatisticsJson
    """Remaining rotations, degrees."""
    relations_used: int
    """Relations whose two times met a pose."""
    relations_total: int
    """All relations of the file."""
    tolerance_s: float
    """A pose further in time from a relation's end than this was not used, seconds."""
    poses: int
    """Poses of the trajectory."""


class RelationErrorsAtScansJson(RelationErrorsJson):
    """Errors on the relations whose both ends are poses of the trajectory itself."""

    translation_mean_95: tuple[float, float]
    """Low and high end of the 95 % interval of the mean translation, metres."""
    rotation_deg_mean_95: tuple[float, float]
    """Low and high end of the 95 % interval of the mean rotation, degrees."""


class DensePosesJson(TypedDict):
    """How poses at the relations' times were composed with odometry."""

    rows: int
    """Rows of the odometry that were given a pose."""
    rows_found_by: Literal["odometry", "stamp"]
    """How a pose's row was found: by the odometry of its scan, or by its stamp."""
    poses_used: int
    """Poses of the trajectory that have a row."""
    poses_without_row: int
    """Poses of the trajectory that have none."""


class PlacedJson(TypedDict):
    """The names of one of several maps or paths."""

    case: str
    """What it was measured against: a place, a log or a truth, by name."""
    method: str
    """What made it: what its file's name says besides case and seed."""
    seed: str
    """Number of the repetition of this method in this case; empty for a single one."""


class MethodMeanJson(TypedDict):
    """The means of a method's figures over its cases; of seeds, those of each case come first."""

    method: str
    """The method."""
    cases: int
    """Cases that it was measured in."""
    figures: Mapping[str, float]
    """Means of the figures that are defined in each of these cases, by name."""


class RepetitionsJson(TypedDict):
    """The figures of a method in one case over several seeds."""

    case: str
    """The case."""
    method: str
    """The method."""
    seeds: int
    """Repetitions."""
    figures: Mapping[str, float]
    """Means of the figures that are defined in each of these, by name."""
    std: Mapping[str, float]
    """Their sample standard deviations (divided by N - 1)."""


class SummariesJson(TypedDict):
    """Figures of several maps or paths as means."""

    means: Sequence[MethodMeanJson]
    """The figures of each method over its cases."""
    repetitions: Sequence[RepetitionsJson]
    """The figures of each method over the seeds of one case; empty where none has several."""
