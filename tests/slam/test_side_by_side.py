"""Producers in processes of their own: the same maps, and one that dies takes nobody with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import RunConfig, SideBySideConfig
from slamfusion.cores import usable_cores
from slamfusion.errors import ConfigError
from slamfusion.io import open_log, write_carmen
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.registry import make_producer, with_settings
from slamfusion.slam.side_by_side import Outcome, SideBySide
from tests.slam.drives import drive
from tests.support.producers import unseeing

pytestmark = pytest.mark.once

CONFIG = RunConfig(seed=4)
SCANS = 40


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "flat.log"
    write_carmen(path, drive(SCANS)[0])
    return path


def limited(**settings: float) -> RunConfig:
    return replace(CONFIG, run=SideBySideConfig(**settings))


def run(
    log: Path,
    *names: str,
    config: RunConfig = CONFIG,
    meanwhile: Callable[[SideBySide], None] | None = None,
) -> dict[str, Outcome]:
    """Run producers to their end; afterwards none of their processes may be left."""
    with SideBySide(names, log, config) as side_by_side:
        if meanwhile is not None:
            meanwhile(side_by_side)
        outcomes = side_by_side.wait()
    assert tuple(outcome.name for outcome in outcomes) == names
    assert not multiprocessing.active_children()
    return {outcome.name: outcome for outcome in outcomes}


def process_of(name: str) -> int | None:
    """Return the number of a producer's process; None where it is not at work."""
    found = multiprocessing.active_children()
    return next((one.pid for one in found if one.name == f"slamfusion-{name}"), None)


def signal_to(name: str, number: signal.Signals) -> Callable[[SideBySide], None]:
    def send(_: SideBySide) -> None:
        process = process_of(name)
        os.kill(process, number)

    return send


def test_each_makes_what_it_makes_alone_and_one_that_is_killed_is_named(log: Path) -> None:
    told: dict[str, list[float]] = {"tinyslam": [], "graph": [], "gmapping": []}
    with SideBySide(tuple(told), log, limited(processes=3)) as side_by_side:
        signal_to("gmapping", signal.SIGKILL)(side_by_side)
        outcomes = side_by_side.wait(lambda name, share: told[name].append(share))
    assert not multiprocessing.active_children()
    assert outcomes[-1].run is None
    assert "killed by SIGKILL" in outcomes[-1].reason
    for outcome in outcomes[:-1]:
        source = open_log(log)
        wanted = run_producer(
            make_producer(outcome.name, CONFIG, open_device()), source, log=source
        )
        assert outcome.reason == ""
        assert np.array_equal(outcome.run.grid.cells, wanted.grid.cells)
        assert outcome.run.grid.origin == wanted.grid.origin
        assert np.array_equal(outcome.run.trajectory.poses, wanted.trajectory.poses)
        assert np.array_equal(outcome.run.match_scores, wanted.match_scores, equal_nan=True)
        assert outcome.run.health == wanted.health
        assert outcome.run.log is not None
        assert outcome.cpu_s is not None
        assert outcome.device
        for array in (outcome.run.grid.cells, outcome.run.trajectory.poses):
            assert not array.flags.writeable
        shares = told[outcome.name]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


@pytest.mark.parametrize(
    ("name", "limit_s", "meanwhile"),
    [
        ("graph", 1.5, signal_to("graph", signal.SIGSTOP)),
        ("tinyslam", 0.1, lambda _: time.sleep(3.0)),  # its answer is heard later
    ],
)
def test_what_passes_its_time_limit_is_left_out(
    log: Path, name: str, limit_s: float, meanwhile: Callable[[SideBySide], None]
) -> None:
    outcome = run(log, name, config=limited(time_limit_s=limit_s), meanwhile=meanwhile)[name]
    assert (outcome.run, outcome.reason) == (None, f"ran past its time limit of {limit_s} s")
    assert outcome.time_s >= limit_s


def test_the_longest_job_starts_first_and_no_more_run_than_may(log: Path) -> None:
    names = ("tinyslam", "graph", "gmapping")
    with SideBySide(names, log, limited(processes=1)):
        assert [process_of(name) is None for name in names] == [True, True, False]
    assert not multiprocessing.active_children()


def test_what_cannot_be_mapped_is_said(log: Path, tmp_path: Path) -> None:
    write_carmen(tmp_path / "blind.log", unseeing(drive(3)[0]))
    crossed_often = with_settings(CONFIG, "graph", min_pass_through=1000)
    for source, config, reason in (
        (tmp_path / "blind.log", CONFIG, "graph could use none of 3 scans"),
        (log, crossed_often, "no cell of its map is known; check the settings of its cells"),
    ):
        outcome = run(source, "graph", config=config)["graph"]
        assert outcome.run is None
        assert reason in outcome.reason
        assert "\n" not in outcome.reason
        assert outcome.detail == ""


@pytest.mark.parametrize("names", [(), ("hector",), ("graph", "graph")])
def test_what_is_no_list_of_producers_is_refused(log: Path, names: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="tinyslam, gmapping, graph"):
        SideBySide(names, log, CONFIG)


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="no /proc to look into")
def test_the_processes_share_the_cores_and_ours_keeps_its_environment(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("POCL_MAX_PTHREAD_COUNT", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    before = dict(os.environ)
    with SideBySide(("tinyslam", "graph"), log, CONFIG):
        process = process_of("graph")
        theirs = environment_of(process)
    assert theirs["POCL_MAX_PTHREAD_COUNT"] == str(max(1, usable_cores() // 2))
    assert theirs["OMP_NUM_THREADS"] == "7"
    assert dict(os.environ) == before


def test_cores_are_those_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5, 6})
    assert usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    for known, cores in ((7, 7), (None, 1)):
        monkeypatch.setattr(os, "cpu_count", lambda known=known: known)
        assert usable_cores() == cores


def environment_of(process: int | None) -> dict[str, str]:
    """What a process was started with; its exec may still be on its way."""
    end_s = time.monotonic() + 30.0
    while time.monotonic() < end_s:
        entries = Path(f"/proc/{process}/environ").read_text(encoding="utf-8").split("\0")
        found = dict(entry.split("=", 1) for entry in entries if "=" in entry)
        if "POCL_MAX_PTHREAD_COUNT" in found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"process {process} has no such variable")
