"""``slamfusion show``: a finished job in the browser, map over map."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import common_options
from slamfusion.cli.output import notice, print_json
from slamfusion.cli.paths import FILE
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import SlamFusionError

if TYPE_CHECKING:
    from slamfusion.jobs.records import ShowDocument

DEFAULTS = FusionNodeConfig()


@click.command("show")
@click.argument("folder", metavar="DIR", type=FILE)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    metavar="N",
    help="Serve the page on this port. [default: any that is free]",
)
@click.option(
    "--host",
    default=DEFAULTS.page_host,
    metavar="ADDRESS",
    help="Serve it on this address; another one than this machine's own lets everybody on the "
    f"network look. [default: {DEFAULTS.page_host}]",
)
@click.option(
    "--drive",
    default="",
    metavar="NAME",
    help="Of an experiment, which of the drives whose maps it kept. [default: the first]",
)
@common_options
def command(folder: Path, port: int, host: str, drive: str, as_json: bool) -> int:
    """Show the maps of a finished run in the browser until Ctrl-C.

    DIR is what `slamfusion run`, `fuse` or `experiment` wrote (of several fusions in one folder,
    the fused map of one), or any folder with maps. The page is that of the live nodes: layers,
    paths, the difference of two maps, and what each map says of a cell.
    """
    from slamfusion.page.finished import read_finished  # noqa: PLC0415

    try:
        from slamfusion.page.server import PageServer  # noqa: PLC0415
    except ImportError as error:
        raise SlamFusionError(str(error)) from error

    found = read_finished(folder, drive)
    server = PageServer(found.scene, host=host, port=port)
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
