"""Fixtures of the live fusion's tests."""

from __future__ import annotations

import pytest

from tests.fusion.live.scripted import Script, follow_script
from tests.support.searches import RememberedSearches


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    """What alignments answer, and what was asked of them."""
    return follow_script(monkeypatch)


@pytest.fixture(autouse=True)
def _remembered(remembered_searches: RememberedSearches) -> None:
    """Most of these tests begin with the same maps."""
