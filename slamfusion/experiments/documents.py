"""What experiments write, and the documents that ``slamfusion experiment --json`` prints of it.

Stands on ``slamfusion.report``: its import says what to install where matplotlib is missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from slamfusion.config import RunConfig
from slamfusion.experiments import cell_models, occupancy_estimator, pictures, real_logs
from slamfusion.experiments.cell_models import CellModelRow
from slamfusion.experiments.error_table import ErrorTable
from slamfusion.experiments.examples import Example, example_file
from slamfusion.experiments.occupancy_estimator import Verdict
from slamfusion.experiments.real_logs import RealLogTable
from slamfusion.experiments.records import (
    CellModelsDocument,
    ErrorTableDocument,
    EstimatorSweepDocument,
    RealLogsDocument,
    RepeatedRunsDocument,
)
from slamfusion.experiments.sheets import Tables, write_error_table
from slamfusion.experiments.table import Results, markdown_table, write_results
from slamfusion.experiments.trials import Trial
from slamfusion.io import AtomicFiles
from slamfusion.jobs.documents import circumstances, plain, versions

__all__ = [
    "keep_results",
    "save_cell_models",
    "save_error_table",
    "save_estimator_sweep",
    "save_real_logs",
    "save_runs",
]


# --- cell-models ---------------------------------------------------------------------------------


def save_cell_models(folder: Path, rows: Sequence[CellModelRow]) -> CellModelsDocument:
    """Write the table as CSV, Markdown and JSON, and the picture; all or none.

    Args:
        folder: made when missing.
        rows: of ``table_two``.

    Raises:
        MapFileError: a file cannot be written.
    """
    heading, cells = cell_models.as_table(rows)
    markdown = [
        "# A cell after 12 observations ([H16], Table II)",
        "",
        "Start 0.5; occupied 0.95, free 0.01. Base with quality 0.2, mean (the paper's modified",
        "model) with quality 1. Forward: the occupied observations first; backward: the free ones.",
        "",
        *markdown_table(heading, cells),
        "",
        "![value of the cell after each observation](cell-models.png)",
        "",
    ]
    table = [heading, *cells]
    contents = {
        "cell-models.csv": "".join(",".join(f'"{cell}"' for cell in line) + "\n" for line in table),
        "cell-models.md": "\n".join(markdown),
        "cell-models.json": json.dumps([row.to_json() for row in rows], indent=2) + "\n",
    }
    with AtomicFiles() as files:
        for name, text in contents.items():
            files.add(folder / name, text.encode())
        files.add(folder / "cell-models.png", pictures.draw_cell_values(rows))
    return {
        "rows": [row.to_json() for row in rows],
        "equal": all(row.is_equal for row in rows),
        "files": [str(folder / name) for name in (*contents, "cell-models.png")],
        "versions": versions(),
    }


# --- occupancy-estimator, cell-models-trajectories -----------------------------------------------


def keep_results(
    folder: Path, stem: str, config: RunConfig, device: str
) -> Callable[[Results], None]:
    """Return what writes the tables so far: an interruption then loses one condition at most."""

    def keep(results: Results) -> None:
        write_results(folder, stem, results, document=plain(circumstances(config, device)))

    return keep


def save_estimator_sweep(
    folder: Path, results: Results, found: Sequence[Verdict], config: RunConfig, device: str
) -> EstimatorSweepDocument:
    """Write what ``sweep_estimators`` found, with pictures and verdicts; see ``save_runs``."""
    stem = occupancy_estimator.NAME
    answers = [verdict.to_json() for verdict in found]
    drawn = pictures.draw_sweep(results, stem, config.report.pictures)
    sentences = [verdict.sentence() for verdict in found]
    more = {"verdicts": answers}
    document = save_runs(folder, stem, results, sentences, config, device, more=more, drawn=drawn)
    return {**document, "verdicts": answers}


def save_runs(
    folder: Path,
    stem: str,
    results: Results,
    sentences: Sequence[str],
    config: RunConfig,
    device: str,
    *,
    more: Mapping[str, Any] | None = None,
    drawn: Mapping[str, bytes] | None = None,
) -> RepeatedRunsDocument:
    """Write tables of runs, and what they say; all or none.

    Args:
        folder: made when missing.
        stem: start of the file names.
        results: all runs.
        sentences: what is said of them.
        config: the settings in effect.
        device: what computed, in words.
        more: joins the JSON file.
        drawn: pictures by file name.

    Raises:
        MapFileError: a file cannot be written.
    """
    told = {"sentences": list(sentences), **circumstances(config, device)}
    files = write_results(
        folder,
        stem,
        results,
        text="\n".join(["## In words", "", *(f"- {sentence}" for sentence in sentences)]),
        document=plain({**(more or {}), **told}),
        pictures=drawn,
    )
    return {
        **results.to_json(),
        "sentences": list(sentences),
        **circumstances(config, device),
        "files": [str(path) for path in files],
    }


# --- experiments on fusion -----------------------------------------------------------------------


def save_error_table(
    folder: Path,
    stem: str,
    table: ErrorTable,
    trials: Sequence[Trial],
    config: RunConfig,
    device: str,
) -> ErrorTableDocument:
    """Write the errors of trials: the tables, then the page.

    Args:
        folder: with the trials in it.
        stem: start of the file names.
        table: their errors.
        trials: the experiment's.
        config: the settings in effect.
        device: what computed, in words.

    Raises:
        SlamFusionError: a file cannot be written.
    """
    shown = pictures.trial_differences(folder, trials)
    files = _save_tables(folder, stem, table, shown, config, device)
    return {
        **table.to_json(),
        **circumstances(config, device),
        "sentences": table.sentences(),
        "files": files,
    }


def save_real_logs(
    folder: Path, table: RealLogTable, config: RunConfig, device: str
) -> RealLogsDocument:
    """Write what ``compare_on_logs`` found: the tables, then the page and the maps that it shows.

    Args:
        folder: made when missing.
        table: the maps of all drives.
        config: the settings in effect.
        device: what computed, in words.

    Raises:
        SlamFusionError: a file cannot be written.
    """
    shown = pictures.log_differences(table)
    files = _save_tables(folder, real_logs.NAME, table, shown, config, device)
    with AtomicFiles() as kept:
        for name, differences in shown.items():
            codes = {item.title: item.codes for item in differences}
            kept.add(example_file(folder, name), Example(codes, differences[0].resolution).packed())
    return {
        **table.to_json(),
        **circumstances(config, device),
        "sentences": table.sentences(),
        "files": files,
    }


def _save_tables(
    folder: Path,
    stem: str,
    table: Tables,
    shown: Mapping[str, Sequence[pictures.Difference]],
    config: RunConfig,
    device: str,
) -> list[str]:
    """Write tables and page; return the files."""
    document: dict[str, Any] = plain(
        {**circumstances(config, device), "sentences": table.sentences()}
    )
    files = write_error_table(folder, stem, table, document, details=True)
    page = pictures.write_page_of_tables(table, shown, folder, config=config, device=device)
    return [str(path) for path in (*files, page)]
