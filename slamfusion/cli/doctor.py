"""``slamfusion doctor``, ``devices``: what is installed, what computes, what to install."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from slamfusion import jobs
from slamfusion.cli import options
from slamfusion.cli.help import Command
from slamfusion.cli.output import Table, print_if_json
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError

if TYPE_CHECKING:
    from slamfusion.compute.compute_device import DeviceInfo


@click.command("doctor", cls=Command)
@options.settings("device")
@options.common
def command(config: RunConfig) -> None:
    """Check this installation.

    Lists versions and devices and tests three kernels.
    """
    found = jobs.doctor.check_installation(config)
    if not print_if_json(found):
        Table(
            ("package ", "version "),
            [[name, version or "absent"] for name, version in found.versions.items()],
        ).print()
        print_devices(found.devices)
        if found.pocl is not None:
            print(f"PoCL: {found.pocl.detail}")
        tests = found.self_test
        failed = [test for test in tests if not test.passed]
        if failed:
            where = found.device or "no device"
            Table(
                ("failed self test ",),
                [[test.name] for test in failed],
                notes=[test.detail for test in failed],
                title=f"{len(failed)} of {len(tests)} self tests failed on {where}",
            ).print()
        else:
            print(f"kernels: all {len(tests)} self tests passed on {found.device}")
        Table(("for ", "install "), [list(item) for item in found.install.items()]).print()
    if found.problems:
        raise SlamFusionError("; ".join(found.problems))


@click.command("devices", cls=Command)
@options.common
def devices_command() -> None:
    """List the OpenCL devices.

    --device takes an index or a part of a name.
    """
    from slamfusion.compute import list_devices  # noqa: PLC0415

    devices = list_devices()
    if print_if_json(jobs.doctor.DevicesDocument(devices)):
        return
    print_devices(devices)
    print("numpy: always there (--device numpy), without OpenCL and slower")
    if not devices:
        print("no OpenCL device found; `slamfusion doctor` says what to install")


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
    Table(columns, rows, notes=[device.note for device in devices]).print()
