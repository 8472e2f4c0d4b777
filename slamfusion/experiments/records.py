"""What ``slamfusion experiment NAME --json`` prints: typed documents and their records.

The text below a key is its meaning and unit; the published JSON Schema carries it (see
``slamfusion.jobs.records``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypedDict

from slamfusion.evaluation.records import DifferenceJson, PairedDifferenceJson, SummaryJson
from slamfusion.jobs.records import CircumstancesJson

__all__ = [
    "AgainstBestInputJson",
    "CellModelJson",
    "CellModelsDocument",
    "ComparisonJson",
    "ErrorTableDocument",
    "ErrorTableJson",
    "EstimatorSweepDocument",
    "MeasurePairJson",
    "MethodPairJson",
    "MethodSummaryJson",
    "NoteJson",
    "OverallRatioJson",
    "RatiosJson",
    "RealLogMapJson",
    "RealLogNumbersJson",
    "RealLogTableJson",
    "RealLogsDocument",
    "RepeatedRunsDocument",
    "RepeatedRunsJson",
    "TrialJson",
    "VerdictJson",
]


# --- cell-models ------------------------------------------------------------------------------


class CellModelJson(TypedDict):
    """One cell of Table II of [H16]."""

    model: str
    """base, or mean: the paper's modified model."""
    order: str
    """forward: occupied observations first; backward: free ones first."""
    occupied: int
    """How many of the observations are occupied."""
    observations: int
    """How many there are."""
    value: float
    """The cell after all observations, 0 to 1."""
    paper: float
    """What the paper prints."""
    equal: bool
    """Whether both are equal in three decimals."""
    values: Sequence[float]
    """The cell before and after each observation."""


class CellModelsDocument(TypedDict):
    """``slamfusion experiment cell-models``; exit code 1 where a value differs from the paper's."""

    rows: Sequence[CellModelJson]
    """The cells of the table."""
    equal: bool
    """Whether all are the paper's."""
    files: Sequence[str]
    """What was written."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""


# --- occupancy-estimator, cell-models-trajectories --------------------------------------------


class ComparisonJson(TypedDict):
    """Two methods under the same other conditions."""

    levels: Sequence[str | float]
    """Level of every factor but the last."""
    methods: Sequence[str | float]
    """Both levels of the last factor."""
    measure: str
    """What is compared; the name ends in its unit."""
    means: Sequence[float]
    """Mean of each method, in the measure's unit."""
    p_values: DifferenceJson | None
    """How likely chance alone makes them differ so much; null where a method has a single run."""


class RepeatedRunsJson(TypedDict):
    """Runs under all conditions of an experiment, with many seeds each."""

    title: str
    """Of the experiment."""
    complete: bool
    """Whether all planned runs were made."""
    runs_made: int
    """Runs so far."""
    runs_planned: int
    """Runs in all."""
    factors: Sequence[str]
    """What the conditions differ in; methods are the levels of the last."""
    conditions: Sequence[Mapping[str, str | float | SummaryJson]]
    """Of each condition the level of every factor, and a summary of every measure, by name."""
    comparisons: Sequence[ComparisonJson]
    """Every two methods, by measure and condition."""
    runs: Sequence[Mapping[str, str | float]]
    """Of each run the level of every factor, its seed, and its measures; names end in units."""


class RepeatedRunsDocument(RepeatedRunsJson, CircumstancesJson):
    """``slamfusion experiment cell-models-trajectories``."""

    sentences: Sequence[str]
    """What the tables say, in words."""
    files: Sequence[str]
    """What was written."""


class VerdictJson(TypedDict):
    """Whether the occupancy estimator helps on coarse cells of one drive."""

    drive: str
    """The drive."""
    measure: str
    """What was compared; the name ends in its unit."""
    sizes_m: Sequence[float]
    """The coarse cell sizes, metres."""
    ratio: float
    """Mean over them of the error with the area estimator, the one without being 1."""
    p_value: float | None
    """How likely chance alone makes it differ so much from 1; null with single runs."""
    answer: Literal["helps", "harms", "no difference"]
    """The answer."""
    sentence: str
    """The answer in words."""


class EstimatorSweepDocument(RepeatedRunsDocument):
    """``slamfusion experiment occupancy-estimator``."""

    verdicts: Sequence[VerdictJson]
    """Whether the estimator helps, by drive and measure."""


# --- ground-obstacle, failures ----------------------------------------------------------------


class MethodSummaryJson(SummaryJson):
    """The [F16] errors of one method under one condition."""

    condition: str
    """The condition."""
    method: str
    """A producer, or a way to vote."""
    interval: tuple[float, float] | None
    """Low and high end of the mean's 95 % interval; null for a single drive."""


class MethodPairJson(TypedDict):
    """Two methods on the same drives."""

    condition: str
    """The condition."""
    methods: Sequence[str]
    """Both methods."""
    p_pooled_t: float
    """P-value of [F16]'s test, which takes the drives for unpaired."""
    p_paired_t_holm: float
    """P-value of the paired t-test, corrected for all pairs of the condition by Holm."""
    paired: PairedDifferenceJson
    """The difference of the errors, first minus second."""


class AgainstBestInputJson(TypedDict):
    """A way to vote against the best input of a condition."""

    condition: str
    """The condition."""
    fusion: str
    """The way to vote."""
    best_input: str
    """The producer with the smallest mean error."""
    ratio: float
    """Mean error of the fusion over that of the best input."""
    interval: tuple[float, float] | None
    """Low and high end of the ratio's 95 % interval; null for a single drive."""
    p_value: float | None
    """Of the paired t-test, corrected; null for a single drive."""


class RatiosJson(TypedDict):
    """Errors of a way to vote over those of the best inputs."""

    ratio: float
    """Mean of the ratios."""
    worst: float
    """The largest of them."""


class OverallRatioJson(RatiosJson):
    """Errors of a way to vote over those of the best inputs, over all conditions."""

    of_sums: float
    """Ratio of the sums of the mean errors, in which large places count more."""


class TrialJson(TypedDict):
    """One drive, mapped by all producers and fused in every way."""

    condition: str
    """The condition."""
    world: int
    """Seed of the place."""
    seed: int
    """Seed of the drive and of the producers."""
    errors: Mapping[str, float]
    """[F16] error of each map, by method."""
    wall_f1: Mapping[str, float]
    """Harmonic mean of the walls' precision and recall, by method; 0 without a map."""
    notes: Mapping[str, str]
    """What went wrong, by method."""
    faces_f1: Mapping[str, float]
    """F1 of the walls' faces within 0.1 m of the true ones, by method; 0 without a map."""
    ate_m: Mapping[str, float]
    """Absolute error of each producer's path and of the fused path, by name; metres."""
    choice: str
    """The producer whose path is taken (``best_producer``); empty where the scans cannot tell."""


class MeasurePairJson(TypedDict):
    """What ``run`` makes of all producers against another path or map, on the same drives."""

    condition: str
    """The condition."""
    measure: Literal["ate_m", "faces_f1"]
    """What is compared: the absolute error of paths, metres, or F1 of walls' faces at 0.1 m."""
    method: str
    """The fused path, or the fused map."""
    against: str
    """A producer, its map drawn from its own path, or the producer that is taken (``choice``)."""
    drives: int
    """Drives that have both."""
    mean: float
    """Mean of the method."""
    against_mean: float
    """Mean of the other."""
    p_paired_t_holm: float | None
    """Of the paired t-test, corrected for the pairs of this table; null for a single drive."""
    p_wilcoxon: float | None
    """Of Wilcoxon's signed-rank test; null for a single drive."""


class ErrorTableJson(TypedDict):
    """The errors of all methods over all drives."""

    title: str
    """Of the experiment."""
    summaries: Sequence[MethodSummaryJson]
    """Of every method under every condition."""
    pairs: Sequence[MethodPairJson]
    """Every two methods under every condition; none for single drives."""
    against_best_input: Sequence[AgainstBestInputJson]
    """Every way to vote against the best input of every condition."""
    overall: Mapping[str, OverallRatioJson]
    """The same over all conditions, by way to vote."""
    against_others_alone: Mapping[str, Mapping[str, float]]
    """Where one producer is harmed: by condition and way to vote, the mean error over that of
    fusing the others alone."""
    paths_and_faces: Sequence[MeasurePairJson]
    """The fused path against every path, and the fused map's faces against every map's."""
    trials: Sequence[TrialJson]
    """Every drive."""


class ErrorTableDocument(ErrorTableJson, CircumstancesJson):
    """``slamfusion experiment ground-obstacle``, and ``failures``."""

    sentences: Sequence[str]
    """What the tables say, in words."""
    files: Sequence[str]
    """What was written."""


# --- real-logs --------------------------------------------------------------------------------


class RealLogNumbersJson(TypedDict):
    """What is measured of a map; null where the map is missing, and for the reference itself."""

    error: float | None
    """[F16] error against the reference map."""
    wall_distance_mean_m: float | None
    """From each wall of the map to the nearest of the reference, mean; metres."""
    wall_distance_p95_m: float | None
    """The same, 95th percentile; metres."""
    reference_to_map_mean_m: float | None
    """From each wall of the reference to the nearest of the map, mean; metres."""
    wall_f1: float | None
    """Harmonic mean of the walls' precision and recall."""
    faces_f1: float | None
    """F1 of the walls' faces within 0.1 m of the reference's."""
    doubled_wall_share: float | None
    """Share of the map's wall cells with a parallel wall close by, 0 to 1."""
    path_error_m: float | None
    """Absolute error of the path (ATE) of a producer, and of the fused path in the row of the map
    that is drawn at it, against the reference trajectory, metres; null for other maps."""


class RealLogMapJson(RealLogNumbersJson):
    """A map of a recorded drive."""

    log: str
    """The drive."""
    map: str
    """A producer, a way to vote, what the scans draw at a path, or the reference map."""


class NoteJson(TypedDict):
    """What went wrong on a recorded drive."""

    log: str
    """The drive."""
    what: str
    """The producer or the way to vote."""
    reason: str
    """What went wrong."""


class RealLogTableJson(TypedDict):
    """All maps of all recorded drives."""

    title: str
    """Of the experiment."""
    maps: Sequence[RealLogMapJson]
    """The maps."""
    overall: Mapping[str, RatiosJson]
    """Every way to vote against the best inputs over all drives."""
    notes: Sequence[NoteJson]
    """What went wrong."""
    references: Mapping[str, str]
    """What the reference map of each drive was drawn from."""
    choices: Mapping[str, str]
    """The SLAM of each drive whose path is taken (``best_producer``), where the scans can tell."""
    others: Mapping[str, Sequence[str]]
    """SLAMs whose saved maps took part beside the producers, by drive."""


class RealLogsDocument(RealLogTableJson, CircumstancesJson):
    """``slamfusion experiment real-logs``."""

    sentences: Sequence[str]
    """What the tables say, in words."""
    files: Sequence[str]
    """What was written."""
