"""Executors without a cluster: none, a pool of processes, and what is no address."""

from __future__ import annotations

import os
import pickle
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import pytest

from slamfusion.compute import open_device, shared_device
from slamfusion.errors import ConfigError, FleetError
from slamfusion.fleet import REPORT_S, as_done, check_address, executor_for, in_order, tasks_ahead


def half(number: int, less: int = 0) -> int:
    if number % 2:
        raise ConfigError(f"{number} is odd")
    return number // 2 - less


def end_by_force(_: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with executor_for(processes=2) as executor:
        assert executor is not None
        yield executor


@pytest.mark.parametrize("here", [True, False])
def test_tasks_are_done_and_errors_come_back(pool: Executor, *, here: bool) -> None:
    executor = None if here else pool
    done = dict(as_done(executor, half, range(0, 20, 2), 1))
    assert done == {number: number // 2 - 1 for number in range(0, 20, 2)}
    assert list(in_order(executor, half, [(n,) for n in range(0, 20, 2)])) == list(range(10))
    with pytest.raises(ConfigError, match="5 is odd"):
        list(as_done(executor, half, [5]))
    with pytest.raises(ConfigError, match="5 is odd"):
        list(in_order(executor, half, [(5,)]))


def slowly(number: int, tell: Callable[[float], None]) -> int:
    time.sleep(1.2 * REPORT_S)
    tell(0.5)
    time.sleep(1.2 * REPORT_S)
    return number


@pytest.mark.parametrize("here", [True, False])
def test_the_part_of_a_task_that_is_done_is_reported(pool: Executor, *, here: bool) -> None:
    counts: list[float] = []
    done = as_done(None if here else pool, slowly, [7], progress=counts.append)
    assert list(done) == [(7, 7)]
    assert counts == [0.5, 1.0]


def test_few_calls_are_handed_over_at_a_time() -> None:
    begun: list[int] = []

    def calls() -> Iterator[tuple[Any, ...]]:
        for number in range(0, 40, 2):
            begun.append(number)
            yield (number,)

    with ThreadPoolExecutor(1) as executor:
        executor.slots = 2  # type: ignore[attr-defined]  # as ours have
        assert tasks_ahead(executor) == 4
        assert next(in_order(executor, half, calls())) == 0
    assert len(begun) == 4


def test_one_process_is_this_one() -> None:
    with executor_for(processes=1) as executor:
        assert executor is None


def test_a_process_that_dies_ends_the_job() -> None:
    with pytest.raises(FleetError, match="a process died"), executor_for(processes=2) as executor:
        list(as_done(executor, end_by_force, [1]))


@pytest.mark.parametrize(
    ("where", "count"), [("local:3", 3), ("tcp://robot-7.lan:8786", None), ("tls://[::1]:1", None)]
)
def test_addresses(where: str, count: int | None) -> None:
    assert check_address(where) == count


@pytest.mark.parametrize(
    "where", ["", "locals", "local:0", "local:-1", "tcp://host", "http://host:1", "host:8786"]
)
def test_what_is_no_address_is_refused(where: str) -> None:
    with (
        pytest.raises(ConfigError, match=r"wanted local, local:N, tcp://HOST:PORT or tls://"),
        executor_for(where),
    ):
        pass


def test_a_device_that_travels_is_the_one_of_the_process() -> None:
    device = open_device()
    arrived = pickle.loads(pickle.dumps(device))  # noqa: S301
    assert arrived.name == device.name
    if device.opencl is not None:
        assert arrived is pickle.loads(pickle.dumps(device)) is shared_device("auto")  # noqa: S301
