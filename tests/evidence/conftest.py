"""One drive with its scores."""

from __future__ import annotations

import pytest

from slamfusion.evidence.beams import JudgedScans, judged_scans
from tests.evidence.rooms import circuit, recorded


@pytest.fixture(scope="session")
def scans() -> JudgedScans:
    return judged_scans(recorded(circuit()))
