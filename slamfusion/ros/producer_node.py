"""``ProducerNode``: a SLAM as a ROS node; scans and odometry in, map, pose and path out.

Callbacks only queue. One worker feeds the SLAM; another converts maps to messages, and draws them
if the SLAM allows it (``DrawsAside``), so that maps delay scans as little as possible.
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import MapMetaData, OccupancyGrid, Path
from sensor_msgs.msg import LaserScan

from slamfusion.config import DeviceConfig, LogConfig, ProducerNodeConfig, RunConfig
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase, Status, Worker
from slamfusion.ros.frames import TransformOutput
from slamfusion.ros.parameters import declare
from slamfusion.ros.scan_input import SCAN_TOPIC, ArrivedScan, ScanInput
from slamfusion.slam.registry import producer, settings_of
from slamfusion.slam.session import NOT_NEWER, Answer, ProducerSession, QueuedScan, UndrawnMap

# After this long with scans but without a transform, the lack is reported, seconds.
NEVER_SENT_S = 5.0
# Fields of ``ProducerNodeConfig`` that may be changed while the node runs.
CHANGEABLE = (
    "odometry_wait_s",
    "scan_queue",
    "map_update_interval_s",
    "publish_tf",
    "scans_stale_s",
    "reset_back_s",
)
# Period of checks for a due map without scans.
LOOK_S = 0.1
# A longer pause of the scans is used to solve all closures for the map.
PAUSE_S = 1.0
# A scan that takes longer is reported.
SLOW_SCAN_S = 5.0


class ProducerNode(NodeBase):
    """A SLAM that maps live scans; its topics and parameters: ``slamfusion.ros.interface``.

    Scans wait in a queue of ``scan_queue``; when it is full the oldest is dropped and counted. A
    scan waits up to ``odometry_wait_s`` for odometry at its own time, interpolated, and is then
    matched without. Scans before the first odometry are left out. Jumps of time: ``ScanInput``.

    Args:
        kind: a producer of ``slamfusion.slam.registry``; also the node's name unless remapped, so
            two of one kind can run at once.

    Raises:
        ConfigError: a parameter is refused.
        DeviceError: the device cannot be used.
    """

    def __init__(self, kind: str, *, context: Any = None, arguments: Any = None) -> None:
        super().__init__(kind, context=context, arguments=arguments)
        node = self.node
        self.settings = declare(
            node, ProducerNodeConfig(), changeable=CHANGEABLE, on_change=self._on_settings
        )
        section = declare(node, settings_of(RunConfig(), kind), kind)
        device = declare(node, DeviceConfig())
        self._config = RunConfig(
            producers={kind: section},
            device=device,
            seed=self.settings.seed,
            log=LogConfig(deskew=self.settings.deskew, sweep_s=self.settings.sweep_s),
        )
        self._own_interval_s = producer(kind).map_interval_s(section)
        own_frame = f"{node.get_namespace()}/{self.name}_map".strip("/")
        self._map_frame = self.settings.map_frame or own_frame
        self._session = ProducerSession(
            kind,
            self._config,
            partial(self.open_device, device.device),
            wants_odometry=self.settings.odometry_source in {"tf", "topic"},
        )
        name = self.name
        self._map_topic = node.create_publisher(OccupancyGrid, f"{name}/map", qos.MAP)
        self._metadata_topic = node.create_publisher(MapMetaData, f"{name}/map_metadata", qos.MAP)
        self._path_topic = node.create_publisher(Path, f"{name}/path", qos.MAP)
        self._pose_topic = node.create_publisher(PoseStamped, f"{name}/pose", qos.POSE)
        self._messages: Worker[UndrawnMap] = Worker(
            self._publish_map, 1, self.failed, f"{name} maps"
        )
        # A scan and its stamp as sent; None: a map is due.
        self._worker: Worker[tuple[QueuedScan, Any] | None] = Worker(
            self._work, self.settings.scan_queue, self.failed, f"{name} scans"
        )
        self._inputs = ScanInput(self, self.settings, self._queue, self._begin_new_map)
        self._transforms: TransformOutput | None = None
        # Whether the transform was sent since the last check.
        self._has_sent_transform = False
        self._on_settings(self.settings)
        self.timer(LOOK_S, self._look)
        self.log.info(
            f"{kind} on {self._session.device.name}, seed {self._config.seed}; map on "
            f"{node.resolve_topic_name(f'{name}/map')!r} in frame {self._map_frame!r}"
        )

    # --- callbacks, in the executor's thread -------------------------------------------------

    def _queue(self, scan: ArrivedScan) -> list[object]:
        """Queue a scan for the worker, which converts it; return what is dropped: the oldest."""
        session, inputs = self._session, self._inputs
        queued = QueuedScan(
            scan.stamp_s,
            scan.arrived_s,
            session.generation,
            lambda: inputs.read(scan),
            lambda times: inputs.odometry_at(scan, times, is_first=session.is_before_odometry),
        )
        dropped = self._worker.put((queued, scan.message.header.stamp))
        return [item for item in dropped if item is not None]

    def _begin_new_map(self) -> None:
        self._session.begin_new_map()
        self._inputs.dropped += sum(map(bool, self._worker.clear()))

    def _on_settings(self, settings: ProducerNodeConfig) -> None:
        self.settings = settings
        self._worker.capacity = settings.scan_queue
        self._inputs.configure(settings)
        if settings.publish_tf and self._transforms is None:
            self._transforms = TransformOutput(self.node)

    def on_time_jump(self, delta_s: float) -> None:
        """Forget transforms of later times; the scans decide about the map."""
        if delta_s < 0.0:
            self._inputs.forget_after(self.clock_s())

    def _look(self) -> None:
        """Request a map when scans pause, and the path for a new listener."""
        snapshot = self._session.snapshot
        wanted = (
            snapshot.unmapped
            or (snapshot.is_path_due and self._is_path_heard())
            or (self._is_paused and not snapshot.is_settled)
        )
        if self._worker.is_idle() and self._is_map_due() and wanted:
            self._worker.put(None)

    @property
    def _is_paused(self) -> bool:
        return time.monotonic() - self._inputs.last_s > PAUSE_S

    def _is_path_heard(self) -> bool:
        return bool(self._path_topic.get_subscription_count() > 0)

    def _is_map_due(self) -> bool:
        asked_s = self.settings.map_update_interval_s
        return self._session.is_map_due(self._own_interval_s if asked_s is None else asked_s)

    # --- the worker's thread -----------------------------------------------------------------

    def _work(self, item: tuple[QueuedScan, Any] | None) -> None:
        session = self._session
        if item is not None:
            answer = session.feed(item[0])
            if session.snapshot.problem:
                self.diagnostics.note("slam", session.snapshot.problem, Level.ERROR)
            if answer is not None:
                self._answer(answer, item[1])
        if item is None or (session.snapshot.unmapped and self._is_map_due()):
            made = session.read_map(is_path_heard=self._is_path_heard(), is_paused=self._is_paused)
            if made is not None:
                self._messages.put(made)

    def _answer(self, answer: Answer, stamp: Any) -> None:
        if answer.unused:
            self.diagnostics.note("blind", answer.unused)
        self._pose_topic.publish(messages.pose_to_message(answer.pose, self._map_frame, stamp))
        if not answer.is_new or self._transforms is None or not self.settings.publish_tf:
            return
        pose = answer.pose
        if self.settings.odometry_source != "none":
            if answer.odometry is None:
                return
            pose = pose.compose(answer.odometry.inverse())
        self._transforms.send(self._map_frame, (self._child_frame, pose, stamp))
        self._has_sent_transform = True

    @property
    def _child_frame(self) -> str:
        """The child frame of the sent transform: without odometry the robot's base."""
        settings = self.settings
        return settings.base_frame if settings.odometry_source == "none" else settings.odom_frame

    # --- the thread of messages --------------------------------------------------------------

    def _publish_map(self, item: UndrawnMap) -> None:
        grid = self._session.draw(item)
        stamp = messages.to_stamp(item.stamp_s)
        message = messages.grid_to_message(grid, self._map_frame, stamp)
        self._map_topic.publish(message)
        self._metadata_topic.publish(message.info)
        if item.trajectory is not None and len(item.trajectory):
            self._path_topic.publish(
                messages.path_to_bytes(item.trajectory, self._map_frame, stamp)
            )
        self._session.count_map()

    def statuses(self) -> list[Status]:
        """Return one line with the state of the SLAM and its figures."""
        self._name_silence()
        snapshot = self._session.snapshot
        self._inputs.look(snapshot.left_out.get(NOT_NEWER, 0))
        text = "; ".join(snapshot.contradictions)
        self.diagnostics.say("odometry against path", text or None)
        level, message = self.diagnostics.worst("mapping" if snapshot.fed else "waiting for scans")
        scans, odometry, drawn = self._inputs, self._inputs.odometry, self._session.drawn
        health, now_s = snapshot.health, time.monotonic()
        heard_s = None if odometry is None else odometry.last_s
        median_ms, high_ms = snapshot.latencies_ms()
        left_out = {"a stamp far from those before and after it": scans.strays, **snapshot.left_out}
        values = {
            "scans fed": snapshot.fed,
            "scans used": health.scans_used,
            "scans held for their stamps": scans.held,
            "scans without odometry": snapshot.without_odometry,
            "scans deskewed": snapshot.deskewing.scans,
            "scans not deskewed": snapshot.deskewing.without_motion,
            "sweep [ms]": 1e3 * snapshot.deskewing.sweep_s,
            "largest turn in a sweep [deg]": math.degrees(snapshot.deskewing.largest_turn_rad),
            "maps published": drawn.maps,
            "maps restarted": scans.jumps_back,
            "match score": health.match_score,
            "mean match score": health.mean_match_score,
            "low scores": health.low_scores,
            "effective particles": health.n_eff,
            "latency median [ms]": median_ms,
            "latency p95 [ms]": high_ms,
            "map [cells]": f"{drawn.shape[0]} x {drawn.shape[1]}",
            "reading the map [ms]": 1e3 * snapshot.map_time_s,
            "drawing the map [ms]": None if drawn.time_s is None else 1e3 * drawn.time_s,
            "memory [MB]": snapshot.memory_bytes / 1e6,
            "odometry with a stray stamp": None if odometry is None else odometry.strays,
            "last odometry [s ago]": None if heard_s is None else now_s - heard_s,
            **{f"left out: {key}": count for key, count in left_out.items() if count},
            **{f"not used: {key}": count for key, count in health.skips.counts.items()},
            "scans received": scans.received,
            "scans dropped": scans.dropped,
            "scans waiting": self._worker.waiting,
            "last scan [s ago]": now_s - scans.last_s if scans.received else None,
            "device": self._session.device.name,
        }
        return [Status("slam", level, message, values)]

    def _name_silence(self) -> None:
        """Report missing scans, a slow scan, and problems with /tf."""
        now_s = time.monotonic()
        since = "yet" if not self._inputs.received else "any more"
        who = self.senders(SCAN_TOPIC, LaserScan)
        # Without the time, so that the text stays the same.
        text = f"no scans on {self.resolved(SCAN_TOPIC)!r} {since}; {who}"
        is_silent = now_s - self._inputs.last_s > self.settings.scans_stale_s
        self.diagnostics.say("scans", text if is_silent else None, Level.STALE)
        snapshot = self._session.snapshot
        busy_s = snapshot.busy_since_s
        is_slow = busy_s is not None and now_s - busy_s > SLOW_SCAN_S
        text = "a scan has been worked on for over 5 s"
        self.diagnostics.say("busy", text if is_slow else None, Level.ERROR)
        is_due = self.settings.publish_tf and not is_silent and not self._has_sent_transform
        self._has_sent_transform = False
        # Why is said of the scans, or of their odometry.
        text = f"publish_tf is on and {self._map_frame!r} -> {self._child_frame!r} cannot be sent"
        words = text if is_due else None
        self.diagnostics.say("unsent", words, Level.ERROR, after_s=NEVER_SENT_S)
        rival = "" if self._transforms is None else self._transforms.rival()[1]
        text = f"{rival}: set publish_tf to false in all but one"
        self.diagnostics.say("rival", text if rival else None, Level.ERROR)

    def close(self) -> None:
        """End the threads after the current scan."""
        self._worker.close()
        self._messages.close()
