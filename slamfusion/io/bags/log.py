"""``BagLog``: the scans of a ROS 1 or ROS 2 bag, with odometry from messages or transforms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, ScanError
from slamfusion.io.bags.odometry import OdometrySurvey
from slamfusion.io.bags.reader import OpenBag, open_bag, stamp_s
from slamfusion.io.log import Continuity, LogScan, Skips
from slamfusion.io.transforms import TILT_MAX_RAD, Mount
from slamfusion.scan import LaserScan

_DEFAULT_CONFIG = LogConfig()

_SCAN_TYPES = ("sensor_msgs/msg/LaserScan",)
# A laser tilted by more is worth a word.
_TILT_NOTED_RAD = math.radians(5.0)

UNREADABLE = "message that cannot be read"
NO_SCAN = "angles or ranges that cannot be a scan"


class BagLog:
    """The scans of a bag; each iteration reads from the start (see ``ScanLog``).

    Time is the scan's header stamp. Odometry comes from a nav_msgs/Odometry topic or, where there
    is none, from the transforms between ``odom_frame`` and the base frame, interpolated at the
    scan's time. The laser's mount comes from the transforms. Readings stay as they are: ROS
    already has REP-117. ``line`` is the number of the message on its topic, from 1.

    A first pass keeps the odometry and the transforms in memory (not the scans): some 60 bytes a
    message, less while the robot rests.

    Args:
        path: a .bag, .db3 or .mcap file, or a ROS 2 bag's folder.
        config: topics, frames, and ``no_return_m`` as an upper limit of the scans' own.

    Attributes:
        path, skips, warnings, notes, has_stamps, fraction_read: see ``ScanLog``.

    Raises:
        LogError: not a readable bag, no laser in it, several topics to choose from, a topic or
            frame asked for that is not there, or ``rosbags`` is not installed.
    """

    def __init__(self, path: str | Path, config: LogConfig = _DEFAULT_CONFIG) -> None:
        self.path = Path(path)
        self.skips = Skips()
        self.warnings = Skips()
        self.notes: list[str] = []
        self.has_stamps = True
        self.fraction_read = 0.0
        self._config = config
        self._mounts: dict[str, Mount] = {}
        survey = OdometrySurvey(self.path, config, notes=self.notes)
        with open_bag(self.path) as bag:
            self._scan_topic = bag.choose_topic(_SCAN_TYPES, config.scan_topic, "scan_topic")
            survey.read(bag)
            self._uses_record_time = self._is_without_stamps(bag)
        survey.check_frames()
        self._tree, self._odometry = survey.tree, survey.odometry
        self._base_frame = survey.base_frame
        if self._odometry is None:
            self.notes.append(
                "no odometry: neither nav_msgs/Odometry nor transforms from "
                f"{config.odom_frame!r} to the robot; scans come without"
            )
        if self._uses_record_time:
            self.notes.append("the scans have no time stamps; used instead: when each was recorded")

    def __iter__(self) -> Iterator[LogScan]:
        """Yield the scans; stamps strictly increase."""
        self.skips, self.warnings, self.fraction_read = Skips(), Skips(), 0.0
        continuity = Continuity(self.skips, self.warnings, self._config.laser)
        with open_bag(self.path) as bag:
            total = max(bag.count(self._scan_topic), 1)
            for number, (_, recorded_ns, message) in enumerate(
                bag.messages(self._scan_topic), start=1
            ):
                self.fraction_read = min(number / total, 1.0)
                if message is None:
                    self.skips.add(UNREADABLE, number)
                    continue
                time_s = recorded_ns * 1e-9 if self._uses_record_time else stamp_s(message)
                try:
                    scan = self._scan(message, time_s)
                except ScanError:
                    self.skips.add(NO_SCAN, number)
                    continue
                pose = None if self._odometry is None else self._odometry.at(time_s)
                if isinstance(pose, str):
                    self.skips.add(pose, number)
                else:
                    yield from continuity.passed(LogScan(scan, pose, number))
            yield from continuity.rest()
        self.fraction_read = 1.0

    def _is_without_stamps(self, bag: OpenBag) -> bool:
        """Whether the first scan has no time of its own."""
        for _, _, message in bag.messages(self._scan_topic):
            if message is not None:
                return stamp_s(message) == 0.0
        text = f"{self.path}: no readable scan on {self._scan_topic}; record the laser again"
        raise LogError(text)

    def _scan(self, message: Any, time_s: float) -> LaserScan:
        """Return the sweep of a message, its angles counter-clockwise seen from above."""
        mount = self._mount(message.header.frame_id.lstrip("/"), time_s)
        turn = -1.0 if mount.is_flipped else 1.0
        limit_m = float(message.range_max)
        if self._config.no_return_m is not None:
            limit_m = min(limit_m, self._config.no_return_m)
        return LaserScan(
            stamp_s=time_s,
            ranges=np.asarray(message.ranges, dtype=np.float32),
            angle_min_rad=turn * float(message.angle_min),
            angle_increment_rad=turn * float(message.angle_increment),
            range_min_m=max(float(message.range_min), 0.0),
            range_max_m=limit_m,
            mount=mount.pose,
        )

    def _mount(self, frame: str, time_s: float) -> Mount:
        """Return where a laser frame sits on the robot; kept when it cannot move."""
        if frame in self._mounts:
            return self._mounts[frame]
        if frame == self._base_frame:
            mount = self._mounts[frame] = Mount()
            return mount
        if not self._tree.is_connected(self._base_frame, frame):
            self.notes.append(
                f"no transforms from {self._base_frame!r} to the laser's frame {frame!r}; taken: "
                "the laser sits upright on the robot's origin and looks ahead"
            )
            mount = self._mounts[frame] = Mount()
            return mount
        is_static = self._tree.is_constant(self._base_frame, frame)
        pose = self._tree.sample(self._base_frame, frame, time_s)[0]
        mount = Mount.of(pose, is_static=is_static)
        if mount.tilt_rad > TILT_MAX_RAD:
            message = (
                f"{self.path}: the laser {frame!r} is tilted by {math.degrees(mount.tilt_rad):.0f} "
                "degrees, wanted one that lies level; choose another with scan_topic"
            )
            raise LogError(message)
        if is_static:
            self._mounts[frame] = mount
            if mount.tilt_rad > _TILT_NOTED_RAD:
                self.notes.append(
                    f"the laser {frame!r} is tilted by {math.degrees(mount.tilt_rad):.0f} degrees; "
                    "its ranges are taken as level"
                )
        return mount
