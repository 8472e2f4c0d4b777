"""``slamfusion show``: a finished job in the browser, map over map."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.help import Command, Number
from slamfusion.cli.options import common_options
from slamfusion.cli.output import notice, print_json
from slamfusion.cli.paths import FILE
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import SlamFusionError

if TYPE_CHECKING:
    from slamfusion.jobs.records import ShowDocument

DEFAULTS = FusionNodeConfig()


@click.command("show", cls=Command, examples=["show out", "show out --port 8080"])
@click.argument("folder", metavar="DIR", type=FILE)
@click.option(
    "--port",
    type=Number(int, 0, 65535),
    default=0,
    metavar="N",
    help="Port of the page. [default: any free port]",
)
@click.option(
    "--host",
    default=DEFAULTS.page_host,
    metavar="ADDRESS",
    help="Address of the page. 0.0.0.0 makes it visible to the whole network. "
    f"[default: {DEFAULTS.page_host}]",
)
@click.option(
    "--drive",
    default="",
    metavar="NAME",
    help="Drive of an experiment to show. [default: the first]",
)
@common_options
def command(folder: Path, port: int, host: str, drive: str, as_json: bool) -> int:
    """Show the maps of a run in the browser.

    DIR is a folder that `slamfusion run`, `fuse` or `experiment` wrote, a fused map, or any folder
    with maps. The page shows layers, paths, the difference of two maps, and the value of a cell in
    each map. Ctrl-C ends it.
    """
    from slamfusion.page.finished import read_finished  # noqa: PLC0415

    try:
        from slamfusion.page.server import PageServer  # noqa: PLC0415
    except ImportError as error:
        raise SlamFusionError(str(error)) from error

    found = read_finished(folder, drive)
    server = PageServer(found.scene, host=host, port=port, report=found.report)
    found.feed(server.feed)
    if as_json:
        document: ShowDocument = {"url": server.url, "maps": [item.name for item in found.maps]}
        print_json(document)
    else:
        print(server.url)
        notice("open that address in a browser; Ctrl-C ends it")
        if found.also:
            notice(f"other drives there, by --drive: {', '.join(found.also)}")
    try:
        sys.stdout.flush()
        threading.Event().wait()
    except KeyboardInterrupt:
        return 0
    finally:
        server.close()
    return 0
