"""Figures of maps and paths by name, and their rows in a table of results.

A *case* is a place, a log or a truth; a *method* made the map or the path. Results that differ only
in the *seed* are repetitions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slamfusion.evaluation.map_error import MapError
from slamfusion.evaluation.odometry import DensePoses
from slamfusion.evaluation.relations import RelationErrors, RelationErrorsAtScans
from slamfusion.evaluation.statistics import ErrorStatistics, mean_interval
from slamfusion.evaluation.trajectory_error import TrajectoryErrors
from slamfusion.geometry import F64

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


# The statistics of an error that tables show.
FIGURES = ("mean", "std", "rmse", "median", "min", "max")


def how_counted(
    truth: TrajectoryErrors | None,
    relations: RelationErrors | None,
    at_scans: RelationErrorsAtScans | None = None,
    dense: DensePoses | None = None,
) -> list[str]:
    """Return in sentences what the errors of a path rest on; see ``error_kinds``.

    Args:
        dense: how odometry carried the path to the times of the relations; None: it did not.
    """
    notes = []
    if relations is not None:
        how = f"poses within {relations.tolerance_s:g} s of both times"
        if dense is not None:
            total = dense.poses_used + dense.poses_without_row
            how = (
                f"poses carried on by {dense.rows} rows of odometry; rows of the poses found "
                f"by {dense.rows_found_by}, {dense.poses_without_row} of {total} poses without one"
            )
        count = f"{relations.relations_used} of {relations.relations_total}"
        notes.append(f"{count} relations used, {how}")
    if at_scans is not None:
        low, high = mean_interval(at_scans.translation_m)
        notes.append(
            f"both ends are poses of the trajectory in {at_scans.relations_used} of "
            f"{at_scans.relations_total} relations; the mean of their translation errors is "
            f"{low:.4f} to {high:.4f} m with 95 %"
        )
    if truth is not None:
        aligned = "aligned" if truth.alignment.kind == "se2" else "not aligned"
        notes.append(
            f"{truth.poses_matched} of {truth.poses} poses met one of {truth.truth} within "
            f"{truth.tolerance_s:g} s, {aligned}; {len(truth.relative_translation_m)} pairs"
        )
        if truth.time_offset_s:
            notes.append(f"{truth.time_offset_s:.4f} s added to the times of {truth.truth}")
    return notes


def error_kinds(
    truth: TrajectoryErrors | None,
    relations: RelationErrors | None,
    at_scans: RelationErrorsAtScans | None = None,
) -> list[tuple[str, ErrorStatistics | None, int]]:
    """Return name with unit, statistics and digits of each kind of error of a path."""
    kinds: list[tuple[str, ErrorStatistics | None, int]] = []
    for errors, where in ((relations, ""), (at_scans, " at scans")):
        if errors is not None:
            kinds += [
                (f"relations{where}, translation [m]", errors.translation, 4),
                (f"relations{where}, rotation [deg]", errors.rotation_deg, 3),
            ]
    if truth is not None:
        unit = truth.rpe_unit.removesuffix("s") if truth.rpe_delta == 1.0 else truth.rpe_unit
        pair = f"{truth.rpe_delta:g} {unit or truth.rpe_unit}"
        kinds += [
            ("ATE, translation [m]", truth.ate, 4),
            ("ATE, rotation [deg]", truth.ate_rotation_deg, 3),
            (f"RPE, translation [m], {pair}", truth.rpe, 4),
            (f"RPE, rotation [deg], {pair}", truth.rpe_rotation_deg, 3),
        ]
    return kinds


def path_figures(
    truth: TrajectoryErrors | None, relations: RelationErrors | None
) -> dict[str, float]:
    """Return the figures of a path by name."""
    statistics: dict[str, ErrorStatistics | None] = {}
    if truth is not None:
        statistics |= {
            "ate_mean_m": truth.ate,
            "ate_rotation_mean_deg": truth.ate_rotation_deg,
            "rpe_mean_m": truth.rpe,
            "rpe_rotation_mean_deg": truth.rpe_rotation_deg,
        }
    if relations is not None:
        statistics |= {
            "relations_mean_m": relations.translation,
            "relations_rotation_mean_deg": relations.rotation_deg,
        }
    first = {} if truth is None else {"ate_rmse_m": truth.ate.rmse}
    return first | {name: own.mean for name, own in statistics.items() if own is not None}


def path_series(truth: TrajectoryErrors | None, relations: RelationErrors | None) -> dict[str, F64]:
    """Return the single errors of a path by name, for ``result_rows``."""
    found = {}
    if truth is not None:
        found["ate_m"] = error_series(truth.translation_m, truth.stamps_s)
        found["ate_rotation_deg"] = error_series(np.rad2deg(truth.rotation_rad), truth.stamps_s)
        found["rpe_m"] = error_series(truth.relative_translation_m, truth.relative_travelled_m)
    if relations is not None:
        found["relations_m"] = error_series(relations.translation_m, *relations.stamps_s.T)
        found["relations_rotation_deg"] = error_series(
            np.rad2deg(relations.rotation_rad), *relations.stamps_s.T
        )
    return found


def error_series(errors: F64, at: F64, to: F64 | None = None) -> F64:
    """Return (N, 3) single errors with their places; ``to`` is NaN if not given."""
    return np.column_stack((errors, at, np.full(len(errors), np.nan) if to is None else to))
