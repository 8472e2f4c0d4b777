"""What a scheduler of tasks offers, and the simplest one: this process."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, Protocol, TypeVar

from slamfusion.cores import usable_cores
from slamfusion.errors import ConfigError

__all__ = ["InProcess", "Scheduler", "Task", "check_address", "open_scheduler"]

_LOG = logging.getLogger(__name__)

Result = TypeVar("Result")
Given_co = TypeVar("Given_co", covariant=True)

LOCAL = re.compile(r"local(?::([1-9][0-9]{0,3}))?")
REMOTE = re.compile(r"(?:tcp|tls)://(?:[^\s:/]+|\[[0-9a-fA-F:.]+\]):[0-9]{1,5}")


class Task(Protocol[Given_co]):
    """Work that was handed over."""

    def result(self) -> Given_co:
        """Return what the work gave, when it is done; raise what it raised."""

    def done(self) -> bool:
        """Return whether it has ended."""


class Scheduler(Protocol):
    """Takes tasks; use it in a ``with`` block, which leaves no process and no task behind."""

    @property
    def device(self) -> str:
        """What tasks compute on: as the option ``--device`` names it."""

    @property
    def slots(self) -> int:
        """Tasks that run at once, now."""

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Task[Result]:
        """Hand over a task.

        Args:
            function: of a module, so that another process finds it by its name.
            arguments: can be pickled.
        """

    def completed(self, tasks: Sequence[Task[Result]]) -> Iterator[Task[Result]]:
        """Yield tasks as they end."""

    def __enter__(self) -> Scheduler:  # noqa: PYI034  typing.Self needs Python 3.11
        """Begin."""

    def __exit__(self, *_: object) -> None:
        """Give up what is not done, and end."""


class _Later(Generic[Result]):
    """A task that is done when its result is asked for."""

    def __init__(self, function: Callable[..., Result], arguments: tuple[Any, ...]) -> None:
        self._function, self._arguments = function, arguments
        self._done: list[Result] = []

    def result(self) -> Result:
        if not self._done:
            self._done.append(self._function(*self._arguments))
        return self._done[0]

    def done(self) -> bool:
        return bool(self._done)


class InProcess:
    """Does each task in this process, when its result is asked for."""

    slots = 1

    def __init__(self, device: str = "auto") -> None:
        """Take what tasks compute on."""
        self.device = device

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Task[Result]:
        """See ``Scheduler``."""
        return _Later(function, arguments)

    def completed(self, tasks: Sequence[Task[Result]]) -> Iterator[Task[Result]]:
        """See ``Scheduler``."""
        for task in tasks:
            task.result()
            yield task

    def __enter__(self) -> InProcess:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(self, *_: object) -> None:
        pass


def open_scheduler(
    where: str | None = None,
    *,
    processes: int | None = None,
    device: str = "auto",
    warn: Callable[[str], None] = _LOG.warning,
) -> Scheduler:
    """Return a scheduler: of a Dask cluster, of processes, or of this process.

    Args:
        where: ``local`` or ``local:N``: a Dask cluster of N processes of this machine, for as long
            as the scheduler lives; ``tcp://HOST:PORT`` or ``tls://HOST:PORT``: one that runs; None:
            no cluster.
        processes: without a cluster, so many processes; None or 1: this one.
        device: what tasks compute on, see ``open_device``.
        warn: told in a sentence what is doubtful about workers.

    Raises:
        ConfigError: the address is none.
        FleetError: Dask is not installed, no scheduler answers there, it has no workers, or they
            cannot do the work.
    """
    if where is not None:
        count = check_address(where)
        from slamfusion.fleet.cluster import DaskCluster  # noqa: PLC0415  (an extra, and slow)

        return DaskCluster(where, count, device, warn)
    if processes is not None and processes > 1:
        from slamfusion.fleet.processes import ProcessPool  # noqa: PLC0415

        return ProcessPool(processes, device)
    return InProcess(device)


def check_address(where: str) -> int | None:
    """Return the processes of a local cluster; None for the address of one that runs.

    Raises:
        ConfigError: it is neither.
    """
    local = LOCAL.fullmatch(where)
    if local is not None:
        return int(local[1]) if local[1] else usable_cores()
    if REMOTE.fullmatch(where) is None:
        message = (
            f"wanted local, local:N, tcp://HOST:PORT or tls://HOST:PORT as a scheduler, found "
            f"{where!r}"
        )
        raise ConfigError(message)
    return None
