"""Tasks in several processes of this machine, which share its cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar, cast

from slamfusion.cores import usable_cores
from slamfusion.errors import FleetError
from slamfusion.fleet.children import interrupts_held, threads_limited
from slamfusion.fleet.scheduler import Task

__all__ = ["ProcessPool"]

Result = TypeVar("Result")

DIED = "a process died (out of memory?); fewer processes need less"


class ProcessPool:
    """A pool of processes; they are started as tasks come, and end with the caller.

    A program that uses it needs the usual ``if __name__ == "__main__":``.
    """

    def __init__(self, processes: int, device: str = "auto") -> None:
        """Take how many, 1 or more, and what their tasks compute on."""
        self.device, self.slots = device, processes
        self._threads = max(1, usable_cores() // processes)
        self._pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin)

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Task[Result]:
        """See ``Scheduler``."""
        try:
            with threads_limited(self._threads), interrupts_held():
                return _Submitted(self._pool.submit(function, *arguments))
        except BrokenProcessPool:
            raise FleetError(DIED) from None

    def completed(self, tasks: Sequence[Task[Result]]) -> Iterator[Task[Result]]:
        """See ``Scheduler``."""
        by_future = {cast("_Submitted[Result]", task).future: task for task in tasks}
        for future in as_completed(by_future):
            yield by_future[future]

    def __enter__(self) -> ProcessPool:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(self, *_: object) -> None:
        # Those at work come to their end unheard, which takes seconds; the others do not begin.
        self._pool.shutdown(cancel_futures=True)


class _Submitted(Task[Result]):
    """A task of the pool."""

    def __init__(self, future: Future[Result]) -> None:
        self.future = future

    def result(self) -> Result:
        try:
            return self.future.result()
        except BrokenProcessPool:
            raise FleetError(DIED) from None

    def done(self) -> bool:
        return self.future.done()


def _begin() -> None:
    """Prepare a process: the caller alone is interrupted, and none outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the caller."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
