"""``slamfusion devices``: what could compute."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import common_options
from slamfusion.cli.output import print_json, print_table

if TYPE_CHECKING:
    from slamfusion.compute.records import DeviceInfo

NUMPY_NOTE = "numpy: always there (--device numpy), without OpenCL and slower"


@click.command("devices")
@common_options
def command(as_json: bool) -> int:
    """List the OpenCL devices that --device can name."""
    from slamfusion.jobs.doctor import devices_document  # noqa: PLC0415

    document = devices_document()
    if as_json:
        print_json(document)
        return 0
    print_devices(document["devices"])
    print(NUMPY_NOTE)
    if not document["devices"]:
        print("no OpenCL device found; `slamfusion doctor` says what to install")
    return 0


def print_devices(devices: Sequence[DeviceInfo]) -> None:
    """Print the table of devices."""
    rows = [
        [
            str(device.index),
            device.name,
            device.platform,
            device.type,
            str(device.compute_units),
            f"{device.memory_mb:.0f}",
            "yes" if device.usable else "NO",
        ]
        for device in devices
    ]
    columns = (
        "index",
        "name ",
        "platform ",
        "type ",
        "units",
        "memory MB",
        "usable ",
    )
    print_table(columns, rows, notes=[device.note for device in devices])
