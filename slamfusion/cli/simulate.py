"""``slamfusion simulate``: a robot's log of a drawn place, with the truth."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import notice, number, print_json, print_table, progress_bar
from slamfusion.config import RunConfig, to_mapping
from slamfusion.jobs.documents import versions
from slamfusion.jobs.inputs import check_writable

if TYPE_CHECKING:
    from slamfusion.jobs.tool_records import SimulatedDriveJson, SimulateDocument
    from slamfusion.sim import Course, Recording

__all__ = ["command"]

SUFFIXES = {".yaml", ".yml"}


class _Command(click.Command):
    """Lists the named courses in the help, from their one table."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the courses."""
        from slamfusion.sim import COURSES  # noqa: PLC0415  (SciPy loads slowly)

        with formatter.section("Courses"):
            formatter.write_dl([(name, words) for name, (words, _) in COURSES.items()])


@click.command("simulate", cls=_Command)
@click.argument("course")
@click.option(
    "-o",
    "--output",
    "folder",
    required=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder for the log, the truth and the course; made where it is missing.",
)
@with_config("simulate", "device", "")
@common_options
@click.pass_context
def command(
    context: click.Context, course: str, folder: Path, config: RunConfig, as_json: bool
) -> int:
    """Simulate a robot that drives COURSE: the name of a course, or a YAML file.

    Writes DIR/NAME.log.gz (a CARMEN log), DIR/truth.yaml and .pgm (the true map), DIR/truth.tum
    (the true poses) and DIR/course.yaml, which gives the same files again.
    """
    from slamfusion.compute import open_device  # noqa: PLC0415
    from slamfusion.sim import simulate, write_recording  # noqa: PLC0415

    check_writable(folder)
    is_seed_given = (
        context.get_parameter_source("config_seed") != click.core.ParameterSource.DEFAULT
    )
    wanted = _course(course, config, is_seed_given=is_seed_given)
    device = open_device(config.device.device)
    start = time.perf_counter()
    with progress_bar() as progress:
        recording = simulate(wanted, device, progress)
    files = write_recording(recording, folder)
    if recording.left_out:
        count = len(recording.left_out)
        notice(f"planned waypoints left out, as this robot cannot drive to them: {count}")
    made: SimulateDocument = {
        **_summary(recording),
        "files": [str(path) for path in files],
        "device": device.name,
        "seed": recording.course.seed,
        "time_s": time.perf_counter() - start,
        "config": to_mapping(config),
        "versions": versions(),
    }
    if as_json:
        print_json(made)
    else:
        _print(made, recording)
    return 0


def _course(name: str, config: RunConfig, *, is_seed_given: bool) -> Course:
    """Return the course of a file or name, changed as the options say."""
    from slamfusion.sim import load_course, named_course, with_overrides  # noqa: PLC0415

    path = Path(name)
    if path.suffix.lower() in SUFFIXES or path.is_file():
        course = load_course(path, config.seed)
        if is_seed_given:
            course = replace(course, seed=config.seed)
    else:
        course = named_course(name, config.seed)
    return with_overrides(course, config.simulate)


def _summary(recording: Recording) -> SimulatedDriveJson:
    """Return what was made, in numbers."""
    truth, odometry = recording.truth, recording.odometry()
    end = truth.pose(-1).inverse().compose(odometry.pose(-1))
    beams = sum(len(item.scan) for item in recording.scans)
    clear = sum(int(item.scan.is_clear().sum()) for item in recording.scans)
    grid = recording.world.grid
    return {
        "name": recording.course.name,
        "scans": len(recording.scans),
        "beams": recording.course.lidar.beams,
        "duration_s": recording.duration_s(),
        "path_m": truth.path_length_m(),
        "waypoints_left_out": len(recording.left_out),
        "no_return_share": clear / beams,
        "odometry_end_error": {
            "translation_m": math.hypot(end.x, end.y),
            "rotation_deg": math.degrees(abs(end.yaw_rad)),
        },
        "world": {
            "name": recording.course.world.name,
            "width_m": grid.width * grid.resolution,
            "height_m": grid.height * grid.resolution,
            "resolution": grid.resolution,
            "people": len(recording.world.people),
            "obstacles": len(recording.world.obstacles),
            "glass_cells": int(recording.world.glass.sum()),
        },
    }


def _print(made: SimulateDocument, recording: Recording) -> None:
    """Print the numbers and the files as two columns."""
    course, end = recording.course, made["odometry_end_error"]
    rows = [
        ["course", f"{course.name}, seed {course.seed}"],
        ["robot", f"{course.drive.model}, {course.lidar.model} of {course.lidar.beams} beams"],
        ["scans", str(made["scans"])],
        ["duration", f"{number(made['duration_s'], 1)} s"],
        ["path", f"{number(made['path_m'], 1)} m"],
        ["no return", f"{number(100.0 * made['no_return_share'], 1)} % of the readings"],
        [
            "odometry at the end",
            f"{number(end['translation_m'], 2)} m and {number(end['rotation_deg'], 1)} deg off",
        ],
        *(["file", path] for path in made["files"]),
        ["time", f"{number(made['time_s'], 1)} s on {made['device']}"],
    ]
    print_table((" ", " "), rows, title="Simulated drive", header=False)
