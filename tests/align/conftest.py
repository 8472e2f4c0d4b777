"""The devices that the fusion runs on."""

from __future__ import annotations

import pytest

from slamfusion.compute import ComputeDevice, NumpyDevice, open_device


@pytest.fixture(scope="session")
def device() -> ComputeDevice:
    """The device that a user gets: PoCL where there is no other."""
    return open_device()


@pytest.fixture(scope="session")
def twins() -> ComputeDevice:
    return NumpyDevice()
