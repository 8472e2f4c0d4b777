"""``slamfusion doctor``: what is installed, whether it computes, what to install."""

from __future__ import annotations

import importlib.metadata
import os
from typing import TYPE_CHECKING

import click

from slamfusion.cli.devices import print_devices
from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import print_json, print_table
from slamfusion.config import RunConfig
from slamfusion.errors import DeviceError, SlamFusionError
from slamfusion.jobs.documents import versions

if TYPE_CHECKING:
    from slamfusion.jobs.tool_records import DoctorDocument

__all__ = ["INSTALL", "command"]

# One line for each maker of devices; names of Ubuntu and Debian packages unless said otherwise.
INSTALL = {
    "any CPU": "pip install pocl-binary-distribution (x86-64), or apt install pocl-opencl-icd",
    "x86-64 CPU": "pip install 'slamfusion[intel]', if PoCL from pip does not know the processor",
    "NVIDIA GPU": "apt install nvidia-opencl-icd (Debian), libnvidia-compute-NNN (Ubuntu)",
    "Intel GPU": "apt install intel-opencl-icd",
    "AMD GPU": "apt install rocm-opencl, or mesa-opencl-icd with RUSTICL_ENABLE=radeonsi",
}


@click.command("doctor")
@with_config("device")
@common_options
def command(config: RunConfig, as_json: bool) -> int:
    """Check this installation: versions, devices, and a one-second test of the kernels."""
    from slamfusion.compute import list_devices, pocl_state  # noqa: PLC0415

    found = versions()
    devices, pocl = list_devices(), pocl_state()
    problems = []
    if not any(device.usable for device in devices):
        problems.append(
            pocl.detail
            if pocl is not None and pocl.state == "refused"
            else "no usable OpenCL device; install one of the drivers listed"
        )
    if has_two_rclpy():
        problems.append(
            "two rclpy: a sourced ROS (ROS_DISTRO) and ros-jazzy-rclpy from pip; "
            "run pip uninstall ros-jazzy-rclpy"
        )
    device, tests = _self_test(config.device.device)
    problems += [f"self test {name}: {detail}" for name, passed, detail in tests if not passed]

    if as_json:
        document: DoctorDocument = {
            "ok": not problems,
            "problems": problems,
            "versions": found,
            "devices": [item.to_json() for item in devices],
            "pocl": None if pocl is None else {"state": pocl.state, "detail": pocl.detail},
            "device": device,
            "self_test": [
                {"name": name, "passed": passed, "detail": detail} for name, passed, detail in tests
            ],
            "install": INSTALL,
        }
        print_json(document)
    else:
        rows = [[name, version or "absent"] for name, version in found.items()]
        print_table(("package ", "version "), rows)
        print_devices()
        if pocl is not None:
            print(f"PoCL: {pocl.detail}")
        tested = [[name, "yes" if passed else "NO", detail] for name, passed, detail in tests]
        print_table(("self test ", "passed ", "detail "), tested, title=f"on {device}")
        print_table(("for ", "install "), [list(item) for item in INSTALL.items()])
    if problems:
        raise SlamFusionError("; ".join(problems))
    return 0


def has_two_rclpy() -> bool:
    """Whether a sourced ROS and the rclpy of the Python package index are both there."""
    if not os.environ.get("ROS_DISTRO"):
        return False
    try:
        importlib.metadata.version("ros-jazzy-rclpy")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _self_test(wanted: str) -> tuple[str | None, list[tuple[str, bool, str]]]:
    """Run the kernels on the chosen device; a device that cannot be opened is a failed test."""
    from slamfusion.compute import open_device  # noqa: PLC0415
    from slamfusion.compute.self_test import self_test  # noqa: PLC0415

    try:
        device = open_device(wanted)
        return device.name, self_test(device)
    except DeviceError as error:
        return None, [("open the device", False, str(error))]
