"""A real Dask cluster of this machine: two workers, each a process of its own."""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import AlignConfig, FusionConfig, RunConfig, VoteConfig
from slamfusion.errors import ConfigError, FleetError
from slamfusion.fleet import InProcess, Scheduler, open_scheduler
from slamfusion.fleet.worker import WorkerFacts, worker_device
from slamfusion.fusion.align import align_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import normalize_grid
from slamfusion.fusion.pair_tasks import AlignmentTasks, PairSettings
from slamfusion.fusion.records import FusionResult
from slamfusion.jobs.fuse import fuse_maps
from slamfusion.version import __version__
from tests.fleet.test_scheduler import end_by_force, half
from tests.support.sites import many_maps

pytest.importorskip("distributed", reason="Dask comes with the fleet extra")
cluster_module = pytest.importorskip("slamfusion.fleet.cluster")

pytestmark = pytest.mark.once

CONFIG = RunConfig(fusion=FusionConfig(vote=VoteConfig("consensus", extent="union")))
SITE = many_maps(7, 0, 200).grids


def process_and_devices() -> tuple[int, int]:
    worker_device("auto")
    return os.getpid(), worker_device.cache_info().misses


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


@pytest.fixture(scope="module")
def cluster() -> Iterator[Scheduler]:
    told: list[str] = []
    before = variables()
    with open_scheduler("local:2", warn=told.append) as scheduler:
        assert told == []
        yield scheduler
    assert variables() == before


def variables() -> dict[str, str]:
    """Return the environment but what pytest sets for each test, and pyopencl for itself."""
    passing = {"PYTEST_CURRENT_TEST", "POCL_DEVICES", "PYOPENCL_HOME", "LD_LIBRARY_PATH"}
    return {name: value for name, value in os.environ.items() if name not in passing}


def outcome(result: FusionResult) -> tuple[object, ...]:
    """Return all that a fusion gives but times."""
    cells = result.fused.cells.tobytes() + result.agreement.cells.tobytes()
    places = [
        (record.name, record.reason, record.alignment and record.alignment.transform)
        for record in result.inputs
    ]
    pairs = [(pair.reference, pair.moving, pair.score, pair.reason) for pair in result.pairs]
    return hashlib.sha256(cells).hexdigest(), places, pairs


def test_tasks_are_done_by_workers_and_errors_come_back(cluster: Scheduler) -> None:
    assert cluster.slots == 2
    tasks = [cluster.submit(half, number) for number in range(0, 40, 2)]
    assert sorted(task.result() for task in cluster.completed(tasks)) == list(range(20))
    with pytest.raises(ConfigError, match="5 is odd"):
        cluster.submit(half, 5).result()


def test_another_client_finds_the_scheduler_by_its_address(cluster: Scheduler) -> None:
    address = cluster._client.scheduler.address
    with open_scheduler(address) as other:
        assert other.slots == 2
        assert other.submit(half, 8).result() == 4
    assert cluster.submit(half, 8).result() == 4


def test_a_killed_worker_costs_a_retry_and_not_a_byte(
    cluster: Scheduler, device: ComputeDevice
) -> None:
    settings = PairSettings(AlignConfig(prove=False), 21, thorough=False)
    grids = [normalize_grid(grid, 0.05, CONFIG.fusion.normalize, device) for grid in SITE[:5]]
    features = [GridFeatures(grid, device) for grid in grids]
    tasks = AlignmentTasks(cluster, settings)
    for moving in features[1:]:
        tasks.begin(features[0], moving, None)
    killed = cluster.submit(os.getpid).result()
    os.kill(killed, signal.SIGKILL)
    for moving in features[1:]:
        found = tasks.result(features[0], moving, None)
        wanted = align_features(
            features[0], moving, settings.config, device, pairs=21, thorough=False
        )
        assert found.to_json() == {**wanted.to_json(), "time_s": found.time_s}
    # Kernels are built once a worker, whatever it was asked.
    asked = [cluster.submit(process_and_devices) for _ in range(8)]
    opened = dict(task.result() for task in asked)
    assert killed not in opened
    assert set(opened.values()) == {1}


@pytest.mark.full
def test_maps_fused_by_workers_are_the_same_bytes_also_when_one_is_killed(
    cluster: Scheduler, device: ComputeDevice
) -> None:
    wanted = outcome(fuse_maps(SITE, CONFIG, device).result)
    victims: list[int] = []

    def kill_one(_: str, done: int, __: int) -> None:
        """Kill a worker when the second pair is asked for, which both are busy with."""
        if done == 2 and not victims:
            victims.append(cluster.submit(os.getpid).result())
            os.kill(victims[0], signal.SIGKILL)

    with open_scheduler(processes=2) as processes:
        for scheduler in (InProcess(), processes, cluster):
            assert outcome(fuse_maps(SITE, CONFIG, device, scheduler=scheduler).result) == wanted
    fused = fuse_maps(SITE, CONFIG, device, scheduler=cluster, progress=kill_one)
    assert victims
    assert outcome(fused.result) == wanted


@pytest.mark.full
def test_a_task_that_kills_its_workers_ends_the_job(cluster: Scheduler) -> None:
    lost = cluster.submit(end_by_force, 0)
    with pytest.raises(FleetError, match=r"several workers of local:2 died of one task, the last"):
        lost.result()
    assert cluster.submit(half, 4).result() == 2


def test_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_module, "ANSWER_S", 0.5)
    began_s = time.monotonic()
    with pytest.raises(FleetError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9 within"):
        open_scheduler("tcp://127.0.0.1:9")
    assert time.monotonic() - began_s < 20.0  # not the minutes that Dask would try


def test_tls_without_certificates_says_where_they_are_named() -> None:
    with pytest.raises(FleetError, match="wants certificates: set DASK_DISTRIBUTED__COMM__TLS__CA"):
        open_scheduler("tls://127.0.0.1:9")


def test_a_scheduler_without_workers_says_how_to_start_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(cluster_module, "WORKERS_S", 0.2)

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
            open_scheduler(where)


def test_workers_that_differ_are_named() -> None:
    told: list[str] = []
    check = cluster_module.check_workers
    one, two = (
        WorkerFacts(__version__, "one (driver 1)"),
        WorkerFacts(__version__, "two (driver 1)"),
    )
    check("local", {"tcp://a:1": one, "tcp://b:1": one}, told.append)
    assert not told
    check("local", {"tcp://a:1": one, "tcp://b:1": two, "tcp://c:1": one}, told.append)
    assert len(told) == 1
    assert "one (driver 1) (tcp://a:1, tcp://c:1); two (driver 1) (tcp://b:1)" in told[0]
    old = WorkerFacts("0.0.1", "one (driver 1)")
    with pytest.raises(FleetError, match=r"another version of slamfusion: 0\.0\.1 \(tcp://b:1\)"):
        check("local", {"tcp://a:1": one, "tcp://b:1": old}, told.append)
    broken = ConfigError("no OpenCL device fits 'x'")
    with pytest.raises(FleetError, match="the worker at tcp://b:1 cannot do the work: no OpenCL"):
        check("local", {"tcp://a:1": one, "tcp://b:1": broken}, told.append)
