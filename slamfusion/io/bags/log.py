"""``BagLog``: the scans of a ROS 1 or ROS 2 bag, with odometry from messages or transforms."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, ScanError
from slamfusion.geometry import F32
from slamfusion.io.bags.odometry import BagFrames
from slamfusion.io.bags.reader import SCAN_TYPES, OpenBag, open_bag, stamp_s
from slamfusion.io.log import NO_SCAN, LogScan, ScanLog
from slamfusion.io.transforms import TILT_MAX_RAD, Mount
from slamfusion.scan import LaserScan

# Number of scans that decide whether there are stamps, and the unit of the ranges.
FIRST_MESSAGES = 20
# If nine of ten readings exceed ``range_max`` by this factor, the unit differs.
OTHER_UNIT = 10.0
# Largest gap between two parts of a sweep, beams.
JOIN_BEAMS = 1.5

NO_STAMP = "no time stamp"
UNREADABLE = "message that cannot be read"


def first_echoes(message: Any) -> F32:
    """Return the ranges of a scan, (N,) metres; of several echoes the first, +inf without any."""
    if message.__msgtype__.endswith("MultiEchoLaserScan"):
        echoes = (beam.echoes for beam in message.ranges)
        return np.array([beam[0] if len(beam) else np.inf for beam in echoes], dtype=np.float32)
    return np.asarray(message.ranges, dtype=np.float32)


def joined_sweeps(scans: Iterable[tuple[int, LaserScan]]) -> Iterator[tuple[int, LaserScan]]:
    """Join sweeps that a laser sends in several messages.

    Scans whose first beam follows the last beam of the scan before belong to one sweep, up to a
    whole turn, with the stamp and number of the first part.
    """
    sweep: tuple[int, LaserScan] | None = None
    for number, scan in scans:
        if sweep is None:
            sweep = number, scan
            continue
        first, part = sweep
        step = part.angle_increment_rad
        gap = scan.angle_min_rad - (part.angle_min_rad + len(part) * step)
        turn = abs(step) * (len(part) + len(scan) - JOIN_BEAMS)
        is_one_laser = (step, part.mount) == (scan.angle_increment_rad, scan.mount)
        if is_one_laser and abs(gap) < JOIN_BEAMS * abs(step) and turn < 2.0 * math.pi:
            sweep = first, replace(part, ranges=np.concatenate((part.ranges, scan.ranges)))
            continue
        yield sweep
        sweep = number, scan
    if sweep is not None:
        yield sweep


class BagLog(ScanLog):
    """The scans of a bag; each iteration reads it as a stream.

    Time is the scan's header stamp. Odometry comes from a nav_msgs/Odometry topic, or else from the
    transforms between ``odom_frame`` and the base frame, interpolated. The laser's mount comes from
    the transforms. Readings follow REP-117 already. ``line`` is the number of the message on its
    topic, from 1. A first pass keeps odometry and transforms in memory.

    Args:
        path: a .bag, .db3 or .mcap file, or a ROS 2 bag's folder.
        config: topics, frames, and ``no_return_m`` as an upper limit of the scans' own.

    Raises:
        LogError: not a readable bag, no laser in it, several topics to choose from, an absent topic
            or frame, or ``rosbags`` is not installed.
    """

    def __init__(self, path: str | Path, config: LogConfig = LogConfig()) -> None:
        super().__init__(path, config)
        self._mounts: dict[str, Mount] = {}
        with open_bag(self.path, self.notes) as bag:
            self._scan_topic = bag.choose_topic(SCAN_TYPES, config.scan_topic, "--scan-topic")
            first = self._first_messages(bag)
            laser_frame = first[0].header.frame_id.lstrip("/")
            frames = BagFrames(bag, config, self._scan_topic, laser_frame)
            self._odometry = frames.odometry()
        # One or a few of many scans may lack a stamp.
        self._uses_record_time = not any(stamp_s(message) for message in first)
        self._tree, self._base_frame = frames.tree, frames.base_frame(self._odometry)
        if self._odometry is None and config.odom_topic != "none":
            self.notes.append(
                "no odometry: neither nav_msgs/Odometry nor transforms from "
                f"{config.odom_frame!r} to the robot; scans come without"
            )
        if self._uses_record_time:
            self.notes.append("the scans have no time stamps; used instead: when each was recorded")
        self._track = None if self._odometry is None else self._odometry.track

    def _scans(self) -> Iterator[LogScan]:
        is_any_used, out_s = False, []
        with open_bag(self.path, self.notes) as bag:
            for number, scan in joined_sweeps(self._sweeps(bag)):
                pose = None if self._odometry is None else self._odometry.at(scan.stamp_s)
                if isinstance(pose, str):
                    self.skips.add(pose, number)
                    out_s.append(scan.stamp_s)
                else:
                    is_any_used = True
                    yield LogScan(scan, pose, number)
        if out_s and not is_any_used and self._odometry is not None:
            first_s, last_s = self._odometry.stamps_s[[0, -1]].tolist()
            raise LogError(
                f"{self.path}: no scan lies in the time of the odometry: scans from {out_s[0]:.3f} "
                f"s to {out_s[-1]:.3f} s, odometry from {first_s:.3f} s to {last_s:.3f} s, "
                f"{first_s - out_s[0]:+.3f} s later: two clocks? record both with one, or read the "
                "scans alone with --odom-topic none"
            )

    def _sweeps(self, bag: OpenBag) -> Iterator[tuple[int, LaserScan]]:
        """Yield the scans with the numbers of their messages; others are counted."""
        total = max(bag.count(self._scan_topic), 1)
        for number, (_, recorded_ns, message) in enumerate(bag.messages(self._scan_topic), start=1):
            self.fraction_read = min(number / total, 1.0)
            if message is None:
                self.skips.add(UNREADABLE, number)
                continue
            time_s = recorded_ns * 1e-9 if self._uses_record_time else stamp_s(message)
            if time_s == 0.0:
                self.skips.add(NO_STAMP, number)
                continue
            try:
                scan = self._scan(message, time_s)
            except ScanError as error:
                self.skips.add(NO_SCAN, number)
                if str(error) not in self.notes and self.skips.counts[NO_SCAN] == 1:
                    self.notes.append(str(error))
            else:
                yield number, scan

    def _first_messages(self, bag: OpenBag) -> list[Any]:
        readable = (message for _, _, message in bag.messages(self._scan_topic) if message)
        first = list(islice(readable, FIRST_MESSAGES))
        if not first:
            raise LogError(
                f"{self.path}: none of the {bag.count(self._scan_topic)} messages on "
                f"{self._scan_topic} can be read as a scan; check that its message type is the "
                "standard one"
            )
        ranges = np.concatenate([first_echoes(message) for message in first])
        ranges = ranges[np.isfinite(ranges) & (ranges > 0.0)]
        limit_m = max(float(message.range_max) for message in first)
        if limit_m > 0.0 and len(ranges) and np.percentile(ranges, 10.0) > OTHER_UNIT * limit_m:
            raise LogError(
                f"{self.path}: the ranges on {self._scan_topic} have a median of "
                f"{np.median(ranges):.0f} with a range_max of {limit_m:g} m: millimetres? wanted "
                "metres; correct the driver, or convert the bag"
            )
        return first

    def _scan(self, message: Any, time_s: float) -> LaserScan:
        mount = self._mount(message.header.frame_id.lstrip("/"), time_s)
        given_m = self._config.no_return_m
        limit_m = math.inf if given_m is None else given_m
        return mount.scan(message, time_s, first_echoes(message), limit_m)

    def _mount(self, frame: str, time_s: float) -> Mount:
        """Return the mount of a laser frame; cached if static."""
        if frame in self._mounts:
            return self._mounts[frame]
        if not self._tree.is_connected(self._base_frame, frame):
            self.notes.append(
                f"no transforms from {self._base_frame!r} to the laser's frame {frame!r}; taken: "
                "the laser sits upright on the robot's origin and looks ahead"
            )
            mount = self._mounts[frame] = Mount()
            return mount
        mount = Mount.of(self._tree.sample(self._base_frame, frame, time_s)[0])
        if mount.tilt_rad > TILT_MAX_RAD:
            raise LogError(
                f"{self.path}: the laser {frame!r} is tilted by {math.degrees(mount.tilt_rad):.0f} "
                "degrees, wanted one that lies level; choose another with --scan-topic"
            )
        if self._tree.is_constant(self._base_frame, frame):
            self._mounts[frame] = mount
            if (note := mount.tilt_note(frame)) is not None:
                self.notes.append(note)
        return mount
