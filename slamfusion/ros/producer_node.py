"""``ProducerNode``: a SLAM as a ROS node; scans and odometry in, map, pose and path out.

The callbacks only queue. One worker feeds the SLAM, another one turns maps into messages, so a
map of many cells does not hold up the next scan for longer than it takes to read the map; where the
SLAM lets its map be drawn aside (``DrawsAside``) that worker draws it, and no scan waits at all.
"""

from __future__ import annotations

import dataclasses
import threading
import time
import traceback
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry, Path
from sensor_msgs.msg import LaserScan

from slamfusion import grid as grids
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import DeviceConfig, ProducerNodeConfig, RunConfig
from slamfusion.errors import ScanError, SlamFusionError, TrajectoryError
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io.log import FARTHEST_M, Skips
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase, Status
from slamfusion.ros.frames import (
    Mount,
    TransformError,
    TransformInput,
    TransformStore,
)
from slamfusion.ros.map_transform import MapTransform
from slamfusion.ros.parameters import declare
from slamfusion.ros.scan_gate import ODOMETRY_ALIVE_S, ArrivedScan, ScanGate
from slamfusion.ros.worker import Worker
from slamfusion.scan import LaserScan as Scan
from slamfusion.slam import registry
from slamfusion.slam.common.mapper import DrawsAside, MapDrawer, MapJob, Mapper, Step
from slamfusion.slam.registry import make_producer, settings_of
from slamfusion.trajectory import Trajectory

__all__ = ["ProducerNode", "make_node"]

SCAN_TOPIC, ODOM_TOPIC = "scan", "odom"
# Fields of ``ProducerNodeConfig`` that may be changed while the node runs.
CHANGEABLE = (
    "odometry_wait_s",
    "scan_queue",
    "map_update_interval_s",
    "path_poses",
    "publish_tf",
    "scans_stale_s",
    "reset_back_s",
)
# How often the node looks whether a map is due although no scan comes.
LOOK_S = 0.1
# Scans that pause for longer leave the time to solve all closures for the map.
PAUSE_S = 1.0
# A scan that is worked on for longer is named.
SLOW_SCAN_S = 5.0
# Words on what has passed stay in the diagnostics this long.
SHOWN_S = 10.0
LATENCIES = 300
WARM_UP_BEAMS = 360

STRAY = "a stamp far from those before and after it"
NO_ODOMETRY_YET = "laser before odometry"
NO_LASER_FRAME = "no transform from the laser"
NOT_NEWER = "stamp not later than the last one's"
NO_SCAN = "angles or ranges that cannot be a scan"
NOT_FED = "the SLAM failed"


def make_node(kind: str, **options: Any) -> NodeBase:
    """Return the node of a producer; see ``ProducerNode``."""
    return ProducerNode(kind, **options)


@dataclass(frozen=True, eq=False)
class _Queued(ArrivedScan):
    """A scan that waits."""

    generation: int


class _MapDue:
    """Asks the worker for a map."""


@dataclass(frozen=True, eq=False)
class _Map:
    """A map on its way out, drawn or to be drawn."""

    grid: grids.OccupancyGrid | MapJob
    trajectory: Trajectory | None
    stamp_s: float
    generation: int


@dataclass
class _Counts:
    """What happened so far."""

    received: int = 0
    fed: int = 0
    dropped: int = 0
    without_odometry: int = 0
    maps: int = 0


class ProducerNode(NodeBase):
    """A SLAM that maps live scans.

    Topics, all relative: reads ``scan`` and ``odom`` (or transforms); writes ``NAME/map``,
    ``NAME/map_metadata``, ``NAME/pose`` (PoseStamped, one for every scan that was fed, with its
    stamp), ``NAME/path`` and ``/diagnostics``. NAME is the node's name, so two nodes of one kind
    can run side by side; the map's frame is NAME_map.

    Scans wait in a queue of ``scan_queue``; when one more comes the oldest is dropped and counted.
    A scan is matched with the odometry of its own time, interpolated; it waits for that up to
    ``odometry_wait_s`` and then goes on without. Scans before the first odometry are left out.
    Time that jumps back by more than ``reset_back_s`` begins a new map, when several scans in a row
    say so and the odometry does not contradict; far forward it is named. A single scan whose stamp
    is far from the others is left out.

    Args:
        kind: a producer of ``slamfusion.slam.common.runner``; also the node's name unless remapped.
        context: rclpy's; default: the one of ``rclpy.init``.
        arguments: ROS arguments of this node alone.

    Raises:
        ConfigError: a parameter is refused.
        DeviceError: the device cannot be used.
    """

    def __init__(self, kind: str, *, context: Any = None, arguments: Any = None) -> None:
        super().__init__(kind, context=context, arguments=arguments)
        node = self.node
        self.settings = declare(
            node, ProducerNodeConfig, changeable=CHANGEABLE, on_change=self._on_settings
        )
        section = declare(node, settings_of(RunConfig(), kind), kind)
        device = declare(node, DeviceConfig)
        self._config = dataclasses.replace(
            RunConfig(), producers={kind: section}, device=device, seed=self.settings.seed
        )
        self._kind = kind
        self._map_frame = self.settings.map_frame or f"{self.name}_map"
        self._device = open_device(device.device)
        # Drawing aside has a backend of its own: a device's queue is one thread's.
        self._drawing: ComputeDevice | None = None
        if isinstance(make_producer(kind, self._config, self._device), DrawsAside):
            self._drawing = open_device(device.device)
        self._producer = _warm(kind, self._config, self._device, self._drawing)

        # Shared between the executor's thread and the workers'; each counter has one writer.
        self._counts = _Counts()
        self._skips = Skips()
        self._lock = threading.Lock()
        self._generation = 0
        self._producer_generation = 0
        self._last_scan_s = self._started_s = time.monotonic()
        self._fed_s: float | None = None
        self._last_pose = IDENTITY
        self._busy_since_s: float | None = None
        self._map_at_s = -1e9
        self._map_time_s = self._draw_time_s = 0.0
        self._job: MapJob | None = None
        self._is_settled = True
        self._drawer: tuple[int, MapDrawer] | None = None
        self._map_shape = (0, 0)
        self._unmapped = 0
        self._is_path_due = False
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)
        self._memory_bytes = 0

        name = self.name
        self._map_topic = self.publisher(OccupancyGrid, f"{name}/map", qos.MAP)
        self._metadata_topic = self.publisher(MapMetaData, f"{name}/map_metadata", qos.MAP)
        self._path_topic = self.publisher(Path, f"{name}/path", qos.MAP)
        self._pose_topic = self.publisher(PoseStamped, f"{name}/pose", qos.POSE)
        self._messages: Worker[_Map] = Worker(self._publish_map, 1, self._failed, f"{name} maps")
        self._worker: Worker[_Queued | _MapDue] = Worker(
            self._work, self.settings.scan_queue, self._failed, f"{name} scans"
        )
        self._transforms: TransformStore | None = None
        self._odometry: TransformStore | None = None
        self._make_inputs()
        self.timer(LOOK_S, self._look)
        self.log.info(
            f"{kind} on {self._device.name}, seed {self._config.seed}; map on "
            f"{node.resolve_topic_name(f'{name}/map')!r} in frame {self._map_frame!r}"
        )

    def _make_inputs(self) -> None:
        """Subscribe to what the settings ask for."""
        settings = self.settings
        if "tf" in {settings.odometry_source, settings.laser_source}:
            self._transforms = TransformInput(self.node)
        if settings.odometry_source == "tf":
            self._odometry = self._transforms
        elif settings.odometry_source == "topic":
            self._odometry = TransformStore()
            self.subscribe(Odometry, ODOM_TOPIC, self._on_odometry, qos.SENSOR)
        self._transform = MapTransform(self, settings, self._map_frame)
        stores = {store for store in (self._transforms, self._odometry) if store is not None}
        frames = settings.odom_frame, settings.base_frame
        self._gate = ScanGate(
            self.diagnostics, settings.reset_back_s, self._odometry, frames, stores
        )
        self.subscribe(LaserScan, SCAN_TOPIC, self._on_scan, qos.SENSOR)

    # --- callbacks, in the executor's thread -------------------------------------------------

    def _on_scan(self, message: Any) -> None:
        """Queue a scan, and those that were held back and that it confirms."""
        self._counts.received += 1
        self._last_scan_s = time.monotonic()
        passed = self._gate.offer(message)
        for _ in passed.strays:
            self._skip(STRAY)
        if passed.jump is not None and passed.jump.is_back:
            self._begin_new_map()
        for scan in passed.items:
            self._queue(_Queued(scan.message, scan.stamp_s, scan.arrived_s, self._generation))

    def _queue(self, item: _Queued) -> None:
        """Let a scan wait for the worker; the oldest goes where that are too many."""
        lost = self._worker.put(item)
        dropped = sum(isinstance(item, _Queued) for item in lost)
        if dropped:
            self._counts.dropped += dropped
            text = (
                f"too slow for the scans: the oldest of {self.settings.scan_queue} that wait is "
                "dropped for each new one; take a faster device or fewer scans"
            )
            self.diagnostics.add("slow", Level.WARN, text, SHOWN_S)

    def _begin_new_map(self) -> None:
        """Leave the old map behind: time has jumped back."""
        self._generation += 1
        waiting = sum(isinstance(item, _Queued) for item in self._worker.clear())
        self._counts.dropped += waiting

    def _on_odometry(self, message: Any) -> None:
        """Keep a pose of the odometry."""
        store = self._odometry
        assert store is not None  # noqa: S101  (made before the subscription)
        try:
            pose = messages.pose2_from_message(message.pose.pose)
        except TrajectoryError as error:
            self.diagnostics.add(
                "odometry values", Level.WARN, f"odometry left out: {error}", SHOWN_S
            )
            return
        if max(abs(pose.x), abs(pose.y)) > FARTHEST_M:
            text = f"odometry left out: ({pose.x:g}, {pose.y:g}) m is nowhere near"
            self.diagnostics.add("odometry values", Level.WARN, text, SHOWN_S)
            return
        child = message.child_frame_id.lstrip("/")
        if child and child != self.settings.base_frame:
            text = (
                f"odometry is that of {child!r}, not of base_frame {self.settings.base_frame!r}; "
                "it is taken for the same"
            )
            self.diagnostics.add("odometry frame", Level.WARN, text, SHOWN_S)
        settings = self.settings
        stamp = message.header.stamp
        store.add(
            [messages.transform_to_message(pose, settings.odom_frame, settings.base_frame, stamp)]
        )

    def _on_settings(self, settings: ProducerNodeConfig) -> None:
        """Take changed settings."""
        self.settings = settings
        self._worker.resize(settings.scan_queue)
        self._gate.set_back(settings.reset_back_s)
        self._transform.configure(settings)

    def on_time_jump(self, delta_s: float) -> None:
        """Forget the transforms of a future that has not come; scans decide about the map."""
        if delta_s >= 0.0:
            return
        for store in (self._transforms, self._odometry):
            if store is not None:
                store.forget_after(self.clock_s())

    def _look(self) -> None:
        """Ask for a map where scans pause, and for the path where somebody begins to listen."""
        is_due = time.monotonic() - self._map_at_s >= self._map_interval_s()
        wanted = (
            self._unmapped or self._is_path_wanted() or (self._is_paused and not self._is_settled)
        )
        if self._worker.is_idle and is_due and wanted:
            self._worker.put(_MapDue())

    @property
    def _is_paused(self) -> bool:
        """Whether no scan has come for a while."""
        return time.monotonic() - self._last_scan_s > PAUSE_S

    def _is_path_wanted(self) -> bool:
        return self._is_path_due and self._path_topic.get_subscription_count() > 0

    def _map_interval_s(self) -> float:
        asked_s = self.settings.map_update_interval_s
        if asked_s is not None:
            return asked_s
        return registry.producer(self._kind).map_interval_s(settings_of(self._config, self._kind))

    # --- the worker's thread -----------------------------------------------------------------

    def _work(self, item: _Queued | _MapDue) -> None:
        """Feed a scan, or take a map."""
        if isinstance(item, _Queued) and item.generation == self._generation:
            self._busy_since_s = time.monotonic()
            try:
                self._feed(item)
            finally:
                self._busy_since_s = None
        is_due = time.monotonic() - self._map_at_s >= self._map_interval_s()
        if isinstance(item, _MapDue) or (self._unmapped and is_due):
            self._take_map()

    def _feed(self, item: _Queued) -> None:
        """Find a scan's odometry and mount, feed it, and tell the pose."""
        if item.generation != self._producer_generation:
            self._producer = make_producer(self._kind, self._config, self._device)
            self._producer_generation = item.generation
            self._fed_s, self._unmapped, self._job, self._is_settled = None, 0, None, True
        if self._fed_s is not None and item.stamp_s <= self._fed_s:
            self._skip(NOT_NEWER)
            if item.stamp_s == self._fed_s:  # sent again: who waits for the answer gets it again
                self._publish_pose(self._last_pose, item.message.header.stamp)
            return
        mount = self._mount(item)
        if mount is None:
            return
        try:
            scan = messages.scan_from_message(item.message, mount.pose, is_flipped=mount.is_flipped)
        except ScanError as error:
            self._skip(NO_SCAN)
            self.diagnostics.add("scan", Level.WARN, str(error), SHOWN_S)
            return
        odometry = self._odometry_at(item)
        if odometry is None and self._is_before_odometry():
            self._skip(NO_ODOMETRY_YET)
            return
        step = self._fed(scan, odometry)
        if step is None:
            return
        self._fed_s, self._last_pose = item.stamp_s, step.pose_map_base
        self._counts.fed += 1
        self._unmapped += 1
        self._publish_pose(step.pose_map_base, item.message.header.stamp)
        self._transform.send(step.pose_map_base, odometry, item.message.header.stamp)
        self._latencies_s.append(time.monotonic() - item.arrived_s)

    def _fed(self, scan: Scan, odometry: Pose2 | None) -> Step | None:
        """Feed the SLAM; None where it fails."""
        try:
            step = self._producer.feed(scan, odometry)
        except SlamFusionError as error:
            self._skip(NOT_FED)
            self.diagnostics.add("slam", Level.ERROR, f"{NOT_FED}: {error}", SHOWN_S)
            return None
        if not step.used:
            text = f"scans are not used: {step.reason}"
            self.diagnostics.add("blind", Level.WARN, text, SHOWN_S)
        return step

    def _mount(self, item: _Queued) -> Mount | None:
        """Return where the laser sits at a scan, or None where that is not known."""
        settings = self.settings
        if settings.laser_source == "parameter":
            return Mount(Pose2(settings.laser_x, settings.laser_y, settings.laser_yaw))
        frame = item.message.header.frame_id.lstrip("/")
        if frame == settings.base_frame:
            return Mount()
        assert self._transforms is not None  # noqa: S101  (made for this source)
        try:
            mount = self._transforms.mount(
                settings.base_frame, frame, item.stamp_s, self._wait_s(item, self._transforms)
            )
        except TransformError as error:
            self._skip(NO_LASER_FRAME)
            text = (
                f"scans in {frame!r} cannot be used: {error}; send the transform, or set "
                "laser_source to parameter"
            )
            self.diagnostics.add("laser", Level.ERROR, text)
            return None
        self.diagnostics.clear("laser")
        return mount

    def _odometry_at(self, item: _Queued) -> Pose2 | None:
        """Return the odometry at a scan's time, or None where it has none."""
        store, settings = self._odometry, self.settings
        if store is None:
            return None
        try:
            pose = store.lookup(
                settings.odom_frame, settings.base_frame, item.stamp_s, self._wait_s(item, store)
            )
        except TransformError as error:
            self._counts.without_odometry += 1
            does = "are left out" if self._is_before_odometry() else "are matched without it"
            text = (
                f"no odometry for the scans, which {does}: {error}; check {self._odometry_words()}"
                ", or set odometry_source to none"
            )
            self.diagnostics.add("odometry", Level.WARN, text)
            return None
        self.diagnostics.clear("odometry")
        return pose

    def _odometry_words(self) -> str:
        if self.settings.odometry_source == "tf":
            return (
                f"the transforms from {self.settings.base_frame!r} to {self.settings.odom_frame!r}"
            )
        return f"the topic {self.node.resolve_topic_name(ODOM_TOPIC)!r}"

    def _is_before_odometry(self) -> bool:
        """Whether odometry is wanted and the map has not begun with it."""
        return self._odometry is not None and self._fed_s is None

    def _wait_s(self, item: _Queued, store: TransformStore) -> float:
        """Return how long a scan may still wait for what a store is to get."""
        now_s = time.monotonic()
        if store.last_s is not None and now_s - store.last_s > ODOMETRY_ALIVE_S:
            return 0.0
        return max(0.0, item.arrived_s + self.settings.odometry_wait_s - now_s)

    def _skip(self, reason: str) -> None:
        """Count a scan that is left out."""
        with self._lock:
            self._skips.add(reason, self._counts.fed + self._skips.total + 1)

    def _publish_pose(self, pose: Pose2, stamp: Any) -> None:
        self._pose_topic.publish(messages.pose_to_message(pose, self._map_frame, stamp))

    def _take_map(self) -> None:
        """Read the map and the path from the SLAM and hand them on."""
        begun_s = self._map_at_s = time.monotonic()
        if self._fed_s is None:
            return
        try:
            grid, is_old = self._read_map()
        except SlamFusionError:  # no scan has been used yet
            return
        if is_old and not self._unmapped and not self._is_path_wanted():
            return
        self._unmapped = 0
        has_listeners = self._path_topic.get_subscription_count() > 0
        trajectory = self._producer.trajectory() if has_listeners else None
        self._is_path_due = trajectory is None
        self._memory_bytes = self._producer.memory_bytes()
        self._map_time_s = time.monotonic() - begun_s
        self._messages.put(_Map(grid, trajectory, self._fed_s, self._producer_generation))

    def _read_map(self) -> tuple[grids.OccupancyGrid | MapJob, bool]:
        """Return the map, or what it is drawn from, and whether that is known to be as before.

        Raises:
            SlamFusionError: no scan has been used yet.
        """
        producer = self._producer
        if not isinstance(producer, DrawsAside):
            return producer.grid(), False
        self._is_settled = self._is_paused
        before, job = self._job, producer.map_job(is_settled=self._is_settled)
        self._job = job
        return job, before is not None and np.array_equal(before.poses, job.poses)

    def _failed(self, _: Any, error: Exception) -> None:
        """Name what a worker stumbled over."""
        if not self.diagnostics.is_on("worker"):
            self.log.error("".join(traceback.format_exception(error)))
        text = f"{type(error).__name__}: {error}"
        self.diagnostics.add("worker", Level.ERROR, text, SHOWN_S)

    # --- the thread of messages --------------------------------------------------------------

    def _publish_map(self, item: _Map) -> None:
        grid = item.grid
        if isinstance(grid, MapJob):
            grid = self._draw(grid, item.generation)
        stamp = messages.to_stamp(item.stamp_s)
        message = messages.grid_to_message(grid, self._map_frame, stamp)
        self._map_topic.publish(message)
        self._metadata_topic.publish(message.info)
        if item.trajectory is not None and len(item.trajectory):
            self._path_topic.publish(
                messages.path_to_message(
                    item.trajectory, self._map_frame, stamp, self.settings.path_poses
                )
            )
        self._map_shape = (grid.width, grid.height)
        self._counts.maps += 1

    def _draw(self, job: MapJob, generation: int) -> grids.OccupancyGrid:
        """Draw a map aside, on the last one of its generation."""
        begun_s = time.monotonic()
        if self._drawer is None or self._drawer[0] != generation:
            producer = self._producer
            assert isinstance(producer, DrawsAside)  # noqa: S101  (else there is no job)
            assert self._drawing is not None  # noqa: S101  (opened for a producer that draws aside)
            self._drawer = generation, producer.map_drawer(self._drawing)
        grid = self._drawer[1].draw(job)
        self._draw_time_s = time.monotonic() - begun_s
        return grid

    # --- diagnostics -------------------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return one line: how the SLAM is, what is wrong, and its figures."""
        self._name_silence()
        self._gate.name_odometry()
        health = self._producer.health
        counts = self._counts
        level, message = self.diagnostics.worst("mapping" if counts.fed else "waiting for scans")
        latency_ms = 1e3 * np.percentile([*self._latencies_s] or [0.0], (50.0, 95.0))
        odometry, now_s = self._odometry, time.monotonic()
        values = {
            "scans received": counts.received,
            "scans fed": counts.fed,
            "scans used": health.scans_used,
            "scans dropped": counts.dropped,
            "scans waiting": self._worker.waiting,
            "scans held for their stamps": self._gate.held,
            "scans without odometry": counts.without_odometry,
            "maps published": counts.maps,
            "maps begun anew": self._gate.jumps_back,
            "match score": health.match_score,
            "mean match score": health.mean_match_score,
            "low scores": health.low_scores,
            "effective particles": health.n_eff,
            "latency median [ms]": float(latency_ms[0]),
            "latency p95 [ms]": float(latency_ms[1]),
            "map [cells]": f"{self._map_shape[0]} x {self._map_shape[1]}",
            "reading the map [ms]": 1e3 * self._map_time_s,
            "drawing the map [ms]": None if self._drawing is None else 1e3 * self._draw_time_s,
            "memory [MB]": self._memory_bytes / 1e6,
            "last scan [s ago]": now_s - self._last_scan_s if counts.received else None,
            "odometry with a stray stamp": None if odometry is None else odometry.strays,
            "last odometry [s ago]": None
            if odometry is None or odometry.last_s is None
            else now_s - odometry.last_s,
            "device": self._device.name,
        }
        with self._lock:
            values |= {f"left out: {key}": count for key, count in self._skips.counts.items()}
        values |= {f"not used: {key}": n for key, n in dict(health.skips.counts).items()}
        return [Status("slam", level, message, values)]

    def _name_silence(self) -> None:
        """Name scans that do not come, a scan that takes too long, and what is wrong with /tf."""
        now_s = time.monotonic()
        silent_s = now_s - self._last_scan_s
        if silent_s > self.settings.scans_stale_s:
            topic = self.node.resolve_topic_name(SCAN_TOPIC)
            writers = self.node.count_publishers(SCAN_TOPIC)
            who = f"{writers} node(s) could send them" if writers else "nobody sends them"
            since = "yet" if not self._counts.received else "any more"
            # Without the time, which would be news each second.
            self.diagnostics.add("scans", Level.STALE, f"no scans on {topic!r} {since}; {who}")
        else:
            self.diagnostics.clear("scans")
        busy_s = self._busy_since_s
        if busy_s is not None and now_s - busy_s > SLOW_SCAN_S:
            self.diagnostics.add("busy", Level.ERROR, "a scan has been worked on for over 5 s")
        else:
            self.diagnostics.clear("busy")
        self._transform.name(are_scans_coming=silent_s <= self.settings.scans_stale_s)

    def close(self) -> None:
        """End the threads; the scan that is being fed is fed to its end."""
        self._worker.close()
        self._messages.close()


def _warm(
    kind: str, config: RunConfig, device: ComputeDevice, drawing: ComputeDevice | None
) -> Mapper:
    """Return a fresh producer, after another one has had its kernels compiled and run."""
    angles = np.linspace(-np.pi, np.pi, WARM_UP_BEAMS, endpoint=False)
    # A square room of 6 m.
    ranges = (3.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))).astype(np.float32)
    trial = make_producer(kind, config, device)
    for index in range(3):
        scan = Scan(0.1 * index, ranges, -np.pi, 2.0 * np.pi / WARM_UP_BEAMS, 0.1, 20.0)
        trial.feed(scan, Pose2(0.3 * index, 0.0, 0.0))
    if isinstance(trial, DrawsAside) and drawing is not None:
        trial.map_drawer(drawing).draw(trial.map_job())
    else:
        trial.grid()
    return make_producer(kind, config, device)
