"""``slamfusion align``: the rigid motion from one map to another, and the scale of a plan."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion import jobs
from slamfusion.cli import options, output
from slamfusion.cli.help import Command
from slamfusion.cli.paths import MAP
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError
from slamfusion.jobs.inputs import PixelSizes, device_for, load_maps, load_truth
from slamfusion.jobs.outputs import OVERLAY, PLACED, PLAN, WORLD_FILE, plan_files
from slamfusion.jobs.records import Circumstances, number

if TYPE_CHECKING:
    from slamfusion.align.records import Alignment


@click.command(
    "align",
    cls=Command,
    examples=["align map_a.yaml map_b.yaml", "align map.yaml plan.png --scale free -o placed"],
)
@click.argument("reference", type=MAP)
@click.argument("moving", type=MAP)
@options.start(
    "Expected pose of MOVING in the frame of REFERENCE. With NAME: the pose of that map in the "
    "frame of the other one, or of both maps in a common frame.",
    bare_name=True,
)
@options.resolution
@options.scale("Find the scale of MOVING, a floor plan: a picture or a DXF drawing.")
@options.output(
    "--output",
    "-o",
    "folder",
    files=lambda path, _: plan_files(path),
    needs=options.REPORT,
    metavar="DIR",
    help="With --scale: save the plan with its resolution, the map in the frame of the plan, a "
    "world file and an overlay picture to this folder.",
)
@options.settings("fusion.normalize", "fusion.align", "map_files", "device", "")
@options.common
def command(
    reference: Path,
    moving: Path,
    starts: options.GivenStarts,
    resolution: float | None,
    scale: PixelSizes | None,
    folder: Path | None,
    config: RunConfig,
) -> None:
    """Align one map with another, or with a floor plan.

    Prints the transform that maps points from the frame of MOVING to the frame of REFERENCE. The
    exit code is 1 if the alignment is rejected. If a start has no M and RAD, the --window options
    apply around it.
    """
    message = "-o and --scale belong together; give both or neither"
    options.refuse(scale is None and folder is not None, message)
    options.refuse(scale and starts, "--scale searches everywhere; leave --start out")
    device = device_for(config)
    if scale is not None:
        still, moved = (
            load_truth(path, config, resolution=resolution, scale=its, warn=output.notice)
            for path, its in ((reference, None), (moving, scale))
        )
        plan = jobs.align.align_plan(still, moved, config, device, scale=scale)
        found, moved = plan.alignment, plan.plan
        if folder is not None and found.accepted:
            plan.save(folder, config.fusion.normalize)
    else:
        still, moved = load_maps(
            (reference, moving), config, resolution=resolution, warn=output.notice
        )
        starts = _named(starts, moved.name)
        config = options.with_starts(config, starts)
        with options.start_errors(starts):
            found = jobs.align.align_maps(still, moved, config, device)
    factor = None if scale is None else plan.scale
    made_by = Circumstances(device.name, config)
    document = jobs.align.AlignDocument(found, made_by, moved.resolution, factor)
    is_json = output.print_if_json(document)
    if not is_json:
        _print_alignment(found, device.name, None if scale is None else moved.resolution)
    if not found.accepted:
        raise AlignmentError(f"{moving} does not align with {reference}: {found.reason}")
    if folder is not None and not is_json:
        drawn, placed = folder / f"{PLAN}.yaml", folder / f"{PLACED}.yaml"
        words = f"{shlex.quote(str(placed))} --truth {shlex.quote(str(drawn))} --scale free"
        output.print_facts(
            ("plan", drawn),
            ("map", f"{placed}, in the frame of the plan"),
            ("world file", folder / WORLD_FILE),
            ("overlay", folder / OVERLAY),
            ("next", f"slamfusion evaluate {words}"),
            *output.map_server_facts(placed),
        )


def _named(starts: options.GivenStarts, moving: str) -> options.GivenStarts:
    """Return starts by name; one without is that of the moving map."""
    named = tuple((name or moving, values) for name, values in starts)
    if len(dict(named)) < len(named):
        message = f"{moving} is given twice, once without its name; keep one"
        raise click.BadParameter(message, param_hint="'--start'")
    return named


def _print_alignment(found: Alignment, device: str, pixel_m: float | None) -> None:
    """Print the record as two columns; of a plan with the size of its pixels, metres."""
    rows = [
        *([] if pixel_m is None else [["resolution", f"{pixel_m:.4g} m per pixel"]]),
        ["dx", f"{number(found.transform.x, 4)} m"],
        ["dy", f"{number(found.transform.y, 4)} m"],
        ["yaw", f"{number(math.degrees(found.transform.yaw_rad))} deg"],
        ["accepted", "yes" if found.accepted else "NO"],
        ["strength", found.strength or "-"],
        ["reason", found.reason],
        ["score", number(found.score)],
        ["overlap", number(found.overlap)],
    ]
    if output.is_verbose():
        rows.append(["error [F16]", number(found.error, 2)])
        if (rival := found.runner_up) is not None:
            x, y, yaw = rival.transform.x, rival.transform.y, rival.transform.yaw_rad
            place = f"{number(x)} m, {number(y)} m, {number(math.degrees(yaw), 1)} deg"
            rows.append(["runner-up", f"{number(rival.ratio)} of the score at {place}"])
        rows += [["time", f"{number(found.time_s)} s"], ["device", device]]
    title = f"{found.moving} in the frame of {found.reference}"
    output.Table((" ", " "), rows, title=title, has_head=False).print()
