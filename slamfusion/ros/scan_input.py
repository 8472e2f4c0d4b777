"""The scans of a node: stamp checks, the laser's mount, and the odometry."""

from __future__ import annotations

import itertools
import operator
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan

from slamfusion.config import ScanNodeConfig
from slamfusion.errors import ScanError, TrajectoryError, counted
from slamfusion.geometry import F64, Pose2, row_of
from slamfusion.io.log import FARTHEST_M
from slamfusion.io.stamps import Passed, StampGate
from slamfusion.io.transforms import Mount, TransformError
from slamfusion.ros import messages, qos
from slamfusion.ros.base import FORWARD_JUMP_S, SHOWN_S, Level, NodeBase, jump_words
from slamfusion.ros.frames import TransformInput, TransformStore
from slamfusion.scan import LaserScan as Scan
from slamfusion.slam.session import LeftOutError

# Odometry older than this is silent, seconds.
ODOMETRY_ALIVE_S = 1.0

SCAN_TOPIC, ODOM_TOPIC = "scan", "odom"


@dataclass(frozen=True, eq=False)
class ArrivedScan:
    """A sensor_msgs/LaserScan, its stamp, and its arrival by ``time.monotonic``; seconds."""

    message: Any
    stamp_s: float
    arrived_s: float


def _is_same(one: ArrivedScan, other: ArrivedScan) -> bool:
    """Whether a scan was sent again; compares bytes, as NaN equals nothing."""
    return bool(one.message.ranges.tobytes() == other.message.ranges.tobytes())


class ScanInput:
    """The scans with valid stamps, and the laser's mount and the odometry at each.

    Subscribes to ``scan`` and the configured odometry. If time jumps back by more than
    ``reset_back_s``, several scans in a row agree and the odometry does not contradict, a new map
    starts; a large forward jump is reported. Single scans with stray stamps are left out
    (``StampGate``).

    Args:
        on_scan: called with each accepted scan; queues it, and returns what is dropped for it.
        on_restart: called before the first scan after a jump back.

    Attributes:
        last_s: ``time.monotonic`` of the last scan, or of the start.
        transforms: from ``/tf``; None if unused.
        odometry: its store; None without odometry.
        held, strays: scans held back for their stamps now, and those left out.
        dropped: scans dropped from the queue, which was full.
    """

    def __init__(
        self,
        base: NodeBase,
        settings: ScanNodeConfig,
        on_scan: Callable[[ArrivedScan], Collection[object]],
        on_restart: Callable[[], None],
    ) -> None:
        self.transforms: TransformStore | None = None
        self.odometry: TransformStore | None = None
        self.received = self.held = self.strays = self.jumps_back = self.dropped = 0
        self.last_s = self._first_s = time.monotonic()
        self._base = base
        self._settings = settings
        self._on_scan, self._on_restart = on_scan, on_restart
        self._gate: StampGate[ArrivedScan] = StampGate(settings.reset_back_s, _is_same)
        # What was left out for its stamps when that was reported last, and the last stray scan.
        self._named = (0, 0, 0)
        self._last_stray = ""
        if "tf" in {settings.odometry_source, settings.laser_source}:
            self.transforms = TransformInput(base.node)
        if settings.odometry_source == "tf":
            self.odometry = self.transforms
        elif settings.odometry_source == "topic":
            self.odometry = TransformStore()
            base.subscribe(Odometry, ODOM_TOPIC, self._on_odometry, qos.SENSOR)
        base.subscribe(LaserScan, SCAN_TOPIC, self._take_scan, qos.SENSOR)

    def configure(self, settings: ScanNodeConfig) -> None:
        """Apply changed settings."""
        self._settings = settings
        self._gate.back_s = settings.reset_back_s

    @property
    def _stores(self) -> set[TransformStore]:
        return {store for store in (self.transforms, self.odometry) if store is not None}

    def forget_after(self, stamp_s: float) -> None:
        """Forget transforms of later times."""
        for store in self._stores:
            store.forget_after(stamp_s)

    def _on_odometry(self, message: Any) -> None:
        odom, base = self._settings.odom_frame, self._settings.base_frame
        problem, pose = "", Pose2()
        try:
            pose = messages.pose2_from_message(message.pose.pose)
        except TrajectoryError as error:
            problem = str(error)
        if max(abs(pose.x), abs(pose.y)) > FARTHEST_M:
            problem = f"({pose.x:g}, {pose.y:g}) m is nowhere near"
        if problem:
            self._base.diagnostics.note("odometry values", f"odometry left out: {problem}")
            return
        named = [
            f"{frame!r}, which is taken for {name}, {wanted!r}"
            for name, frame, wanted in (
                ("odom_frame", message.header.frame_id, odom),
                ("base_frame", message.child_frame_id, base),
            )
            if frame.lstrip("/") not in {"", wanted}
        ]
        if named:
            text = f"odometry names {', and '.join(named)}; correct one"
            self._base.diagnostics.note("odometry frames", text)
        assert self.odometry is not None  # noqa: S101  (made before the subscription)
        self.odometry.add([messages.transform_to_message(pose, odom, base, message.header.stamp)])

    def read(self, scan: ArrivedScan) -> Scan:
        """Convert a scan; LeftOutError, reported, if it is invalid or its mount is unknown."""
        mount = self._mount(scan)
        try:
            read = messages.scan_from_message(scan.message, mount)
        except ScanError as error:
            self._base.diagnostics.note("scan", f"left out: {error}")
            raise LeftOutError("angles or ranges that cannot be a scan") from error
        return read.remounted(self._settings.laser)

    def _mount(self, scan: ArrivedScan) -> Mount:
        """Return the laser's mount at a scan; see ``read``."""
        settings = self._settings
        if settings.laser_source == "parameter":
            return Mount(Pose2(settings.laser_x, settings.laser_y, settings.laser_yaw))
        frame, mount = scan.message.header.frame_id.lstrip("/"), Mount()
        if frame != settings.base_frame:
            assert self.transforms is not None  # noqa: S101  (made for this source)
            wait_s = self._wait_s(scan, self.transforms)
            try:
                mount = self.transforms.mount(settings.base_frame, frame, scan.stamp_s, wait_s)
            except TransformError as error:
                what = "send" if error.may_come else "correct"
                text = (
                    f"scans in {frame!r} cannot be used: {error}; {what} the transform, or set "
                    "laser_source to parameter"
                )
                self._base.diagnostics.say("laser", text, Level.ERROR)
                raise LeftOutError("no transform from the laser") from error
        self._base.diagnostics.clear("laser")
        self._base.diagnostics.say("tilt", mount.tilt_note(frame))
        return mount

    def odometry_at(self, scan: ArrivedScan, times: F64, *, is_first: bool) -> F64 | None:
        """Return the odometry within a sweep; None, reported, if its stamp has none.

        Args:
            scan: waits for it up to ``odometry_wait_s``.
            times: (K,) seconds, from the scan's stamp on.
            is_first: scans without odometry are left out, as there is no map yet.

        Returns:
            (K, 3) poses, or those before the first unknown one.
        """
        store, settings = self.odometry, self._settings
        if store is None:
            return None
        rows: list[F64] = []
        try:
            for time_s in times.tolist():
                frames = settings.odom_frame, settings.base_frame
                rows.append(row_of(store.lookup(*frames, time_s, self._wait_s(scan, store))))
        except TransformError as error:
            if rows:
                text = f"scans are not deskewed, for their odometry ends within the sweep: {error}"
                # Not of a log's last scan alone, after which no odometry comes.
                self._base.diagnostics.say("sweep", text, for_s=SHOWN_S, after_s=ODOMETRY_ALIVE_S)
                return np.array(rows)
            does = "are left out" if is_first else "are matched without it"
            source = f"the topic {self._base.resolved(ODOM_TOPIC)!r}"
            if settings.odometry_source == "tf":
                source = f"the transforms from {settings.base_frame!r} to {settings.odom_frame!r}"
            text = (
                f"no odometry for the scans, which {does}: {error}; check {source}, or set "
                "odometry_source to none"
            )
            self._base.diagnostics.say("odometry", text)
            return None
        self._base.diagnostics.clear("odometry")
        if len(rows) > 1:
            self._base.diagnostics.clear("sweep")
        return np.array(rows)

    def _wait_s(self, scan: ArrivedScan, store: TransformStore) -> float:
        """Return how long a scan may still wait for a store."""
        now_s = time.monotonic()
        heard_s = self._first_s if store.last_s is None else store.last_s
        if now_s - heard_s > ODOMETRY_ALIVE_S:
            return 0.0
        return max(0.0, scan.arrived_s + self._settings.odometry_wait_s - now_s)

    def _take_scan(self, message: Any) -> None:
        self.last_s = time.monotonic()
        self._first_s = self._first_s if self.received else self.last_s
        self.received += 1
        scan = ArrivedScan(message, messages.stamp_s(message), self.last_s)
        before_s = self._gate.newest_s
        passed = self._gate.offer(scan.stamp_s, scan, scan.arrived_s, self._odometry_agrees)
        self.held = self._gate.held
        if before_s is not None:
            if passed.strays:
                self.strays += len(passed.strays)
                stamp_s = passed.strays[-1].stamp_s
                how = "older than" if stamp_s < before_s else "ahead of"
                off = f"{abs(stamp_s - before_s):.3f} s {how} those around it"
                self._last_stray = f"the last has {stamp_s:.3f} s, {off}"
            if passed.items:
                self._name_jump(passed, before_s)
        if passed.jump is not None:
            for store in self._stores:
                store.settle(passed.items[-1].stamp_s)
            if passed.jump.is_back:
                self._on_restart()
        for item in passed.items:
            if dropped := self._on_scan(item):
                self.dropped += len(dropped)
                self._name_dropped()

    def look(self, late: int = 0) -> None:
        """Report several senders, and what was left out for its stamps since the last call.

        ``late``: scans so far whose stamps did not increase.
        """
        is_topic = self._settings.odometry_source == "topic"
        for topic in (SCAN_TOPIC, ODOM_TOPIC) if is_topic else (SCAN_TOPIC,):
            outcome = f"their messages are mixed: end one, or remap (-r {topic}:=NAME)"
            self._base.name_writers(f"writers of {topic}", topic, outcome)
        odometry = 0 if self.odometry is None else self.odometry.strays
        found = self.strays, late, odometry
        parts = (
            f"{counted(self.strays, 'scan')} far from the others ({self._last_stray})",
            f"{counted(late, 'scan')} not newer than the one before",
            f"{counted(odometry, 'transform')} of odometry or others far from the rest",
        )
        text = (
            f"left out for their stamps: {', '.join(itertools.compress(parts, found))}; check the "
            f"clocks of the senders, and that one alone sends {self._base.resolved(SCAN_TOPIC)!r}"
        )
        if any(map(operator.gt, found, self._named)):
            self._base.diagnostics.note("strays", text)
        self._named = found

    def _name_dropped(self) -> None:
        why = "too slow for the scans"
        advice = "take a faster device, fewer scans or a lower --rate"
        is_unheard = self.odometry is not None and self.odometry.last_s is None
        if is_unheard or any(store.is_awaited for store in self._stores):
            why = "scans wait for their odometry or transform"
            advice = "send it sooner, or raise scan_queue of a producer"
        text = f"{why}: the oldest that waits is dropped for each new one; {advice}"
        self._base.diagnostics.note("slow", text)

    def _odometry_agrees(self, before_s: float, after_s: float) -> bool:
        """Whether the odometry has jumped with the scans, or is unknown."""
        odometry = self.odometry
        if odometry is None or odometry.last_s is None:
            return True
        heard_s = odometry.heard_s(self._settings.odom_frame, self._settings.base_frame)
        is_silent = time.monotonic() - odometry.last_s > ODOMETRY_ALIVE_S
        if heard_s is None or is_silent or abs(heard_s - after_s) < abs(heard_s - before_s):
            return True
        text = (
            f"scans jumped {jump_words(after_s - before_s, after_s)} and the odometry did not: "
            "they are left out, and the map stays; check the clocks of both"
        )
        self._base.diagnostics.say("clocks", text, Level.ERROR)
        return False

    def _name_jump(self, passed: Passed[ArrivedScan], before_s: float) -> None:
        diagnostics = self._base.diagnostics
        diagnostics.clear("clocks")
        after_s = passed.items[0].stamp_s
        text = f"scans jumped {jump_words(after_s - before_s, after_s)}"
        if passed.jump is not None and passed.jump.is_back:
            self.jumps_back += 1
            diagnostics.clear("back")
            diagnostics.note("back", f"{text}: a new map starts")
        elif after_s > before_s + FORWARD_JUMP_S:
            diagnostics.note("forward", text)
