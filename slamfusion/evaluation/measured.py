"""Figures of maps and paths by name, and their rows in a table of results.

A *case* is a place, a log or a truth; a *method* made the map or the path. Results that differ only
in the *seed* are repetitions.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamfusion.config import RunConfig, TrajectoryConfig
from slamfusion.errors import counted
from slamfusion.evaluation.odometry import DensePoses, poses_by_odometry
from slamfusion.evaluation.relations import (
    RelationErrors,
    RelationErrorsAtScans,
    Relations,
    errors_at_scans,
    read_relations,
    relation_errors,
)
from slamfusion.evaluation.statistics import ErrorStatistics
from slamfusion.evaluation.trajectory_error import TrajectoryErrors, trajectory_errors
from slamfusion.geometry import F64
from slamfusion.io import read_trajectory
from slamfusion.json_values import FLAT, printed_with
from slamfusion.trajectory import Trajectory

if TYPE_CHECKING:  # OpenCV loads slowly
    from slamfusion.evaluation.map_error import MapError

_LOG = logging.getLogger(__name__)

# A row of a table of results: case, seed, method, figure, value, at, to. ``at`` is NaN for a figure
# of the whole map or path; for a single error it is the time of a pose in s, or the metres
# travelled to the end of a pair of poses. A relation has two times, ``at`` and ``to``.
Row = tuple[str, str, str, str, float, float, float]


@dataclass(frozen=True)
class Figure:
    """How a figure is shown: ``label`` with its unit; ``larger_is_better`` None: neither."""

    label: str
    digits: int = 3
    larger_is_better: bool | None = False


# By name; other names are errors.
_FIGURES = {
    "error": Figure("error", 2),
    "wall_precision": Figure("wall precision", larger_is_better=True),
    "wall_recall": Figure("recall", larger_is_better=True),
    "wall_f1": Figure("F1", larger_is_better=True),
    "iou_occupied": Figure("IoU wall", larger_is_better=True),
    "iou_free": Figure("IoU free", larger_is_better=True),
    "map_to_truth_mean_m": Figure("to truth, mean [m]"),
    "map_to_truth_p95_m": Figure("to truth, 95 % [m]"),
    "truth_to_map_mean_m": Figure("from truth, mean [m]"),
    "faces_f1": Figure("faces F1 (0.1 m)", larger_is_better=True),
    "wall_thickness_mean_m": Figure("thickness, mean [m]", larger_is_better=None),
    "doubled_wall_share": Figure("doubled"),
    "outside_m2": Figure("outside [m2]", 1),
    "ssim": Figure("SSIM", larger_is_better=True),
    "coverage": Figure("coverage", larger_is_better=True),
    "ate_rmse_m": Figure("ATE rmse [m]", 4),
    "ate_mean_m": Figure("ATE mean [m]", 4),
    "ate_rotation_mean_deg": Figure("ATE mean [deg]"),
    "rpe_mean_m": Figure("RPE mean [m]", 4),
    "rpe_rotation_mean_deg": Figure("RPE mean [deg]"),
    "relations_mean_m": Figure("relations mean [m]", 4),
    "relations_rotation_mean_deg": Figure("relations mean [deg]"),
    "truth_covered_share": Figure("truth covered, share", larger_is_better=None),
    "relations_used_share": Figure("relations used, share", larger_is_better=None),
    "consistency": Figure("log-likelihood per hit, mean", 4, larger_is_better=True),
    "seen_share": Figure("seen again, share", larger_is_better=None),
    "distance_error_mean_m": Figure("distances mean [m]"),
    # Series of single errors.
    "ate_m": Figure("ATE [m]", 4),
    "ate_rotation_deg": Figure("ATE [deg]"),
    "rpe_m": Figure("RPE [m]", 4),
    "relations_m": Figure("relations [m]", 4),
    "relations_rotation_deg": Figure("relations [deg]"),
    # Of experiments.
    "time_per_scan_ms": Figure("time per scan [ms]", 2),
    "value": Figure("value of the cell", larger_is_better=None),
}
# Columns of a table of errors.
_SHOWN = (
    *("error", "wall_precision", "wall_recall", "wall_f1", "iou_occupied", "iou_free"),
    *("map_to_truth_mean_m", "truth_to_map_mean_m", "ssim", "coverage"),
)
# Tolerance of faces, metres: the middle one.
_FACES_M = 0.1


def figure_of(name: str) -> Figure:
    """Return how a figure is shown; an unknown one is an error, smaller is better."""
    return _FIGURES.get(name, Figure(name.replace("_", " ")))


def result_rows(
    case: str,
    seed: str,
    method: str,
    figures: Mapping[str, float | None],
    series: Mapping[str, F64] | None = None,
) -> list[Row]:
    """Return the rows of one map or path in a table of results.

    Args:
        seed: number of the repetition; empty for a single one.
        figures: by name; None: not defined.
        series: by name (N, 3) float64, single errors: value, ``at`` and ``to``; see ``Row``.
    """
    rows: list[Row] = [
        (case, seed, method, name, math.nan if value is None else float(value), math.nan, math.nan)
        for name, value in figures.items()
    ]
    for name, errors in (series or {}).items():
        rows += [(case, seed, method, name, *error) for error in errors.tolist()]
    return rows


def map_figures(error: MapError) -> dict[str, float | None]:
    """Return the figures of a map by name; None: not defined."""
    outward, back, thickness = error.map_to_truth_m, error.truth_to_map_m, error.wall_thickness_m
    return {
        "error": error.error,
        "wall_precision": error.wall_precision,
        "wall_recall": error.wall_recall,
        "wall_f1": error.wall_f1,
        "iou_occupied": error.iou_occupied,
        "iou_free": error.iou_free,
        "map_to_truth_mean_m": None if outward is None else outward.mean,
        "truth_to_map_mean_m": None if back is None else back.mean,
        "faces_f1": error.faces.f1(_FACES_M),
        "wall_thickness_mean_m": None if thickness is None else thickness.mean,
        "doubled_wall_share": error.doubled_wall_share,
        "outside_m2": error.outside_m2,
        "ssim": error.ssim,
        "coverage": error.coverage,
    }


def shown_figures(error: MapError) -> list[tuple[Figure, float | None]]:
    """Return the figures of a map that a table of errors shows, in order."""
    known = map_figures(error)
    return [(figure_of(name), known[name]) for name in _SHOWN]


def face_figures(error: MapError) -> list[tuple[Figure, float | None]]:
    """Return the figures that do not depend on the thickness of walls, in order."""
    faces, known = error.faces, map_figures(error)
    found: list[tuple[Figure, float | None]] = [
        (Figure(f"faces F1 ({own.tolerance_m:g} m)", larger_is_better=True), own.f1)
        for own in faces.agreements
    ]
    for name, distance in (
        ("map_to_truth_mean_m", faces.map_to_truth_m),
        ("truth_to_map_mean_m", faces.truth_to_map_m),
    ):
        found.append((figure_of(name), None if distance is None else distance.mean))
    names = ("wall_thickness_mean_m", "doubled_wall_share", "outside_m2")
    return found + [(figure_of(name), known[name]) for name in names]


# --- paths ----------------------------------------------------------------------------------------

# The statistics of an error that tables show.
FIGURES = ("mean", "std", "rmse", "median", "min", "max")


@dataclass(frozen=True)
class PathErrors:
    """Errors of a path: against the truth, on known relations, both or none."""

    truth: TrajectoryErrors | None = field(default=None, metadata=FLAT)
    relations: RelationErrors | None = field(default=None, metadata=FLAT)
    odometry: DensePoses | None = field(default=None, metadata=printed_with("relations"))
    """How poses at the relations' times were composed with odometry; null: they were not."""
    at_scans: RelationErrorsAtScans | None = field(default=None, metadata=printed_with("relations"))
    """Errors on the relations whose both ends are poses of the path; null: the same or none."""

    def figures(self) -> dict[str, float]:
        """Return the figures of the path by name."""
        truth, known = self.truth, self.relations
        means: dict[str, ErrorStatistics | None] = {}
        found: dict[str, float] = {}
        if truth is not None:
            found["ate_rmse_m"] = truth.ate.rmse
            means = {"ate_mean_m": truth.ate, "ate_rotation_mean_deg": truth.ate_rotation_deg}
            means |= {"rpe_mean_m": truth.rpe, "rpe_rotation_mean_deg": truth.rpe_rotation_deg}
        if known is not None:
            means["relations_mean_m"] = known.translation
            means["relations_rotation_mean_deg"] = known.rotation_deg
        found |= {name: own.mean for name, own in means.items() if own is not None}
        if truth is not None:
            found["truth_covered_share"] = truth.covered_share
        if known is not None:
            found["relations_used_share"] = known.relations_used / known.relations_total
        return found

    def series(self) -> dict[str, F64]:
        """Return the single errors by name, for ``result_rows``."""
        found = {}
        if (truth := self.truth) is not None:
            found["ate_m"] = error_series(truth.translation_m, truth.stamps_s)
            found["ate_rotation_deg"] = error_series(np.rad2deg(truth.rotation_rad), truth.stamps_s)
            found["rpe_m"] = error_series(truth.relative_translation_m, truth.relative_travelled_m)
        if (known := self.relations) is not None:
            found["relations_m"] = error_series(known.translation_m, *known.stamps_s.T)
            found["relations_rotation_deg"] = error_series(
                np.rad2deg(known.rotation_rad), *known.stamps_s.T
            )
        return found

    def kinds(self) -> list[tuple[str, ErrorStatistics | None, int]]:
        """Return name with unit, statistics and digits of each kind of error."""
        kinds: list[tuple[str, ErrorStatistics | None, int]] = []
        for errors, where in ((self.relations, ""), (self.at_scans, " at scans")):
            if errors is not None:
                kinds += [
                    (f"relations{where}, translation [m]", errors.translation, 4),
                    (f"relations{where}, rotation [deg]", errors.rotation_deg, 3),
                ]
        if (truth := self.truth) is not None:
            unit = truth.rpe_unit.removesuffix("s") if truth.rpe_delta == 1.0 else truth.rpe_unit
            pair = f"{truth.rpe_delta:g} {unit or truth.rpe_unit}"
            kinds += [
                ("ATE, translation [m]", truth.ate, 4),
                ("ATE, rotation [deg]", truth.ate_rotation_deg, 3),
                (f"RPE, translation [m], {pair}", truth.rpe, 4),
                (f"RPE, rotation [deg], {pair}", truth.rpe_rotation_deg, 3),
            ]
        return kinds

    def how_counted(self) -> list[str]:
        """Return in sentences what the errors rest on."""
        notes = []
        if (known := self.relations) is not None:
            how = f"poses within {known.tolerance_s:g} s of both times"
            if (dense := self.odometry) is not None:
                total = dense.poses_used + dense.poses_without_row
                how = (
                    f"poses carried on by {dense.rows} rows of odometry; the row of each pose is "
                    f"found by its {dense.rows_found_by}, {dense.poses_without_row} of {total} "
                    "poses have none"
                )
            notes.append(f"{known.relations_used} of {known.relations_total} relations used, {how}")
        if (scans := self.at_scans) is not None:
            low, high = scans.translation_mean_95
            notes.append(
                f"both ends are poses of the trajectory in {scans.relations_used} of "
                f"{scans.relations_total} relations; the mean of their translation errors is "
                f"{low:.4f} to {high:.4f} m with 95 % confidence"
            )
        if (truth := self.truth) is not None:
            aligned = "aligned" if truth.alignment.kind == "se2" else "not aligned"
            notes.append(
                f"{truth.poses_matched} of {counted(truth.poses, 'pose')} met one of {truth.truth} "
                f"within {truth.tolerance_s:g} s and cover {truth.covered_share:.0%} of its time, "
                f"{aligned}; {counted(truth.rpe_pairs, 'pair')}"
            )
            if truth.time_offset_s:
                notes.append(f"{truth.time_offset_s:.4f} s added to the times of {truth.truth}")
        return notes


@dataclass(frozen=True)
class Measures(PathErrors):
    """Errors of a path, and of the same path as it was first reported."""

    as_first_reported: PathErrors | None = field(
        default=None, metadata=printed_with("as_first_reported")
    )
    """The same of the path as it was first reported, of a producer that corrects it later."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPath:
    """A path and its errors."""

    trajectory: Trajectory = field(repr=False)
    measures: Measures = field(default=Measures(), metadata=FLAT)
    name: str = field(init=False)
    """The path."""
    file: Path | None = None
    """Its file; null where there is none."""
    poses: int = field(init=False)
    """Its poses."""
    path_length_m: float = field(init=False)
    """Its length, metres."""

    def __post_init__(self) -> None:
        path = self.trajectory
        vars(self).update(name=path.name, poses=len(path), path_length_m=path.path_length_m())


def rankings(paths: Sequence[MeasuredPath]) -> dict[str, dict[str, tuple[float, int]]]:
    """Return ATE and mean error on the relations of paths, metres, with the rank; least first."""
    truths = {own.name: own.measures.truth for own in paths}
    known = {own.name: own.measures.relations for own in paths}
    found = {
        "ATE": {name: own.ate.rmse for name, own in truths.items() if own is not None},
        "relations": {name: own.translation.mean for name, own in known.items() if own is not None},
    }
    return {
        kind: {
            name: (error_m, rank)
            for rank, (name, error_m) in enumerate(sorted(own.items(), key=itemgetter(1)), start=1)
        }
        for kind, own in found.items()
    }


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """What paths are measured by: known relations, the true path, or both.

    Attributes:
        relations: known motions between pairs of times.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        scans: raw odometry of the scans of the path's log.
    """

    relations: Relations | None = None
    odometry: Trajectory | None = None
    truth: Trajectory | None = None
    scans: Trajectory | None = None

    @classmethod
    def read(
        cls,
        config: RunConfig,
        relations: str | Path | None = None,
        odometry: str | Path | None = None,
        truth: str | Path | None = None,
        warn: Callable[[str], None] = _LOG.warning,
    ) -> GroundTruth:
        """Read the files that are named."""
        topic = config.trajectory.pose_topic
        return cls(
            None if relations is None else read_relations(relations),
            None if odometry is None else read_trajectory(odometry, config.log),
            None if truth is None else read_trajectory(truth, config.log, topic, warn),
        )

    def measure(
        self, path: Trajectory, config: RunConfig, scans: Trajectory | None = None
    ) -> Measures:
        """Measure a path by all that there is; see ``measure_trajectory``."""
        known = replace(self, scans=scans or self.scans)
        return measure_trajectory(path, config.trajectory, **vars(known))


def measure_trajectory(
    estimate: Trajectory,
    config: TrajectoryConfig | None = None,
    *,
    relations: Relations | None = None,
    odometry: Trajectory | None = None,
    scans: Trajectory | None = None,
    truth: Trajectory | None = None,
) -> Measures:
    """Measure a trajectory by everything given; see ``GroundTruth``.

    Raises:
        TrajectoryError: the estimate has no times in common with one of them.
    """
    config, dense, known, at_scans = config or TrajectoryConfig(), None, None, None
    if relations is not None:
        if odometry is not None:
            dense = poses_by_odometry(estimate, scans, odometry, tolerance_s=config.tolerance_s)
        scored = estimate if dense is None else dense.trajectory
        known = relation_errors(scored, relations, config.tolerance_s)
        at_scans = errors_at_scans(estimate, relations)
    errors = None if truth is None else trajectory_errors(estimate, truth, config)
    return Measures(errors, known, dense, at_scans)


def error_series(errors: F64, at: F64, to: F64 | None = None) -> F64:
    """Return (N, 3) single errors with their places; ``to`` is NaN if not given."""
    return np.column_stack((errors, at, np.full(len(errors), np.nan) if to is None else to))
