"""``slamfusion align``: the rigid motion from one map to another."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import common_options, map_resolution_option, with_config
from slamfusion.cli.output import notice, number, print_json, print_table
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError
from slamfusion.geometry import Pose2
from slamfusion.jobs.inputs import device_for, load_maps

if TYPE_CHECKING:
    from slamfusion.fusion.records import Alignment

__all__ = ["command"]


@click.command("align")
@click.argument("reference", type=click.Path(path_type=Path))
@click.argument("moving", type=click.Path(path_type=Path))
@click.option(
    "--start",
    type=(float, float, float),
    metavar="DX DY YAW",
    help="Start of the search in m, m, rad; the --window options count from here.",
)
@map_resolution_option
@with_config("fusion.normalize", "fusion.align", "map_files", "device", "")
@common_options
def command(
    reference: Path,
    moving: Path,
    start: tuple[float, float, float] | None,
    resolution: float | None,
    config: RunConfig,
    as_json: bool,
) -> int:
    """Align the map MOVING with the map REFERENCE.

    The motion printed maps a point of MOVING's frame into REFERENCE's. Exit code 1 when the
    alignment cannot be believed; the record is printed all the same.
    """
    from slamfusion.jobs.align import align_document, align_maps  # noqa: PLC0415

    try:
        start_pose = None if start is None else Pose2(*start)
    except ValueError as error:
        message = f"--start: {error}"
        raise click.UsageError(message) from None
    still, moved = load_maps((reference, moving), resolution, config.map_files, notice)
    device = device_for(config)
    found = align_maps(still, moved, config, device, start=start_pose)
    if as_json:
        print_json(align_document(found, config, device.name))
    else:
        _print_alignment(found, device.name)
    if not found.accepted:
        message = f"{moving} does not align with {reference}: {found.reason}"
        raise AlignmentError(message)
    return 0


def _print_alignment(found: Alignment, device: str) -> None:
    """Print the record as two columns."""
    rows = [
        ["dx", f"{number(found.transform.x, 4)} m"],
        ["dy", f"{number(found.transform.y, 4)} m"],
        ["yaw", f"{number(math.degrees(found.transform.yaw_rad))} deg"],
        ["accepted", "yes" if found.accepted else "NO"],
        ["reason", found.reason],
        ["score", number(found.score)],
        ["overlap", number(found.overlap)],
        ["error [F16]", number(found.error, 2)],
    ]
    if found.runner_up is not None:
        rows.append(
            [
                "runner-up",
                _where(found.runner_up.transform, found.runner_up.ratio),
            ]
        )
    rows += [["bound gap", number(found.bound_gap)], ["time", f"{number(found.time_s)} s"]]
    title = f"{found.moving} onto {found.reference}, on {device}"
    print_table((" ", " "), rows, title=title, header=False)


def _where(pose: Pose2, ratio: float) -> str:
    yaw = number(math.degrees(pose.yaw_rad), 1)
    return f"{number(ratio)} of the score at {number(pose.x)} m, {number(pose.y)} m, {yaw} deg"
