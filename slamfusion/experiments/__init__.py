"""The experiments of the papers, run again here: conditions, seeds, tables and p-values.

An experiment runs producers and measures them; it draws nothing and prints nothing. Where times are
measured runs are made one after the other, so that they mean something, and the results so far are
handed out after each condition. Where only errors are, drives run side by side, and each one that
is done is kept.
"""

from __future__ import annotations

from slamfusion.experiments.cell_models import CellModelRow, table_two
from slamfusion.experiments.cell_models_trajectories import compare_models, model_sentences
from slamfusion.experiments.drives import (
    Drive,
    DriveFiles,
    gather_drives,
    read_drive,
    simulated_office,
)
from slamfusion.experiments.error_table import ErrorTable
from slamfusion.experiments.examples import read_example
from slamfusion.experiments.failures import compare_failures, failure_trials
from slamfusion.experiments.ground_obstacle import compare_with_obstacle, obstacle_trials
from slamfusion.experiments.occupancy_estimator import sweep_estimators, verdicts
from slamfusion.experiments.real_logs import (
    REAL_LOGS,
    RealLogTable,
    compare_on_logs,
    logs_there,
    other_slams,
)
from slamfusion.experiments.sheets import write_error_table
from slamfusion.experiments.table import Results, repeat, write_results
from slamfusion.experiments.trials import Trial, TrialRecord

__all__ = [
    "REAL_LOGS",
    "CellModelRow",
    "Drive",
    "DriveFiles",
    "ErrorTable",
    "RealLogTable",
    "Results",
    "Trial",
    "TrialRecord",
    "compare_failures",
    "compare_models",
    "compare_on_logs",
    "compare_with_obstacle",
    "failure_trials",
    "gather_drives",
    "logs_there",
    "model_sentences",
    "obstacle_trials",
    "other_slams",
    "read_drive",
    "read_example",
    "repeat",
    "simulated_office",
    "sweep_estimators",
    "table_two",
    "verdicts",
    "write_error_table",
    "write_results",
]
