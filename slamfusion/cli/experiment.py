"""``slamfusion experiment``: the tables of the papers, computed here, repeated and tested."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import notice, print_json, print_table, progress_bar
from slamfusion.config import RunConfig, to_mapping
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.jobs.documents import plain, versions
from slamfusion.jobs.inputs import Progress, check_writable

if TYPE_CHECKING:
    from slamfusion.compute import ComputeDevice
    from slamfusion.experiments import (
        CellModelRow,
        Drive,
        DriveFiles,
        RealLogTable,
        Results,
        Trial,
    )
    from slamfusion.experiments.records import CellModelsDocument
    from slamfusion.experiments.sheets import Tables
    from slamfusion.report.experiment_report import Difference, Panel
    from slamfusion.report.page import Table

__all__ = ["command"]

FIRST_FLOOR = 1
OUTPUT = click.option(
    "-o",
    "--output",
    "folder",
    required=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder for the tables and pictures; made where it is missing.",
)


@click.group("experiment")
def command() -> None:
    """Repeat an experiment of the papers, with deviations and p-values.

    Writes every single run as CSV, the table as Markdown and JSON, and pictures. What was run
    before an interruption is kept.
    """


# --- Table II ------------------------------------------------------------------------------------


@command.command("cell-models")
@OUTPUT
@common_options
def cell_models(folder: Path, as_json: bool) -> int:
    """Compute Table II of [H16]: a cell told 12 values in two orders.

    Exit code 1 when a value differs from the paper's in its three decimals.
    """
    import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)
    from slamfusion.experiments import table_two  # noqa: PLC0415

    check_writable(folder)
    rows = table_two()
    files = _write_cell_models(folder, rows)
    if as_json:
        document: CellModelsDocument = {
            "rows": [row.to_json() for row in rows],
            "equal": all(row.is_equal for row in rows),
            "files": [str(path) for path in files],
            "versions": versions(),
        }
        print_json(document)
    else:
        heading, cells = _cell_model_table(rows)
        columns = [f"{heading[0]} ", f"{heading[1]} ", *heading[2:-1], f"{heading[-1]} "]
        print_table(columns, cells, title="A cell after 12 observations ([H16], Table II)")
        _print_files(files)
    different = [row for row in rows if not row.is_equal]
    if different:
        where = ", ".join(f"{row.model} {row.order} {row.occupied}" for row in different)
        message = f"{len(different)} of {len(rows)} values differ from Table II of [H16]: {where}"
        raise SlamFusionError(message)
    return 0


def _cell_model_table(rows: Sequence[CellModelRow]) -> tuple[list[str], list[list[str]]]:
    """Return the table in the shape of the paper's: a row for model and order."""
    counts = list(dict.fromkeys(row.occupied for row in rows))
    heading = [
        "model",
        "order",
        *(f"{count} occupied" for count in counts),
        *(f"paper, {count}" for count in counts),
        "equal",
    ]
    cells = []
    for model, order in dict.fromkeys((row.model, row.order) for row in rows):
        own = [row for row in rows if (row.model, row.order) == (model, order)]
        is_equal = all(row.is_equal for row in own)
        cells.append(
            [
                model,
                order,
                *(f"{row.value:.3f}" for row in own),
                *(f"{row.paper:.3f}" for row in own),
                "yes" if is_equal else "NO",
            ]
        )
    return heading, cells


def _write_cell_models(folder: Path, rows: Sequence[CellModelRow]) -> list[Path]:
    """Write the table as CSV, Markdown and JSON, and the picture; all or none."""
    from slamfusion.experiments.table import markdown_table  # noqa: PLC0415
    from slamfusion.io import AtomicFiles  # noqa: PLC0415
    from slamfusion.report.experiment_report import (  # noqa: PLC0415
        Line,
        Panel,
        cell_values_picture,
    )

    heading, cells = _cell_model_table(rows)
    panels = [
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
        files.add(folder / "cell-models.png", cell_values_picture(panels))
    return [folder / name for name in (*contents, "cell-models.png")]


# --- Table III -----------------------------------------------------------------------------------


@command.command("occupancy-estimator")
@OUTPUT
@click.option(
    "--log",
    "log_path",
    type=click.Path(path_type=Path),
    metavar="LOG",
    help="A recorded drive, besides the simulated floors.",
)
@click.option(
    "--relations",
    "relations_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Known motions of the recorded drive [K09].",
)
@click.option(
    "--odometry",
    "odometry_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Raw odometry of its whole run, to carry poses on to the times of the relations.",
)
@click.option(
    "--reference",
    "reference_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The best known trajectory of the recorded drive.",
)
@with_config("experiment.occupancy_estimator", "device", "")
@common_options
def occupancy_estimator(
    folder: Path,
    log_path: Path | None,
    relations_path: Path | None,
    odometry_path: Path | None,
    reference_path: Path | None,
    config: RunConfig,
    as_json: bool,
) -> int:
    """Sweep tinySLAM's cell size with both occupancy estimators: Table III of [H16].

    On simulated office floors, whose truth is known, and on a log where one is given.
    """
    from slamfusion.experiments import DriveFiles, sweep_estimators, verdicts  # noqa: PLC0415
    from slamfusion.experiments.occupancy_estimator import NAME  # noqa: PLC0415

    others = (relations_path, odometry_path, reference_path)
    if log_path is None and any(path is not None for path in others):
        message = "--relations, --odometry and --reference belong to a recorded drive; give --log"
        raise click.UsageError(message)
    recorded = [] if log_path is None else [DriveFiles(log_path, *others)]
    floors = _floors(config.experiment.occupancy_estimator.floors, recorded)
    device = _prepare(folder, config)
    keep = _keeper(folder, NAME, config, device)
    with progress_bar() as progress:
        drives = _drives(recorded, floors, config, device, progress)
        results = sweep_estimators(drives, config, device, keep=keep, progress=progress)
    found = verdicts(results)
    sentences = [verdict.sentence() for verdict in found]
    document = {"verdicts": [verdict.to_json() for verdict in found]}
    pictures = _sweep_pictures(results, NAME)
    _finish(folder, NAME, results, sentences, document, pictures, config, device, as_json)
    return 0


def _sweep_pictures(results: Results, stem: str) -> dict[str, bytes]:
    """Return a picture for each error: against cell size, a line for each estimator."""
    from slamfusion.experiments.drives import TIME  # noqa: PLC0415
    from slamfusion.experiments.table import measure_label  # noqa: PLC0415
    from slamfusion.report.experiment_report import sweep_picture  # noqa: PLC0415

    pictures = {}
    for measure in results.measures():
        if measure != TIME:
            name = measure.rpartition("_")[0].replace("_", "-")
            pictures[f"{stem}-{name}.png"] = sweep_picture(
                _sweep_panels(results, measure),
                x_label="cell size in m",
                y_label=measure_label(measure),
            )
    return pictures


def _sweep_panels(results: Results, measure: str) -> list[Panel]:
    """Return a panel for each drive that has the error."""
    from slamfusion.report.experiment_report import Line, Panel  # noqa: PLC0415

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


# --- Table I -------------------------------------------------------------------------------------


@command.command("cell-models-trajectories")
@OUTPUT
@click.option(
    "--log",
    "logs",
    multiple=True,
    metavar="LOG:RELATIONS[:ODOMETRY]",
    help="A recorded drive with known motions [K09], and raw odometry of its whole run; may be "
    "given several times.",
)
@with_config("experiment.cell_models_trajectories", "device", "")
@common_options
def cell_models_trajectories(
    folder: Path, logs: tuple[str, ...], config: RunConfig, as_json: bool
) -> int:
    """Compare tinySLAM's cell models and gmapping by errors of the trajectory: Table I of [H16].

    On simulated office floors, whose truth is known, and on the logs given.
    """
    from slamfusion.experiments import compare_models, model_sentences  # noqa: PLC0415
    from slamfusion.experiments.cell_models_trajectories import NAME  # noqa: PLC0415

    recorded = [_drive_files(text) for text in logs]
    floors = _floors(config.experiment.cell_models_trajectories.floors, recorded)
    device = _prepare(folder, config)
    keep = _keeper(folder, NAME, config, device)
    with progress_bar() as progress:
        drives = _drives(recorded, floors, config, device, progress)
        results = compare_models(drives, config, device, keep=keep, progress=progress)
    _finish(folder, NAME, results, model_sentences(results), {}, {}, config, device, as_json)
    return 0


def _drive_files(text: str) -> DriveFiles:
    """Return the files of ``LOG:RELATIONS[:ODOMETRY]``."""
    from slamfusion.experiments import DriveFiles  # noqa: PLC0415

    parts = text.split(":")
    if len(parts) not in {2, 3} or not all(parts):
        message = f"--log: wanted LOG:RELATIONS or LOG:RELATIONS:ODOMETRY, found {text!r}"
        raise click.UsageError(message)
    return DriveFiles(*map(Path, parts))


# --- fusion --------------------------------------------------------------------------------------


@command.command("ground-obstacle")
@OUTPUT
@with_config("experiment.ground_obstacle", "device", "")
@common_options
def ground_obstacle(folder: Path, config: RunConfig, as_json: bool) -> int:
    """Compare three producers and their fusions, with and without an obstacle on the ground.

    Tables I to III of [F16]: each drive is simulated, mapped by all producers and fused in every
    way; then every two methods are tested. What is done stays in DIR/trials: started again after
    an interruption, only the rest is run.
    """
    from slamfusion.experiments import compare_with_obstacle, obstacle_trials  # noqa: PLC0415
    from slamfusion.experiments.ground_obstacle import NAME  # noqa: PLC0415

    device = _prepare(folder, config).name
    with progress_bar() as progress:
        table = compare_with_obstacle(config, folder, progress)
    pictures = _differences(folder, obstacle_trials(config))
    _finish_fusion(folder, NAME, table, pictures, config, device, as_json=as_json)
    return 0


@command.command("failures")
@OUTPUT
@with_config("experiment.failures", "device", "")
@common_options
def failures(folder: Path, config: RunConfig, as_json: bool) -> int:
    """Compare three producers and their fusions where the place, the drive or a producer fails.

    Courses: corridor loop, glass, people, slip, kidnapping, broken odometry, lost for good; each
    with each laser. What is done stays in DIR/trials: started again after an interruption, only
    the rest is run.
    """
    from slamfusion.experiments import compare_failures, failure_trials  # noqa: PLC0415
    from slamfusion.experiments.failures import NAME  # noqa: PLC0415

    try:
        trials = failure_trials(config)
    except ConfigError as error:
        raise click.UsageError(str(error)) from None
    device = _prepare(folder, config).name
    with progress_bar() as progress:
        table = compare_failures(config, folder, progress)
    pictures = _differences(folder, trials)
    _finish_fusion(folder, NAME, table, pictures, config, device, as_json=as_json)
    return 0


@command.command("real-logs")
@OUTPUT
@click.option(
    "--datasets",
    required=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder of the recordings, with mit-csail/ and intel/ in it.",
)
@with_config("device", "")
@common_options
def real_logs(folder: Path, datasets: Path, config: RunConfig, as_json: bool) -> int:
    """Compare three producers and their fusions on recorded drives: mit-csail and Intel.

    Against the map drawn from the best trajectory known, the nearest thing to the truth. A drive
    whose files are not in the folder is skipped, and named.
    """
    from slamfusion.experiments import REAL_LOGS, compare_on_logs  # noqa: PLC0415
    from slamfusion.experiments.real_logs import NAME  # noqa: PLC0415

    names = []
    for name, files in REAL_LOGS.items():
        absent = [path for path in (files.log, files.reference) if not (datasets / path).is_file()]
        if absent:
            notice(f"skipped: {name}: {datasets / absent[0]} is not there")
        else:
            names.append(name)
    if not names:
        message = f"no recorded drive in {datasets}; wanted {' or '.join(REAL_LOGS)} there"
        raise SlamFusionError(message)
    device = _prepare(folder, config)
    with progress_bar() as progress:
        table = compare_on_logs(datasets, names, config, device, progress)
    pictures = _map_differences(table)
    _finish_fusion(folder, NAME, table, pictures, config, device.name, as_json=as_json)
    return 0


def _map_differences(table: RealLogTable) -> dict[str, list[Difference]]:
    """Return the maps of recorded drives against the reference maps, by drive."""
    from slamfusion.report.experiment_report import Difference  # noqa: PLC0415

    shown: dict[str, list[Difference]] = {}
    for row in table.rows:
        if row.error is not None:
            caption = f"{row.log}, against the reference map."
            codes, size = row.error.difference, row.error.resolution
            shown.setdefault(row.log, []).append(Difference(row.method, caption, codes, size))
    return shown


def _finish_fusion(
    folder: Path,
    stem: str,
    table: Tables,
    pictures: Mapping[str, Sequence[Difference]],
    config: RunConfig,
    device: str,
    *,
    as_json: bool,
) -> None:
    """Write the tables and the page, and print them."""
    from slamfusion.experiments import write_error_table  # noqa: PLC0415
    from slamfusion.report.experiment_report import write_fusion_experiment  # noqa: PLC0415

    sentences = table.sentences()
    full = {**_circumstances(config, device), "sentences": sentences}
    files = write_error_table(folder, stem, table, full, details=True)
    page = write_fusion_experiment(
        table.title,
        {name: values["ratio"] for name, values in table.overall().items()},
        sentences,
        _page_tables(table),
        pictures,
        folder,
        config=config,
        device=device,
    )
    files.append(page)
    if as_json:
        print_json({**table.to_json(), **full, "files": files})
        return
    print(table.title)
    for sheet in table.sheets(details=False):
        columns = [f"{sheet.heading[0]} ", *sheet.heading[1:]]
        print_table(columns, sheet.rows, title=sheet.title)
    for sentence in sentences:
        print(sentence)
    _print_files(files)


def _page_tables(table: Tables) -> list[Table]:
    """Return the tables as the page has them; all but the first two are folded."""
    from slamfusion.report.page import Cell, Table  # noqa: PLC0415

    return [
        Table(
            sheet.title,
            sheet.heading,
            [[Cell(text, is_number=text[:1].isdigit()) for text in row] for row in sheet.rows],
            sheet.note,
            folded=number > 1,
        )
        for number, sheet in enumerate(table.sheets(details=True))
    ]


def _differences(folder: Path, trials: Sequence[Trial]) -> dict[str, list[Difference]]:
    """Return the maps of the examples against the truth, by condition."""
    from slamfusion.experiments import read_example  # noqa: PLC0415
    from slamfusion.report.experiment_report import Difference  # noqa: PLC0415

    shown = {}
    for trial in trials:
        if trial.is_example:
            example = read_example(folder, trial)
            caption = f"{trial.condition}, world {trial.world}, seed {trial.seed}."
            shown[f"One drive: {trial.condition}"] = [
                Difference(method, caption, codes, example.resolution)
                for method, codes in example.differences.items()
            ]
    return shown


# --- what the repeated ones share ----------------------------------------------------------------


def _prepare(folder: Path, config: RunConfig) -> ComputeDevice:
    """Refuse what cannot end well before any work, and open the device."""
    import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)
    from slamfusion.compute import open_device  # noqa: PLC0415

    check_writable(folder)
    return open_device(config.device.device)


def _floors(count: int, recorded: Sequence[DriveFiles]) -> range:
    """Return the seeds of the simulated floors; there must be something to run on."""
    if not recorded and not count:
        message = "nothing to run on: give --log, or --floors of at least 1"
        raise click.UsageError(message)
    return range(FIRST_FLOOR, FIRST_FLOOR + count)


def _drives(
    recorded: Sequence[DriveFiles],
    floors: Sequence[int],
    config: RunConfig,
    device: ComputeDevice,
    progress: Progress | None,
) -> list[Drive]:
    """Return the recorded drives, then the simulated ones; their names differ."""
    from slamfusion.experiments import read_drive, simulated_office  # noqa: PLC0415

    drives: list[Drive] = []
    for files in recorded:
        drive = read_drive(files, config)
        twins = sum(other.name.split("#")[0] == drive.name for other in drives)
        drives.append(replace(drive, name=f"{drive.name}#{twins + 1}") if twins else drive)
    return drives + [simulated_office(seed, device, progress) for seed in floors]


def _keeper(
    folder: Path, stem: str, config: RunConfig, device: ComputeDevice
) -> Callable[[Results], None]:
    """Return what writes the tables so far: an interruption then loses one condition at most."""
    from slamfusion.experiments import write_results  # noqa: PLC0415

    def keep(results: Results) -> None:
        write_results(folder, stem, results, document=_circumstances(config, device.name))

    return keep


def _finish(
    folder: Path,
    stem: str,
    results: Results,
    sentences: Sequence[str],
    document: Mapping[str, Any],
    pictures: Mapping[str, bytes],
    config: RunConfig,
    device: ComputeDevice,
    as_json: bool,
) -> None:
    """Write everything, and print it."""
    from slamfusion.experiments import write_results  # noqa: PLC0415
    from slamfusion.experiments.table import measure_label  # noqa: PLC0415

    full = {**document, "sentences": list(sentences), **_circumstances(config, device.name)}
    text = "\n".join(["## In words", "", *(f"- {sentence}" for sentence in sentences)])
    files = write_results(folder, stem, results, text=text, document=full, pictures=pictures)
    if as_json:
        print_json({**results.to_json(), **full, "files": files})
        return
    print(results.title)
    for measure in results.measures():
        heading, rows = results.rows(measure)
        columns = [f"{heading[0]} ", *heading[1:]]
        print_table(columns, rows, title=measure_label(measure))
    for sentence in sentences:
        print(sentence)
    _print_files(files)


def _circumstances(config: RunConfig, device: str) -> dict[str, Any]:
    found = {
        "device": device,
        "seed": config.seed,
        "config": to_mapping(config),
        "versions": versions(),
    }
    return {name: plain(value) for name, value in found.items()}


def _print_files(files: Sequence[Path]) -> None:
    for path in files:
        print(path)
