"""Player, three producers and the fusion as a robot runs them, beside the same log offline.

    python -m tests.benchmarks.bench_nodes --minutes 10

A simulated laser of 360 beams at 10 Hz (or ``--log``, a recorded one) drives through an office; the
player sends at rate 1, each node is a process, all over DDS. Shown for each node: wall and
processor time until it is ready; its resident memory then, and while it runs the mean, the most and
the last; the mean of its share of memory (PSS: a page of a library that N processes map counts an
Nth); its processor time a second while it runs, also by thread. For each producer also: the error
of the poses that it told (root mean square of the places, and the 95th percentile) against that of
the same scans fed one by one, scans dropped, the longest queue, and the latency over scans (median
and 95th percentile of the last 300, at the end and at its worst). For the fusion: the latency from
a map's arrival to the fused map's publication. A busy machine shows in all of it: the load is
printed too.

The nodes load PoCL alone: the tests' OpenCL simulator, which no user has, takes 20 MB of each.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import PoseStamped
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.config import RunConfig, SimulateConfig, TrajectoryConfig
from slamfusion.evaluation.trajectory_error import trajectory_errors
from slamfusion.io import open_log
from slamfusion.io.carmen import write_carmen
from slamfusion.io.log import LogScan
from slamfusion.ros import messages
from slamfusion.ros.base import STARTED_VARIABLE
from slamfusion.sim.courses import named_course, with_overrides
from slamfusion.sim.simulate import Recording, simulate
from slamfusion.slam.registry import BUILT_IN, make_producer
from slamfusion.trajectory import Trajectory
from tests.benchmarks.bench_hours import pocl_alone
from tests.benchmarks.record import bench_parser, console_for
from tests.ros.drives import as_sent
from tests.ros.live import Observer, Process, Processes, free_domain, ros_environment, values

RATE_HZ = 10.0
SAMPLE_S = 5.0
# Threads with a smaller share, percent of a core, are left out.
LEAST = 0.3
MEMORY = ("MB: ready", "mean", "most", "at the end", "mean share")


def record(minutes: float) -> Recording:
    """Return a drive of at least so many minutes, stop by stop again and again."""
    device = open_device()
    course = with_overrides(named_course("office", 0), SimulateConfig(lidar="rplidar"))
    course = dataclasses.replace(
        course, lidar=dataclasses.replace(course.lidar, rate_hz=RATE_HZ), people=0
    )
    once = simulate(course, device)
    assert once.course.waypoints is not None
    times = int(60.0 * minutes / (len(once.scans) / RATE_HZ)) + 1
    again = dataclasses.replace(once.course, waypoints=once.course.waypoints * times)
    return simulate(again, device)


@dataclass
class Watch:
    """What is seen of one process while it runs."""

    process: Process
    status: str
    ready: str
    memory_mb: list[tuple[float, float]] = field(default_factory=list)  # resident, and its share
    waiting: list[int] = field(default_factory=list)
    p95_ms: list[float] = field(default_factory=list)
    figures: dict[str, str] = field(default_factory=dict)
    began_s: float = 0.0
    looked_s: float = 0.0
    began_cpu_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)

    def begin(self) -> None:
        """Count processor time from now on."""
        self.began_s, self.began_cpu_s = time.monotonic(), cpu_s(self.process.process.pid)

    def shares(self) -> dict[str, float]:
        """Return the processor time of each thread, percent of a core, the largest first."""
        took_s = self.looked_s - self.began_s
        shares = {
            name: 100.0 * (spent_s - self.began_cpu_s.get(name, 0.0)) / took_s
            for name, spent_s in self.cpu_s.items()
        }
        return dict(sorted(shares.items(), key=lambda item: -item[1]))

    def look(self, observer: Observer) -> None:
        """Note memory, processor time by thread and what the diagnostics say."""
        number = self.process.process.pid
        self.memory_mb.append(memory_mb(number))
        self.looked_s, self.cpu_s = time.monotonic(), cpu_s(number)
        told = observer.statuses().get(self.status)
        if told is not None:
            self.figures = values(told)
            self.waiting.append(int(self.figures.get("scans waiting", 0)))
            self.p95_ms.append(float(self.figures["latency p95 [ms]"]))


def memory_mb(number: int) -> tuple[float, float]:
    """Return the resident memory of a process, and with shared pages counted once in all (PSS)."""
    lines = Path(f"/proc/{number}/smaps_rollup").read_text().splitlines()
    kilobytes = dict(line.split()[:2] for line in lines[1:])
    return 1.024e-3 * int(kilobytes["Rss:"]), 1.024e-3 * int(kilobytes["Pss:"])


def cpu_s(number: int) -> dict[str, float]:
    """Return the processor time of a process by the names of its threads, seconds."""
    found: Counter[str] = Counter()
    for task in Path(f"/proc/{number}/task").iterdir():
        name, _, rest = (task / "stat").read_text().partition("(")[2].rpartition(")")
        own = "executor" if task.name == str(number) else name
        found[own] += sum(map(int, rest.split()[11:13])) / os.sysconf("SC_CLK_TCK")
    return dict(found)


def started(run: Processes, kind: str, folder: Path) -> Watch:
    """Start a node, alone, and wait until it is ready."""
    mark, began_s = folder / f"{kind}-started", time.monotonic()
    # Not forked from a process that has loaded what it needs.
    command = [sys.executable, "-m", "slamfusion", "node", kind]
    process = run.start(kind, command, {STARTED_VARIABLE: str(mark)})
    while not mark.exists():
        time.sleep(0.01)
    number = process.process.pid
    took = f"{time.monotonic() - began_s:.1f} / {sum(cpu_s(number).values()):.1f}"
    status = "fusion: fusion" if kind == "fusion" else f"{kind}: slam"
    return Watch(process, status, took, [memory_mb(number)])


def error_cm(poses: Trajectory, truth: Trajectory) -> str:
    """Return the root mean square and 95th percentile of the places' errors, as text."""
    errors = trajectory_errors(poses, truth, TrajectoryConfig()).translation_m
    return f"{100 * np.sqrt((errors**2).mean()):.2f} / {100 * np.percentile(errors, 95):.2f}"


def offline(kind: str, scans: list[LogScan]) -> Trajectory:
    """Return the poses that a producer tells at each scan, fed one by one."""
    producer = make_producer(kind, RunConfig(), open_device())
    rows = []
    for item in scans:
        pose = producer.feed(item.scan, item.odometry).pose_map_base
        rows.append((item.scan.stamp_s, pose.x, pose.y, pose.yaw_rad))
    table = np.array(rows)
    return Trajectory(table[:, 0], table[:, 1:], kind)


def heard(kind: str, poses: list[PoseStamped]) -> Trajectory:
    """Return the poses that a node told."""
    found = {messages.stamp_s(item): messages.pose2_from_message(item.pose) for item in poses}
    stamps = sorted(found)
    table = np.array([(found[s].x, found[s].y, found[s].yaw_rad) for s in stamps])
    return Trajectory(np.array(stamps), table, kind)


def play(log: Path, folder: Path, seconds: float) -> tuple[dict[str, Watch], dict[str, Trajectory]]:
    """Run all nodes on the log, and return what was seen of each and the poses they told."""
    with (
        free_domain() as domain,
        Processes(ros_environment(domain) | pocl_alone(), folder) as run,
        Observer(domain) as observer,
    ):
        poses = {kind: observer.collect(PoseStamped, f"{kind}/pose") for kind in BUILT_IN}
        watches = {kind: started(run, kind, folder) for kind in ("fusion", *BUILT_IN)}
        player = run.node("player", file=str(log), wait_for=list(BUILT_IN))
        observer.wait(lambda: all(poses.values()), 120.0, "the first poses")
        for watch in watches.values():
            watch.begin()
        began_s = next_s = time.monotonic()
        while player.is_running and time.monotonic() - began_s < seconds:
            next_s += SAMPLE_S
            observer.listen(next_s - time.monotonic())
            for watch in watches.values():
                watch.look(observer)
        observer.listen(3.0)
        for watch in watches.values():
            watch.look(observer)
        return watches, {kind: heard(kind, items) for kind, items in poses.items()}


def memory_cells(memory_mb: npt.ArrayLike) -> list[str]:
    """Return the cells of ``MEMORY`` for the memory over time, (N, 2), the first when ready."""
    resident_mb, shares_mb = np.array(memory_mb).T
    running_mb = resident_mb[1:]
    found = (resident_mb[0], running_mb.mean(), running_mb.max(), running_mb[-1])
    return [f"{mb:.0f}" for mb in (*found, shares_mb[1:].mean())]


def table_of(watches: dict[str, Watch], online: dict[str, str], alone: dict[str, str]) -> Table:
    """Return the table, a row for each node."""
    columns = (
        "node", "error cm: live", "offline", "fed", "dropped", "longest queue",
        "latency ms: median", "p95", "worst p95", "ready s: wall / CPU", *MEMORY, "CPU %",
        "its threads",
    )  # fmt: skip
    title = f"{os.cpu_count()} cores, load {os.getloadavg()[1]:.1f} over five minutes"
    table = Table(*columns, title=title)
    for name, watch in watches.items():
        told = watch.figures
        shares = watch.shares()
        table.add_row(
            name,
            online.get(name, "-"),
            alone.get(name, "-"),
            told.get("scans fed", f"{told.get('maps published')} maps"),
            told.get("scans dropped", "-"),
            str(max(watch.waiting, default=0)),
            told["latency median [ms]"],
            told["latency p95 [ms]"],
            f"{max(watch.p95_ms):.4g}",
            watch.ready,
            *memory_cells(watch.memory_mb),
            f"{sum(shares.values()):.1f}",
            ", ".join(f"{part} {share:.1f}" for part, share in shares.items() if share >= LEAST),
        )
    # All at the same times.
    together = np.sum([watch.memory_mb for watch in watches.values()], axis=0)
    cpu = sum(sum(watch.shares().values()) for watch in watches.values())
    blank = [""] * (len(columns) - len(MEMORY) - 3)
    table.add_row("all", *blank, *memory_cells(together), f"{cpu:.1f}", "")
    return table


def main() -> None:
    """Record, play, feed the same offline, and print."""
    parser = bench_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--log", type=Path, help="a recorded one instead; without errors")
    options = parser.parse_args()
    minutes = options.minutes
    if options.log is not None:
        with tempfile.TemporaryDirectory() as folder:
            watches, _ = play(options.log, Path(folder), 60.0 * minutes)
        console_for("nodes", options.record, width=200).print(table_of(watches, {}, {}))
        return
    recording = record(minutes)
    scans = recording.scans[: int(60.0 * minutes * RATE_HZ)]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "office.log"
        write_carmen(log, scans)
        watches, told = play(log, Path(folder), 60.0 * minutes + 60.0)
        sent = list(as_sent(open_log(log)))
    truth = recording.truth
    online = {kind: error_cm(path, truth) for kind, path in told.items()}
    alone = {kind: error_cm(offline(kind, sent), truth) for kind in BUILT_IN}
    console_for("nodes", options.record, width=200).print(table_of(watches, online, alone))


if __name__ == "__main__":
    main()
