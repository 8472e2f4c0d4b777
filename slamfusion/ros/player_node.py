"""``PlayerNode``: a log or bag as live topics, in its own time, faster, or in lockstep."""

from __future__ import annotations

import dataclasses
import itertools
import math
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
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
from slamfusion.errors import ConfigError, LogError, SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.io.files import refuse_overwriting
from slamfusion.io.log import LogScan, ScanLog
from slamfusion.io.logs import log_sources, open_log
from slamfusion.io.map_server import save_map, saved_files
from slamfusion.io.stamps import AHEAD_S, CONFIRMING
from slamfusion.io.trajectories import write_tum
from slamfusion.ros import messages, qos
from slamfusion.ros.base import DIAGNOSTICS_TOPIC, FINAL, Level, NodeBase, Status, shown
from slamfusion.ros.frames import TransformOutput
from slamfusion.ros.parameters import declare, declare_names

# Of the fusion: a map that is saved, and the path that is saved with it.
MAP_TOPIC, PATH_TOPIC = "fused/map", "fused/path"
# A scan that is not answered is sent again after this long: best-effort readers may lose one.
AGAIN_S = 1.0
# After a jump of the log's time producers wait for a scan to be sent again, and are not made to
# wait long for that.
AGAIN_AT_JUMP_S = 0.1
STAMP_TOLERANCE_S = 1e-6
# The last scans may have been dropped by the fusion, seconds.
FINAL_S = 1.0


class Interrupt(threading.Condition):
    """One condition for all that the player's thread waits for, the end of the node among it.

    Attributes:
        is_set: whether the node ends; waits end at once from then on.
    """

    is_set = False

    def set(self) -> None:
        """End all waits."""
        with self:
            self.is_set = True
            self.notify_all()

    def wait_until(self, is_true: Callable[[], bool], duration_s: float) -> bool:
        """Wait until something is true or the node ends; return whether either is so."""
        with self:
            return self.wait_for(lambda: self.is_set or is_true(), duration_s)

    def pause(self, duration_s: float) -> None:
        """Wait, but not beyond the end of the node."""
        self.wait_until(lambda: False, duration_s)


SCAN_TOPIC, ODOM_TOPIC, CLOCK_TOPIC = "scan", "odom", "/clock"
# Reliable readers are given this long to take the last messages.
ACKNOWLEDGE_S = 5.0


class ScanSender:
    """Sends ``scan``, ``odom``, transforms and ``/clock``, all with the log's stamps.

    Args:
        settings: its frames, and what of the odometry is sent.

    Attributes:
        sent: scans sent so far, each counted once.
        sent_again: how often one of them was repeated.
        stamp_s: of the last scan; None before the first.
    """

    def __init__(self, base: NodeBase, settings: PlayerNodeConfig) -> None:
        self.sent = 0
        self.sent_again = 0
        self.stamp_s: float | None = None
        self._settings = settings
        self._scans = base.node.create_publisher(LaserScan, SCAN_TOPIC, qos.STREAM)
        self._odometry = base.node.create_publisher(Odometry, ODOM_TOPIC, qos.STREAM)
        self._clock = base.node.create_publisher(Clock, CLOCK_TOPIC, qos.STREAM)
        self._transforms = TransformOutput(base.node)
        self._mount: Pose2 | None = None

    def listeners(self) -> int:
        """Return how many subscriptions the scans have."""
        return int(self._scans.get_subscription_count())

    def rivals(self) -> dict[str, str]:
        """Return the parents of frames that another node sends too, by child; see ``frames``."""
        return self._transforms.rivals()

    def send(self, item: LogScan, following: LogScan | None = None) -> None:
        """Send a scan with its time, transforms and odometry, the scan last.

        Args:
            item: the scan.
            following: the one after it, whose odometry goes out too: the robot's motion during the
                sweep of this one; None: not needed.
        """
        settings, scan = self._settings, item.scan
        stamp = messages.to_stamp(scan.stamp_s)
        self.stamp_s = scan.stamp_s
        self.send_clock(scan.stamp_s)
        if scan.mount != self._mount:
            self._mount = scan.mount
            frames = settings.base_frame, settings.laser_frame
            self._transforms.send_static(scan.mount, *frames, stamp)
        frames = settings.odom_frame, settings.base_frame
        for one in (item, following):
            if one is None or one.odometry is None:
                continue
            stamp = messages.to_stamp(one.scan.stamp_s)
            if settings.odometry in {"tf", "both"}:
                self._transforms.send(one.odometry, *frames, stamp)
            if settings.odometry in {"topic", "both"}:
                self._odometry.publish(messages.odometry_to_message(one.odometry, *frames, stamp))
        self._scans.publish(messages.scan_to_message(scan, settings.laser_frame))
        self.sent += 1

    def send_again(self, item: LogScan) -> None:
        """Repeat a scan that was sent."""
        self.send(item)
        self.sent -= 1
        self.sent_again += 1

    def send_clock(self, stamp_s: float) -> None:
        """Send the log's time, where that is asked for."""
        if self._settings.publish_clock:
            self._clock.publish(Clock(clock=messages.to_stamp(max(stamp_s, 0.0))))

    def wait_for_delivery(self) -> None:
        """Give reliable readers the time to take the last messages."""
        for publisher in (self._scans, self._odometry):
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_S))


# A line for each tenth of the log, but no more often than this, seconds.
PARTS, APART_S = 10, 5.0

# Between two scans the clock goes on in steps of this real time.
CLOCK_STEP_S = 0.02
# Writers are known a moment before their readers hear them.
SETTLE_S = 0.3
# Maps that are saved when the player is stopped may take this long.
SAVE_AT_END_S = 8.0
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

    Raises:
        ConfigError: a parameter is refused, or no file is named.
        LogError: the log cannot be read.
        OSError: the same, by the system; or the folder of ``save`` cannot be written to.
    """

    def __init__(self, *, context: Any = None, arguments: Any = None) -> None:
        super().__init__("player", context=context, arguments=arguments)
        node = self.node
        self.settings = declare(
            node, PlayerNodeConfig(), changeable=("rate",), on_change=self._take
        )
        reading = declare(node, LogConfig(), "log")
        self.wait_for = declare_names(
            node,
            "wait_for",
            (),
            "producers that must answer the first scan, and in lockstep every one",
        )
        topics = [f"{name}/map" for name in self.wait_for]
        text = "map topics that are written to the folder `save` at the end of the log"
        map_topics = declare_names(node, "maps", topics, text)
        if self.settings.file is None:
            raise ConfigError("player: name the log or bag with the parameter file: -p file:=PATH")
        if self.settings.lockstep and not self.wait_for:
            message = "player: lockstep needs to know whom to wait for: -p wait_for:=[NAME]"
            raise ConfigError(message)
        self._interrupt = Interrupt()
        # The newest map by topic, and where it is to be written; the stamp of each newest pose.
        self._maps: dict[str, Any] = {}
        self._path: Any = None
        self._final_s = -math.inf
        self._stems: dict[str, Path] = {}
        self._stamps_s: dict[str, float] = {}
        if self.settings.save is not None:
            self._open_maps(map_topics, Path(self.settings.save), Path(self.settings.file))
        # The scans go out as they are: who hears them deskews them.
        self._deskewer = Deskewer(reading)
        self._log: ScanLog = open_log(self.settings.file, dataclasses.replace(reading, deskew="no"))
        self._sender = ScanSender(self, self.settings)
        for name in self.wait_for:
            self.subscribe(PoseStamped, f"{name}/pose", partial(self._on_pose, name), qos.STREAM)
        self._told_part, self._told_s = 0, time.monotonic()
        self._rounds = 0
        self._due_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def _take(self, settings: PlayerNodeConfig) -> None:
        self.settings = settings

    # --- the player's thread -----------------------------------------------------------------

    def _run(self) -> None:
        """Play the log and end the node."""
        code = 1
        try:
            begun_s = time.monotonic()
            self._wait_for_listeners()
            self._play()
            if not self._interrupt.is_set:
                self._sender.wait_for_delivery()
                self.log.info(self._words_at_end(time.monotonic() - begun_s))
            if self.settings.save is not None:
                self._save()
            code = 0
        except (SlamFusionError, OSError) as error:
            self.log.error(f"player: {error}")
        except Exception:  # noqa: BLE001  (a bug; named, and the process ends with 1)
            self.log.error(traceback.format_exc())
        finally:
            if not self._interrupt.is_set:
                self.stop(code)

    def _words_at_end(self, duration_s: float) -> str:
        skipped = "; ".join(self._log.skips.sentences())
        return (
            f"end of {self._log.path}: {self._sender.sent} scans sent in {duration_s:.1f} s"
            + (f", {self._sender.sent_again} of them again" if self._sender.sent_again else "")
            + (f"; left out: {skipped}" if skipped else "")
        )

    def _wait_for_listeners(self) -> None:
        """Wait until everybody listens who should, or somebody does.

        Raises:
            SlamFusionError: a producer of ``wait_for`` does not come.
        """
        until_s = time.monotonic() + self.settings.start_timeout_s
        while not self._interrupt.is_set:
            count = self.node.count_publishers
            absent = [name for name in self.wait_for if not count(f"{name}/pose")]
            listeners = self._sender.listeners()
            if not absent and listeners >= max(1, len(self.wait_for)):
                self._interrupt.pause(SETTLE_S)
                return
            if time.monotonic() > until_s:
                topic = self.node.resolve_topic_name(SCAN_TOPIC)
                if not self.wait_for:
                    self.log.warning(f"no node listens on {topic!r}; playing all the same")
                    return
                who = ", ".join(absent) or f"only {listeners} node(s) listen on {topic!r}"
                raise SlamFusionError(
                    f"waited {self.settings.start_timeout_s:g} s for {', '.join(self.wait_for)}; "
                    f"missing: {who}"
                )
            self._interrupt.pause(0.05)

    def _play(self) -> None:
        """Send every scan at its time."""
        while not self._interrupt.is_set:
            self._rounds += 1
            sent = self._sender.sent
            for item, following, wait_s in self._timed():
                if self._interrupt.is_set:
                    return
                if not self.settings.lockstep:
                    self._run_clock(item.scan.stamp_s, wait_s)
                before_s = self._sender.stamp_s
                is_skewed = self._deskewer.is_skewed(item.scan)
                self._sender.send(item, following if is_skewed else None)
                self._tell_progress()
                if self.settings.lockstep:
                    self._wait_for_answers(item, before_s)
                elif before_s is None and self.wait_for:
                    self._wait_for_first_answers(item)
            if self._sender.sent == sent and not self._interrupt.is_set:
                skipped = "; ".join(self._log.skips.sentences())
                message = (
                    f"{self._log.path}: no scan in it could be used{skipped and ': '}{skipped}"
                )
                raise LogError(message)
            if not self.settings.loop:
                return

    def _tell_progress(self) -> None:
        """Say each tenth of the log; of a short one not all of them."""
        part, now_s = math.floor(PARTS * self._log.fraction_read), time.monotonic()
        self._told_part = min(self._told_part, part)  # it may be played again
        if self._told_part < part < PARTS and now_s - self._told_s >= APART_S:
            self._told_part, self._told_s = part, now_s
            self.log.info(f"played {part / PARTS:.0%}: {self._sender.sent} scans")

    def _timed(self) -> Iterator[tuple[LogScan, LogScan | None, float]]:
        """Yield scans, the one after each, and the recorded time since the one before, seconds."""
        before_s: float | None = None
        ahead, scans = itertools.tee(self._log)
        next(ahead, None)
        for item, following in itertools.zip_longest(scans, ahead):
            stamp_s = item.scan.stamp_s
            wait_s = 0.0 if before_s is None else min(stamp_s - before_s, LONGEST_PAUSE_S)
            yield item, following, wait_s
            before_s = stamp_s
        self._due_s = None

    def _run_clock(self, stamp_s: float, since_s: float) -> None:
        """Wait until a scan is due, by the rate, and let the clock go on meanwhile."""
        now_s = time.monotonic()
        due_s, rate = self._due_s, self.settings.rate
        # A player that fell behind goes on from now; it never hurries.
        due_s = now_s if due_s is None else max(due_s + since_s / rate, now_s - AGAIN_S)
        while (left_s := due_s - time.monotonic()) > 0.0 and not self._interrupt.is_set:
            self._sender.send_clock(stamp_s - left_s * rate)
            self._interrupt.pause(min(left_s, CLOCK_STEP_S))
        self._due_s = due_s

    def _wait_for_first_answers(self, item: LogScan) -> None:
        """Wait until every producer has told its pose at the first scan; name one that has not."""
        try:
            self._wait_for_answers(item, None)
        except SlamFusionError as error:
            self.diagnostics.add("first", Level.WARN, f"playing all the same: {error}")
        self._due_s = time.monotonic()

    def _wait_for_answers(self, item: LogScan, before_s: float | None) -> None:
        """Wait until every producer has told its pose at a scan that was sent.

        Args:
            item: the scan.
            before_s: stamp of the scan before it; None for the first.

        Raises:
            SlamFusionError: one has not, however often the scan was sent.
        """
        stamp_s, timeout_s = item.scan.stamp_s, self.settings.lockstep_timeout_s
        until_s = time.monotonic() + timeout_s
        is_jump = before_s is not None and not 0.0 < stamp_s - before_s <= AHEAD_S
        pauses_s = [AGAIN_AT_JUMP_S] * (CONFIRMING - 1) if is_jump else []
        again_s = time.monotonic() + (pauses_s.pop() if pauses_s else AGAIN_S)
        while not self._interrupt.is_set:
            duration_s = min(again_s, until_s) - time.monotonic()
            if self._interrupt.wait_until(lambda: not self._silent(stamp_s), duration_s):
                return
            now_s = time.monotonic()
            if now_s >= until_s:
                with self._interrupt:
                    silent = self._silent(stamp_s)
                if not silent:  # the last answer came with the end of the wait
                    return
                raise SlamFusionError(
                    f"no pose at {stamp_s:.3f} s from {', '.join(silent)} within "
                    f"{timeout_s:g} s; the producer may have ended, or "
                    "leaves the scan out: see its diagnostics"
                )
            if now_s >= again_s:
                self._sender.send_again(item)
                again_s = now_s + (pauses_s.pop() if pauses_s else AGAIN_S)

    def _silent(self, stamp_s: float) -> list[str]:
        """Return the producers whose newest pose is none at a stamp."""
        return [
            name
            for name in self.wait_for
            if abs(self._stamps_s.get(name, math.inf) - stamp_s) > STAMP_TOLERANCE_S
        ]

    def _on_pose(self, name: str, message: Any) -> None:
        """Note that a producer has told its pose at a stamp."""
        with self._interrupt:
            self._stamps_s[name] = messages.stamp_s(message)
            self._interrupt.notify_all()

    # --- maps that are written at the end ----------------------------------------------------

    def _open_maps(self, topics: Sequence[str], folder: Path, log: Path) -> None:
        """Listen to maps, and see that they can be written: before the log plays, not after.

        Raises:
            SlamFusionError: a map would be written over a file of the log.
            OSError: the folder cannot be made, or written to.
        """
        self._stems = {
            topic: folder / topic.strip("/").removesuffix("/map").replace("/", "_")
            for topic in topics
        }
        refuse_overwriting(
            [(log, file) for file in log_sources(log)],
            [(f"save {stem}", file) for stem in self._stems.values() for file in saved_files(stem)],
        )
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass  # a file can be made there
        for topic in topics:
            self.subscribe(OccupancyGrid, topic, partial(self._on_map, topic), qos.MAP)
        if MAP_TOPIC in topics:
            self.subscribe(PathMessage, PATH_TOPIC, self._on_path, qos.MAP)
            self.subscribe(DiagnosticArray, DIAGNOSTICS_TOPIC, self._on_diagnostics, qos.STREAM)

    def _save(self) -> None:
        """Write the newest map of every topic, as soon as they hold the last scan.

        When the node is ended before, those that have come.

        Raises:
            SlamFusionError: no map came, or one is none or cannot be written.
        """
        stamp_s = self._sender.stamp_s or 0.0
        is_early = self._interrupt.is_set
        self._interrupt.wait_until(lambda: not self._late(stamp_s), self.settings.save_timeout_s)
        with self._interrupt:
            maps, late = dict(self._maps), self._late(stamp_s)
        if is_early:
            played = f"{self._sender.sent} scans of {self._log.path}"
            ends = "the maps that have come are saved" if maps else "no map has come to be saved"
            self.log.warning(f"stopped after {played}; {ends}")
            late = []
        for topic in late:
            what = "it is older than the last scan" if topic in maps else "no map came"
            self.log.warning(f"the map on {self.node.resolve_topic_name(topic)!r}: {what}")
        if not maps and not is_early:
            raise SlamFusionError(f"no map came on {', '.join(self._stems) or '(no topic)'}")
        for topic, message in maps.items():
            stem = self._stems[topic]
            stem.parent.mkdir(parents=True, exist_ok=True)
            path, _ = save_map(messages.grid_from_message(message, topic), stem)
            self.log.info(f"wrote {path}")
            if topic == MAP_TOPIC and self._path is not None:
                driven = messages.path_from_message(self._path, "fused")
                write_tum(stem.with_name(f"{stem.name}.tum"), driven)

    def _late(self, stamp_s: float) -> list[str]:
        """Return the topics whose newest map does not hold the scan of a stamp.

        A fused map that is drawn from scans is that of ``run`` a little later.
        """
        is_drawn = self._path is not None
        return [
            topic
            for topic in self._stems
            if topic not in self._maps
            or messages.stamp_s(self._maps[topic]) < stamp_s - STAMP_TOLERANCE_S
            or (topic == MAP_TOPIC and is_drawn and self._final_s < stamp_s - FINAL_S)
        ]

    def _on_diagnostics(self, message: Any) -> None:
        """Note how far the fused map is final."""
        told = [own.value for status in message.status for own in status.values if own.key == FINAL]
        with self._interrupt:
            for value in told:
                if value != shown(None):
                    self._final_s = float(value)
            self._interrupt.notify_all()

    def _on_path(self, message: Any) -> None:
        """Keep the newest fused path."""
        self._path = message

    def _on_map(self, topic: str, message: Any) -> None:
        """Keep the newest map of a topic."""
        with self._interrupt:
            self._maps[topic] = message
            self._interrupt.notify_all()

    # --- diagnostics and end -----------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return one line: how far the log is."""
        level, message = self.diagnostics.worst(
            "playing" if self._sender.sent else "waiting for listeners"
        )
        if self._sender.rivals():
            child, parent = next(iter(self._sender.rivals().items()))
            text = f"another node sends the transform to {child!r} too (from {parent!r})"
            level, message = Level.ERROR, text
        values = {
            "log": str(self._log.path),
            "scans sent": self._sender.sent,
            "sent again": self._sender.sent_again,
            "rounds": self._rounds,
            "read [%]": 100.0 * self._log.fraction_read,
            "log time [s]": "-" if self._sender.stamp_s is None else f"{self._sender.stamp_s:.3f}",
        }
        return [Status("player", level, message, values)]

    def close(self) -> None:
        """End the thread."""
        self._interrupt.set()
        self._thread.join(SAVE_AT_END_S)
