"""Fixtures shared by all tests: backends, the recorded maps, drawn grids."""

from __future__ import annotations

import pytest

from tests.support import datasets


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--full", action="store_true", help="also run the tests marked full")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if "full" in item.keywords and not config.getoption("--full"):
            item.add_marker(pytest.mark.skip(reason="long; run with --full"))
        if "datasets" in item.keywords and not datasets.MAPS.is_dir():
            item.add_marker(pytest.mark.skip(reason=datasets.ABSENT))
