"""``slamfusion doctor``, ``devices``: what is installed, what computes, what to install."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from slamfusion.cli.help import Command
from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import print_json, print_table
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError

if TYPE_CHECKING:
    from slamfusion.compute.compute_device import DeviceInfo
    from slamfusion.jobs.doctor import DoctorDocument


@click.command("doctor", cls=Command)
@with_config("device")
@common_options
def command(config: RunConfig, as_json: bool) -> int:
    """Check this installation.

    Lists versions and devices and tests three kernels.
    """
    from slamfusion.jobs.doctor import check_installation  # noqa: PLC0415

    document = check_installation(config)
    if as_json:
        print_json(document)
    else:
        _print(document)
    if document["problems"]:
        raise SlamFusionError("; ".join(document["problems"]))
    return 0


def _print(document: DoctorDocument) -> None:
    """Print what was found as tables."""
    rows = [[name, version or "absent"] for name, version in document["versions"].items()]
    print_table(("package ", "version "), rows)
    print_devices(document["devices"])
    if document["pocl"] is not None:
        print(f"PoCL: {document['pocl'].detail}")
    tests = document["self_test"]
    failed = [test for test in tests if not test["passed"]]
    if failed:
        print_table(
            ("failed self test ",),
            [[test["name"]] for test in failed],
            notes=[test["detail"] for test in failed],
            title=f"{len(failed)} of {len(tests)} self tests failed on {document['device']}",
        )
    else:
        print(f"kernels: all {len(tests)} self tests passed on {document['device']}")
    print_table(("for ", "install "), [list(item) for item in document["install"].items()])


NUMPY_NOTE = "numpy: always there (--device numpy), without OpenCL and slower"


@click.command("devices", cls=Command)
@common_options
def devices_command(as_json: bool) -> int:
    """List the OpenCL devices.

    --device takes an index or a part of a name.
    """
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
    columns = ("index", "name ", "platform ", "type ", "units", "memory [MB]", "usable ")
    print_table(columns, rows, notes=[device.note for device in devices])
