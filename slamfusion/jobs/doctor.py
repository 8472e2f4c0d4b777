"""What is installed, whether it computes, what to install; and what could compute."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slamfusion.compute import list_devices, open_device
from slamfusion.compute.compute_device import DeviceInfo
from slamfusion.compute.pocl import PoclState, name_processor
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


@dataclass(frozen=True)
class DevicesDocument:
    """``slamfusion devices``."""

    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""


@dataclass(frozen=True)
class SelfTest:
    """A test of the kernels."""

    name: str
    """What was tested."""
    passed: bool
    """Whether it computes as it should."""
    detail: str
    """What was found."""


@dataclass(frozen=True)
class DoctorDocument:
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
    """How the PoCL that came with the package was changed; null if its wheel is not installed."""
    device: str | None
    """The one that was tested, in words; null where it cannot be opened."""
    self_test: Sequence[SelfTest]
    """The tests of the kernels."""
    install: Mapping[str, str]
    """What to install, by maker of the device."""


def check_installation(config: RunConfig) -> DoctorDocument:
    """Report versions, devices, problems and a test of three kernels of the chosen device."""
    from slamfusion.compute.self_test import self_test  # noqa: PLC0415

    found, devices, pocl = versions(), list_devices(), name_processor()
    problems = []
    if not any(device.usable for device in devices):
        problems.append(
            pocl.detail
            if pocl is not None and pocl.state == "refused"
            else f"no usable OpenCL device; for any CPU: {INSTALL['any CPU']}"
        )
    if os.environ.get("ROS_DISTRO") and version_of("ros-jazzy-rclpy") is not None:
        problems.append(
            "two rclpy: a sourced ROS (ROS_DISTRO) and ros-jazzy-rclpy from pip; "
            "run pip uninstall ros-jazzy-rclpy"
        )
    name = None
    try:
        device = open_device(config.device.device)
        name, tests = device.name, [SelfTest(*test) for test in self_test(device)]
    except DeviceError as error:
        tests = [SelfTest("open the device", passed=False, detail=str(error))]
    problems += [
        f"self test {test.name}: {test.detail}; use --device numpy, or another driver: "
        f"{INSTALL['any CPU']}"
        for test in tests
        if not test.passed
    ]
    return DoctorDocument(not problems, problems, found, devices, pocl, name, tests, INSTALL)
