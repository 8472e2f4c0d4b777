"""The experiments of the papers, run again here: conditions, seeds, tables and p-values.

An experiment runs producers and measures them; it draws nothing and prints nothing. Runs are made
one after the other, so that the times that they take mean something, and the results so far are
handed out after each condition.
"""

from __future__ import annotations

from slamfusion.experiments.cell_models import CellModelRow, table_two
from slamfusion.experiments.cell_models_trajectories import compare_models, model_sentences
from slamfusion.experiments.drives import Drive, DriveFiles, read_drive, simulated_office
from slamfusion.experiments.occupancy_estimator import sweep_estimators, verdicts
from slamfusion.experiments.table import Results, Run, repeat, write_results

__all__ = [
    "CellModelRow",
    "Drive",
    "DriveFiles",
    "Results",
    "Run",
    "compare_models",
    "model_sentences",
    "read_drive",
    "repeat",
    "simulated_office",
    "sweep_estimators",
    "table_two",
    "verdicts",
    "write_results",
]
