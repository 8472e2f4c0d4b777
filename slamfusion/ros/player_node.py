"""``PlayerNode``: plays a log or bag as live topics, in real time, faster, or in lockstep."""

from __future__ import annotations

import dataclasses
import itertools
import math
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from slamfusion.config import LogConfig, PlayerNodeConfig
from slamfusion.deskew import Deskewer
from slamfusion.errors import ConfigError, LogError, SlamFusionError, counted
from slamfusion.geometry import Pose2
from slamfusion.io.files import refuse_overwriting, user_path
from slamfusion.io.lines import saved_files
from slamfusion.io.log import LogScan, ScanLog
from slamfusion.io.logs import log_sources, open_log
from slamfusion.io.map_server import save_map
from slamfusion.io.stamps import AHEAD_S, CONFIRMING
from slamfusion.io.trajectories import replace_tum
from slamfusion.ros import messages, qos
from slamfusion.ros.base import DIAGNOSTICS_TOPIC, FINAL, Level, NodeBase, Status, shown
from slamfusion.ros.frames import TransformOutput
from slamfusion.ros.interface import MAPS, WAIT_FOR
from slamfusion.ros.parameters import declare, declare_names

SCAN_TOPIC, ODOM_TOPIC, CLOCK_TOPIC = "scan", "odom", "/clock"
# Of the fusion: the saved map and path.
MAP_TOPIC, PATH_TOPIC = "fused/map", "fused/path"
# An unanswered scan is sent again after this: best-effort readers may lose one.
AGAIN_S = 1.0
# After a jump of the log's time producers wait for more scans, which are sent at this interval.
AGAIN_AT_JUMP_S = 0.1
STAMP_TOLERANCE_S = 1e-6
# The fusion may have dropped the last scans, seconds.
FINAL_S = 1.0
# Reliable readers have this long to receive the last messages.
ACKNOWLEDGE_S = 5.0
# Progress is logged for each tenth of the log, at most this often, seconds.
PARTS, APART_S = 10, 5.0
# Between two scans the clock advances in steps of this real time.
CLOCK_STEP_S = 0.02
# Writers are discovered a moment before their readers receive them.
SETTLE_S = 0.3
# Longest wait for the maps that hold the last scan, seconds; then those that came are written.
SAVE_TIMEOUT_S = 20.0
# Longest time for saving maps when the player is stopped.
SAVE_AT_END_S = 8.0
# Longer pauses in a log are shortened to this.
LONGEST_PAUSE_S = 3600.0


class PlayerNode(NodeBase):
    """Plays a log: ``scan``, ``odom``, transforms and ``/clock``, all with the log's stamps.

    The first scan, and with ``lockstep`` every scan, is repeated each second until every producer
    of ``wait_for`` has answered with its pose on ``NAME/pose``. The node ends after the last scan;
    with ``save`` it first writes the newest maps, also when it is stopped early.

    Raises:
        ConfigError: a parameter is refused, or no file is named.
        LogError: the log cannot be read.
        OSError: the log cannot be opened, or the folder of ``save`` cannot be written to.
    """

    def __init__(self, name: str = "player", *, context: Any = None, arguments: Any = None) -> None:
        super().__init__(name, context=context, arguments=arguments)
        node = self.node
        self.settings = declare(
            node, PlayerNodeConfig(), changeable=("rate",), on_change=self._take
        )
        reading = declare(node, LogConfig(), "log")
        self.wait_for = declare_names(node, WAIT_FOR)
        map_topics = declare_names(node, MAPS, [f"{name}/map" for name in self.wait_for])
        if not self.settings.file:
            raise ConfigError("player: name the log or bag with the parameter file: -p file:=PATH")
        if self.settings.lockstep and not self.wait_for:
            message = "player: lockstep needs to know whom to wait for: -p wait_for:=[NAME]"
            raise ConfigError(message)
        if self.settings.save is not None and not map_topics:
            raise ConfigError("player: save needs to know which maps: -p maps:=[NAME/map]")
        # Notified on poses, maps and the node's end.
        self._changed = threading.Condition()
        self._is_ending = False
        # The newest map and its file by topic; each producer's newest pose.
        self._maps: dict[str, Any] = {}
        self._stems: dict[str, Path] = {}
        self._poses: dict[str, Any] = {}
        # The newest fused path, serialized; and the stamp up to which the fused map is final, None
        # if the fusion draws it from no drive.
        self._path: bytes | None = None
        self._final_s: float | None = None
        log = user_path(self.settings.file)
        if self.settings.save is not None:
            self._open_maps(map_topics, user_path(self.settings.save), log)
        # Scans are sent as recorded: their readers deskew them.
        self._deskewer = Deskewer(reading)
        self._log: ScanLog = open_log(log, dataclasses.replace(reading, deskew="no"))
        self._scans = node.create_publisher(LaserScan, SCAN_TOPIC, qos.STREAM)
        self._odometry = node.create_publisher(Odometry, ODOM_TOPIC, qos.STREAM)
        self._clock = node.create_publisher(Clock, CLOCK_TOPIC, qos.STREAM)
        self._transforms = TransformOutput(node)
        for producer in self.wait_for:
            on_pose = partial(self._keep, self._poses, producer)
            self.subscribe(PoseStamped, f"{producer}/pose", on_pose, qos.STREAM)
        # Scans sent, each counted once, and repeated; stamp and mount of the last.
        self._sent = self._sent_again = self._rounds = 0
        self._stamp_s: float | None = None
        self._mount: Pose2 | None = None
        self._shown_part, self._shown_s = 0, time.monotonic()
        self._due_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def _take(self, settings: PlayerNodeConfig) -> None:
        self.settings = settings

    # --- the player's thread -----------------------------------------------------------------

    def _run(self) -> None:
        code = 1
        try:
            began_s = time.monotonic()
            self._wait_for_listeners()
            self._play()
            if not self._is_ending:
                for publisher in (self._scans, self._odometry):
                    publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_S))
                again = f", {self._sent_again} of them again" if self._sent_again else ""
                skipped = "; ".join(self._log.skips.sentences())
                self.log.info(
                    f"end of {self._log.path}: {counted(self._sent, 'scan')} sent in "
                    f"{time.monotonic() - began_s:.1f} s{again}"
                    f"{'; left out: ' if skipped else ''}{skipped}"
                )
            if self.settings.save is not None:
                self._save()
            code = 0
        except (SlamFusionError, OSError) as error:
            self.log.error(f"player: {error}")
        except Exception:  # noqa: BLE001  (a bug; named, and the process ends with 1)
            self.log.error(traceback.format_exc())
        finally:
            if not self._is_ending:
                self.stop(code)

    def _wait_until(self, is_true: Callable[[], bool], duration_s: float) -> bool:
        """Wait until a condition or the node's end; return whether either came."""
        with self._changed:
            return self._changed.wait_for(lambda: self._is_ending or is_true(), duration_s)

    def _pause(self, duration_s: float) -> None:
        self._wait_until(lambda: False, duration_s)

    def _wait_for_listeners(self) -> None:
        """Wait until the producers of ``wait_for``, or any node without those, listen.

        A fusion whose map is saved is waited for, too: its path needs the scans from the first on.
        """
        until_s = time.monotonic() + self.settings.start_timeout_s
        wanted = {name: f"{name}/pose" for name in self.wait_for}
        wanted |= {"the fusion": MAP_TOPIC} if MAP_TOPIC in self._stems else {}
        while not self._is_ending:
            count = self.node.count_publishers
            absent = [name for name, topic in wanted.items() if not count(topic)]
            listeners = self._scans.get_subscription_count()
            if not absent and listeners >= max(1, len(self.wait_for)):
                self._pause(SETTLE_S)
                return
            if time.monotonic() > until_s:
                topic = self.resolved(SCAN_TOPIC)
                if not wanted:
                    self.log.warning(f"no node listens on {topic!r}; playing all the same")
                    return
                who = (
                    ", ".join(absent) or f"only {counted(listeners, 'node', 'listen')} on {topic!r}"
                )
                raise SlamFusionError(
                    f"waited {self.settings.start_timeout_s:g} s for {', '.join(wanted)}; "
                    f"missing: {who}"
                )
            self._pause(0.05)

    def _play(self) -> None:
        while not self._is_ending:
            self._rounds += 1
            sent, last_s, self._due_s = self._sent, None, None
            ahead, scans = itertools.tee(self._log)
            next(ahead, None)
            for item, following in itertools.zip_longest(scans, ahead):
                stamp_s = item.scan.stamp_s
                since_s = 0.0 if last_s is None else min(stamp_s - last_s, LONGEST_PAUSE_S)
                last_s = stamp_s
                if not self.settings.lockstep:
                    self._run_clock(stamp_s, since_s)
                if self._is_ending:
                    return
                before_s = self._stamp_s
                is_skewed = self._deskewer.is_skewed(item.scan)
                self._send(item, following if is_skewed else None)
                self._sent += 1
                self._show_progress()
                if self.settings.lockstep:
                    self._wait_for_answers(item, before_s)
                elif before_s is None and self.wait_for:
                    try:
                        self._wait_for_answers(item, None)
                    except SlamFusionError as error:
                        self.diagnostics.say("first", f"playing all the same: {error}")
                    self._due_s = time.monotonic()
            if self._sent == sent and not self._is_ending:
                skipped = "; ".join(self._log.skips.sentences())
                raise LogError(
                    f"{self._log.path}: no scan in it could be used{skipped and ': '}{skipped}"
                )
            if not self.settings.loop:
                return

    def _send(self, item: LogScan, following: LogScan | None = None) -> None:
        """Send a scan with its time, transforms and odometry, and that of the following scan."""
        settings, scan = self.settings, item.scan
        stamp = messages.to_stamp(scan.stamp_s)
        self._stamp_s = scan.stamp_s
        self._send_clock(scan.stamp_s)
        if scan.mount != self._mount:
            self._mount = scan.mount
            laser = settings.laser_frame, scan.mount, stamp
            self._transforms.send(settings.base_frame, laser, is_static=True)
        frames = settings.odom_frame, settings.base_frame
        for one in (item, following):
            if one is None or one.odometry is None:
                continue
            stamp = messages.to_stamp(one.scan.stamp_s)
            if settings.odometry in {"tf", "both"}:
                self._transforms.send(
                    settings.odom_frame, (settings.base_frame, one.odometry, stamp)
                )
            if settings.odometry in {"topic", "both"}:
                self._odometry.publish(messages.odometry_to_message(one.odometry, *frames, stamp))
        self._scans.publish(messages.scan_to_message(scan, settings.laser_frame))

    def _send_clock(self, stamp_s: float) -> None:
        if self.settings.publish_clock:
            self._clock.publish(Clock(clock=messages.to_stamp(max(stamp_s, 0.0))))

    def _show_progress(self) -> None:
        part, now_s = math.floor(PARTS * self._log.fraction_read), time.monotonic()
        self._shown_part = min(self._shown_part, part)  # smaller in a new round
        if self._shown_part < part < PARTS and now_s - self._shown_s >= APART_S:
            self._shown_part, self._shown_s = part, now_s
            self.log.info(f"played {part / PARTS:.0%}: {counted(self._sent, 'scan')}")

    def _run_clock(self, stamp_s: float, since_s: float) -> None:
        """Wait until a scan is due, ``since_s`` after the last, and advance the clock meanwhile."""
        now_s = time.monotonic()
        due_s, rate = self._due_s, self.settings.rate
        # After a delay it continues from now, without catching up.
        due_s = now_s if due_s is None else max(due_s + since_s / rate, now_s - AGAIN_S)
        while (left_s := due_s - time.monotonic()) > 0.0 and not self._is_ending:
            self._send_clock(stamp_s - left_s * rate)
            self._pause(min(left_s, CLOCK_STEP_S))
        self._due_s = due_s

    def _wait_for_answers(self, item: LogScan, before_s: float | None) -> None:
        """Wait for every producer's pose at a scan; SlamFusionError after a timeout."""
        stamp_s, timeout_s = item.scan.stamp_s, self.settings.lockstep_timeout_s
        until_s = time.monotonic() + timeout_s
        is_jump = before_s is not None and not 0.0 < stamp_s - before_s <= AHEAD_S
        at_jump_s = [AGAIN_AT_JUMP_S] * (CONFIRMING - 1) if is_jump else []
        for pause_s in itertools.chain(at_jump_s, itertools.repeat(AGAIN_S)):
            left_s = until_s - time.monotonic()
            if self._wait_until(lambda: not self._silent(stamp_s), min(pause_s, left_s)):
                return
            if pause_s >= left_s and (silent := self._silent(stamp_s)):
                raise SlamFusionError(
                    f"no pose at {stamp_s:.3f} s from {', '.join(silent)} within {timeout_s:g} s; "
                    "the producer may have ended, or leaves the scan out: see its diagnostics"
                )
            self._send(item)
            self._sent_again += 1

    def _silent(self, stamp_s: float) -> list[str]:
        """Return the producers whose newest pose has another stamp."""
        return [
            name
            for name in self.wait_for
            if name not in self._poses
            or abs(messages.stamp_s(self._poses[name]) - stamp_s) > STAMP_TOLERANCE_S
        ]

    def _keep(self, newest: dict[str, Any], name: str, message: Any) -> None:
        with self._changed:
            newest[name] = message
            self._changed.notify_all()

    def _open_maps(self, topics: Sequence[str], folder: Path, log: Path) -> None:
        """Subscribe to maps, and check early that they can be written."""
        self._stems = {
            topic: folder / topic.strip("/").removesuffix("/map").replace("/", "_")
            for topic in topics
        }
        if len({*self._stems.values()}) < len(topics):
            raise ConfigError(f"player: two maps would have one file: {', '.join(topics)}")
        refuse_overwriting(
            [(log, file) for file in log_sources(log)],
            [(f"save {stem}", file) for stem in self._stems.values() for file in saved_files(stem)],
        )
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass  # the folder is writable
        for topic in topics:
            self.subscribe(OccupancyGrid, topic, partial(self._keep, self._maps, topic), qos.MAP)
        if MAP_TOPIC in topics:
            self.subscribe(PathMessage, PATH_TOPIC, self._on_path, qos.MAP, raw=True)
            self.subscribe(DiagnosticArray, DIAGNOSTICS_TOPIC, self._on_diagnostics, qos.STREAM)

    def _save(self) -> None:
        """Write the newest maps once they hold the last scan; those received if stopped early."""
        stamp_s = self._stamp_s or 0.0
        is_early = self._is_ending
        self._wait_until(lambda: not self._late(stamp_s), SAVE_TIMEOUT_S)
        with self._changed:
            maps, late = dict(self._maps), self._late(stamp_s)
        if is_early:
            played = f"{counted(self._sent, 'scan')} of {self._log.path}"
            ends = "the maps that have come are saved" if maps else "no map has come to be saved"
            self.log.warning(f"stopped after {played}; {ends}")
            late = {}
        for topic, what in late.items():
            self.log.warning(f"the map on {self.resolved(topic)!r}: {what}")
        if not maps and not is_early:
            raise SlamFusionError(f"no map came on {', '.join(self._stems)}")
        for topic, message in maps.items():
            stem = self._stems[topic]
            stem.parent.mkdir(parents=True, exist_ok=True)
            path, _ = save_map(messages.grid_from_message(message, topic), stem)
            self.log.info(f"wrote {path}")
            if topic == MAP_TOPIC:
                data = self._path
                driven = None if data is None else messages.path_from_bytes(data, "fused")
                replace_tum(stem.with_name(f"{stem.name}.tum"), driven)

    def _late(self, stamp_s: float) -> dict[str, str]:
        """Return why the newest map of a topic is not that of the scan of a stamp, if it is not."""
        late = {topic: "no map came" for topic in self._stems if topic not in self._maps}
        for topic, message in self._maps.items():
            if messages.stamp_s(message) < stamp_s - STAMP_TOLERANCE_S:
                late[topic] = "it is older than the last scan"
        if self._final_s is not None and self._final_s < stamp_s - FINAL_S:
            late.setdefault(MAP_TOPIC, "it came before the whole drive was solved")
        return late

    def _on_diagnostics(self, message: Any) -> None:
        values = [own for status in message.status for own in status.values]
        with self._changed:
            for own in values:
                if own.key == FINAL:
                    self._final_s = None if own.value == shown(None) else float(own.value)
            self._changed.notify_all()

    def _on_path(self, data: bytes) -> None:
        self._path = data

    def statuses(self) -> list[Status]:
        """Return one line with the progress."""
        level, message = self.diagnostics.worst(
            "playing" if self._sent else "waiting for listeners"
        )
        if rival := self._transforms.rival()[1]:
            level, message = Level.ERROR, rival
        values = {
            "log": str(self._log.path),
            "scans sent": self._sent,
            "sent again": self._sent_again,
            "rounds": self._rounds,
            "read [%]": 100.0 * self._log.fraction_read,
            "log time [s]": None if self._stamp_s is None else f"{self._stamp_s:.3f}",
        }
        return [Status("player", level, message, values)]

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._is_ending = True
            self._changed.notify_all()
        self._thread.join(SAVE_AT_END_S)
