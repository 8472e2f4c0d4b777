"""``slamfusion experiment``: the tables of the papers, computed here, repeated and tested."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import click

from slamfusion import experiments
from slamfusion.cli import options, results
from slamfusion.cli.help import Group
from slamfusion.cli.output import Table, notice, print_if_json, progress_bar
from slamfusion.cli.paths import CASE_MAP, FILE, InputPath
from slamfusion.config import PICTURE_FORMS, RunConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.inputs import LogFiles, device_for
from slamfusion.jobs.outputs import TRIALS


def _files(folder: Path, _: Mapping[str, Any]) -> list[Path]:
    """Return what may be written: the tables, the plot, and what is kept of runs."""
    stem = click.get_current_context().command.name
    tables = [folder / f"{stem}.{ending}" for ending in ("csv", "md", "png", *PICTURE_FORMS)]
    return [*tables, *(folder / TRIALS).glob("*")]


def _read_of_drive(text: Path, given: Mapping[str, Any]) -> list[Path]:
    parts = astuple(_drive_files(text))
    return [file for part in parts if part is not None for file in FILE.files(part, given)]


def _read_of_datasets(folder: Path, _: Mapping[str, Any]) -> list[Path]:
    logs = experiments.real_logs.REAL_LOGS.values()
    return [folder / name for log in logs for name in (log.log, log.reference)]


def _experiment(
    *sections: str,
) -> Callable[[Callable[..., experiments.page.Experiment]], Callable[..., None]]:
    """Return what makes a command of a function: options that all have, and the output."""

    def decorate(function: Callable[..., experiments.page.Experiment]) -> Callable[..., None]:
        @functools.wraps(function)
        def run(
            folder: Path, config: RunConfig, scheduler: str | None = None, **given: Any
        ) -> None:
            from slamfusion.compute import NumpyDevice  # noqa: PLC0415  (loads slowly)

            device = device_for(config) if "device" in sections else NumpyDevice()
            with progress_bar() as progress:
                setup = experiments.runs.Setup(
                    config, device, folder, progress, scheduler=scheduler
                )
                found = function(setup, **given)
            files = found.write(folder, config.report.pictures)
            document = found.document(files, config, device.name)
            results.save_results(document, found.rows, lambda: found.read)
            if not print_if_json(document):
                print(found.title)
                for title, heads, rows in found.text_tables(details=False):
                    Table([f"{heads[0]} ", *heads[1:]], rows, title=title).print()
                print(*document.sentences, *files, sep="\n")
            if found.failure:
                raise SlamFusionError(found.failure)

        command = options.settings(*sections)(
            options.common(results.results_option(results.table_option(run)))
        )
        text = "Write the results, tables and the plot to this folder."
        return options.main_output("folder", "DIR", text, _files)(command)

    return decorate


@click.group("experiment", cls=Group)
def command() -> None:
    """Repeat an experiment of a paper.

    Writes every result as CSV, the tables and tests as Markdown, and a plot. After an interruption,
    the same command runs only what is missing.
    """


@command.command("cell-models")
@_experiment("report")
def cell_models(_: experiments.runs.Setup) -> experiments.page.Experiment:
    """Compute Table II of [H16], a cell that receives 12 values in two orders.

    The exit code is 1 if a value differs from the paper in its three decimals.
    """
    return experiments.tinyslam.table_two()


@command.command("occupancy-estimator")
@options.file("--log", "log", "LOG", "A recorded drive, in addition to the simulated floors.")
@options.file("--relations", "relations", "FILE", "Known motions of the recorded drive [K09].")
@options.file(
    "--odometry",
    "odometry",
    "FILE",
    "Raw odometry of its whole run. It carries poses to the times of the relations.",
)
@options.file("--reference", "truth", "FILE", "The best known trajectory of the recorded drive.")
@_experiment("experiment.occupancy_estimator", "report", "device", "")
def occupancy_estimator(
    setup: experiments.runs.Setup, log: Path | None, **others: Path | None
) -> experiments.page.Experiment:
    """Sweep tinySLAM's cell size with both occupancy estimators, Table III of [H16].

    Uses simulated office floors, whose truth is known, and a recorded drive with --log.
    """
    message = "--relations, --odometry and --reference belong to a recorded drive; give --log"
    options.refuse(log is None and any(path is not None for path in others.values()), message)
    recorded = [] if log is None else [LogFiles(log, **others)]
    _check_drives(setup.config.experiment.occupancy_estimator.floors, recorded)
    return experiments.tinyslam.sweep_estimators(recorded, setup)


@command.command("cell-models-trajectories")
@click.option(
    "--log",
    "logs",
    multiple=True,
    type=InputPath(_read_of_drive),
    metavar="LOG:RELATIONS[:ODOMETRY]",
    help="A recorded drive with known motions [K09] and raw odometry. Can be repeated.",
)
@_experiment("experiment.cell_models_trajectories", "report", "device", "")
def cell_models_trajectories(
    setup: experiments.runs.Setup, logs: tuple[Path, ...]
) -> experiments.page.Experiment:
    """Compare tinySLAM's cell models and gmapping by path errors, Table I of [H16].

    Uses simulated office floors, whose truth is known, and the recorded drives of --log.
    """
    recorded = [_drive_files(text) for text in logs]
    _check_drives(setup.config.experiment.cell_models_trajectories.floors, recorded)
    return experiments.tinyslam.compare_models(recorded, setup)


def _drive_files(text: Path) -> LogFiles:
    """Return the files of ``LOG:RELATIONS[:ODOMETRY]``."""
    parts = str(text).split(":")
    if len(parts) not in {2, 3} or not all(parts):
        message = f"--log: wanted LOG:RELATIONS or LOG:RELATIONS:ODOMETRY, found '{text}'"
        raise click.UsageError(message)
    # No shell expands what follows a colon.
    return LogFiles(*(FILE.convert(part, None, None) for part in parts))


def _check_drives(floors: int, recorded: Sequence[LogFiles]) -> None:
    message = "nothing to run on: give --log, or --floors of at least 1"
    options.refuse(not recorded and not floors, message)


@command.command("ground-obstacle")
@options.scheduler("the drives")
@_experiment("experiment.ground_obstacle", "report", "device", "")
def ground_obstacle(setup: experiments.runs.Setup) -> experiments.page.Experiment:
    """Compare three SLAMs and their fusions, with and without an obstacle on the ground.

    Tables I to III of [F16]. Each drive is simulated, mapped by all SLAMs and fused in every way;
    then every two methods are tested. Finished drives stay in DIR/trials.
    """
    return experiments.trials.compare_with_obstacle(setup)


@command.command("failures")
@options.scheduler("the drives")
@_experiment("experiment.failures", "report", "device", "")
def failures(setup: experiments.runs.Setup) -> experiments.page.Experiment:
    """Compare three SLAMs and their fusions in difficult places and drives.

    Courses: corridor loop, glass, people, slip, kidnapping, broken odometry, lost for good, each
    with each laser. Finished drives stay in DIR/trials.
    """
    try:
        return experiments.trials.compare_failures(setup)
    except ConfigError as error:
        raise click.UsageError(str(error)) from None


@command.command("real-logs")
@click.option(
    "--datasets",
    required=True,
    type=InputPath(_read_of_datasets),
    metavar="DIR",
    help="Folder with the recordings mit-csail/ and intel/.",
)
@options.case(
    "--inputs", "maps", "MAP", "Saved map of another SLAM. Its name contains the drive.", CASE_MAP
)
@options.case("--paths", "paths", "PATH", "The path of such a map, with the same name.")
@_experiment("report", "device", "")
def real_logs(
    setup: experiments.runs.Setup,
    datasets: Path,
    maps: tuple[CaseFile, ...],
    paths: tuple[CaseFile, ...],
) -> experiments.page.Experiment:
    """Compare three SLAMs and their fusions on recorded drives, mit-csail and Intel.

    The reference is the map drawn at the best known trajectory. Drives that are not in the folder
    are skipped. Maps of other SLAMs are measured and vote too: intel/karto.yaml and
    intel_karto.yaml are the maps of karto for intel, or intel=MAP.
    """
    names = experiments.real_logs.logs_there(datasets, notice)
    others = experiments.real_logs.other_slams(names, maps, paths)
    return experiments.real_logs.compare_on_logs(datasets, names, setup, others)
