"""Tasks on the workers of a Dask cluster: one that runs, or one of this machine alone.

A worker that dies costs a retry of what it did: tasks bring all that they need with them, so that
any other worker can do them.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

from slamfusion.cores import usable_cores
from slamfusion.errors import FleetError, SlamFusionError
from slamfusion.fleet.children import interrupts_held, restore_variables, thread_limits
from slamfusion.fleet.scheduler import Task
from slamfusion.fleet.worker import WorkerFacts, do_alone, facts_of_worker
from slamfusion.version import __version__

try:
    import distributed
except ImportError as missing:
    _MESSAGE = f"a scheduler needs Dask ({missing}); pip install 'slamfusion[fleet]'"
    raise FleetError(_MESSAGE) from missing

__all__ = ["DaskCluster", "check_workers"]

Result = TypeVar("Result")

# Patience, seconds: with a scheduler that does not answer, with one that has no worker yet, and
# with one that has lost all of them.
ANSWER_S, WORKERS_S, NO_WORKERS_S = 5.0, 5.0, 60.0
# How often a task that is waited for is looked after, seconds.
LOOK_S = 2.0


class DaskCluster:
    """The workers of a Dask scheduler; they compute on the device that the settings name.

    Attributes:
        device: see ``Scheduler``.
        workers: what each worker is that was there at the start, by address.
    """

    def __init__(
        self, where: str, processes: int | None, device: str, warn: Callable[[str], None]
    ) -> None:
        """Connect, or start a cluster of this machine.

        Args:
            where: the scheduler's address, or what it is called.
            processes: of a cluster of this machine; None: connect to ``where``.
            device: what workers compute on.
            warn: told where workers differ.

        Raises:
            FleetError: no scheduler answers, it has no workers, or they cannot do the work.
        """
        self.device, self._where = device, where
        self._ends = contextlib.ExitStack()
        self._futures: set[Any] = set()
        self._known: list[str] = []
        self._known_s = 0.0
        self._ends.enter_context(_without_log())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                address: Any = where if processes is None else self._start(processes)
                self._client = self._connect(address)
                self.workers = self._look_at_workers(warn)
            except BaseException:
                self._ends.close()
                raise

    @property
    def slots(self) -> int:
        """See ``Scheduler``: one task a worker, however many threads it has."""
        return max(1, len(self._addresses()))

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Task[Result]:
        """See ``Scheduler``."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of arguments of megabytes, which are meant
            future = self._client.submit(do_alone, function, *arguments, pure=False)
        self._futures.add(future)
        return _OnCluster(future, self)

    def completed(self, tasks: Sequence[Task[Result]]) -> Iterator[Task[Result]]:
        """See ``Scheduler``."""
        waiting = {cast("_OnCluster[Result]", task).future: task for task in tasks}
        while waiting:
            self.wait(waiting)
            for future in [item for item in waiting if item.done()]:
                yield waiting.pop(future)

    def wait(self, futures: Any) -> None:
        """Wait until one of some tasks is done.

        Raises:
            FleetError: the scheduler is gone, or there was no worker for a while.
        """
        alone_since: float | None = None
        while not any(future.done() for future in futures):
            # Of Python 3.10 it is another one than the built-in.
            with contextlib.suppress(distributed.TimeoutError):
                distributed.wait(list(futures), timeout=LOOK_S, return_when="FIRST_COMPLETED")
            if self._client.status != "running":
                message = f"the scheduler at {self._where} went away; start it and this again"
                raise FleetError(message)
            if self._addresses():
                alone_since = None
                continue
            alone_since = alone_since or time.monotonic()
            if time.monotonic() - alone_since > NO_WORKERS_S:
                message = f"the scheduler at {self._where} has lost all its workers; start some"
                raise FleetError(message)

    def result_of(self, future: Any) -> Any:
        """Return what a task gave; see ``Task``."""
        self.wait([future])
        try:
            return future.result()
        except distributed.KilledWorker as error:
            message = (
                f"several workers of {self._where} died of one task, the last at "
                f"{error.last_worker.address}; out of memory, perhaps: give workers more, or start "
                "fewer on a machine"
            )
            raise FleetError(message) from None
        except (distributed.client.FutureCancelledError, OSError) as error:
            if isinstance(error, SlamFusionError):
                raise
            message = f"the scheduler at {self._where} went away; start it and this again"
            raise FleetError(message) from None
        finally:
            self._futures.discard(future)

    def __enter__(self) -> DaskCluster:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):  # of what is over anyway
            self._client.cancel(list(self._futures), force=True)
        self._futures.clear()
        self._ends.close()

    def _start(self, processes: int) -> Any:
        """Start a cluster of processes of this machine, which nobody else can reach."""
        limits = thread_limits(max(1, usable_cores() // processes))
        before = dict(os.environ)
        with interrupts_held():
            cluster = distributed.LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
                env=limits,
            )
        # Dask sets variables that are meant for workers here, whenever it starts one.
        left = {
            name: before.get(name) for name in os.environ if os.environ[name] != before.get(name)
        }
        self._ends.callback(restore_variables, left)
        self._ends.callback(cluster.close, timeout=ANSWER_S)
        return cluster

    def _connect(self, address: Any) -> Any:
        try:
            client = distributed.Client(address, timeout=ANSWER_S)
        except (OSError, distributed.TimeoutError, ValueError) as error:
            message = (
                f"no Dask scheduler answers at {self._where} within {ANSWER_S:g} s "
                f"({' '.join(str(error).split())}); start one with `dask scheduler`, or give "
                "--scheduler local"
            )
            raise FleetError(message) from None
        except TypeError:  # what Dask says of an address that begins with tls, without certificates
            message = (
                f"{self._where} wants certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, "
                "DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT and ..._KEY to files"
            )
            raise FleetError(message) from None
        self._ends.callback(client.close, timeout=ANSWER_S)
        return client

    def _addresses(self) -> list[str]:
        """Return the addresses of the workers that there are, or were a moment ago."""
        now_s = time.monotonic()
        if not self._known or now_s - self._known_s > LOOK_S:
            # Asks the scheduler, which takes milliseconds; who hands over tasks asks often.
            self._known = list(self._client.scheduler_info(n_workers=-1)["workers"])
            self._known_s = now_s
        return self._known

    def _look_at_workers(self, warn: Callable[[str], None]) -> dict[str, WorkerFacts]:
        """Ask the workers what they are; refuse those that cannot do the same work."""
        until = time.monotonic() + WORKERS_S
        while not self._addresses():
            if time.monotonic() > until:
                message = (
                    f"the scheduler at {self._where} has no workers; start some with "
                    f"`dask worker {self._where} --nthreads 1`"
                )
                raise FleetError(message)
            time.sleep(0.1)
        found = self._client.run(facts_of_worker, self.device, on_error="return")
        return check_workers(self._where, found, warn)


@contextlib.contextmanager
def _without_log() -> Iterator[None]:
    """Silence what Dask logs: of workers that come and go a sentence is told here, or no news."""
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado.application")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class _OnCluster(Task[Result]):
    """A task of a cluster."""

    def __init__(self, future: Any, cluster: DaskCluster) -> None:
        self.future, self._cluster = future, cluster

    def result(self) -> Result:
        return cast("Result", self._cluster.result_of(self.future))

    def done(self) -> bool:
        return bool(self.future.done())


def check_workers(
    where: str, found: Mapping[str, WorkerFacts | BaseException], warn: Callable[[str], None]
) -> dict[str, WorkerFacts]:
    """Refuse workers that cannot do the same work as this process, and name those that differ.

    Args:
        where: their scheduler.
        found: what each said of itself, or why it could not, by address.
        warn: told where they compute on different devices.

    Raises:
        FleetError: one cannot, or has another version of this package.
    """
    facts = {}
    for address, said in found.items():
        if not isinstance(said, WorkerFacts):
            words = " ".join(str(said).split())
            message = f"the worker at {address} cannot do the work: {words}"
            raise FleetError(message)
        facts[address] = said
    versions = _by_kind(
        {"here": __version__} | {address: item.version for address, item in facts.items()}
    )
    if len(versions) > 1:
        message = (
            f"workers of {where} have another version of slamfusion: {_listed(versions)}; install "
            "one version on all of them"
        )
        raise FleetError(message)
    devices = _by_kind({address: item.device for address, item in facts.items()})
    if len(devices) > 1:
        warn(
            f"workers of {where} compute on different devices, so that the same task need not give "
            f"the same bytes: {_listed(devices)}"
        )
    return facts


def _by_kind(kinds: dict[str, str]) -> dict[str, list[str]]:
    """Return the addresses of each kind of worker."""
    found = defaultdict(list)
    for address, kind in sorted(kinds.items()):
        found[kind].append(address)
    return dict(found)


def _listed(kinds: dict[str, list[str]]) -> str:
    return "; ".join(f"{kind} ({', '.join(where)})" for kind, where in sorted(kinds.items()))
