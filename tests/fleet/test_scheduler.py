"""Schedulers without a cluster: this process, a pool of processes, and what is no scheduler."""

from __future__ import annotations

import os
import signal

import pytest

from slamfusion.errors import ConfigError, FleetError
from slamfusion.fleet import InProcess, open_scheduler
from slamfusion.fleet.scheduler import check_address
from slamfusion.fleet.worker import WorkerFacts, facts_of_worker, worker_device
from slamfusion.version import __version__


def half(number: int) -> int:
    if number % 2:
        message = f"{number} is odd"
        raise ConfigError(message)
    return number // 2


def end_by_force(_: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def test_tasks_of_this_process_are_done_when_they_are_asked_for() -> None:
    done: list[int] = []
    with open_scheduler(device="numpy") as scheduler:
        assert (scheduler.slots, scheduler.device) == (1, "numpy")
        tasks = [scheduler.submit(done.append, number) for number in range(3)]
        assert (done, tasks[1].done()) == ([], False)
        tasks[1].result()
        tasks[1].result()
        assert (done, tasks[1].done()) == ([1], True)
        assert list(scheduler.completed(tasks)) == tasks
        assert done == [1, 0, 2]
        with pytest.raises(ConfigError, match="3 is odd"):
            scheduler.submit(half, 3).result()


def test_one_process_is_this_one() -> None:
    assert isinstance(open_scheduler(processes=1), InProcess)


def test_processes_do_tasks_and_one_that_dies_is_told() -> None:
    with open_scheduler(processes=2) as scheduler:
        assert scheduler.slots == 2
        tasks = [scheduler.submit(half, number) for number in range(0, 20, 2)]
        assert sorted(task.result() for task in scheduler.completed(tasks)) == list(range(10))
        assert all(task.done() for task in tasks)
        with pytest.raises(ConfigError, match="5 is odd"):
            scheduler.submit(half, 5).result()
        lost = scheduler.submit(end_by_force, 1)
        with pytest.raises(FleetError, match="a process died"):
            lost.result()
        with pytest.raises(FleetError, match="a process died"):
            scheduler.submit(half, 2)


@pytest.mark.parametrize(
    ("where", "count"), [("local:3", 3), ("tcp://robot-7.lan:8786", None), ("tls://[::1]:1", None)]
)
def test_addresses(where: str, count: int | None) -> None:
    assert check_address(where) == count


@pytest.mark.parametrize(
    "where", ["", "locals", "local:0", "local:-1", "tcp://host", "http://host:1", "host:8786"]
)
def test_what_is_no_address_is_refused(where: str) -> None:
    with pytest.raises(ConfigError, match=r"wanted local, local:N, tcp://HOST:PORT or tls://"):
        open_scheduler(where)


def test_a_process_opens_its_device_once() -> None:
    worker_device.cache_clear()
    assert facts_of_worker("numpy") == WorkerFacts(__version__, "NumPy twins (no OpenCL)")
    assert worker_device("numpy") is worker_device("numpy")
    assert worker_device.cache_info().misses == 1
