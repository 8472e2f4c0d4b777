"""Every device of this machine, both of PoCL's first; ``test_simulator`` runs the simulator."""

from __future__ import annotations

import platform
import sys

import pytest

from slamfusion.compute import ComputeDevice, list_devices, open_device

POCL = "portable computing"
# Its kernels leave out what only threads need.
SINGLE_THREAD = "basic"
SIMULATOR = "oclgrind"
# Both come as wheels for this platform and belong to the test requirements, so there their absence
# is a failure. Elsewhere it is a skip.
WHEELS_EXIST = sys.platform == "linux" and platform.machine() == "x86_64"


def other_devices() -> list[str]:
    """Indices of the usable devices beside PoCL and the simulator."""
    return [
        str(device.index)
        for device in list_devices()
        if device.usable and not any(n in device.platform.lower() for n in (POCL, SIMULATOR))
    ]


@pytest.fixture(
    scope="session",
    params=[POCL, pytest.param(SINGLE_THREAD, marks=pytest.mark.once), *other_devices()],
)
def device(request: pytest.FixtureRequest) -> ComputeDevice:
    """The device of each device in turn."""
    if not WHEELS_EXIST:
        names = " ".join(f"{d.platform} {d.name}".lower() for d in list_devices())
        if request.param in {POCL, SINGLE_THREAD} and request.param not in names:
            pytest.skip(f"no {request.param} on this platform")
    return open_device(request.param)


def opened() -> ComputeDevice:
    """PoCL, or the first device where there is no PoCL wheel."""
    return open_device(POCL if WHEELS_EXIST else "auto")


@pytest.fixture(scope="session")
def pocl() -> ComputeDevice:
    """The device of most tests."""
    return opened()


@pytest.fixture(scope="module")
def fresh() -> ComputeDevice:
    """The same device opened once more, where each operation has yet to run."""
    return opened()
