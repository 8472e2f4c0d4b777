"""Maps and paths with their figures by name, as tables, saved results and comparisons share them.

A *case* is what was measured against: a place, a log, a truth. A *method* is what made the map or
the path. An item is one method in one case; items that differ in the *seed* alone are repetitions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slamfusion.evaluation.map_error import MapError
from slamfusion.evaluation.records import MeasuredItemJson
from slamfusion.evaluation.relations import RelationErrors
from slamfusion.evaluation.statistics import ErrorStatistics
from slamfusion.evaluation.trajectory_error import TrajectoryErrors

__all__ = [
    "ErrorSeries",
    "Figure",
    "MeasuredItem",
    "figure_of",
    "map_figures",
    "path_figures",
    "path_series",
]

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """How a figure is shown and read.

    Attributes:
        label: head of its column, with its unit.
        digits: after the point.
        larger_is_better: None: neither way is better.
    """

    label: str
    digits: int = 3
    larger_is_better: bool | None = False


# By name; a figure that is not here is an error of that name.
_FIGURES = {
    "error": Figure("error", 2),
    "wall_precision": Figure("wall precision", larger_is_better=True),
    "wall_recall": Figure("recall", larger_is_better=True),
    "wall_f1": Figure("F1", larger_is_better=True),
    "iou_occupied": Figure("IoU wall", larger_is_better=True),
    "iou_free": Figure("IoU free", larger_is_better=True),
    "map_to_truth_mean_m": Figure("to truth m"),
    "truth_to_map_mean_m": Figure("from truth m"),
    "faces_f1": Figure("faces F1 0.1 m", larger_is_better=True),
    "wall_thickness_mean_m": Figure("thickness m", larger_is_better=None),
    "doubled_wall_share": Figure("doubled"),
    "outside_m2": Figure("outside m2", 1),
    "ssim": Figure("SSIM", larger_is_better=True),
    "coverage": Figure("coverage", larger_is_better=True),
    "ate_rmse_m": Figure("ATE rmse m", 4),
    "ate_mean_m": Figure("ATE mean m", 4),
    "ate_rotation_mean_deg": Figure("ATE deg"),
    "rpe_mean_m": Figure("RPE m", 4),
    "rpe_rotation_mean_deg": Figure("RPE deg"),
    "relations_mean_m": Figure("relations m", 4),
    "relations_rotation_mean_deg": Figure("relations deg"),
    "consistency": Figure("log-likelihood a hit", 4, larger_is_better=True),
    "seen_share": Figure("seen again", larger_is_better=None),
    "distance_error_mean_m": Figure("distances m"),
    # Series of single errors.
    "ate_m": Figure("ATE m", 4),
    "ate_rotation_deg": Figure("ATE deg"),
    "rpe_m": Figure("RPE m", 4),
    "relations_m": Figure("relations m", 4),
    "relations_rotation_deg": Figure("relations deg"),
    # Of experiments.
    "value": Figure("value of the cell", larger_is_better=None),
}
# Faces this near to true ones are right, metres: the middle one of the tolerances.
_FACES_M = 0.1


def figure_of(name: str) -> Figure:
    """Return how a figure is shown; one without an entry here is an error, smaller is better."""
    return _FIGURES.get(name, Figure(name.replace("_", " ")))


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """The single errors that a figure sums up, each at its place.

    Attributes:
        at: (N, K) float64, what tells an error from the others: the time of a pose in seconds, both
            times of a relation, or the metres travelled to the end of a pair of poses.
        errors: (N,) float64, in the unit of the series' name.
    """

    at: F64
    errors: F64

    def __post_init__(self) -> None:
        """Check once.

        Raises:
            ValueError: shapes that do not fit, or values that are not finite.
        """
        if self.at.ndim != 2 or self.errors.shape != self.at.shape[:1]:
            message = f"{self.at.shape} places do not fit {self.errors.shape} errors"
            raise ValueError(message)
        if not (np.isfinite(self.at).all() and np.isfinite(self.errors).all()):
            message = "places and errors must be finite"
            raise ValueError(message)

    def __len__(self) -> int:
        """Errors."""
        return len(self.errors)


@dataclass(frozen=True, eq=False)
class MeasuredItem:
    """What was measured of one map or path.

    Attributes:
        case: what it was measured against: a place, a log or a truth.
        method: what made it.
        figures: by name, each finite; what is not defined is missing.
        series: single errors, by name.
        seed: number of the repetition of this method in this case; empty for a single one.
        kind: ``map``, ``path``, or ``run`` of an experiment.
    """

    case: str
    method: str
    figures: Mapping[str, float]
    series: Mapping[str, ErrorSeries] = field(default_factory=dict)
    seed: str = ""
    kind: str = "path"

    def to_json(self) -> MeasuredItemJson:
        """Return everything but the series for a JSON document."""
        return {
            "case": self.case,
            "seed": self.seed,
            "method": self.method,
            "kind": self.kind,
            "figures": dict(self.figures),
        }


def map_figures(error: MapError) -> dict[str, float]:
    """Return the figures of a map by name; those that are not defined are left out."""
    outward, back, thickness = error.map_to_truth, error.truth_to_map, error.wall_thickness
    figures = {
        "error": error.error,
        "wall_precision": error.wall_precision,
        "wall_recall": error.wall_recall,
        "wall_f1": error.wall_f1,
        "iou_occupied": error.iou_occupied,
        "iou_free": error.iou_free,
        "map_to_truth_mean_m": None if outward is None else outward.mean_m,
        "truth_to_map_mean_m": None if back is None else back.mean_m,
        "faces_f1": error.faces.f1(_FACES_M),
        "wall_thickness_mean_m": None if thickness is None else thickness.mean_m,
        "doubled_wall_share": error.doubled_wall_share,
        "outside_m2": error.outside_m2,
        "ssim": error.ssim,
        "coverage": error.coverage,
    }
    return {
        name: value for name, value in figures.items() if value is not None and math.isfinite(value)
    }


def path_figures(
    truth: TrajectoryErrors | None, relations: RelationErrors | None
) -> dict[str, float]:
    """Return the figures of a path by name.

    Args:
        truth: its errors against the true path; None: there is none.
        relations: its errors on known relations; None: there are none.
    """
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


def path_series(
    truth: TrajectoryErrors | None, relations: RelationErrors | None
) -> dict[str, ErrorSeries]:
    """Return the single errors of a path by name; see ``path_figures``."""
    found = {}
    if truth is not None:
        at = truth.stamps_s[:, None]
        found["ate_m"] = ErrorSeries(at, truth.translation_m)
        found["ate_rotation_deg"] = ErrorSeries(at, np.rad2deg(truth.rotation_rad))
        found["rpe_m"] = ErrorSeries(
            truth.relative_travelled_m[:, None], truth.relative_translation_m
        )
    if relations is not None:
        found["relations_m"] = ErrorSeries(relations.stamps_s, relations.translation_m)
        found["relations_rotation_deg"] = ErrorSeries(
            relations.stamps_s, np.rad2deg(relations.rotation_rad)
        )
    return {name: series for name, series in found.items() if len(series)}
