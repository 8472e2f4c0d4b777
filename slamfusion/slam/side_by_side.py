"""Several producers on one log, side by side: each in a process of its own that reads the log.

A producer that fails, dies or takes too long is named with its reason; the others go on.
"""

from __future__ import annotations

import contextlib
import gc
import math
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from slamfusion.config import RunConfig
from slamfusion.cores import GC_OBJECTS, usable_cores
from slamfusion.errors import SlamFusionError
from slamfusion.fleet import interrupts_held, threads_limited
from slamfusion.io.log import ScanLog
from slamfusion.io.logs import open_log
from slamfusion.slam.common.runner import NO_CELL, ProducerRun, run_producer
from slamfusion.slam.registry import (
    check_names,
    make_producer,
    open_producer_device,
    producer,
    with_producers,
)

# Time between two progress reports of a process, seconds.
TELL_S = 0.2
# Time to wait for a process that was killed or has closed its pipe, seconds.
JOIN_S = 10.0

# Receives the producer's name and the share of the log that it has read, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Outcome:
    """The outcome of one producer; ``run`` is None if it failed.

    Attributes:
        reason: why it failed, in one line; else empty.
        time_s: from the start of its process to its answer, imports included.
        cpu_s: processor time of its process, user and system; None if the process died.
        device: description of the device; empty if it was not opened.
        detail: the traceback of a failure that is a bug; else empty.
    """

    name: str
    run: ProducerRun | None
    reason: str = ""
    time_s: float = 0.0
    cpu_s: float | None = None
    device: str = ""
    detail: str = ""


@dataclass(frozen=True)
class _Job:
    name: str
    process: SpawnProcess
    answers: Connection
    begun_s: float

    def age_s(self) -> float:
        """Return the time since its process was started."""
        return time.perf_counter() - self.begun_s


class SideBySide:
    """Producers at work; use it in a ``with`` block, which leaves no process behind.

    The first producers start at once, the others in ``wait``. ``config`` has the settings of all
    producers, defaults included; ``source`` is the opened log.

    Raises:
        ConfigError: no producer, an unknown one, or one given twice.
        LogError: the log cannot be opened; nothing was started.
    """

    def __init__(
        self, names: Sequence[str], log: Path, config: RunConfig, scan_odometry: Path | None = None
    ) -> None:
        check_names(names)
        self.config = config = with_producers(config, names)
        self.source = open_log(log, config.log, scan_odometry)
        self._names = tuple(names)
        self._arguments = (self.source, config)
        self._limit_s = config.run.time_limit_s or math.inf
        cores = usable_cores()
        self._processes = min(len(names), config.run.processes or cores)
        self._threads = max(1, cores // self._processes)
        self._waiting = sorted(names, key=lambda name: -producer(name).cost)
        self._jobs: list[_Job] = []
        self._outcomes: dict[str, Outcome] = {}

    def __enter__(self) -> SideBySide:  # noqa: PYI034  typing.Self needs Python 3.11
        try:
            self._start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for job in self._jobs:
            _stop(job)
        self._jobs.clear()

    def wait(self, progress: Progress | None = None) -> tuple[Outcome, ...]:
        """Return the outcome of each producer, in the order given, when the last one has ended."""
        while self._jobs:
            left_s = max(0.0, self._limit_s - max(job.age_s() for job in self._jobs))
            timeout_s = left_s if math.isfinite(left_s) else None
            ready = connection.wait([job.answers for job in self._jobs], timeout_s)
            for job in list(self._jobs):
                if job.answers in ready:
                    self._listen(job, progress)
                elif job.age_s() >= self._limit_s:
                    self._conclude(job, Outcome(job.name, None, time_s=job.age_s()))
            self._start()
        return tuple(self._outcomes[name] for name in self._names)

    def _start(self) -> None:
        while self._waiting and len(self._jobs) < self._processes:
            with interrupts_held():  # none comes before the process can be stopped
                self._jobs.append(_start(self._waiting.pop(0), self._arguments, self._threads))

    def _listen(self, job: _Job, progress: Progress | None) -> None:
        """Receive one message of a process; the end of its pipe means that it died."""
        try:
            said = job.answers.recv()
        except (EOFError, OSError):
            job.process.join(JOIN_S)
            reason = _how_it_died(job.process.exitcode)
            said = Outcome(job.name, None, reason, job.age_s())
        if not isinstance(said, Outcome):
            if progress is not None:
                progress(job.name, said)
            return
        if progress is not None and said.run is not None:
            progress(job.name, 1.0)
        self._conclude(job, said)

    def _conclude(self, job: _Job, said: Outcome) -> None:
        """Keep the outcome of a process; an answer may be late and heard only now."""
        self._jobs.remove(job)
        if not said.reason and said.time_s >= self._limit_s:
            reason = f"ran past its time limit of {self._limit_s:g} s"
            said = replace(said, run=None, reason=reason)
        run = None if said.run is None else _sealed(said.run)
        self._outcomes[job.name] = replace(said, run=run)
        _stop(job)  # one that has answered has nothing left to do


def _sealed(run: ProducerRun) -> ProducerRun:
    """Return a run whose arrays are read-only again, which sending them undoes."""
    return replace(
        run,
        grid=replace(run.grid),
        trajectory=replace(run.trajectory),
        odometry=None if run.odometry is None else replace(run.odometry),
        other_paths=tuple(replace(path) for path in run.other_paths),
    )


def _start(name: str, arguments: tuple[Any, ...], threads: int) -> _Job:
    """Start a producer's process; its device and libraries may start ``threads`` threads each."""
    context = multiprocessing.get_context("spawn")
    answers, theirs = context.Pipe(duplex=False)
    begun_s = time.perf_counter()
    process = context.Process(
        target=_work,
        args=(name, *arguments, theirs, begun_s),
        name=f"slamfusion-{name}",
        daemon=True,
    )
    with threads_limited(threads):
        process.start()
    theirs.close()  # else the pipe would not end with the process
    return _Job(name, process, answers, begun_s)


def _stop(job: _Job) -> None:
    if job.process.is_alive():
        job.process.kill()
        job.process.join(JOIN_S)
    job.answers.close()
    with contextlib.suppress(ValueError):  # the process cannot be killed
        job.process.close()


def _how_it_died(exit_code: int | None) -> str:
    if exit_code is None or exit_code >= 0:
        return f"its process ended with code {exit_code} and no map"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    hint = "; out of memory, perhaps" if name == "SIGKILL" else ""
    return f"its process was killed by {name}{hint}"


# --- in the process of a producer -------------------------------------------------------------


def _work(
    name: str, source: ScanLog, config: RunConfig, answers: Connection, begun_s: float
) -> None:
    """Send the outcome; ``begun_s`` is of a clock that all processes of a machine share."""
    gc.set_threshold(GC_OBJECTS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller handles the interrupt
    os.dup2(2, 1)  # standard output belongs to the caller; drivers may print
    try:
        answer = _answer(name, source, config, answers)
        answers.send(replace(answer, time_s=time.perf_counter() - begun_s))
    except BrokenPipeError:  # the caller is gone
        sys.exit(1)


def _answer(name: str, source: ScanLog, config: RunConfig, answers: Connection) -> Outcome:
    try:
        device = open_producer_device(name, config)
        mapper = make_producer(name, config, device)
        told_s = 0.0

        def tell(_: int) -> None:
            nonlocal told_s
            now_s = time.perf_counter()
            if now_s - told_s >= TELL_S:
                told_s = now_s
                answers.send(source.fraction_read)

        run = run_producer(mapper, source, log=source, progress=tell)
    except BrokenPipeError:
        raise
    except (SlamFusionError, OSError) as error:
        reason, detail = str(error), ""
    except MemoryError:
        reason, detail = "out of memory; use a coarser cell or fewer processes", ""
    except Exception as error:  # noqa: BLE001 - a bug in one producer must not stop the others
        reason, detail = f"a bug: {type(error).__name__}: {error}", traceback.format_exc()
    else:
        if run.grid.known_box is not None:
            return Outcome(name, run, cpu_s=time.process_time(), device=device.name)
        reason, detail = NO_CELL, ""
    reason = " ".join(reason.split())
    return Outcome(name, None, reason, cpu_s=time.process_time(), detail=detail)
