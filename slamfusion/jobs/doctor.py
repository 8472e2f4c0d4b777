"""What is installed, whether it computes, what to install; and what could compute."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TypedDict

from slamfusion.compute import list_devices, open_device, pocl_state
from slamfusion.compute.compute_device import DeviceInfo, PoclState
from slamfusion.config import RunConfig
from slamfusion.errors import DeviceError
from slamfusion.version import version_of, versions

# One line for each maker of devices; names of Ubuntu and Debian packages unless said otherwise.
INSTALL = {
    "any CPU": "pip install pocl-binary-distribution (x86-64), or apt install pocl-opencl-icd",
    "x86-64 CPU": "pip install 'slamfusion[intel]', if PoCL from pip does not know the processor",
    "NVIDIA GPU": "apt install nvidia-opencl-icd (Debian), libnvidia-compute-NNN (Ubuntu)",
    "Intel GPU": "apt install intel-opencl-icd",
    "AMD GPU": "apt install rocm-opencl, or mesa-opencl-icd with RUSTICL_ENABLE=radeonsi",
}


class DevicesDocument(TypedDict):
    """``slamfusion devices``."""

    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""


class SelfTestJson(TypedDict):
    """A test of the kernels."""

    name: str
    """What was tested."""
    passed: bool
    """Whether it computes as it should."""
    detail: str
    """What was found."""


class DoctorDocument(TypedDict):
    """``slamfusion doctor``; exit code 1 where it is not ``ok``."""

    ok: bool
    """Whether nothing is wrong."""
    problems: Sequence[str]
    """What is wrong and what to do, a sentence each."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""
    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""
    pocl: PoclState | None
    """How the PoCL that came with the package was changed; null where no OpenCL was looked at."""
    device: str | None
    """The one that was tested, in words; null where it cannot be opened."""
    self_test: Sequence[SelfTestJson]
    """The tests of the kernels."""
    install: Mapping[str, str]
    """What to install, by maker of the device."""


def devices_document() -> DevicesDocument:
    """Return the OpenCL devices that ``--device`` can name."""
    return {"devices": list_devices()}


def check_installation(config: RunConfig) -> DoctorDocument:
    """Look at versions and devices, and test three kernels of the chosen device.

    Returns:
        What was found; ``problems`` says what is wrong and what to do, and nothing is raised.
    """
    found = versions()
    devices, pocl = list_devices(), pocl_state()
    problems = []
    if not any(device.usable for device in devices):
        problems.append(
            pocl.detail
            if pocl is not None and pocl.state == "refused"
            else f"no usable OpenCL device; for any CPU: {INSTALL['any CPU']}"
        )
    if has_two_rclpy():
        problems.append(
            "two rclpy: a sourced ROS (ROS_DISTRO) and ros-jazzy-rclpy from pip; "
            "run pip uninstall ros-jazzy-rclpy"
        )
    device, tests = _self_test(config.device.device)
    problems += [
        f"self test {name}: {detail}; use --device numpy, or another driver: {INSTALL['any CPU']}"
        for name, passed, detail in tests
        if not passed
    ]
    return {
        "ok": not problems,
        "problems": problems,
        "versions": found,
        "devices": devices,
        "pocl": pocl,
        "device": device,
        "self_test": [
            {"name": name, "passed": passed, "detail": detail} for name, passed, detail in tests
        ],
        "install": INSTALL,
    }


def has_two_rclpy() -> bool:
    """Whether a sourced ROS and the rclpy of the Python package index are both there."""
    in_ros = bool(os.environ.get("ROS_DISTRO"))
    return in_ros and version_of("ros-jazzy-rclpy") is not None


def _self_test(wanted: str) -> tuple[str | None, list[tuple[str, bool, str]]]:
    """Test three kernels of the chosen device; a device that cannot be opened is a failed test."""
    from slamfusion.compute.self_test import self_test  # noqa: PLC0415

    try:
        device = open_device(wanted)
        return device.name, self_test(device)
    except DeviceError as error:
        return None, [("open the device", False, str(error))]
