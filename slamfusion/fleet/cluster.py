"""The workers of a Dask cluster as an executor: a cluster that runs, or one of this machine alone.

A worker that dies costs a retry of what it did: tasks bring all that they need with them, so that
any other worker can do them.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import threading
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future
from typing import Any, TypeVar

from slamfusion.compute import shared_device
from slamfusion.cores import usable_cores
from slamfusion.errors import FleetError, extra_needed
from slamfusion.fleet import interrupts_held, threads_limited
from slamfusion.version import __version__

with extra_needed("fleet", "a scheduler needs", FleetError):
    import dask
    import distributed
    from distributed.cfexecutor import ClientExecutor

_LOG = logging.getLogger(__name__)

Result = TypeVar("Result")

# Patience with a scheduler that does not answer, and with one that has no worker yet, seconds.
ANSWER_S, WORKERS_S = 5.0, 5.0


@contextlib.contextmanager
def dask_executor(where: str, processes: int | None, device: str) -> Iterator[Executor]:
    """Connect to a cluster, or start one of this machine with processes; see ``executor_for``."""
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what is wrong is told in a sentence
    with contextlib.ExitStack() as ends:
        address = where if processes is None else ends.enter_context(_local_cluster(processes))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                client = distributed.Client(address, timeout=ANSWER_S)
        except (OSError, distributed.TimeoutError, ValueError) as error:
            raise FleetError(
                f"no Dask scheduler answers at {where} within {ANSWER_S:g} s "
                f"({' '.join(str(error).split())}); start one with `dask scheduler`, or give "
                "--scheduler local"
            ) from None
        except TypeError:  # what Dask says of a tls address without certificates
            raise FleetError(
                f"{where} wants certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, "
                "DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT and ..._KEY to files"
            ) from None
        ends.callback(client.close, timeout=ANSWER_S)
        executor = _Workers(client, where)
        ends.callback(executor.end)
        check_workers(where, client.run(_facts, device, on_error="return"))
        try:
            yield executor
        except distributed.KilledWorker as error:
            raise FleetError(
                f"several workers of {where} died of one task, the last at "
                f"{error.last_worker.address}; out of memory, perhaps: give workers more, or start "
                "fewer on a machine"
            ) from None
        except (CancelledError, distributed.comm.CommClosedError):
            raise FleetError(_gone(where)) from None


def _gone(where: str) -> str:
    return f"the scheduler at {where} went away; start it and this again"


class _Workers(ClientExecutor):  # type: ignore[misc]  # Dask has no types
    """Executor of a Dask client; its ``slots`` are workers, which do one task at a time."""

    def __init__(self, client: Any, where: str) -> None:
        super().__init__(client)
        self._where = where
        try:
            client.wait_for_workers(1, WORKERS_S)
        except distributed.TimeoutError:
            raise FleetError(
                f"the scheduler at {where} has no workers; start some with "
                f"`dask worker {where} --nthreads 1`"
            ) from None
        self.slots = len(client.scheduler_info(n_workers=-1)["workers"])

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        if self._client.status != "running":
            raise FleetError(_gone(self._where))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of arguments of megabytes, which are meant
            future: Future[Any] = super().submit(_do_alone, function, *arguments)
            return future

    def end(self) -> None:
        """Give up what is not done."""
        with contextlib.suppress(Exception):  # of what is over anyway
            self._client.cancel(list(self._futures), force=True)


@contextlib.contextmanager
def _local_cluster(processes: int) -> Iterator[Any]:
    """Start a cluster of processes of this machine, which no other machine can reach."""
    with threads_limited(max(1, usable_cores() // processes)):
        # Dask would set variables that are meant for workers here.
        ours = dask.config.set({"distributed.nanny.pre-spawn-environ": {}})
        with interrupts_held(), ours, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cluster = distributed.LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        try:
            yield cluster
        finally:
            with contextlib.suppress(distributed.TimeoutError):  # of a worker that only begins
                cluster.close(timeout=ANSWER_S)


def check_workers(where: str, found: Mapping[str, tuple[str, str] | BaseException]) -> None:
    """Raise FleetError for workers that cannot do the same work; log that devices differ.

    ``found``: version of this package and device of each, or why it could not tell, by address.
    """
    devices: dict[str, list[str]] = defaultdict(list)
    for address, facts in sorted(found.items()):
        if isinstance(facts, BaseException):
            words = " ".join(str(facts).split())
            raise FleetError(f"the worker at {address} cannot do the work: {words}")
        version, device = facts
        if version != __version__:
            raise FleetError(
                f"the worker at {address} has version {version} of slamfusion, and here is "
                f"{__version__}; install one version on all machines"
            )
        devices[device].append(address)
    if len(devices) > 1:
        listed = [f"{device} ({', '.join(on)})" for device, on in sorted(devices.items())]
        _LOG.warning(
            "workers of %s compute on different devices, so that the same task need not give the "
            "same bytes: %s",
            where,
            "; ".join(listed),
        )


# --- in the process of a worker ------------------------------------------------------------------

# Devices and what tasks keep are of one thread; a worker may have been given several.
_ALONE = threading.Lock()


def _facts(wanted: str) -> tuple[str, str]:
    """Return the version of this package, and the name of the device, which is opened."""
    return __version__, shared_device(wanted).name


def _do_alone(function: Callable[..., Result], *arguments: Any) -> Result:
    """Do a task alone in this process, which is no daemon: a task may start processes."""
    with _ALONE:
        multiprocessing.current_process().daemon = False
        return function(*arguments)
