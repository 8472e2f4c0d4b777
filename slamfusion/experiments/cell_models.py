"""Table II of [H16]: what the cell models make of twelve observations in two orders.

Deterministic: a cell starts at 0.5 and receives 12 values, of which 3, 6 or 9 are occupied (0.95)
and the others free (0.01). Base has quality 0.2, mean (the paper's modified model) quality 1.

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

from slamfusion.evaluation import Row, result_rows
from slamfusion.experiments.page import Experiment
from slamfusion.slam.tinyslam.cell_models import CELL_MODELS

OBSERVATIONS = 12
OCCUPIED_COUNTS = (3, 6, 9)
OCCUPIED_VALUE, FREE_VALUE = 0.95, 0.01
QUALITY = {"base": 0.2, "mean": 1.0}
# "Forward": the occupied observations come first; "backward": the free ones.
PAPER = {
    ("base", "forward"): (0.105, 0.225, 0.460),
    ("base", "backward"): (0.502, 0.737, 0.858),
    ("mean", "forward"): (0.245, 0.480, 0.715),
    ("mean", "backward"): (0.245, 0.480, 0.715),
}


def table_two() -> Experiment:
    """Compute every cell of the table; it fails where a value is not the paper's."""
    rows: list[Row] = []
    different = []
    for (model, order), printed in PAPER.items():
        for occupied, paper in zip(OCCUPIED_COUNTS, printed, strict=True):
            observed = [OCCUPIED_VALUE] * occupied + [FREE_VALUE] * (OBSERVATIONS - occupied)
            if order == "backward":
                observed.reverse()
            value = float(CELL_MODELS[model](observed, QUALITY[model])[-1])
            case = f"{order}, {occupied} occupied"
            rows += result_rows(case, "", model, {"value": value})
            rows += result_rows(case, "", f"{model} [H16]", {"value": paper})
            if f"{value:.3f}" != f"{paper:.3f}":
                different.append(f"{model}, {case}: found {value:.3f}, wanted {paper:.3f}")
    failure = f"{len(different)} values differ from Table II of [H16]: {'; '.join(different)}"
    return Experiment(
        "cell-models",
        "A cell after 12 observations ([H16], Table II)",
        rows,
        ("value",),
        failure=failure if different else "",
    )
