"""Hours of a recorded log, forward and backward, through the SLAMs and the live fusion in lockstep.

    python -m tests.benchmarks.bench_hours LOG --hours 10

Each SLAM is a process with the session of its node, which reads map and path every ``TOLD_S`` of
the log; the fusion is this process. All of them use memory as nodes do: one heap, from which what
is free is returned now and then, and PoCL without the tests' OpenCL simulator, which no user has.
Shown for each hour of the log and each of the four: its processor time a scan, its memory at the
end of the hour, and the largest time of one scan; for a SLAM also how far its poses are from those
of its first way through the same scans (root mean square).
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.compute.device import VENDORS
from slamfusion.config import RunConfig
from slamfusion.geometry import Pose2, row_of
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan, open_log
from slamfusion.io.files import return_freed_memory, use_one_arena
from slamfusion.slam.registry import BUILT_IN
from slamfusion.slam.session import ProducerSession, QueuedScan
from slamfusion.trajectory import Trajectory

HOUR_S = 3600.0
# Path and map come this often, seconds of the log.
TOLD_S = 2.0
# Freed memory is returned this often (``ros.base.TRIM_S``), seconds of the log.
TRIM_S = 10.0
# The path of a node has at most this many poses (``messages.PATH_POSES``).
PATH_POSES = 2000
COLUMNS = ("hour", "node", "CPU ms a scan", "MB", "slowest scan ms", "apart m")


@dataclass(frozen=True)
class Chunk:
    """What a SLAM answers to the scans of ``TOLD_S``: its poses, map and path, and what it took."""

    poses: Sequence[Pose2]
    path: Trajectory
    grid: OccupancyGrid
    cpu_s: float
    slowest_s: float
    memory_mb: float


def scans_of(log: Path, seconds: float) -> Iterator[tuple[int, LogScan]]:
    """Yield index and scan of a log forward and backward, with stamps that go on."""
    scans = list(open_log(log))
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    steps_s = np.diff(stamps_s)
    now_s, index, way = 0.0, 0, 1
    while now_s <= seconds:
        item = scans[index]
        yield index, replace(item, scan=replace(item.scan, stamp_s=stamps_s[0] + now_s))
        way = -1 if index == len(scans) - 1 else 1 if index == 0 else way
        now_s += max(float(steps_s[min(index, index + way)]), 1e-3)
        index += way


def chunks(log: Path, seconds: float) -> Iterator[list[tuple[int, LogScan]]]:
    """Yield the scans of each ``TOLD_S``."""
    chunk: list[tuple[int, LogScan]] = []
    for index, item in scans_of(log, seconds):
        chunk.append((index, item))
        if item.scan.stamp_s - chunk[0][1].scan.stamp_s >= TOLD_S:
            yield chunk
            chunk = []


def pocl_alone() -> dict[str, str]:
    """Return the environment in which OpenCL's loader loads the PoCL of the wheels alone."""
    spec = importlib.util.find_spec("pyopencl")
    entry = Path(spec.origin if spec and spec.origin else "").parent / ".libs" / "pocl.icd"
    return {VENDORS: str(entry)} if entry.exists() else {}


def resident_mb() -> float:
    """Return the resident memory of this process."""
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Trim:
    """Returns freed memory now and then."""

    def __init__(self) -> None:
        self._due_s = -np.inf

    def look(self, now_s: float) -> None:
        """Return it if it is time, seconds of the log."""
        if now_s >= self._due_s:
            return_freed_memory()
            self._due_s = now_s + TRIM_S


def produce(kind: str, log: Path, seconds: float, answers: Connection) -> None:
    """Feed a SLAM as its node does, and send what it answers."""
    use_one_arena()
    session = ProducerSession(kind, RunConfig(), open_device, wants_odometry=True)
    trim = Trim()
    for chunk in chunks(log, seconds):
        poses, slowest_s, before_s = [], 0.0, time.process_time()
        for _, item in chunk:
            began_s = time.process_time()
            answer = session.feed(_queued(item))
            assert answer is not None, session.snapshot
            poses.append(answer.pose)
            slowest_s = max(slowest_s, time.process_time() - began_s)
        made = session.read_map(is_path_heard=True, is_paused=False)
        assert made is not None
        assert made.trajectory is not None
        grid = session.draw(made)
        path = replace(made.trajectory.at_most(PATH_POSES), name=kind)
        trim.look(chunk[-1][1].scan.stamp_s)
        spent_s = time.process_time() - before_s
        answers.send(Chunk(poses, path, grid.with_name(kind), spent_s, slowest_s, resident_mb()))


def _queued(item: LogScan) -> QueuedScan:
    pose = item.odometry

    def odometry_at(times: np.ndarray) -> np.ndarray | None:
        return None if pose is None else np.tile(row_of(pose), (len(times), 1))

    return QueuedScan(item.scan.stamp_s, time.monotonic(), 0, lambda: item.scan, odometry_at)


class Row:
    """What one node took in a part of the drive."""

    def __init__(self) -> None:
        self.scans, self.cpu_s, self.slowest_s, self.memory_mb = 0, 0.0, 0.0, 0.0
        self.apart_m2: list[float] = []

    def cells(self) -> list[str]:
        """Return the cells of its row."""
        apart = f"{np.sqrt(np.mean(self.apart_m2)):.3f}" if self.apart_m2 else "-"
        return [
            f"{1e3 * self.cpu_s / max(self.scans, 1):.2f}",
            f"{self.memory_mb:.0f}",
            f"{1e3 * self.slowest_s:.0f}",
            apart,
        ]


class Hours:
    """The rows of all nodes, and where the robot was when it first had each scan."""

    def __init__(self, names: Sequence[str], row_s: float, title: str) -> None:
        self.table = Table(*COLUMNS, title=title)
        self._names, self._row_s, self._until_s = names, row_s, row_s
        self._rows = {name: Row() for name in names}
        self._first: dict[tuple[str, int], Pose2] = {}

    def take(self, name: str, index: int, pose: Pose2) -> None:
        """Compare a pose with the first one at that scan."""
        known = self._first.setdefault((name, index), pose)
        self._rows[name].apart_m2.append((pose.x - known.x) ** 2 + (pose.y - known.y) ** 2)

    def end(self, now_s: float, *, is_last: bool = False) -> None:
        """Print the rows of a part that is over; seconds since the first scan."""
        if now_s < self._until_s and not is_last:
            return
        for name in self._names:
            cells = (f"{self._until_s / HOUR_S:.3g}", name, *self._rows[name].cells())
            self.table.add_row(*cells)
            print("; ".join(cells), flush=True)
        self._rows = {name: Row() for name in self._names}
        self._until_s += self._row_s

    def took(self, name: str, scans: int, cpu_s: float, slowest_s: float, memory: float) -> None:
        """Add what a node took for a chunk of scans."""
        row = self._rows[name]
        row.scans += scans
        row.cpu_s += cpu_s
        row.slowest_s = max(row.slowest_s, slowest_s)
        row.memory_mb = memory


class Fusion:
    """The live fusion in this process."""

    def __init__(self, names: Sequence[str]) -> None:
        # Here, for the memory of the SLAMs' processes, which import this module.
        from tests.benchmarks.live_drives import Robot, Told  # noqa: PLC0415

        self._robot, self._told = Robot(names, open_device()), Told
        self._number, self._trim = 0, Trim()

    def hear(
        self, chunk: Sequence[tuple[int, LogScan]], told: dict[str, Chunk], hours: Hours
    ) -> None:
        """Take a chunk of scans and what the SLAMs answer to it."""
        robot, slowest_s, before_s = self._robot, 0.0, time.process_time()
        for at, (index, item) in enumerate(chunk):
            began_s, is_last = time.process_time(), at == len(chunk) - 1
            self._number += 1
            poses = {name: one.poses[at] for name, one in told.items()}
            paths = {name: one.path for name, one in told.items() if is_last}
            maps = {name: one.grid for name, one in told.items() if is_last}
            robot.hear(item, self._told(poses, paths, maps), self._number)
            slowest_s = max(slowest_s, time.process_time() - began_s)
            for _, located in robot.online:
                hours.take("fusion", index, located.pose)
            robot.online.clear()
        robot.is_undecided.clear()
        self._trim.look(chunk[-1][1].scan.stamp_s)
        hours.took("fusion", len(chunk), time.process_time() - before_s, slowest_s, resident_mb())


def drive(log: Path, options: argparse.Namespace) -> Table:
    """Drive through the log for hours of its time; prints each row as it is done."""
    seconds, names = options.hours * HOUR_S, options.slam
    context = multiprocessing.get_context("spawn")
    answers = {}
    for name in names:
        answers[name], theirs = context.Pipe(duplex=False)
        context.Process(target=produce, args=(name, log, seconds, theirs), daemon=True).start()
        theirs.close()
    fusion = None if options.alone else Fusion(names)
    shown = names if fusion is None else (*names, "fusion")
    title = f"{log.name}, {options.hours:g} hours, on {open_device().name}"
    hours, first_s, now_s = Hours(shown, 60.0 * options.row, title), None, 0.0
    for chunk in chunks(log, seconds):
        first_s = chunk[0][1].scan.stamp_s if first_s is None else first_s
        now_s = chunk[0][1].scan.stamp_s - first_s
        hours.end(now_s)
        told = {name: answers[name].recv() for name in names}
        for name, one in told.items():
            hours.took(name, len(chunk), one.cpu_s, one.slowest_s, one.memory_mb)
            for (index, _), pose in zip(chunk, one.poses, strict=True):
                hours.take(name, index, pose)
        if fusion is not None:
            fusion.hear(chunk, told, hours)
    hours.end(now_s, is_last=True)
    return hours.table


def main() -> None:
    """Print a table with a row for each hour and node."""
    # Here, as above.
    from tests.benchmarks.record import bench_parser, console_for  # noqa: PLC0415

    parser = bench_parser(__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--row", type=float, default=60.0, help="minutes of the log in a row")
    parser.add_argument("--slam", nargs="+", default=BUILT_IN, choices=BUILT_IN)
    parser.add_argument("--alone", action="store_true", help="without the fusion")
    options = parser.parse_args()
    os.environ.update(pocl_alone())
    use_one_arena()
    console_for("hours", options.record, width=120).print(drive(options.log, options))


if __name__ == "__main__":
    main()
