"""Processes that this one starts: they share its cores, and hear no interrupt too early."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker
from types import FrameType

# What PoCL, OpenMP and OpenBLAS read before they start their threads; what the user set stays.
THREAD_VARIABLES = ("POCL_MAX_PTHREAD_COUNT", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


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
        threads: what device and libraries of each of them may start; what the user has set in the
            environment is left alone.
    """
    added = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(added, str(threads)))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)
