"""Bags written for tests, of every kind, through the library that the reader uses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags comes with the bags extra")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SCAN, ODOMETRY, TF = (
    "sensor_msgs/msg/LaserScan",
    "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage",
)
POSE = "geometry_msgs/msg/PoseStamped"
LOCALIZED = "geometry_msgs/msg/PoseWithCovarianceStamped"
TEXT = "std_msgs/msg/String"
KINDS = ("ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "mcap")
Quaternion = tuple[float, float, float, float]
LEVEL: Quaternion = (0.0, 0.0, 0.0, 1.0)
UPSIDE_DOWN: Quaternion = (1.0, 0.0, 0.0, 0.0)


def yaw_quaternion(yaw_rad: float) -> Quaternion:
    return (0.0, 0.0, math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0))


@dataclass
class Bag:
    """Messages to be written; times are seconds."""

    messages: list[tuple[float, str, str, dict[str, Any]]] = field(default_factory=list)

    def scan(
        self,
        stamp_s: float,
        ranges: Any = (1.0, 2.0, 3.0),
        topic: str = "/scan",
        frame: str = "laser",
        **fields: float,
    ) -> Bag:
        values = {
            "angle_min": -0.5,
            "angle_max": 0.5,
            "angle_increment": 0.5,
            "time_increment": 0.0,
            "scan_time": 0.1,
            "range_min": 0.1,
            "range_max": 10.0,
            "ranges": np.array(ranges, np.float32),
            "intensities": np.zeros(0, np.float32),
            **fields,
        }
        return self.add(stamp_s, topic, SCAN, stamp_s=stamp_s, frame=frame, **values)

    def odometry(
        self,
        stamp_s: float,
        pose: tuple[float, float, float],
        topic: str = "/odom",
        child: str = "base_link",
    ) -> Bag:
        return self.add(stamp_s, topic, ODOMETRY, stamp_s=stamp_s, pose=pose, child=child)

    def transform(
        self,
        stamp_s: float,
        parent: str,
        child: str,
        move: tuple[float, float, float] = (0.0, 0.0, 0.0),
        turn: Quaternion = LEVEL,
        topic: str = "/tf",
    ) -> Bag:
        return self.add(
            stamp_s, topic, TF, stamp_s=stamp_s, parent=parent, child=child, move=move, turn=turn
        )

    def add(self, time_s: float, topic: str, kind: str, **values: Any) -> Bag:
        self.messages.append((time_s, topic, kind, values))
        return self

    def write(self, folder: Path, kind: str = "mcap", version: int = 9) -> Path:
        """Write the bag as one of ``KINDS`` and return what to open."""
        is_ros1 = kind.startswith("ros1")
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
        if TF not in store.types:  # ROS 1 keeps it outside its common messages
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        path = folder / ("a.bag" if is_ros1 else f"bag-{kind}")
        if is_ros1:
            writer: Any = Writer1(path)
            if "-" in kind:
                writer.set_compression(Writer1.CompressionFormat[kind.split("-")[1].upper()])
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=version, storage_plugin=plugin)
        serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            # A bag is in the order of recording; a stamp of 0 was recorded all the same.
            for number, (time_s, topic, name, values) in enumerate(self.messages):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=store)
                message = MAKERS[name](store.types, is_ros1=is_ros1, number=number, **values)
                recorded_ns = round((time_s if time_s > 0.0 else 5.0 + number) * 1e9)
                writer.write(connections[topic], recorded_ns, serialize(message, name))
        return path


def _header(types: Any, stamp_s: float, frame: str, *, is_ros1: bool, number: int) -> Any:
    nanoseconds = round(stamp_s * 1e9)
    time = types["builtin_interfaces/msg/Time"](
        sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
    )
    extra = {"seq": number} if is_ros1 else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **extra)


def _scan(
    types: Any, *, stamp_s: float, frame: str, is_ros1: bool, number: int, **values: Any
) -> Any:
    header = _header(types, stamp_s, frame, is_ros1=is_ros1, number=number)
    return types[SCAN](header=header, **values)


def _pose(types: Any, pose: tuple[float, float, float]) -> Any:
    geometry = "geometry_msgs/msg"
    x, y, z, w = yaw_quaternion(pose[2])
    return types[f"{geometry}/Pose"](
        position=types[f"{geometry}/Point"](x=pose[0], y=pose[1], z=0.0),
        orientation=types[f"{geometry}/Quaternion"](x=x, y=y, z=z, w=w),
    )


def _pose_stamped(
    types: Any, *, stamp_s: float, pose: tuple[float, float, float], is_ros1: bool, number: int
) -> Any:
    header = _header(types, stamp_s, "map", is_ros1=is_ros1, number=number)
    return types[POSE](header=header, pose=_pose(types, pose))


def _pose_with_covariance(
    types: Any, *, stamp_s: float, pose: tuple[float, float, float], is_ros1: bool, number: int
) -> Any:
    kind = types["geometry_msgs/msg/PoseWithCovariance"]
    place = kind(pose=_pose(types, pose), covariance=np.zeros(36))
    header = _header(types, stamp_s, "map", is_ros1=is_ros1, number=number)
    return types[LOCALIZED](header=header, pose=place)


def _text(types: Any, *, data: str, is_ros1: bool, number: int) -> Any:
    del is_ros1, number
    return types[TEXT](data=data)


def _odometry(
    types: Any,
    *,
    stamp_s: float,
    pose: tuple[float, float, float],
    child: str,
    is_ros1: bool,
    number: int,
) -> Any:
    geometry = "geometry_msgs/msg"
    vector, covariance = types[f"{geometry}/Vector3"](x=0.0, y=0.0, z=0.0), np.zeros(36)
    place = _pose(types, pose)
    twist = types[f"{geometry}/Twist"](linear=vector, angular=vector)
    return types[ODOMETRY](
        header=_header(types, stamp_s, "odom", is_ros1=is_ros1, number=number),
        child_frame_id=child,
        pose=types[f"{geometry}/PoseWithCovariance"](pose=place, covariance=covariance),
        twist=types[f"{geometry}/TwistWithCovariance"](twist=twist, covariance=covariance),
    )


def _transform(
    types: Any,
    *,
    stamp_s: float,
    parent: str,
    child: str,
    move: tuple[float, float, float],
    turn: Quaternion,
    is_ros1: bool,
    number: int,
) -> Any:
    geometry = "geometry_msgs/msg"
    x, y, z, w = turn
    stamped = types[f"{geometry}/TransformStamped"](
        header=_header(types, stamp_s, parent, is_ros1=is_ros1, number=number),
        child_frame_id=child,
        transform=types[f"{geometry}/Transform"](
            translation=types[f"{geometry}/Vector3"](x=move[0], y=move[1], z=move[2]),
            rotation=types[f"{geometry}/Quaternion"](x=x, y=y, z=z, w=w),
        ),
    )
    return types[TF](transforms=[stamped])


MAKERS: dict[str, Any] = {
    SCAN: _scan,
    ODOMETRY: _odometry,
    TF: _transform,
    POSE: _pose_stamped,
    LOCALIZED: _pose_with_covariance,
    TEXT: _text,
}
