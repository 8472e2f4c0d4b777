"""What experiments draw: their numbers as panels, and maps against the truth for the page.

The only module of experiments that knows ``slamfusion.report``, and with it matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.experiments.cell_models import CellModelRow
from slamfusion.experiments.drives import TIME
from slamfusion.experiments.examples import read_example
from slamfusion.experiments.real_logs import RealLogTable
from slamfusion.experiments.sheets import Tables
from slamfusion.experiments.table import Results, measure_label
from slamfusion.experiments.trials import Trial
from slamfusion.report.canvas import in_form
from slamfusion.report.experiment_report import (
    Difference,
    Line,
    Panel,
    cell_values_picture,
    sweep_picture,
    write_fusion_experiment,
)
from slamfusion.report.page import Cell, Table

__all__ = [
    "Difference",
    "draw_cell_values",
    "draw_sweep",
    "log_differences",
    "trial_differences",
    "write_page_of_tables",
]


def draw_cell_values(rows: Sequence[CellModelRow]) -> bytes:
    """Return a picture of a cell's value after each observation: a panel for each count."""
    return cell_values_picture(
        [
            Panel(
                f"{count} of 12 observations are occupied",
                [
                    Line(f"{row.model}, {row.order}", range(len(row.values)), row.values)
                    for row in rows
                    if row.occupied == count
                ],
            )
            for count in dict.fromkeys(row.occupied for row in rows)
        ]
    )


def draw_sweep(results: Results, stem: str, forms: Sequence[str] = ()) -> dict[str, bytes]:
    """Return a picture for each error, by file name: against cell size, a line for each method.

    Args:
        results: whose factors are drive, cell size and method.
        stem: start of the file names.
        forms: that the pictures are wanted in beside PNG: ``svg``, ``pdf``.
    """
    pictures = {}
    for measure in results.measures():
        if measure != TIME:
            name = measure.rpartition("_")[0].replace("_", "-")
            picture = sweep_picture(
                _sweep_panels(results, measure),
                x_label="cell size in m",
                y_label=measure_label(measure),
            )
            for form in ("png", *forms):
                pictures[f"{stem}-{name}.{form}"] = in_form(picture, form)
    return pictures


def _sweep_panels(results: Results, measure: str) -> list[Panel]:
    """Return a panel for each drive that has the error."""
    panels = []
    for drive in results.levels(0):
        lines = []
        for method in results.levels(2):
            points = [
                (float(size), summary)
                for size in results.levels(1)
                if (summary := results.summary((drive, size, method), measure)) is not None
            ]
            if points:
                sizes, summaries = zip(*points, strict=True)
                means = [summary.mean for summary in summaries]
                deviations = [summary.std or 0.0 for summary in summaries]
                lines.append(Line(str(method), sizes, means, deviations))
        if lines:
            panels.append(Panel(str(drive), lines))
    return panels


def trial_differences(folder: Path, trials: Sequence[Trial]) -> dict[str, list[Difference]]:
    """Return the maps of the examples against the truth, by condition.

    Args:
        folder: where the trials are kept.
        trials: of the experiment.
    """
    shown = {}
    for trial in trials:
        if trial.is_example:
            example = read_example(folder, trial.key)
            caption = f"{trial.condition}, world {trial.world}, seed {trial.seed}."
            shown[f"One drive: {trial.condition}"] = [
                Difference(method, caption, codes, example.resolution)
                for method, codes in example.differences.items()
            ]
    return shown


def log_differences(table: RealLogTable) -> dict[str, list[Difference]]:
    """Return the maps of recorded drives against the reference maps, by drive."""
    shown: dict[str, list[Difference]] = {}
    for row in table.rows:
        if row.error is not None:
            caption = f"{row.log}, against the reference map."
            codes, size = row.error.difference, row.error.resolution
            shown.setdefault(row.log, []).append(Difference(row.method, caption, codes, size))
    return shown


def write_page_of_tables(
    table: Tables,
    pictures: Mapping[str, Sequence[Difference]],
    folder: Path,
    *,
    config: RunConfig,
    device: str,
) -> Path:
    """Write the page of an experiment on fusion: the tables, folded but for two, and the maps."""
    tables = [
        Table(
            sheet.title,
            sheet.heading,
            [[Cell(text, is_number=text[:1].isdigit()) for text in row] for row in sheet.rows],
            sheet.note,
            folded=number > 1,
        )
        for number, sheet in enumerate(table.sheets(details=True))
    ]
    ratios = {name: values["ratio"] for name, values in table.overall().items()}
    return write_fusion_experiment(
        table.title,
        ratios,
        table.borne_out(),
        table.sentences(),
        tables,
        pictures,
        folder,
        config=config,
        device=device,
    )
