"""``PlayerNode``: a log or bag as live topics, in its own time, faster, or in lockstep."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from slamfusion.config import LogConfig, PlayerNodeConfig
from slamfusion.errors import ConfigError, LogError, SlamFusionError
from slamfusion.io.log import LogScan, ScanLog
from slamfusion.io.logs import open_log
from slamfusion.ros.base import Level, NodeBase, Status
from slamfusion.ros.interrupt import Interrupt
from slamfusion.ros.parameters import declare, declare_names
from slamfusion.ros.player_answers import AGAIN_S, Answers
from slamfusion.ros.player_maps import PlayerMaps
from slamfusion.ros.player_output import SCAN_TOPIC, ScanSender
from slamfusion.ros.player_progress import ProgressLines

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
        map_topics = declare_names(node, "maps", topics, text)
        if self.settings.file is None:
            message = "player: name the log or bag with the parameter file: -p file:=PATH"
            raise ConfigError(message)
        if self.settings.lockstep and not self.wait_for:
            message = "player: lockstep needs to know whom to wait for: -p wait_for:=[NAME]"
            raise ConfigError(message)
        self._interrupt = Interrupt()
        self._maps: PlayerMaps | None = None
        if self.settings.save is not None:
            folder = Path(self.settings.save)
            log = Path(self.settings.file)
            self._maps = PlayerMaps(self, map_topics, folder, self._interrupt, log)
        self._log: ScanLog = open_log(self.settings.file, reading)
        self._sender = ScanSender(self, self.settings)
        timeout_s = self.settings.lockstep_timeout_s
        self._answers = Answers(self, self.wait_for, self._interrupt, timeout_s)
        self._progress = ProgressLines(self.log.info)
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
            if self._maps is not None:
                played = f"{self._sender.sent} scans of {self._log.path}"
                stamp_s = self._sender.stamp_s or 0.0
                self._maps.save(stamp_s, self.settings.save_timeout_s, played)
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
            absent, listeners = self._answers.absent(), self._sender.listeners()
            if not absent and listeners >= max(1, len(self.wait_for)):
                self._interrupt.pause(SETTLE_S)
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
            self._interrupt.pause(0.05)

    def _play(self) -> None:
        """Send every scan at its time."""
        while not self._interrupt.is_set:
            self._rounds += 1
            sent = self._sender.sent
            for item, wait_s in self._timed():
                if self._interrupt.is_set:
                    return
                if not self.settings.lockstep:
                    self._run_clock(item.scan.stamp_s, wait_s)
                before_s = self._sender.stamp_s
                self._sender.send(item)
                self._progress.tell(self._log.fraction_read, f"{self._sender.sent} scans")
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
        """Wait until every producer has told its pose at a scan; see ``Answers.wait``."""
        self._answers.wait(item.scan.stamp_s, before_s, lambda: self._sender.send_again(item))

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
