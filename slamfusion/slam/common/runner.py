"""Run one producer over the scans of a log, and record its results and costs."""

from __future__ import annotations

import copy
import math
import resource
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import F64
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import LogRecord, LogScan, ScanLog
from slamfusion.slam.common.mapper import ClosesLoops, Closure, Health, Mapper, Series
from slamfusion.slam.common.odometry_check import contradictions
from slamfusion.slam.records import ProducerRunJson, TimePerScanJson
from slamfusion.trajectory import Trajectory


@runtime_checkable
class Resumable(Mapper, Protocol):
    """A producer whose whole state can be saved and resumed; ``last_stamp_s`` is in seconds."""

    last_stamp_s: float | None

    def save_state(self, path: Path) -> None:
        """Write everything that the next scan depends on to a file."""


BYTES_PER_MB = 1e6
# Percent of the scans that took at most p50, p95, p99, p999.
TIME_PERCENTILES = (50.0, 95.0, 99.0, 99.9)
# Name of the path as it was reported during the run.
FIRST_REPORTED = "as first reported"
# Share of the scans with a low match, and number of these in a row, from which on the robot may be
# lost: a door or a crowd makes one now and then.
MANY_LOW_SHARE, MANY_LOW_IN_A_ROW = 0.05, 8
# Share of the mean score below which a match is low: that of ``Health.low_scores``.
LOW_SHARE = 0.5
# Share of the scans that could not be used from which on there is a warning: a log may hold blind
# moments, but one that is blind for longer is hardly mapped.
MANY_SKIPPED_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class ProducerRun:
    """The results of one producer on a log, and their cost.

    Attributes:
        trajectory: its pose at each scan, in the frame of the map.
        odometry: raw odometry of the scans that have some; None if none has.
        log: the log's record; None if the scans are from no log.
        time_s: from the first scan requested to the finished map, reading included.
        feed_s: (N,) float64, seconds that the producer itself took for each scan.
        low_in_a_row: most consecutive matches whose score was below half of the mean.
        peak_memory_bytes: of map and filter together, host and device.
        process_peak_memory_bytes: of the whole process so far, as the system counts it.
        is_complete: whether the scans ended before the limit.
        known_scans: scans skipped because a resumed producer had received them; ``scans`` counts
            those of all runs.
        other_paths: alternative paths, best first.
        match_scores: (N,) float64, share of each fed scan's hits on known walls; NaN if it was not
            matched.
    """

    name: str
    trajectory: Trajectory
    odometry: Trajectory | None
    grid: OccupancyGrid
    health: Health
    log: LogRecord | None
    time_s: float
    feed_s: F64
    low_in_a_row: int
    peak_memory_bytes: int
    process_peak_memory_bytes: int
    is_complete: bool = True
    known_scans: int = 0
    series: tuple[Series, ...] = ()
    other_paths: tuple[Trajectory, ...] = ()
    closures: tuple[Closure, ...] = ()
    match_scores: F64 = field(default_factory=lambda: np.empty(0))

    @property
    def scans(self) -> int:
        """Scans that were ever fed."""
        return self.health.scans

    @property
    def scans_used(self) -> int:
        """Of these, the ones that were matched or mapped."""
        return self.health.scans_used

    def time_per_scan_ms(self) -> TimePerScanJson:
        """Return mean, median (p50), p95, p99, p99.9 (as ``p999``) and longest time for a scan."""
        feed_ms = 1e3 * self.feed_s
        p50, p95, p99, p999 = np.percentile(feed_ms, TIME_PERCENTILES).tolist()
        return {
            "mean": float(feed_ms.mean()),
            "p50": p50,
            "p95": p95,
            "p99": p99,
            "p999": p999,
            "max": float(feed_ms.max()),
        }

    def online_path(self) -> Trajectory | None:
        """Return the poses as they were first reported; None if the producer keeps none."""
        for path in self.other_paths:
            if path.name == FIRST_REPORTED:
                return path
        return None

    def warnings(self) -> tuple[str, ...]:
        """Return what contradicts the map, a sentence each."""
        sentences = []
        health = self.health
        is_often_low = health.low_scores > MANY_LOW_SHARE * health.scans_used
        if is_often_low or self.low_in_a_row >= MANY_LOW_IN_A_ROW:
            share = 100.0 * health.low_scores / health.scans_used
            sentences.append(
                f"tracking may be lost: {health.low_scores} of {health.scans_used} scans "
                f"({share:.1f} %), up to {self.low_in_a_row} in a row, match the map less than "
                "half as well as usual; look at the map"
            )
        skipped = health.skips.total  # a producer may pass over scans that it does not need
        if skipped > MANY_SKIPPED_SHARE * health.scans:
            sentences.append(
                f"tracking may be lost: {skipped} of {health.scans} scans could not be used "
                f"({'; '.join(health.skips.sentences('scan'))}); there its pose is dead reckoning"
            )
        if self.odometry is not None:
            sentences += contradictions(self.odometry, self.trajectory)
        return (*sentences, *health.warnings())

    def to_json(self) -> ProducerRunJson:
        """Return the record for a JSON document; times in s and ms, memory in MB of 10^6 bytes."""
        stamps_s = self.trajectory.stamps_s
        return {
            "name": self.name,
            "scans": self.scans,
            "scans_used": self.scans_used,
            "time_s": self.time_s,
            "time_per_scan_ms": self.time_per_scan_ms(),
            "peak_memory_mb": self.peak_memory_bytes / BYTES_PER_MB,
            "process_peak_memory_mb": self.process_peak_memory_bytes / BYTES_PER_MB,
            "duration_s": float(stamps_s[-1] - stamps_s[0]),
            "path_length_m": self.trajectory.path_length_m(),
            "odometry_path_length_m": None
            if self.odometry is None
            else self.odometry.path_length_m(),
            "map": {
                "width": self.grid.width,
                "height": self.grid.height,
                "resolution": self.grid.resolution,
            },
            "health": self.health.to_json(),
            "low_scores_in_a_row": self.low_in_a_row,
            "warnings": list(self.warnings()),
            "complete": self.is_complete,
            "known_scans": self.known_scans,
            "log": self.log,
        }


def run_producer(
    mapper: Mapper,
    scans: Iterable[LogScan],
    *,
    log: ScanLog | None = None,
    progress: Callable[[int], None] | None = None,
    limit: int | None = None,
) -> ProducerRun:
    """Feed scans to a producer, which keeps its map, and return its results.

    A resumed producer does not receive known scans again. It stops after ``limit`` scans, at least
    1 if given.
    """
    last_s = mapper.last_stamp_s if isinstance(mapper, Resumable) else None
    known_until_s = -math.inf if last_s is None else last_s
    feed_s: list[float] = []
    scores: list[float] = []
    odometry: list[tuple[float, float, float, float]] = []
    known_scans = memory = row = longest_row = 0
    is_complete = True
    begun_s = time.perf_counter()
    for item in scans:
        stamp_s, wheels = item.scan.stamp_s, item.odometry
        if stamp_s <= known_until_s:
            known_scans += 1
        elif limit is not None and len(feed_s) >= limit:
            is_complete = False
            break
        else:
            before_s = time.perf_counter()
            step = mapper.feed(item.scan, wheels)
            feed_s.append(time.perf_counter() - before_s)
            score, mean = step.match_score, mapper.health.mean_match_score
            scores.append(math.nan if score is None else score)
            is_low = score is not None and mean is not None and score < LOW_SHARE * mean
            row = row + 1 if is_low else 0
            longest_row = max(longest_row, row)
            memory = max(memory, mapper.memory_bytes())
        if wheels is not None:
            odometry.append((stamp_s, wheels.x, wheels.y, wheels.yaw_rad))
        if progress is not None and stamp_s > known_until_s:
            progress(len(feed_s))
    record = None if log is None else LogRecord.of(log)
    if known_scans and not feed_s:
        where = "" if record is None else f"{record.path}: "
        raise SlamFusionError(
            f"{where}{mapper.name} knows every one of the {known_scans} scans: its state goes up "
            f"to {known_until_s:.3f} s; give a log that goes on from there"
        )
    if not feed_s or not mapper.health.scans_used:
        raise SlamFusionError(_nothing_used(mapper, record, len(feed_s)))
    grid, trajectory = mapper.grid(), mapper.trajectory()
    time_s, rows = time.perf_counter() - begun_s, np.array(odometry)
    return ProducerRun(
        name=mapper.name,
        trajectory=trajectory,
        odometry=Trajectory(rows[:, 0], rows[:, 1:], "odometry") if odometry else None,
        grid=grid,
        health=copy.deepcopy(mapper.health),  # the producer may go on
        log=record,
        time_s=time_s,
        feed_s=np.array(feed_s),
        low_in_a_row=longest_row,
        peak_memory_bytes=max(memory, mapper.memory_bytes()),
        process_peak_memory_bytes=_process_peak_bytes(),
        is_complete=is_complete,
        known_scans=known_scans,
        series=mapper.series(),
        other_paths=mapper.other_paths(),
        closures=tuple(mapper.closures()) if isinstance(mapper, ClosesLoops) else (),
        match_scores=np.array(scores),
    )


def _nothing_used(mapper: Mapper, record: LogRecord | None, fed: int) -> str:
    where = "" if record is None else f"{record.path}: "
    reasons = list(mapper.health.skips.sentences("scan")) if fed else []
    if record is not None:
        reasons += [f"{sentence} in the log" for sentence in record.skipped.sentences()]
    why = f": {'; '.join(reasons)}" if reasons else ""
    return (
        f"{where}{mapper.name} could use none of {fed} scans{why}; "
        "give a log whose scans see walls within the usable range"
    )


def _process_peak_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
