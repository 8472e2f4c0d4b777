"""``slamfusion experiment``: the tables of the papers, computed here, repeated and tested."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamfusion.cli.fleet import asked_scheduler, scheduler_option
from slamfusion.cli.options import case_option, common_options, output_option, with_config
from slamfusion.cli.output import notice, print_json, print_table, progress_bar
from slamfusion.cli.paths import CASE_MAP, FILE, InputPath
from slamfusion.cli.results import results_option, save_results
from slamfusion.cli.table_files import table_option
from slamfusion.config import PICTURE_FORMS, RunConfig
from slamfusion.errors import ConfigError
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.inputs import device_for
from slamfusion.jobs.outputs import possible_report

if TYPE_CHECKING:
    from slamfusion.experiments import DriveFiles, Results
    from slamfusion.experiments.records import (
        ErrorTableDocument,
        RealLogsDocument,
        RepeatedRunsDocument,
    )
    from slamfusion.experiments.sheets import Tables
    from slamfusion.jobs.saved_maps import SavedMaps

__all__ = ["command"]

FIRST_FLOOR = 1


def _files(folder: Path, _: Mapping[str, Any]) -> list[Path]:
    """Return what may be written: tables, pictures, the page, and what is kept of drives."""
    from slamfusion.experiments.examples import FOLDER  # noqa: PLC0415  (loads slowly)

    stem = click.get_current_context().command.name
    tables = [folder / f"{stem}.{ending}" for ending in ("csv", "md", "json", "png")]
    pictures = [path for form in PICTURE_FORMS for path in folder.glob(f"{stem}-*.{form}")]
    return [*tables, *pictures, *possible_report(folder), *(folder / FOLDER).glob("*")]


def _read_of_drive(text: Path, given: Mapping[str, Any]) -> list[Path]:
    """Return the files of ``LOG:RELATIONS[:ODOMETRY]``."""
    parts = dataclasses.astuple(_drive_files(text))
    return [file for part in parts if part is not None for file in FILE.files(part, given)]


def _read_of_datasets(folder: Path, _: Mapping[str, Any]) -> list[Path]:
    from slamfusion.experiments import REAL_LOGS  # noqa: PLC0415  (loads slowly)

    return [folder / name for log in REAL_LOGS.values() for name in (log.log, log.reference)]


OUTPUT = output_option(
    "-o",
    "--output",
    "folder",
    files=_files,
    required=True,
    metavar="DIR",
    help="Folder for the tables and pictures; made where it is missing.",
)


F = TypeVar("F", bound=Callable[..., Any])


def _experiment(*sections: str) -> Callable[[F], F]:
    """Return what gives a command the settings of sections and the options that all have."""

    def decorate(function: F) -> F:
        function = common_options(results_option(table_option(function)))
        return with_config(*sections)(function) if sections else function

    return decorate


@click.group("experiment")
def command() -> None:
    """Repeat an experiment of the papers, with deviations and p-values.

    Writes every single run as CSV, the table as Markdown and JSON, and pictures. What was run
    before an interruption is kept.
    """


# --- Table II ------------------------------------------------------------------------------------


@command.command("cell-models")
@OUTPUT
@_experiment()
def cell_models(folder: Path, results_path: Path | None, as_json: bool) -> int:
    """Compute Table II of [H16]: a cell told 12 values in two orders.

    Exit code 1 when a value differs from the paper's in its three decimals.
    """
    from slamfusion.experiments.cell_models import (  # noqa: PLC0415
        as_table,
        check_table_two,
        table_two,
    )
    from slamfusion.experiments.documents import save_cell_models  # noqa: PLC0415

    rows = table_two()
    document = save_cell_models(folder, rows)
    save_results(results_path, document, [own for row in rows for own in row.figure_rows()])
    if as_json:
        print_json(document)
    else:
        heading, cells = as_table(rows)
        columns = [f"{heading[0]} ", f"{heading[1]} ", *heading[2:-1], f"{heading[-1]} "]
        print_table(columns, cells, title="A cell after 12 observations ([H16], Table II)")
        print(*document["files"], sep="\n")
    check_table_two(rows)
    return 0


# --- Table III -----------------------------------------------------------------------------------


@command.command("occupancy-estimator")
@OUTPUT
@click.option(
    "--log",
    "log_path",
    type=FILE,
    metavar="LOG",
    help="A recorded drive, besides the simulated floors.",
)
@click.option(
    "--relations",
    "relations_path",
    type=FILE,
    metavar="FILE",
    help="Known motions of the recorded drive [K09].",
)
@click.option(
    "--odometry",
    "odometry_path",
    type=FILE,
    metavar="FILE",
    help="Raw odometry of its whole run, to carry poses on to the times of the relations.",
)
@click.option(
    "--reference",
    "reference_path",
    type=FILE,
    metavar="FILE",
    help="The best known trajectory of the recorded drive.",
)
@_experiment("experiment.occupancy_estimator", "report", "device", "")
def occupancy_estimator(
    folder: Path,
    log_path: Path | None,
    relations_path: Path | None,
    odometry_path: Path | None,
    reference_path: Path | None,
    config: RunConfig,
    results_path: Path | None,
    as_json: bool,
) -> int:
    """Sweep tinySLAM's cell size with both occupancy estimators: Table III of [H16].

    On simulated office floors, whose truth is known, and on a log where one is given.
    """
    from slamfusion.experiments import (  # noqa: PLC0415
        DriveFiles,
        gather_drives,
        sweep_estimators,
        verdicts,
    )
    from slamfusion.experiments.documents import (  # noqa: PLC0415
        keep_results,
        save_estimator_sweep,
    )
    from slamfusion.experiments.occupancy_estimator import NAME  # noqa: PLC0415

    others = (relations_path, odometry_path, reference_path)
    if log_path is None and any(path is not None for path in others):
        message = "--relations, --odometry and --reference belong to a recorded drive; give --log"
        raise click.UsageError(message)
    recorded = [] if log_path is None else [DriveFiles(log_path, *others)]
    floors = _floors(config.experiment.occupancy_estimator.floors, recorded)
    device = device_for(config)
    keep = keep_results(folder, NAME, config, device.name)
    with progress_bar() as progress:
        drives = gather_drives(recorded, floors, config, device, progress)
        results = sweep_estimators(drives, config, device, keep=keep, progress=progress)
    document = save_estimator_sweep(folder, results, verdicts(results), config, device.name)
    save_results(results_path, document, results.figure_rows(), lambda: _drive_inputs(recorded))
    return _show(document, as_json, lambda: _print_results(results))


# --- Table I -------------------------------------------------------------------------------------


@command.command("cell-models-trajectories")
@OUTPUT
@click.option(
    "--log",
    "logs",
    multiple=True,
    type=InputPath(_read_of_drive),
    metavar="LOG:RELATIONS[:ODOMETRY]",
    help="A recorded drive with known motions [K09], and raw odometry of its whole run; may be "
    "given several times.",
)
@_experiment("experiment.cell_models_trajectories", "device", "")
def cell_models_trajectories(
    folder: Path,
    logs: tuple[Path, ...],
    config: RunConfig,
    results_path: Path | None,
    as_json: bool,
) -> int:
    """Compare tinySLAM's cell models and gmapping by errors of the trajectory: Table I of [H16].

    On simulated office floors, whose truth is known, and on the logs given.
    """
    from slamfusion.experiments import (  # noqa: PLC0415
        compare_models,
        gather_drives,
        model_sentences,
    )
    from slamfusion.experiments.cell_models_trajectories import NAME  # noqa: PLC0415
    from slamfusion.experiments.documents import keep_results, save_runs  # noqa: PLC0415

    recorded = [_drive_files(text) for text in logs]
    floors = _floors(config.experiment.cell_models_trajectories.floors, recorded)
    device = device_for(config)
    keep = keep_results(folder, NAME, config, device.name)
    with progress_bar() as progress:
        drives = gather_drives(recorded, floors, config, device, progress)
        results = compare_models(drives, config, device, keep=keep, progress=progress)
    document = save_runs(folder, NAME, results, model_sentences(results), config, device.name)
    save_results(results_path, document, results.figure_rows(), lambda: _drive_inputs(recorded))
    return _show(document, as_json, lambda: _print_results(results))


def _drive_files(text: Path) -> DriveFiles:
    """Return the files of ``LOG:RELATIONS[:ODOMETRY]``."""
    from slamfusion.experiments import DriveFiles  # noqa: PLC0415

    parts = str(text).split(":")
    if len(parts) not in {2, 3} or not all(parts):
        message = f"--log: wanted LOG:RELATIONS or LOG:RELATIONS:ODOMETRY, found '{text}'"
        raise click.UsageError(message)
    # No shell expands what follows a colon.
    return DriveFiles(*(FILE.convert(part, None, None) for part in parts))


# --- fusion --------------------------------------------------------------------------------------


@command.command("ground-obstacle")
@OUTPUT
@scheduler_option("the drives")
@_experiment("experiment.ground_obstacle", "report", "device", "")
def ground_obstacle(
    folder: Path,
    scheduler: str | None,
    config: RunConfig,
    results_path: Path | None,
    as_json: bool,
) -> int:
    """Compare three producers and their fusions, with and without an obstacle on the ground.

    Tables I to III of [F16]: each drive is simulated, mapped by all producers and fused in every
    way; then every two methods are tested. What is done stays in DIR/trials: started again after
    an interruption, only the rest is run.
    """
    from slamfusion.experiments import compare_with_obstacle, obstacle_trials  # noqa: PLC0415
    from slamfusion.experiments.documents import save_error_table  # noqa: PLC0415
    from slamfusion.experiments.ground_obstacle import NAME  # noqa: PLC0415

    device = device_for(config).name
    with asked_scheduler(scheduler, config) as fleet, progress_bar() as progress:
        table = compare_with_obstacle(config, folder, progress, fleet)
    document = save_error_table(folder, NAME, table, obstacle_trials(config), config, device)
    save_results(results_path, document, table.figure_rows())
    return _show(document, as_json, lambda: _print_tables(table))


@command.command("failures")
@OUTPUT
@scheduler_option("the drives")
@_experiment("experiment.failures", "report", "device", "")
def failures(
    folder: Path,
    scheduler: str | None,
    config: RunConfig,
    results_path: Path | None,
    as_json: bool,
) -> int:
    """Compare three producers and their fusions where the place, the drive or a producer fails.

    Courses: corridor loop, glass, people, slip, kidnapping, broken odometry, lost for good; each
    with each laser. What is done stays in DIR/trials: started again after an interruption, only
    the rest is run.
    """
    from slamfusion.experiments import compare_failures, failure_trials  # noqa: PLC0415
    from slamfusion.experiments.documents import save_error_table  # noqa: PLC0415
    from slamfusion.experiments.failures import NAME  # noqa: PLC0415

    try:
        trials = failure_trials(config)
    except ConfigError as error:
        raise click.UsageError(str(error)) from None
    device = device_for(config).name
    with asked_scheduler(scheduler, config) as fleet, progress_bar() as progress:
        table = compare_failures(config, folder, progress, fleet)
    document = save_error_table(folder, NAME, table, trials, config, device)
    save_results(results_path, document, table.figure_rows())
    return _show(document, as_json, lambda: _print_tables(table))


@command.command("real-logs")
@OUTPUT
@click.option(
    "--datasets",
    required=True,
    type=InputPath(_read_of_datasets),
    metavar="DIR",
    help="Folder of the recordings, with mit-csail/ and intel/ in it.",
)
@case_option(
    "--inputs",
    "maps",
    "MAP",
    "Saved map of another SLAM, of a drive whose name it says.",
    CASE_MAP,
)
@case_option(
    "--paths", "paths", "PATH", "The path that was found with such a map, named as that is."
)
@_experiment("report", "device", "")
def real_logs(
    folder: Path,
    datasets: Path,
    maps: tuple[CaseFile, ...],
    paths: tuple[CaseFile, ...],
    config: RunConfig,
    results_path: Path | None,
    as_json: bool,
) -> int:
    """Compare three producers and their fusions on recorded drives: mit-csail and Intel.

    Against the map drawn from the best trajectory known, the nearest thing to the truth. A drive
    whose files are not in the folder is skipped, and named. Maps of other SLAMs are measured and
    vote, too: intel/karto.yaml and intel_karto.yaml are karto's of intel, or intel=MAP.
    """
    from slamfusion.experiments import compare_on_logs, logs_there, other_slams  # noqa: PLC0415
    from slamfusion.experiments.documents import save_real_logs  # noqa: PLC0415

    names = logs_there(datasets, notice)
    others = other_slams(names, maps, paths)
    device = device_for(config)
    with progress_bar() as progress:
        table = compare_on_logs(datasets, names, config, device, progress, others)
    document = save_real_logs(folder, table, config, device.name)
    save_results(
        results_path, document, table.figure_rows(), lambda: _log_inputs(datasets, names, others)
    )
    return _show(document, as_json, lambda: _print_tables(table))


# --- what they share -----------------------------------------------------------------------------


def _floors(count: int, recorded: Sequence[DriveFiles]) -> range:
    """Return the seeds of the simulated floors; there must be something to run on."""
    if not recorded and not count:
        message = "nothing to run on: give --log, or --floors of at least 1"
        raise click.UsageError(message)
    return range(FIRST_FLOOR, FIRST_FLOOR + count)


def _drive_inputs(recorded: Sequence[DriveFiles]) -> list[tuple[str, str, Path]]:
    """Return role, drive and path of the files of recorded drives."""
    return [
        (role, files.log.stem, path)
        for files in recorded
        for role, path in (
            ("log", files.log),
            ("relations", files.relations),
            ("odometry", files.odometry),
            ("truth", files.reference),
        )
        if path is not None
    ]


def _log_inputs(
    folder: Path, names: Sequence[str], others: Mapping[str, SavedMaps]
) -> list[tuple[str, str, Path]]:
    """Return the files of drives of the data sets, and of other SLAMs' maps and paths of them."""
    from slamfusion.experiments import REAL_LOGS  # noqa: PLC0415
    from slamfusion.jobs.results import map_inputs  # noqa: PLC0415

    saved = [item for name in names for item in map_inputs("map", name, others[name].files)]
    saved += [("path", name, path) for name in names for path in others[name].paths.values()]
    return saved + [
        (role, name, folder / path)
        for name in names
        for role, path in (("log", REAL_LOGS[name].log), ("truth", REAL_LOGS[name].reference))
    ]


def _show(
    document: RepeatedRunsDocument | ErrorTableDocument | RealLogsDocument,
    as_json: bool,
    print_tables: Callable[[], None],
) -> int:
    """Print the document, or the tables, what they say, and the files."""
    if as_json:
        print_json(document)
    else:
        print_tables()
        print(*document["sentences"], *document["files"], sep="\n")
    return 0


def _print_results(results: Results) -> None:
    """Print a table for each measure."""
    from slamfusion.experiments.table import measure_label  # noqa: PLC0415

    print(results.title)
    for measure in results.measures():
        heading, rows = results.rows(measure)
        columns = [f"{heading[0]} ", *heading[1:]]
        print_table(columns, rows, title=measure_label(measure))


def _print_tables(table: Tables) -> None:
    """Print the tables without their details."""
    print(table.title)
    for sheet in table.sheets(details=False):
        columns = [f"{sheet.heading[0]} ", *sheet.heading[1:]]
        print_table(columns, sheet.rows, title=sheet.title)
