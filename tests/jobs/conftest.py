"""A short drive in files, for the jobs on logs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.slam.drives import write_flat
from tests.support.searches import RememberedSearches


@pytest.fixture(autouse=True)
def _remembered(remembered_searches: RememberedSearches) -> None:
    """Many of these tests align the sample maps."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short drive, its true path and one known relation."""
    folder = tmp_path_factory.mktemp("place")
    write_flat(folder, 32)
    return folder
