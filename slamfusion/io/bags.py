"""``BagLog``: the laser scans of a ROS 1 or ROS 2 bag, with odometry from messages or transforms.

Bags are read through ``rosbags``, which needs no ROS; it comes with the extra ``bags``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, ScanError, SlamFusionError
from slamfusion.geometry import Pose2, compose_poses, wrap_angle
from slamfusion.io.log import FARTHEST_M, Continuity, LogScan, Skips
from slamfusion.io.transforms import (
    HOLD_S,
    REACH_S,
    TILT_MAX_RAD,
    Mount,
    TransformTree,
    plan_poses,
)
from slamfusion.io.tum import quaternion_yaw_rad
from slamfusion.scan import LaserScan

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

__all__ = ["BagLog"]

_DEFAULT_CONFIG = LogConfig()

Floats = npt.NDArray[np.float64]

_SCAN_TYPES = ("sensor_msgs/msg/LaserScan",)
_ODOMETRY_TYPES = ("nav_msgs/msg/Odometry",)
_TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_BASE_FRAMES = ("base_footprint", "base_link")

# A laser tilted by more is worth a word.
_TILT_NOTED_RAD = math.radians(5.0)

UNREADABLE = "message that cannot be read"
NO_SCAN = "angles or ranges that cannot be a scan"
BEFORE_ODOMETRY = "laser before odometry"
AFTER_ODOMETRY = "laser after odometry"
NO_ODOMETRY = f"no odometry within {REACH_S:g} s of the laser"


@dataclass(frozen=True)
class _Odometry:
    """Poses (N, 3) of the base frame in the odometry frame at increasing stamps (N,)."""

    stamps_s: Floats
    poses: Floats
    base_frame: str

    def at(self, stamp_s: float) -> Pose2 | str:
        """Return the pose at a time, linear between neighbours, or why there is none."""
        if stamp_s < self.stamps_s[0] - HOLD_S:
            return BEFORE_ODOMETRY
        if stamp_s > self.stamps_s[-1] + HOLD_S:
            return AFTER_ODOMETRY
        after = int(np.searchsorted(self.stamps_s, stamp_s))
        if after in {0, len(self.stamps_s)}:
            return Pose2(*self.poses[min(after, len(self.stamps_s) - 1)].tolist())
        since_s = stamp_s - float(self.stamps_s[after - 1])
        until_s = float(self.stamps_s[after]) - stamp_s
        if min(since_s, until_s) > REACH_S:
            return NO_ODOMETRY
        first, second = self.poses[after - 1].tolist(), self.poses[after].tolist()
        share = since_s / (since_s + until_s)
        return Pose2(
            first[0] + share * (second[0] - first[0]),
            first[1] + share * (second[1] - first[1]),
            wrap_angle(first[2] + share * wrap_angle(second[2] - first[2])),
        )


class BagLog:
    """The scans of a bag; each iteration starts anew (see ``ScanLog``).

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
        self._tree = TransformTree()
        with self._open() as reader:
            self._scan_topic = self._choose(reader, _SCAN_TYPES, config.scan_topic, "scan_topic")
            self._read_transforms(reader)
            self._odometry = self._odometry_of(reader)
            self._uses_record_time = self._is_without_stamps(reader)
        self._base_frame = self._find_base_frame()
        self._check_frames()
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
        continuity = Continuity(self.skips, self.warnings)
        with self._open() as reader:
            connections = self._connections(reader, self._scan_topic)
            total = max(sum(item.msgcount for item in connections), 1)
            for number, (connection, recorded_ns, raw) in enumerate(
                reader.messages(connections), start=1
            ):
                self.fraction_read = min(number / total, 1.0)
                message = _deserialized(reader, connection, raw)
                if message is None:
                    self.skips.add(UNREADABLE, number)
                    continue
                stamp_s = recorded_ns * 1e-9 if self._uses_record_time else _stamp_s(message)
                try:
                    scan = self._scan(message, stamp_s)
                except ScanError:
                    self.skips.add(NO_SCAN, number)
                    continue
                pose = None if self._odometry is None else self._odometry.at(stamp_s)
                if isinstance(pose, str):
                    self.skips.add(pose, number)
                else:
                    yield from continuity.passed(LogScan(scan, pose, number))
            yield from continuity.rest()
        self.fraction_read = 1.0

    # --- opening ---------------------------------------------------------------------------------

    @contextmanager
    def _open(self) -> Iterator[AnyReader]:
        """Open the bag; whatever the library stumbles over is damage of the bag."""
        try:
            from rosbags.highlevel import AnyReader  # noqa: PLC0415  (an extra, and slow to load)
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
        except ImportError as error:
            message = f"{self.path}: reading bags needs rosbags; pip install 'slamfusion[bags]'"
            raise LogError(message) from error
        try:
            # Old ROS 2 bags do not carry their message definitions.
            store = get_typestore(Stores.LATEST)
            with AnyReader(self._files(), default_typestore=store) as reader:
                yield reader
        except (SlamFusionError, PermissionError):
            raise
        except FileNotFoundError:
            if not self.path.exists():
                raise
            message = f"{self.path}: not a whole bag: a file of it is missing; copy all of it"
            raise LogError(message) from None
        except Exception as error:
            reason = textwrap.shorten(str(error), 120) or type(error).__name__
            message = (
                f"{self.path}: cannot be read as a bag ({reason}); check that it was recorded and "
                "copied to its end"
            )
            raise LogError(message) from error

    def _files(self) -> list[Path]:
        """Return what to open: the path itself, or the storage files of a folder without index."""
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            for pattern in ("*.mcap", "*.db3"):
                files = sorted(self.path.glob(pattern))
                if files:
                    return files
        return [self.path]

    def _choose(
        self, reader: AnyReader, types: tuple[str, ...], wanted: str | None, key: str
    ) -> str:
        """Return the topic that was asked for, or the only one of its type."""
        topics = sorted({item.topic for item in reader.connections if item.msgtype in types})
        kind = types[0].replace("/msg/", "/")
        if wanted is not None:
            for topic in topics:
                if topic.lstrip("/") == wanted.lstrip("/"):
                    return topic
            found = ", ".join(topics) or "none"
            message = (
                f"{self.path}: no {kind} topic {wanted!r} in it; found {found}; change {key} or "
                "leave it out"
            )
            raise LogError(message)
        if not topics:
            others = ", ".join(sorted({item.topic for item in reader.connections})) or "nothing"
            message = (
                f"{self.path}: no laser in it: wanted a {kind} topic, found {others}; give a bag "
                "that recorded one"
            )
            raise LogError(message)
        if len(topics) > 1:
            message = (
                f"{self.path}: several {kind} topics: {', '.join(topics)}; choose one with {key}"
            )
            raise LogError(message)
        return topics[0]

    @staticmethod
    def _connections(reader: AnyReader, topic: str) -> list[Connection]:
        return [item for item in reader.connections if item.topic == topic]

    # --- the first pass --------------------------------------------------------------------------

    def _read_transforms(self, reader: AnyReader) -> None:
        """Take in every transform of the bag."""
        connections = [item for item in reader.connections if item.msgtype in _TRANSFORM_TYPES]
        unusable = 0
        for connection, _, raw in reader.messages(connections) if connections else ():
            message = _deserialized(reader, connection, raw)
            is_static = connection.topic.endswith("tf_static")
            for item in () if message is None else message.transforms:
                move, turn = item.transform.translation, item.transform.rotation
                row = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
                unusable += not self._tree.add(
                    item.header.frame_id,
                    item.child_frame_id,
                    _stamp_s(item),
                    row,
                    is_static=is_static,
                )
            unusable += message is None
        if unusable:
            self.notes.append(
                f"{unusable} transforms are not finite, no rotation, or not of two frames; left out"
            )

    def _odometry_of(self, reader: AnyReader) -> _Odometry | None:
        """Return the odometry by messages, else by transforms, else None."""
        config = self._config
        if config.odom_topic is not None or any(
            item.msgtype in _ODOMETRY_TYPES and item.msgcount for item in reader.connections
        ):
            topic = self._choose(reader, _ODOMETRY_TYPES, config.odom_topic, "odom_topic")
            odometry = self._odometry_by_messages(reader, topic)
            if odometry is not None:
                return odometry
            self.notes.append(f"no usable odometry on {topic}; the transforms are used")
        for base_frame in (config.base_frame,) if config.base_frame else _BASE_FRAMES:
            odometry = self._odometry_by_transforms(base_frame)
            if odometry is not None:
                return odometry
        return None

    def _odometry_by_messages(self, reader: AnyReader, topic: str) -> _Odometry | None:
        """Return the poses of an odometry topic, in the order of time."""
        stamps, poses, base_frame, unusable = [], [], "", 0
        for connection, _, raw in reader.messages(self._connections(reader, topic)):
            message = _deserialized(reader, connection, raw)
            if message is None:
                unusable += 1
                continue
            place, turn = message.pose.pose.position, message.pose.pose.orientation
            row = (place.x, place.y, quaternion_yaw_rad(turn.x, turn.y, turn.z, turn.w))
            # NaN is no less than any number.
            if not (
                abs(row[0]) <= FARTHEST_M and abs(row[1]) <= FARTHEST_M and math.isfinite(row[2])
            ):
                unusable += 1
                continue
            base_frame = base_frame or message.child_frame_id.lstrip("/")
            stamps.append(_stamp_s(message))
            poses.append(row)
        if unusable:
            self.notes.append(f"{unusable} messages on {topic} are no finite pose; left out")
        if not stamps:
            return None
        times, first = np.unique(np.array(stamps), return_index=True)
        rows = np.array(poses)[first]
        wanted = self._config.base_frame
        if wanted is None or wanted.lstrip("/") == base_frame:
            return _Odometry(times, rows, base_frame)
        return _Odometry(times, self._moved_to(rows, times, base_frame, wanted), wanted.lstrip("/"))

    def _moved_to(self, poses: Floats, stamps_s: Floats, base_frame: str, wanted: str) -> Floats:
        """Return the poses of another frame on the robot."""
        if not self._tree.is_connected(base_frame, wanted):
            raise LogError(self._no_way(base_frame, wanted))
        return compose_poses(poses, plan_poses(self._tree.sample(base_frame, wanted, stamps_s)))

    def _no_way(self, base_frame: str, wanted: str) -> str:
        known = ", ".join(sorted(self._tree.frames)) or "none"
        return (
            f"{self.path}: no transforms from {base_frame!r} to base_frame {wanted!r}; frames in "
            f"it: {known}; change base_frame or leave it out"
        )

    def _odometry_by_transforms(self, base_frame: str) -> _Odometry | None:
        """Return the poses of a frame in the odometry frame, at the times they were sent."""
        frame = base_frame.lstrip("/")
        if not self._tree.is_connected(self._config.odom_frame, frame):
            return None
        stamps_s = self._tree.change_stamps_s(self._config.odom_frame, frame)
        if not stamps_s.size:
            return None
        poses = plan_poses(self._tree.sample(self._config.odom_frame, frame, stamps_s))
        return _Odometry(stamps_s, poses, frame)

    def _is_without_stamps(self, reader: AnyReader) -> bool:
        """Whether the first scan has no time of its own."""
        for connection, _, raw in reader.messages(self._connections(reader, self._scan_topic)):
            message = _deserialized(reader, connection, raw)
            if message is not None:
                return _stamp_s(message) == 0.0
        message = f"{self.path}: no readable scan on {self._scan_topic}; record the laser again"
        raise LogError(message)

    def _find_base_frame(self) -> str:
        """Return the frame whose pose the odometry is; empty where nothing says it."""
        if self._odometry is not None and self._odometry.base_frame:
            return self._odometry.base_frame
        if self._config.base_frame is not None:
            return self._config.base_frame.lstrip("/")
        known = self._tree.frames
        return next((frame for frame in _BASE_FRAMES if frame in known), "")

    def _check_frames(self) -> None:
        """Refuse a base frame that was asked for and is nowhere."""
        wanted = self._config.base_frame
        if wanted is None or wanted.lstrip("/") in self._tree.frames:
            return
        if self._odometry is None or self._odometry.base_frame != wanted.lstrip("/"):
            raise LogError(self._no_way(self._config.odom_frame, wanted))

    # --- scans -----------------------------------------------------------------------------------

    def _scan(self, message: Any, stamp_s: float) -> LaserScan:
        """Return the sweep of a message, its angles counter-clockwise seen from above."""
        mount = self._mount(message.header.frame_id.lstrip("/"), stamp_s)
        turn = -1.0 if mount.is_flipped else 1.0
        limit_m = float(message.range_max)
        if self._config.no_return_m is not None:
            limit_m = min(limit_m, self._config.no_return_m)
        return LaserScan(
            stamp_s=stamp_s,
            ranges=np.asarray(message.ranges, dtype=np.float32),
            angle_min_rad=turn * float(message.angle_min),
            angle_increment_rad=turn * float(message.angle_increment),
            range_min_m=max(float(message.range_min), 0.0),
            range_max_m=limit_m,
            mount=mount.pose,
        )

    def _mount(self, frame: str, stamp_s: float) -> Mount:
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
        pose = self._tree.sample(self._base_frame, frame, stamp_s)[0]
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


def _deserialized(reader: AnyReader, connection: Connection, raw: bytes) -> Any:
    """Return the message, or None when its bytes are none."""
    try:
        return reader.deserialize(raw, connection.msgtype)
    except Exception:  # noqa: BLE001  (damaged bytes fail in many ways; the caller counts them)
        return None


def _stamp_s(message: Any) -> float:
    """Return the time in a message's header, seconds."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec * 1e-9)
