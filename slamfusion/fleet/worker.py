"""What a process that does tasks keeps: its device, opened once, and what tells it from others."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.version import __version__

__all__ = ["WorkerFacts", "do_alone", "facts_of_worker", "worker_device"]

Result = TypeVar("Result")

# Devices and what tasks keep are of one thread; a worker may have been given several.
_ALONE = threading.Lock()


@dataclass(frozen=True)
class WorkerFacts:
    """What decides the bytes that a worker gives.

    Attributes:
        version: of this package.
        device: what it computes on, in words, driver included.
    """

    version: str
    device: str


@cache
def worker_device(wanted: str) -> ComputeDevice:
    """Return the device of this process: its kernels are built once.

    Raises:
        DeviceError: see ``open_device``.
    """
    return open_device(wanted)


def facts_of_worker(wanted: str) -> WorkerFacts:
    """Return what this process is, and open its device.

    Raises:
        DeviceError: see ``open_device``.
    """
    return WorkerFacts(__version__, worker_device(wanted).name)


def do_alone(function: Callable[..., Result], *arguments: Any) -> Result:
    """Do a task when no other one is done in this process.

    Workers of a cluster are daemons as a rule, which may start no processes; a task may.
    """
    process = multiprocessing.current_process()
    with _ALONE:
        if process.daemon:
            process.daemon = False
        return function(*arguments)
