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
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.registry import make_producer
from slamfusion.slam.side_by_side import Outcome, SideBySide
from tests.slam.drives import drive

pytestmark = pytest.mark.once

CONFIG = RunConfig(seed=4)
SCANS = 40


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "flat.log"
    write_carmen(path, drive(SCANS)[0])
    return path


def with_settings(**settings: float) -> RunConfig:
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
        assert process is not None
        os.kill(process, number)

    return send


def test_each_makes_what_it_makes_alone_and_one_that_is_killed_is_named(log: Path) -> None:
    told: dict[str, list[float]] = {"tinyslam": [], "graph": [], "gmapping": []}
    with SideBySide(tuple(told), log, with_settings(processes=3)) as side_by_side:
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


def test_a_frozen_producer_is_stopped_at_its_time_limit(log: Path) -> None:
    outcomes = run(
        log, "graph", config=with_settings(time_limit_s=1.5),
        meanwhile=signal_to("graph", signal.SIGSTOP),
    )  # fmt: skip
    assert outcomes["graph"].run is None
    assert "ran past its time limit of 1.5 s" in outcomes["graph"].reason
    assert outcomes["graph"].time_s >= 1.5


def test_an_answer_past_the_time_limit_is_left_out_even_if_it_is_heard_later(log: Path) -> None:
    outcomes = run(
        log, "tinyslam", config=with_settings(time_limit_s=0.1), meanwhile=lambda _: time.sleep(3.0)
    )
    assert outcomes["tinyslam"].run is None
    assert outcomes["tinyslam"].reason == "ran past its time limit of 0.1 s"
    assert outcomes["tinyslam"].time_s > 0.1


def test_the_longest_job_starts_first_and_no_more_run_than_may(log: Path) -> None:
    names = ("tinyslam", "graph", "gmapping")
    with SideBySide(names, log, with_settings(processes=1)):
        assert [process_of(name) is None for name in names] == [True, True, False]
    assert not multiprocessing.active_children()


def test_what_cannot_be_mapped_is_said(tmp_path: Path) -> None:
    blind = [
        LogScan(
            LaserScan(item.scan.stamp_s, np.full(len(item.scan), np.inf), -1.0, 0.01, 0.05, 30.0),
            item.odometry,
            item.line,
        )
        for item in drive(3)[0]
    ]
    log = tmp_path / "blind.log"
    write_carmen(log, blind)
    for name, outcome in run(log, "graph").items():
        assert outcome.run is None
        assert f"{name} could use none of 3 scans" in outcome.reason
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
