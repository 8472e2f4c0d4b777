"""The backends that the fusion runs on."""

from __future__ import annotations

import pytest

from slamfusion.compute import Backend, NumpyBackend, open_backend


@pytest.fixture(scope="session")
def backend() -> Backend:
    """The device that a user gets: PoCL where there is no other."""
    return open_backend()


@pytest.fixture(scope="session")
def twins() -> Backend:
    return NumpyBackend()
