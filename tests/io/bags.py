"""Bags written for tests, of every kind, through the library that the reader uses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags comes with the bags extra")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
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
        return self.add(stamp_s, topic, SCAN, frame=frame, **values)

    def odometry(
        self,
        stamp_s: float,
        pose: tuple[float, float, float],
        topic: str = "/odom",
        child: str = "base_link",
    ) -> Bag:
        return self.add(stamp_s, topic, ODOMETRY, frame="odom", pose=pose, child=child)

    def transform(
        self,
        stamp_s: float,
        parent: str,
        child: str,
        move: tuple[float, float, float] = (0.0, 0.0, 0.0),
        turn: Quaternion = LEVEL,
        topic: str = "/tf",
    ) -> Bag:
        return self.add(stamp_s, topic, TF, frame=parent, child=child, move=move, turn=turn)

    def add(self, time_s: float, topic: str, kind: str, **values: Any) -> Bag:
        self.messages.append((time_s, topic, kind, values))
        return self

    def write(
        self, folder: Path, kind: str = "mcap", version: int = 9, packed: str | None = None
    ) -> Path:
        """Write the bag as one of ``KINDS`` and return what to open.

        Args:
            packed: what of a ROS 2 bag is packed with zstd: STORAGE, FILE or MESSAGE.
        """
        is_ros1 = kind.startswith("ros1")
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
        if TF not in store.types:  # ROS 1 keeps it outside its common messages
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        path = folder / ("a.bag" if is_ros1 else f"bag-{packed or kind}")
        if is_ros1:
            writer: Any = Writer1(path)
            if "-" in kind:
                writer.set_compression(Writer1.CompressionFormat[kind.split("-")[1].upper()])
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=version, storage_plugin=plugin)
            if packed is not None:
                writer.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
        serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            # A bag is in the order of recording; a stamp of 0 was recorded all the same.
            for number, (time_s, topic, name, values) in enumerate(self.messages):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=store)
                message = message_of(store.types, name, time_s, number if is_ros1 else None, values)
                recorded_ns = round((time_s if time_s > 0.0 else 5.0 + number) * 1e9)
                writer.write(connections[topic], recorded_ns, serialize(message, name))
        return path


def message_of(
    types: Any, kind: str, time_s: float, sequence: int | None, values: dict[str, Any]
) -> Any:
    """Return a message of ``types``; a ``sequence`` number is in the headers of ROS 1 alone."""

    def made(name: str, **fields: Any) -> Any:
        return types[name if "/" in name else f"geometry_msgs/msg/{name}"](**fields)

    def of_axes(name: str, numbers: Sequence[float]) -> Any:
        return made(name, **dict(zip("xyzw", numbers, strict=False)))

    if kind == TEXT:
        return made(TEXT, **values)
    nanoseconds = round(time_s * 1e9)
    header = made(
        "std_msgs/msg/Header",
        stamp=made(
            "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        ),
        frame_id=values.get("frame", "map"),
        **({} if sequence is None else {"seq": sequence}),
    )
    if kind == SCAN:
        return made(
            SCAN, header=header, **{key: own for key, own in values.items() if key != "frame"}
        )
    if kind == TF:
        move, turn = of_axes("Vector3", values["move"]), of_axes("Quaternion", values["turn"])
        motion = made("Transform", translation=move, rotation=turn)
        child = values["child"]
        stamped = made("TransformStamped", header=header, child_frame_id=child, transform=motion)
        return made(TF, transforms=[stamped])
    x, y, yaw_rad = values["pose"]
    place, turn = of_axes("Point", (x, y, 0.0)), of_axes("Quaternion", yaw_quaternion(yaw_rad))
    pose = made("Pose", position=place, orientation=turn)
    if kind == POSE:
        return made(POSE, header=header, pose=pose)
    covariance = np.zeros(36)
    pose = made("PoseWithCovariance", pose=pose, covariance=covariance)
    if kind == LOCALIZED:
        return made(LOCALIZED, header=header, pose=pose)
    still = of_axes("Vector3", (0.0, 0.0, 0.0))
    twist = made("Twist", linear=still, angular=still)
    twist = made("TwistWithCovariance", twist=twist, covariance=covariance)
    child = values.get("child", "base_link")
    return made(ODOMETRY, header=header, child_frame_id=child, pose=pose, twist=twist)
