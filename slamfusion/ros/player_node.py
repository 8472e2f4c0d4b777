"""``PlayerNode``: a log or bag as live topics, in its own time, faster, or in lockstep."""

from __future__ import annotations

import math
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from slamfusion.config import LogConfig, PlayerNodeConfig
from slamfusion.errors import ConfigError, LogError, SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan, ScanLog
from slamfusion.io.logs import open_log
from slamfusion.io.map_server import save_map
from slamfusion.io.stamps import AHEAD_S, CONFIRMING
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase, Status
from slamfusion.ros.frames import TransformOutput
from slamfusion.ros.parameters import declare, declare_names

__all__ = ["PlayerNode", "make_node"]

SCAN_TOPIC, ODOM_TOPIC, CLOCK_TOPIC = "scan", "odom", "/clock"
# Between two scans the clock goes on in steps of this real time.
CLOCK_STEP_S = 0.02
# A scan that is not answered is sent again after this long: best-effort readers may lose one.
AGAIN_S = 1.0
# After a jump of the log's time producers wait for a scan to be sent again, and are not made to
# wait long for that.
AGAIN_AT_JUMP_S = 0.1
# Writers are known a moment before their readers hear them.
SETTLE_S = 0.3
ACKNOWLEDGE_S = 5.0
# Maps that are saved when the player is stopped may take this long.
SAVE_AT_END_S = 8.0
STAMP_TOLERANCE_S = 1e-6
# A pause in a log that is longer is not waited for.
LONGEST_PAUSE_S = 3600.0


def make_node(_: str, **options: Any) -> NodeBase:
    """Return a player; see ``PlayerNode``."""
    return PlayerNode(**options)


class PlayerNode(NodeBase):
    """Plays a log: ``scan``, ``odom``, transforms and ``/clock``, all with the log's stamps.

    The first scan is sent again each second until every producer of ``wait_for`` has told its pose
    at it on ``NAME/pose``: a reader that is known may not hear yet. With ``lockstep`` so is every
    scan. The node ends after the last scan; with ``save`` it writes the newest maps first, and also
    when it is stopped before.

    Args:
        context: rclpy's; default: the one of ``rclpy.init``.
        arguments: ROS arguments of this node alone.

    Raises:
        ConfigError: a parameter is refused, or no file is named.
        LogError: the log cannot be read.
        OSError: the same, by the system; or the folder of ``save`` cannot be written to.
    """

    def __init__(self, *, context: Any = None, arguments: Any = None) -> None:
        super().__init__("player", context=context, arguments=arguments)
        node = self.node
        self.settings = declare(node, PlayerNodeConfig, changeable=("rate",), on_change=self._take)
        reading = declare(node, LogConfig, "log")
        self.wait_for = declare_names(
            node,
            "wait_for",
            (),
            "producers that must answer the first scan, and in lockstep every one",
        )
        topics = [f"{name}/map" for name in self.wait_for]
        text = "map topics that are written to the folder `save` at the end of the log"
        self._map_topics = declare_names(node, "maps", topics, text)
        if self.settings.file is None:
            message = "player: name the log or bag with the parameter file: -p file:=PATH"
            raise ConfigError(message)
        if self.settings.lockstep and not self.wait_for:
            message = "player: lockstep needs to know whom to wait for: -p wait_for:=[NAME]"
            raise ConfigError(message)
        if self.settings.save is not None:
            _check_writable(Path(self.settings.save))
        self._log: ScanLog = open_log(self.settings.file, reading)
        self._scans = self.publisher(LaserScan, SCAN_TOPIC, qos.STREAM)
        self._odometry = self.publisher(Odometry, ODOM_TOPIC, qos.STREAM)
        self._clock = self.publisher(Clock, CLOCK_TOPIC, qos.STREAM)
        self._transforms = TransformOutput(node)
        self._mount: Pose2 | None = None
        self._sent = self._again = self._rounds = 0
        self._stamp_s: float | None = None
        self._due_s: float | None = None
        self._changed = threading.Condition()
        self._answers: dict[str, float] = {}
        for name in self.wait_for:
            self.subscribe(
                PoseStamped,
                f"{name}/pose",
                partial(self._on_pose, name),
                qos.STREAM,
            )
        self._maps: dict[str, Any] = {}
        for topic in self._map_topics if self.settings.save is not None else ():
            self.subscribe(OccupancyGrid, topic, partial(self._on_map, topic), qos.MAP)
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def _take(self, settings: PlayerNodeConfig) -> None:
        self.settings = settings

    def _on_pose(self, name: str, message: Any) -> None:
        """Note that a producer has told its pose at a stamp."""
        with self._changed:
            self._answers[name] = messages.stamp_s(message)
            self._changed.notify_all()

    def _on_map(self, topic: str, message: Any) -> None:
        """Keep the newest map of a topic."""
        with self._changed:
            self._maps[topic] = message
            self._changed.notify_all()

    # --- the player's thread -----------------------------------------------------------------

    def _run(self) -> None:
        """Play the log and end the node."""
        code = 1
        try:
            begun_s = time.monotonic()
            self._wait_for_listeners()
            self._play()
            if not self._is_closed:
                self._wait_for_delivery()
                self.log.info(self._words_at_end(time.monotonic() - begun_s))
            self._save_maps()
            code = 0
        except (SlamFusionError, OSError) as error:
            self.log.error(f"player: {error}")
        except Exception:  # noqa: BLE001  (a bug; named, and the process ends with 1)
            self.log.error(traceback.format_exc())
        finally:
            if not self._is_closed:
                self.stop(code)

    def _words_at_end(self, duration_s: float) -> str:
        skipped = "; ".join(self._log.skips.sentences())
        return (
            f"end of {self._log.path}: {self._sent} scans sent in {duration_s:.1f} s"
            + (f", {self._again} of them again" if self._again else "")
            + (f"; left out: {skipped}" if skipped else "")
        )

    def _wait_for_listeners(self) -> None:
        """Wait until everybody listens who should, or somebody does.

        Raises:
            SlamFusionError: a producer of ``wait_for`` does not come.
        """
        until_s = time.monotonic() + self.settings.start_timeout_s
        while not self._is_closed:
            absent = [
                name for name in self.wait_for if not self.node.count_publishers(f"{name}/pose")
            ]
            listeners = self._scans.get_subscription_count()
            if not absent and listeners >= max(1, len(self.wait_for)):
                self._pause(SETTLE_S)
                return
            if time.monotonic() > until_s:
                topic = self.node.resolve_topic_name(SCAN_TOPIC)
                if not self.wait_for:
                    self.log.warning(f"nobody listens on {topic!r}; playing all the same")
                    return
                who = ", ".join(absent) or f"only {listeners} node(s) listen on {topic!r}"
                message = (
                    f"waited {self.settings.start_timeout_s:g} s for {', '.join(self.wait_for)}; "
                    f"missing: {who}"
                )
                raise SlamFusionError(message)
            self._pause(0.05)

    def _play(self) -> None:
        """Send every scan at its time."""
        while not self._is_closed:
            self._rounds += 1
            sent = self._sent
            for item, wait_s in self._timed():
                if self._is_closed:
                    return
                if not self.settings.lockstep:
                    self._run_clock(item.scan.stamp_s, wait_s)
                before_s = self._stamp_s
                self._send(item)
                if self.settings.lockstep:
                    self._wait_for_answers(item, before_s)
                elif before_s is None and self.wait_for:
                    self._wait_for_first_answers(item)
            if self._sent == sent and not self._is_closed:
                skipped = "; ".join(self._log.skips.sentences())
                message = (
                    f"{self._log.path}: no scan in it could be used{skipped and ': '}{skipped}"
                )
                raise LogError(message)
            if not self.settings.loop:
                return

    def _timed(self) -> Iterator[tuple[LogScan, float]]:
        """Yield scans with the recorded time since the one before, seconds."""
        before_s: float | None = None
        for item in self._log:
            stamp_s = item.scan.stamp_s
            yield item, 0.0 if before_s is None else min(stamp_s - before_s, LONGEST_PAUSE_S)
            before_s = stamp_s
        self._due_s = None

    def _run_clock(self, stamp_s: float, since_s: float) -> None:
        """Wait until a scan is due, by the rate, and let the clock go on meanwhile."""
        now_s = time.monotonic()
        due_s, rate = self._due_s, self.settings.rate
        # A player that fell behind goes on from now; it never hurries.
        due_s = now_s if due_s is None else max(due_s + since_s / rate, now_s - AGAIN_S)
        while (left_s := due_s - time.monotonic()) > 0.0 and not self._is_closed:
            self._send_clock(stamp_s - left_s * rate)
            self._pause(min(left_s, CLOCK_STEP_S))
        self._due_s = due_s

    def _send(self, item: LogScan) -> None:
        """Send a scan with its time, transforms and odometry, the scan last."""
        settings, scan = self.settings, item.scan
        stamp = messages.to_stamp(scan.stamp_s)
        self._stamp_s = scan.stamp_s
        self._send_clock(scan.stamp_s)
        if scan.mount != self._mount:
            self._mount = scan.mount
            self._transforms.send_static(
                [
                    messages.transform_to_message(
                        scan.mount, settings.base_frame, settings.laser_frame, stamp
                    )
                ]
            )
        pose = item.odometry
        if pose is not None and settings.odometry in {"tf", "both"}:
            self._transforms.send(
                [
                    messages.transform_to_message(
                        pose, settings.odom_frame, settings.base_frame, stamp
                    )
                ]
            )
        if pose is not None and settings.odometry in {"topic", "both"}:
            self._odometry.publish(
                messages.odometry_to_message(pose, settings.odom_frame, settings.base_frame, stamp)
            )
        self._scans.publish(messages.scan_to_message(scan, settings.laser_frame))
        self._sent += 1

    def _send_clock(self, stamp_s: float) -> None:
        if self.settings.publish_clock:
            self._clock.publish(Clock(clock=messages.to_stamp(max(stamp_s, 0.0))))

    def _wait_for_first_answers(self, item: LogScan) -> None:
        """Wait until every producer has told its pose at the first scan; name one that has not."""
        try:
            self._wait_for_answers(item, None)
        except SlamFusionError as error:
            self.diagnostics.add("first", Level.WARN, f"playing all the same: {error}")
        self._due_s = time.monotonic()

    def _wait_for_answers(self, item: LogScan, before_s: float | None) -> None:
        """Wait until every producer has told its pose at a scan.

        Args:
            item: the scan, which was sent.
            before_s: stamp of the scan before it; None for the first.

        Raises:
            SlamFusionError: one has not, however often the scan was sent.
        """
        stamp_s = item.scan.stamp_s
        until_s = time.monotonic() + self.settings.lockstep_timeout_s
        is_jump = before_s is not None and not 0.0 < stamp_s - before_s <= AHEAD_S
        pauses_s = [AGAIN_AT_JUMP_S] * (CONFIRMING - 1) if is_jump else []
        again_s = time.monotonic() + (pauses_s.pop() if pauses_s else AGAIN_S)

        def missing() -> list[str]:
            return [
                name
                for name in self.wait_for
                if abs(self._answers.get(name, math.inf) - stamp_s) > STAMP_TOLERANCE_S
            ]

        while not self._is_closed:
            now_s = time.monotonic()
            with self._changed:
                if self._changed.wait_for(
                    lambda: self._is_closed or not missing(), min(again_s, until_s) - now_s
                ):
                    return
                silent = missing()
            now_s = time.monotonic()
            if now_s >= until_s:
                message = (
                    f"no pose at {stamp_s:.3f} s from {', '.join(silent)} within "
                    f"{self.settings.lockstep_timeout_s:g} s; the producer may have ended, or "
                    "leaves the scan out: see its diagnostics"
                )
                raise SlamFusionError(message)
            if now_s >= again_s:
                self._send(item)
                self._sent -= 1
                self._again += 1
                again_s = now_s + (pauses_s.pop() if pauses_s else AGAIN_S)

    def _wait_for_delivery(self) -> None:
        """Give reliable readers the time to take the last messages."""
        for publisher in (self._scans, self._odometry):
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_S))

    def _save_maps(self) -> None:
        """Write the newest map of every topic, as soon as they hold the last scan.

        When the player is stopped before, those that have come.

        Raises:
            SlamFusionError: no map came, or one is none or cannot be written.
        """
        if self.settings.save is None:
            return
        is_early = self._is_closed
        last_s = (self._stamp_s or 0.0) - STAMP_TOLERANCE_S

        def late() -> list[str]:
            maps = self._maps
            return [
                topic
                for topic in self._map_topics
                if topic not in maps or messages.stamp_s(maps[topic]) < last_s
            ]

        with self._changed:
            self._changed.wait_for(
                lambda: self._is_closed or not late(), self.settings.save_timeout_s
            )
            maps, missing = dict(self._maps), late()
        if is_early:
            ends = "the maps that have come are saved" if maps else "no map has come to be saved"
            self.log.warning(f"stopped after {self._sent} scans of {self._log.path}; {ends}")
            missing = []
        for topic in missing:
            what = "it is older than the last scan" if topic in maps else "no map came"
            self.log.warning(f"the map on {self.node.resolve_topic_name(topic)!r}: {what}")
        if not maps and not is_early:
            message = f"no map came on {', '.join(self._map_topics) or '(no topic)'}"
            raise SlamFusionError(message)
        folder = Path(self.settings.save)
        folder.mkdir(parents=True, exist_ok=True)
        for topic, message in maps.items():
            name = topic.strip("/").removesuffix("/map").replace("/", "_")
            path, _ = save_map(messages.grid_from_message(message, topic), folder / name)
            self.log.info(f"wrote {path}")

    def _pause(self, duration_s: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed, duration_s)

    # --- diagnostics and end -----------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return one line: how far the log is."""
        level, message = self.diagnostics.worst(
            "playing" if self._sent else "waiting for listeners"
        )
        if self._transforms.rivals():
            child, parent = next(iter(self._transforms.rivals().items()))
            text = f"another node sends the transform to {child!r} too (from {parent!r})"
            level, message = Level.ERROR, text
        values = {
            "log": str(self._log.path),
            "scans sent": self._sent,
            "sent again": self._again,
            "rounds": self._rounds,
            "read [%]": 100.0 * self._log.fraction_read,
            "log time [s]": "-" if self._stamp_s is None else f"{self._stamp_s:.3f}",
        }
        return [Status("player", level, message, values)]

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join(SAVE_AT_END_S)


def _check_writable(folder: Path) -> None:
    """Make a folder, and refuse one in which no file can be made: before the log plays, not after.

    Raises:
        OSError: the folder cannot be made, or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
