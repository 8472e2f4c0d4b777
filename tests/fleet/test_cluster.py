"""A real Dask cluster of this machine: two workers, each a process of its own."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from functools import partial
from importlib.util import find_spec
from typing import Any

import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice, open_device, shared_device
from slamfusion.config import AlignConfig, FusionConfig, RunConfig, VoteConfig
from slamfusion.errors import ConfigError, FleetError
from slamfusion.fleet import THREAD_VARIABLES, as_done, executor_for, tasks_ahead
from slamfusion.jobs.fuse import fuse_maps
from slamfusion.json_values import record_keys
from slamfusion.version import __version__
from tests.fleet.test_executor import end_by_force, half
from tests.support.sites import many_maps

pytestmark = [
    pytest.mark.once,
    pytest.mark.skipif(not find_spec("distributed"), reason="Dask comes with the fleet extra"),
]

CONFIG = RunConfig(fusion=FusionConfig(vote=VoteConfig("consensus", extent="union")))
SITE = many_maps(7, 0, 200).grids


def process_and_devices() -> tuple[int, int]:
    shared_device("auto")
    return os.getpid(), shared_device.cache_info().misses


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


@pytest.fixture(scope="module")
def cluster() -> Iterator[Executor]:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    with executor_for("local:2") as executor:
        assert executor is not None
        yield executor
    assert {name: os.environ.get(name) for name in THREAD_VARIABLES} == before


def outcome(result: FusionResult) -> tuple[object, ...]:
    """Return all that a fusion gives but times."""
    cells = result.fused.cells.tobytes() + result.agreement.cells.tobytes()
    places = [
        (record.name, record.reason, record.alignment and record.alignment.transform)
        for record in result.inputs
    ]
    pairs = [(pair.reference, pair.moving, pair.score, pair.reason) for pair in result.pairs]
    return hashlib.sha256(cells).hexdigest(), places, pairs


def test_tasks_are_done_by_workers_and_errors_come_back(cluster: Executor) -> None:
    assert tasks_ahead(cluster) == 4
    done = as_done(cluster, half, range(0, 40, 2))
    assert sorted(number for _, number in done) == list(range(20))
    with pytest.raises(ConfigError, match="5 is odd"):
        cluster.submit(half, 5).result()


def test_another_client_finds_the_scheduler_by_its_address(cluster: Executor) -> None:
    distributed = pytest.importorskip("distributed")
    address = distributed.default_client().scheduler.address
    with executor_for(address) as other:
        assert tasks_ahead(other) == 4
        assert other.submit(half, 8).result() == 4
    assert cluster.submit(half, 8).result() == 4


def test_a_killed_worker_costs_a_retry_and_not_a_byte(
    cluster: Executor, device: ComputeDevice
) -> None:
    align = partial(align_pair, config=AlignConfig(), pairs=21, thorough=False)
    grids = [normalize_grid(grid, 0.05, CONFIG.fusion.normalize, device) for grid in SITE[:5]]
    features = [GridFeatures(grid, device) for grid in grids]
    pairs = [Pair(features[0], moving) for moving in features[1:]]
    tasks = [cluster.submit(align, pair) for pair in pairs]
    killed = cluster.submit(os.getpid).result()
    os.kill(killed, signal.SIGKILL)
    for pair, task in zip(pairs, tasks, strict=True):
        found, wanted = task.result(), align(pair)
        assert record_keys(found) == {**record_keys(wanted), "time_s": found.time_s}
    # Kernels are built once a worker, whatever it was asked.
    asked = [cluster.submit(process_and_devices) for _ in range(8)]
    opened = dict(task.result() for task in asked)
    assert killed not in opened
    assert set(opened.values()) == {1}


@pytest.mark.full
def test_maps_fused_by_processes_and_workers_are_the_same_bytes(
    cluster: Executor, device: ComputeDevice
) -> None:
    wanted = outcome(fuse_maps(SITE, CONFIG, device).result)
    with executor_for(processes=2) as processes:
        for executor in (processes, cluster):
            assert outcome(fuse_maps(SITE, CONFIG, device, executor=executor).result) == wanted


def _work_until(where: str, something_happens: Callable[[], object]) -> None:
    with executor_for(where) as executor:
        jobs = as_done(executor, time.sleep, [0.0, 60.0])
        assert next(jobs)[0] == 0.0
        something_happens()
        next(jobs)


@pytest.mark.full
def test_a_task_that_kills_its_workers_ends_the_job() -> None:
    with (
        pytest.raises(FleetError, match=r"several workers of local:2 died of one task, the last"),
        executor_for("local:2") as executor,
    ):
        list(as_done(executor, end_by_force, [0]))


def test_a_scheduler_that_goes_away_ends_the_job() -> None:
    import distributed  # noqa: PLC0415  (an extra)

    own = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0")
    with pytest.raises(FleetError, match=f"the scheduler at {own.scheduler_address} went away"):
        _work_until(own.scheduler_address, own.close)


def refused(where: str) -> None:
    with executor_for(where):
        pytest.fail("there is nobody")


def test_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slamfusion.fleet.cluster.ANSWER_S", 0.5)
    began_s = time.monotonic()
    with pytest.raises(FleetError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9 within"):
        refused("tcp://127.0.0.1:9")
    assert time.monotonic() - began_s < 20.0  # not the minutes that Dask would try


def test_tls_without_certificates_says_where_they_are_named() -> None:
    with pytest.raises(FleetError, match="wants certificates: set DASK_DISTRIBUTED__COMM__TLS__CA"):
        refused("tls://127.0.0.1:9")


def test_a_scheduler_without_workers_says_how_to_start_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import distributed  # noqa: PLC0415  (an extra)

    monkeypatch.setattr("slamfusion.fleet.cluster.WORKERS_S", 0.2)

    def start_empty() -> Any:
        return distributed.LocalCluster(n_workers=0, dashboard_address=":0")

    try:
        cluster = start_empty()
    except AssertionError:  # Dask's own: its thread had not begun within 10 s
        cluster = start_empty()
    with cluster as empty:
        where = empty.scheduler_address
        with pytest.raises(
            FleetError, match=f"has no workers; start some with `dask worker {where}"
        ):
            refused(where)


def test_workers_that_differ_are_named(caplog: pytest.LogCaptureFixture) -> None:
    from slamfusion.fleet.cluster import check_workers as check  # noqa: PLC0415  (an extra)

    one, two = (__version__, "one"), (__version__, "two")
    with caplog.at_level(logging.WARNING, "slamfusion.fleet"):
        check("local", {"tcp://a:1": one, "tcp://b:1": one})
        assert not caplog.messages
        check("local", {"tcp://a:1": one, "tcp://b:1": two, "tcp://c:1": one})
    (told,) = caplog.messages
    assert "one (tcp://a:1, tcp://c:1); two (tcp://b:1)" in told
    with pytest.raises(FleetError, match=r"tcp://b:1 has version 0\.0\.1 of slamfusion, and here"):
        check("local", {"tcp://a:1": one, "tcp://b:1": ("0.0.1", "one")})
    broken = ConfigError("no OpenCL device fits 'x'")
    with pytest.raises(FleetError, match="the worker at tcp://b:1 cannot do the work: no OpenCL"):
        check("local", {"tcp://a:1": one, "tcp://b:1": broken})
