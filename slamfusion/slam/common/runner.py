"""Run one producer over the scans of a log, and record its results and costs."""

from __future__ import annotations

import copy
import math
import resource
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from slamfusion.errors import SlamFusionError, counted
from slamfusion.geometry import F64
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import LogRecord, LogScan, ScanLog
from slamfusion.slam.common.mapper import LOW_SHARE, ClosesLoops, Closure, Health, Mapper, Series
from slamfusion.slam.common.odometry_check import contradictions
from slamfusion.trajectory import Trajectory


@runtime_checkable
class Resumable(Mapper, Protocol):
    """A producer whose whole state can be saved and resumed; ``last_stamp_s`` is in seconds."""

    last_stamp_s: float | None

    def save_state(self, path: Path) -> None:
        """Write everything that the next scan depends on to a file."""


BYTES_PER_MB = 1e6
# Unit of the system's peak memory.
PEAK_BYTES = 1 if sys.platform == "darwin" else 1024
# Name of the path as it was reported during the run.
FIRST_REPORTED = "as first reported"
# Share of the scans with a low match, and number of these in a row, from which on the robot may be
# lost: a door or a crowd makes one now and then.
MANY_LOW_SHARE, MANY_LOW_IN_A_ROW = 0.05, 8
# Share of the scans that could not be used from which on there is a warning: a log may hold blind
# moments, but one that is blind for longer is hardly mapped.
MANY_SKIPPED_SHARE = 0.2
NO_CELL = "no cell of its map is known; check the settings of its cells"


@dataclass(frozen=True)
class MapSize:
    """Size of a map."""

    width: int
    """Columns."""
    height: int
    """Rows."""
    resolution: float
    """Metres per cell."""


@dataclass(frozen=True)
class TimePerScan:
    """Time that a producer took for a scan, nothing else in it; milliseconds."""

    mean: float
    """Mean, milliseconds."""
    p50: float
    """Median, milliseconds."""
    p95: float
    """95th percentile, milliseconds."""
    p99: float
    """99th percentile, milliseconds."""
    p999: float
    """99.9th percentile, milliseconds."""
    max: float
    """The longest, milliseconds."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProducerRun:
    """What one producer made of a log, and what it took.

    Attributes:
        trajectory: its pose at each scan, in the frame of the map.
        odometry: raw odometry of the scans that have some; None if none has.
        feed_s: (N,) float64, seconds that the producer itself took for each scan.
        other_paths: alternative paths, best first.
        match_scores: (N,) float64, share of each fed scan's hits on known walls; NaN if it was not
            matched.
    """

    name: str
    """The producer."""
    scans: int = field(init=False)
    """Scans that were ever fed to it, before it was resumed too."""
    scans_used: int = field(init=False)
    """Of these, the ones that were matched or mapped."""
    time_s: float
    """From the first scan asked for to the finished map, reading included; seconds."""
    time_per_scan_ms: TimePerScan = field(init=False)
    """Time for each scan that was fed in this run, milliseconds."""
    peak_memory_mb: float
    """Peak of map and filter together, host and device; MB of 10^6 bytes."""
    process_peak_memory_mb: float
    """Peak of the whole process, as the system counts it; MB of 10^6 bytes."""
    duration_s: float = field(init=False)
    """Time from the first pose to the last, seconds."""
    path_length_m: float = field(init=False)
    """Length of the path, metres."""
    odometry_path_length_m: float | None = field(init=False)
    """Length of the path by raw odometry, metres; null without odometry."""
    map: MapSize = field(init=False)
    """Size of its map."""
    health: Health
    """How well it did."""
    low_scores_in_a_row: int
    """Most matches one after the other whose score was below half of the mean."""
    warnings: Sequence[str] = field(init=False)
    """What contradicts the map, a sentence each."""
    complete: bool
    """Whether the scans came to their end; false: it was stopped before."""
    known_scans: int
    """Scans of the log that a resumed producer had been fed before and that were passed over."""
    log: LogRecord | None
    """What the log said of itself; null where the scans are from no log."""
    trajectory: Trajectory = field(repr=False)
    odometry: Trajectory | None = field(repr=False)
    grid: OccupancyGrid = field(repr=False)
    feed_s: F64 = field(repr=False)
    series: tuple[Series, ...] = field(repr=False)
    other_paths: tuple[Trajectory, ...] = field(repr=False)
    closures: tuple[Closure, ...] = field(repr=False)
    match_scores: F64 = field(repr=False)

    def __post_init__(self) -> None:
        """Work out what follows from the rest."""
        feed_ms, stamps_s, wheels = 1e3 * self.feed_s, self.trajectory.stamps_s, self.odometry
        p50, p95, p99, p999 = np.percentile(feed_ms, (50.0, 95.0, 99.0, 99.9)).tolist()
        vars(self).update(
            scans=self.health.scans,
            scans_used=self.health.scans_used,
            time_per_scan_ms=TimePerScan(
                float(feed_ms.mean()), p50, p95, p99, p999, float(feed_ms.max())
            ),
            duration_s=float(stamps_s[-1] - stamps_s[0]),
            path_length_m=self.trajectory.path_length_m(),
            odometry_path_length_m=None if wheels is None else wheels.path_length_m(),
            map=MapSize(self.grid.width, self.grid.height, self.grid.resolution),
            warnings=self._contradictions(),
        )

    def online_path(self) -> Trajectory | None:
        """Return the poses as they were first reported; None if the producer keeps none."""
        path = next((own for own in self.other_paths if own.name == FIRST_REPORTED), None)
        return path and replace(path, name=f"{self.trajectory.name} {FIRST_REPORTED}")

    def _contradictions(self) -> tuple[str, ...]:
        sentences, health = [], self.health
        if self.grid.known_box is None:
            sentences.append(NO_CELL)
        is_often_low = health.low_scores > MANY_LOW_SHARE * health.scans_used
        if is_often_low or self.low_scores_in_a_row >= MANY_LOW_IN_A_ROW:
            share = 100.0 * health.low_scores / health.scans_used
            sentences.append(
                f"tracking may be lost: {health.low_scores} of {health.scans_used} scans "
                f"({share:.1f} %), up to {self.low_scores_in_a_row} in a row, match the map less "
                "than half as well as usual; look at the map"
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
    record: LogRecord | None = None
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
            if log is not None and len(feed_s) == limit:
                # The log reads one scan more, which shows whether the limit cuts anything off.
                record = copy.deepcopy(LogRecord.of(log))
        if wheels is not None:
            odometry.append((stamp_s, wheels.x, wheels.y, wheels.yaw_rad))
        if progress is not None and stamp_s > known_until_s:
            progress(len(feed_s))
    if log is not None and (is_complete or record is None):
        record = LogRecord.of(log)
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
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * PEAK_BYTES
    return ProducerRun(
        name=mapper.name,
        trajectory=trajectory,
        odometry=Trajectory(rows[:, 0], rows[:, 1:], "odometry") if odometry else None,
        grid=grid,
        health=copy.deepcopy(mapper.health),  # the producer may go on
        log=record,
        time_s=time_s,
        feed_s=np.array(feed_s),
        low_scores_in_a_row=longest_row,
        peak_memory_mb=max(memory, mapper.memory_bytes()) / BYTES_PER_MB,
        process_peak_memory_mb=peak / BYTES_PER_MB,
        complete=is_complete,
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
        reasons += record.notes
    if fed:
        reasons.append("give a log whose scans see walls within the usable range")
    return f"{where}{mapper.name} could use none of {counted(fed, 'scan')}: {'; '.join(reasons)}"
