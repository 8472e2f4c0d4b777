"""``ProducerSession``: a SLAM at work on live scans, one map after another; no ROS.

Scans are fed in one thread, maps drawn in a second one, and a third observes. The workers' results
are frozen snapshots, replaced as a whole, so that other threads read them without a lock.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.deskew import Deskewer, Deskewing
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import F64, Pose2, row_of
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.io.log import BEFORE_ODOMETRY
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import DrawsAside, Health, MapJob, Mapper
from slamfusion.slam.common.odometry_check import contradictions
from slamfusion.slam.registry import make_producer
from slamfusion.trajectory import Trajectory

NOT_NEWER = "stamp not later than the last one's"
SENT_AGAIN = "sent again"
NOT_FED = "the SLAM failed"

# Largest share of the time for reading and drawing maps: that of a large one comes less often.
MAP_SHARE = 0.1
# Scans whose latency is kept.
LATENCIES = 300
# Scans whose motion is compared with the odometry.
MOTIONS = 3000
WARM_UP_BEAMS = 360
NEVER_S = float("-inf")


class LeftOutError(Exception):
    """A scan cannot be fed; the message is the reason under which it is counted."""


@dataclass(frozen=True, eq=False)
class QueuedScan:
    """A waiting scan.

    Attributes:
        arrived_s: time of arrival, on the clock of the session.
        generation: of its map; see ``ProducerSession.begin_new_map``.
        read: returns the scan; may raise ``LeftOutError``.
        odometry: returns poses (K, 3) at times (K,), seconds, up to the first unknown one; None if
            the first, the scan's own, is unknown.
    """

    stamp_s: float
    arrived_s: float
    generation: int
    read: Callable[[], LaserScan]
    odometry: Callable[[F64], F64 | None]


@dataclass(frozen=True, eq=False)
class Answer:
    """The result of a scan; the pose of the base is in the map frame.

    Attributes:
        is_new: False for a scan that was sent again and gets the same answer.
        unused: why the scan was not used, one line; else empty.
    """

    pose: Pose2
    odometry: Pose2 | None = None
    is_new: bool = True
    unused: str = ""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The results of the scan worker so far.

    Attributes:
        without_odometry: scans without the odometry that is wanted.
        left_out: scans that were not fed, by reason.
        fed_s: stamp of the newest scan in this map, seconds; None before the first.
        pose: of the base in the map frame at that scan.
        unmapped: scans fed since the last map was read.
        problem: why the producer failed at the last scan, one line; else empty.
        busy_since_s: start of the work on the present scan; None if there is none.
        map_at_s: when a map was last read.
        is_settled: whether that map had all closures solved.
        is_path_due: whether that map had no path, without subscribers.
        latencies_s: from arrival to answer, of the last scans.
        contradictions: between poses and odometry when a map was last read, a sentence each.
    """

    fed: int = 0
    without_odometry: int = 0
    left_out: Mapping[str, int] = field(default_factory=dict)
    fed_s: float | None = None
    pose: Pose2 = IDENTITY
    unmapped: int = 0
    health: Health = field(default_factory=Health)
    problem: str = ""
    busy_since_s: float | None = None
    map_at_s: float = NEVER_S
    map_time_s: float = 0.0
    is_settled: bool = True
    is_path_due: bool = False
    memory_bytes: int = 0
    latencies_s: tuple[float, ...] = ()
    deskewing: Deskewing = field(default_factory=Deskewing)
    contradictions: tuple[str, ...] = ()

    def latencies_ms(self) -> tuple[float, float]:
        """Return median and 95th percentile of the latencies, ms; 0 without any."""
        median, high = 1e3 * np.percentile(self.latencies_s or (0.0,), (50.0, 95.0))
        return float(median), float(high)


@dataclass(frozen=True, eq=False)
class UndrawnMap:
    """A map to be published, drawn or not; ``stamp_s`` is of its newest scan, seconds.

    ``trajectory`` is None without subscribers.
    """

    grid: OccupancyGrid | MapJob
    trajectory: Trajectory | None
    stamp_s: float
    generation: int


@dataclass(frozen=True)
class Drawn:
    """The results of the map worker so far.

    Attributes:
        shape: width and height of the last map, cells.
        time_s: time to draw it; None if maps are not drawn in this thread.
    """

    maps: int = 0
    shape: tuple[int, int] = (0, 0)
    time_s: float | None = None


class ProducerSession:
    """Feeds scans to a producer, starts new maps when time goes back, and reads maps.

    ``snapshot`` and ``drawn`` may be read by any thread.

    Args:
        open_device: opens one device for the warm-up, one for the scans and, if the producer's map
            can be drawn aside, one for the map thread, since a queue belongs to one thread.
        clock: monotonic time, seconds.
    """

    def __init__(
        self,
        kind: str,
        config: RunConfig,
        open_device: Callable[[], ComputeDevice],
        *,
        wants_odometry: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.generation = 0
        self.snapshot = Snapshot()
        self.drawn = Drawn()
        _warm_up(lambda device: make_producer(kind, config, device), open_device())
        self.device = open_device()
        self._make: Callable[[], Mapper] = lambda: make_producer(kind, config, self.device)
        self._config = config
        self._wants_odometry = wants_odometry
        self._deskewer = Deskewer(config.log)
        self._clock = clock
        self._producer = self._make()
        self._drawing: ComputeDevice | None = None
        if isinstance(self._producer, DrawsAside):
            self._drawing = open_device()
            self.drawn = Drawn(time_s=0.0)
        self._producer_generation = 0
        self._job: MapJob | None = None
        # What draws the maps of a generation.
        self._drawer: tuple[int, Callable[[MapJob], OccupancyGrid]] | None = None
        # Of the newest scan: NaN equals nothing.
        self._ranges = b""
        # Stamp, pose and odometry of the last scans, a row each.
        self._moved: F64 = np.empty((0, 7))

    def begin_new_map(self) -> None:
        """Start a new map: scans queued from now on belong to it."""
        self.generation += 1

    @property
    def is_before_odometry(self) -> bool:
        """Whether odometry is wanted and the map waits for it."""
        return self._wants_odometry and self.snapshot.fed_s is None

    # -- in the worker of scans -------------------------------------------------------------------

    def feed(self, item: QueuedScan) -> Answer | None:
        """Feed a scan; None if it is left out, with the reason counted in the snapshot."""
        self._change(problem="")
        if item.generation != self.generation:
            return None
        self._change(busy_since_s=self._clock())
        try:
            return self._feed(item)
        except LeftOutError as error:
            self.leave_out(str(error))
            return None
        finally:
            self._change(busy_since_s=None)

    def leave_out(self, reason: str) -> None:
        """Count a scan that is left out."""
        counts = self.snapshot.left_out
        self._change(left_out={**counts, reason: counts.get(reason, 0) + 1})

    def _change(self, **made: object) -> None:
        self.snapshot = replace(self.snapshot, **made)  # type: ignore[arg-type]

    def _feed(self, item: QueuedScan) -> Answer | None:
        if item.generation != self._producer_generation:
            self._producer = self._make()
            self._producer_generation, self._job = item.generation, None
            self._moved = self._moved[:0]
            self._change(fed_s=None, unmapped=0, is_settled=True, health=Health())
        fed_s = self.snapshot.fed_s
        if fed_s is not None and item.stamp_s <= fed_s:
            if item.stamp_s < fed_s or item.read().ranges.tobytes() != self._ranges:
                raise LeftOutError(NOT_NEWER)
            self.leave_out(SENT_AGAIN)
            # The answer is repeated.
            return Answer(self.snapshot.pose, is_new=False)
        scan = item.read()
        within, odometry = self._deskewer.follow(scan, item.odometry)
        if odometry is None and self._wants_odometry:
            self._change(without_odometry=self.snapshot.without_odometry + 1)
            if fed_s is None:
                raise LeftOutError(BEFORE_ODOMETRY)
        try:
            step = self._producer.feed(self._deskewer.moved(scan, within), odometry)
        except SlamFusionError as error:
            self._change(problem=f"{NOT_FED}: {error}")
            raise LeftOutError(NOT_FED) from error
        self._ranges = scan.ranges.tobytes()
        before = self.snapshot
        latency_s = self._clock() - item.arrived_s
        self._change(
            fed=before.fed + 1,
            fed_s=item.stamp_s,
            pose=step.pose_map_base,
            unmapped=before.unmapped + 1,
            health=copy.deepcopy(self._producer.health),
            deskewing=replace(self._deskewer.done),
            latencies_s=(*before.latencies_s[1 - LATENCIES :], latency_s),
        )
        if odometry is not None:
            row = (item.stamp_s, *row_of(step.pose_map_base), *row_of(odometry))
            self._moved = np.vstack((self._moved[1 - MOTIONS :], row))
        unused = "" if step.used else f"scans are not used: {step.reason}"
        return Answer(step.pose_map_base, odometry, unused=unused)

    def is_map_due(self, interval_s: float) -> bool:
        """Whether the last map was read long enough ago, also for what it took."""
        took_s = self.snapshot.map_time_s + (self.drawn.time_s or 0.0)
        since_s = self._clock() - self.snapshot.map_at_s
        return since_s >= max(interval_s, took_s / MAP_SHARE)

    def read_map(self, *, is_path_heard: bool, is_paused: bool) -> UndrawnMap | None:
        """Read the map and the path; None if there is no map or nothing new in it."""
        begun_s = self._clock()
        self._change(map_at_s=begun_s)
        before = self.snapshot
        if before.fed_s is None:
            return None
        try:
            grid, is_old = self._grid(is_paused=is_paused)
        except SlamFusionError:  # no scan has been used yet
            return None
        if is_old and not before.unmapped and not (before.is_path_due and is_path_heard):
            return None
        trajectory, producer = None, self._producer
        if is_path_heard and isinstance(grid, MapJob) and isinstance(producer, DrawsAside):
            trajectory = producer.trajectory(grid)  # the map's own path
        elif is_path_heard:
            trajectory = producer.trajectory()
        self._change(
            unmapped=0,
            is_path_due=trajectory is None,
            memory_bytes=producer.memory_bytes(),
            map_time_s=self._clock() - begun_s,
            contradictions=self._contradictions(),
        )
        return UndrawnMap(grid, trajectory, before.fed_s, self._producer_generation)

    def _contradictions(self) -> tuple[str, ...]:
        """Say how the last poses contradict the odometry."""
        if len(self._moved) < 2:
            return ()
        rows = self._moved
        path, odometry = (Trajectory(rows[:, 0], rows[:, at : at + 3]) for at in (1, 4))
        return tuple(contradictions(odometry, path))

    def _grid(self, *, is_paused: bool) -> tuple[OccupancyGrid | MapJob, bool]:
        """Return the map or its job, and whether it is known to be unchanged."""
        producer = self._producer
        if not isinstance(producer, DrawsAside):
            return producer.grid(), False
        self._change(is_settled=is_paused)
        before, job = self._job, producer.map_job(is_settled=is_paused)
        self._job = job
        return job, before is not None and np.array_equal(before.poses, job.poses)

    # -- in the worker of maps --------------------------------------------------------------------

    def draw(self, item: UndrawnMap) -> OccupancyGrid:
        """Return the map; one that is drawn aside updates the last one of its generation."""
        grid, time_s = item.grid, self.drawn.time_s
        if isinstance(grid, MapJob):
            begun_s = self._clock()
            if self._drawer is None or self._drawer[0] != item.generation:
                producer = self._producer  # of any generation: the settings are the same
                assert isinstance(producer, DrawsAside)  # noqa: S101  (else there is no job)
                assert self._drawing is not None  # noqa: S101  (opened for one that draws aside)
                self._drawer = item.generation, producer.map_drawer(self._drawing)
            grid = self._drawer[1](grid)
            time_s = self._clock() - begun_s
        self.drawn = Drawn(self.drawn.maps, (grid.width, grid.height), time_s)
        return grid

    def count_map(self) -> None:
        """Count a published map."""
        self.drawn = replace(self.drawn, maps=self.drawn.maps + 1)


def _warm_up(make: Callable[[ComputeDevice], Mapper], device: ComputeDevice) -> None:
    """Let a producer compile and run its kernels, on scans of a square room of 6 m.

    On a device of its own: PoCL's compiler keeps 80 MB until that is closed.
    """
    trial = make(device)
    angles = np.linspace(-np.pi, np.pi, WARM_UP_BEAMS, endpoint=False)
    ranges = (3.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))).astype(np.float32)
    for index in range(3):
        scan = LaserScan(0.1 * index, ranges, -np.pi, 2.0 * np.pi / WARM_UP_BEAMS, 0.1, 20.0)
        trial.feed(scan, Pose2(0.3 * index, 0.0, 0.0))
    if isinstance(trial, DrawsAside):
        trial.map_drawer(device)(trial.map_job())
    else:
        trial.grid()
