"""Fixtures shared by all tests: devices, the recorded maps, drawn grids."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

from slamfusion.compute import ComputeDevice, NumpyDevice, open_device
from tests.support import datasets
from tests.support.examples import FULL
from tests.support.searches import CALLERS, RememberedSearches

TESTS = Path(__file__).parent
# Folders whose tests are all marked ``once``.
ONCE = (TESTS / "cli", TESTS / "web")

# Examples of each property: in every run, under --full, and where NumPy and OpenCV are looked at
# alone. A busy machine is no fault of the code.
PROFILES = {"suite": 12, "full": FULL, "brief": 3}
for profile, count in PROFILES.items():
    settings.register_profile(
        profile, deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=count
    )
settings.load_profile("suite")

# The longest files in the order in which test processes take them, so that none of them is alone at
# the end. One process runs all tests with nodes, the first of which is in the first of these files:
# they mostly wait, and two that wait at once leave the processor idle.
LONGEST = (
    "ros/test_producer_node.py",
    "jobs/test_live_drive.py",
    "jobs/test_run.py",
    "cli/test_run.py",
    "evidence/test_refined_path.py",
    "docs/test_pages.py",
    "jobs/test_judge.py",
    "align/test_datasets.py",
    "evidence/test_recommendation.py",
    "align/test_scale_search.py",
    "golden/test_golden.py",
    "fusion/test_pipeline.py",
    "test_installed.py",
    "cli/test_commands.py",
    "slam/test_mappers.py",
    "slam/graph/test_slam.py",
    "fuzz/test_readers.py",
    "fleet/test_cluster.py",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--full", action="store_true", help="also run the tests marked full")
    parser.addoption(
        "--few-each",
        action="store_true",
        help="of tests that differ in their parameters alone run one, and all marked jazzy",
    )


# What collecting makes stays to the end, so nothing of it is looked for meanwhile, or ever again: a
# third of its processor time, and a twentieth of that of the tests after it.
gc.disable()


def pytest_collection_finish() -> None:
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--full"):
        settings.load_profile("full")


def few_of_each(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return the items without those that only have other parameters than some before them."""
    seen: set[tuple[Path, str]] = set()
    kept = []
    for item in items:
        function = item.path, item.nodeid.partition("[")[0]
        if function not in seen or "jazzy" in item.keywords:
            kept.append(item)
        if "full" not in item.keywords:
            seen.add(function)
    return kept


class Scheduling(LoadFileScheduling):  # type: ignore[misc]  # xdist has no types
    """Give all tests with nodes to one process, and any other file to the next that is free."""

    def _split_scope(self, nodeid: str) -> str:
        is_of_nodes = nodeid.startswith(("tests/ros/", "tests/launch/"))
        return "nodes" if is_of_nodes else str(super()._split_scope(nodeid))


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling | None:
    return Scheduling(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--few-each"):
        items[:] = few_of_each(items)
    for item in items:
        if item.path.parent in ONCE:
            item.add_marker("once")
        if "full" in item.keywords and not config.getoption("--full"):
            item.add_marker(pytest.mark.skip(reason="long; run with --full"))
        if "datasets" in item.keywords and not datasets.MAPS.is_dir():
            item.add_marker(pytest.mark.skip(reason=datasets.ABSENT))
    places = {TESTS / name: place for place, name in enumerate(LONGEST)}
    if gone := [str(path) for path in places if not path.is_file()]:
        message = f"LONGEST in tests/conftest.py names files that are not there: {', '.join(gone)}"
        raise pytest.UsageError(message)
    items.sort(key=lambda item: places.get(item.path, len(places)))


@pytest.fixture(scope="module", autouse=True)
def _own_environment() -> Iterator[None]:
    """Take back what tests of a module, and libraries that they start, write into it."""
    with mock.patch.dict(os.environ):
        yield


@pytest.fixture(scope="session")
def device() -> ComputeDevice:
    """The device that a user gets: PoCL where there is no other."""
    return open_device()


@pytest.fixture(scope="session")
def twins() -> ComputeDevice:
    return NumpyDevice()


@pytest.fixture(scope="session")
def searches() -> RememberedSearches:
    return RememberedSearches()


@pytest.fixture
def remembered_searches(
    searches: RememberedSearches, monkeypatch: pytest.MonkeyPatch
) -> RememberedSearches:
    """A search that was made in this process is not made again."""
    for module in CALLERS:
        monkeypatch.setattr(module, "search", searches)
    return searches
