"""Work for other processes: those of this machine, or the workers of a Dask cluster.

``executor_for`` gives a ``concurrent.futures.Executor``. None in its place means that the caller
does the work. What a task gives does not depend on where it ran, as long as devices and drivers are
the same. Dask is imported where a cluster is asked for, and nowhere else.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any, TypeVar

from slamfusion.cores import usable_cores
from slamfusion.errors import ConfigError, FleetError

Item = TypeVar("Item")
Result = TypeVar("Result")

LOCAL = re.compile(r"local(?::([1-9][0-9]{0,3}))?")
# Time between two reports of a process on the share of its task that is done, seconds.
REPORT_S = 0.5
# In a process of ``_Processes``: takes (number of the task, share that is done).
_reports: Any = None
REMOTE = re.compile(r"(?:tcp|tls)://(?:[^\s:/]+|\[[0-9a-fA-F:.]+\]):[0-9]{1,5}")


@contextlib.contextmanager
def executor_for(
    where: str | None = None, processes: int | None = None, device: str = "auto"
) -> Iterator[Executor | None]:
    """Give an executor to a ``with`` block, and leave no process and no task behind.

    Args:
        where: ``local`` or ``local:N``: a Dask cluster of N processes of this machine; or
            ``tcp://HOST:PORT`` or ``tls://HOST:PORT``: one that runs; None: no cluster.
        processes: their number, without a cluster; None or 1: no executor. A program that uses
            them needs the usual ``if __name__ == "__main__":``.

    Raises:
        ConfigError: the address is none.
        FleetError: Dask is not installed, no scheduler answers there, it has no workers, they
            cannot do the work, or, out of the block: a process or the scheduler died.
    """
    if where is not None:
        count = check_address(where)
        from slamfusion.fleet.cluster import dask_executor  # noqa: PLC0415  (an extra, and slow)

        with dask_executor(where, count, device) as executor:
            yield executor
    elif processes is None or processes == 1:
        yield None
    else:
        pool = _Processes(processes)
        try:
            with threads_limited(max(1, usable_cores() // processes)):
                yield pool
        except BrokenProcessPool:
            raise FleetError("a process died (out of memory?); fewer processes need less") from None
        finally:
            # Running tasks finish, which takes seconds; others are cancelled.
            pool.shutdown(cancel_futures=True)


def check_address(where: str) -> int | None:
    """Return the processes of a local cluster; None for one that runs; ConfigError for neither."""
    local = LOCAL.fullmatch(where)
    if local is not None:
        return int(local[1]) if local[1] else usable_cores()
    if REMOTE.fullmatch(where) is None:
        raise ConfigError(
            f"wanted local, local:N, tcp://HOST:PORT or tls://HOST:PORT as a scheduler, found "
            f"{where!r}"
        )
    return None


def as_done(
    executor: Executor | None,
    function: Callable[..., Result],
    items: Iterable[Item],
    *more: Any,
    progress: Callable[[float], None] | None = None,
) -> Iterator[tuple[Item, Result]]:
    """Yield each item with its result, in the order in which they are done.

    Args:
        function: called as ``function(item, *more)``; with ``progress`` a last argument follows, to
            be called with the share of the item that is done, 0 to 1.
        progress: called with the number of items that are done. The parts of those at work count,
            except on the workers of a cluster.
    """
    shares: dict[int, float] = {}

    def tell(number: int, share: float) -> None:
        shares[number] = share
        if progress is not None:
            progress(sum(shares.values()))

    if executor is None:
        for number, item in enumerate(items):
            told = () if progress is None else (partial(tell, number),)
            result = function(item, *more, *told)
            tell(number, 1.0)
            yield item, result
        return
    reports = getattr(executor, "reports", None)
    jobs = {}
    for number, item in enumerate(items):
        task = (function,) if progress is None else (_report, function, number)
        jobs[executor.submit(*task, item, *more)] = (number, item)
    waiting = set(jobs)
    while waiting:
        ended, waiting = wait(waiting, REPORT_S, FIRST_COMPLETED)
        while reports is not None and not reports.empty():
            tell(*reports.get())
        for job in ended:
            number, item = jobs[job]
            result = job.result()
            tell(number, 1.0)
            yield item, result


def _report(function: Callable[..., Result], number: int, *arguments: Any) -> Result:
    """Do a task in another process, and report the share that is done now and then."""
    last_s = time.monotonic()

    def tell(share: float) -> None:
        nonlocal last_s
        if _reports is not None and time.monotonic() - last_s >= REPORT_S:
            last_s = time.monotonic()
            _reports.put((number, share))

    return function(*arguments, tell)


def in_order(
    executor: Executor | None, function: Callable[..., Result], calls: Iterable[tuple[Any, ...]]
) -> Iterator[Result]:
    """Yield what a function makes of the arguments of each call, in their order.

    Few calls are handed over at a time: their arguments and results may be large.
    """
    waiting: deque[Future[Result]] = deque()
    for arguments in calls:
        if executor is None:
            yield function(*arguments)
            continue
        waiting.append(executor.submit(function, *arguments))
        if len(waiting) >= tasks_ahead(executor):
            yield waiting.popleft().result()
    yield from (job.result() for job in waiting)


def tasks_ahead(executor: Executor) -> int:
    """Return how many tasks keep an executor busy: two for each that it does at once."""
    return 2 * int(getattr(executor, "slots", usable_cores()))


class _Processes(ProcessPoolExecutor):
    """Processes of this machine; they are started as tasks come."""

    def __init__(self, slots: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.slots, self.reports = slots, context.SimpleQueue()
        super().__init__(slots, context, _begin, (self.reports,))

    def submit(self, *task: Any, **named: Any) -> Future[Any]:
        with interrupts_held():
            return super().submit(*task, **named)


def _begin(reports: Any) -> None:
    """Prepare a process: the caller alone is interrupted, and none outlives it."""
    global _reports  # noqa: PLW0603 - of this process
    _reports = reports
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


# --- processes that this one starts ---------------------------------------------------------------

# What PoCL and BLAS read before they start their threads; what the user set stays.
THREAD_VARIABLES = ("POCL_MAX_PTHREAD_COUNT", "OMP_NUM_THREADS")


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Let processes that are started in a ``with`` block not hear an interrupt before they can.

    A terminal sends it to all of them: one that is still importing would end in a traceback. They
    begin with it blocked; ours comes when the block ends. Blocking alone does not hold ours: a
    thread of a library takes the signal, and Python's handler runs in the main thread all the same.
    """
    resource_tracker.ensure_running()  # where the first process starts it, it ends the blocking
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    heard: list[tuple[int, FrameType | None]] = []
    handler = signal.getsignal(signal.SIGINT)
    is_ours = callable(handler) and threading.current_thread() is threading.main_thread()
    if is_ours:
        signal.signal(signal.SIGINT, lambda *told: heard.append(told))
    try:
        yield
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if heard and callable(handler):
            handler(*heard[0])


@contextlib.contextmanager
def threads_limited(threads: int) -> Iterator[None]:
    """Let processes that are started in a ``with`` block share the cores.

    Args:
        threads: what the device of each of them may start; BLAS gets one. What the user has set
            in the environment is left alone.
    """
    wanted = dict(zip(THREAD_VARIABLES, (str(threads), "1"), strict=True))
    added = wanted.keys() - os.environ.keys()
    os.environ.update({name: wanted[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)
