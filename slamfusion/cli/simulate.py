"""``slamfusion simulate``: a robot's log of a drawn place, with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from slamfusion import jobs
from slamfusion.cli import options
from slamfusion.cli.help import Command
from slamfusion.cli.output import Table, notice, print_if_json, progress_bar
from slamfusion.cli.paths import MAP, InputPath
from slamfusion.config import COURSES, RunConfig
from slamfusion.jobs.records import number


class _Command(Command):
    """Lists the named courses in the help, from their one table."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the courses."""
        with formatter.section("Courses"):
            formatter.write_dl([(name, words) for name, (words, _) in COURSES.items()])


def _read(path: Path, given: Mapping[str, Any]) -> list[Path]:
    """Return the file of a course, and those of the map that it takes place in."""
    course = jobs.simulate.choose_course(path, given["config"])
    world = course.world.map
    return [path, *([] if world is None else MAP.files(Path(world), given))]


def _files(folder: Path, given: Mapping[str, Any]) -> list[Path]:
    from slamfusion.sim.simulate import recording_files  # noqa: PLC0415

    course = jobs.simulate.choose_course(given["course"], given["config"])
    return recording_files(course, folder)


@click.command(
    "simulate",
    cls=_Command,
    examples=["simulate office -o out/drive", "simulate f16 --lidar rplidar --seed 1 -o out/drive"],
)
@click.argument("course", type=InputPath(_read))
@options.main_output(
    "folder", "DIR", "Write the log, the truth and the course to this folder.", _files
)
@options.settings("simulate", "device", "")
@options.common
@click.pass_context
def command(context: click.Context, course: Path, folder: Path, config: RunConfig) -> None:
    """Simulate a robot's log, with the true map and path.

    COURSE is the name of a course, or a YAML file. The command writes NAME.log.gz (a CARMEN log),
    truth.yaml and .pgm (the true map with solid walls), truth_thin.yaml and .pgm (only the surfaces
    of walls, which a lidar can see), truth.tum (the true poses) and course.yaml, which reproduces
    these files.
    """
    source = context.get_parameter_source("config_seed")
    is_seed_given = source != click.core.ParameterSource.DEFAULT
    seed = config.seed if is_seed_given else None
    wanted = jobs.simulate.choose_course(course, config, seed=seed)
    with progress_bar() as progress:
        drive = jobs.simulate.simulate_course(wanted, config, progress=progress)
    made = jobs.simulate.save_simulated_drive(drive, folder)
    if made.waypoints_left_out:
        notice(f"waypoints left out, which this robot cannot reach: {made.waypoints_left_out}")
    if print_if_json(made):
        return
    end, done = made.odometry_end_error, made.recording.course
    rows = [
        ["course", f"{done.name}, seed {done.seed}"],
        ["robot", f"{done.drive.model}, {done.lidar.model} of {done.lidar.beams} beams"],
        ["scans", str(made.scans)],
        ["duration", f"{number(made.duration_s, 1)} s"],
        ["path", f"{number(made.path_m, 1)} m"],
        ["no return", f"{number(100.0 * made.no_return_share, 1)} % of the readings"],
        [
            "odometry at the end",
            f"{number(end.translation_m, 2)} m and {number(end.rotation_deg, 1)} deg off",
        ],
        *(["file", str(path)] for path in made.files),
        ["time", f"{number(made.time_s, 1)} s on {made.device}"],
    ]
    Table((" ", " "), rows, title="Simulated drive", has_head=False).print()
