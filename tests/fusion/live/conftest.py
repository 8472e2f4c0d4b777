"""Fixtures of the live fusion's tests."""

from __future__ import annotations

import pytest

from tests.support.searches import RememberedSearches


@pytest.fixture(autouse=True)
def _remembered(remembered_searches: RememberedSearches) -> None:
    """Most of these tests begin with the same maps."""
