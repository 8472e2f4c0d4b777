"""A short drive as a log and as messages, and what a producer makes of it without ROS."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from slamfusion.compute import open_device
from slamfusion.config import RunConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.io import LogScan, open_log
from slamfusion.io.carmen import write_carmen
from slamfusion.ros import messages
from slamfusion.ros.frames import TransformStore
from slamfusion.slam.registry import make_producer, with_settings
from tests.slam.drives import drive

FIRST_S = 100.0


def scans(count: int = 40, *, mount: Pose2 = IDENTITY, first_s: float = FIRST_S) -> list[LogScan]:
    """Return a drive through the drawn flat at 10 Hz, whose odometry turns a little too much."""
    driven, _ = drive(count, mount=mount, turn_bias=0.003)
    return [
        dataclasses.replace(
            item, scan=dataclasses.replace(item.scan, stamp_s=first_s + item.scan.stamp_s)
        )
        for item in driven
    ]


def write_log(folder: Path, count: int = 40, *, mount: Pose2 = IDENTITY) -> Path:
    """Write the drive as a log."""
    path = folder / "drive.log"
    write_carmen(path, scans(count, mount=mount))
    return path


def sent(message: Any) -> Any:
    """Return a message as it arrives: float32 is rounded on the way, not before."""
    return deserialize_message(serialize_message(message), type(message))


def as_sent(items: Iterable[LogScan]) -> Iterator[LogScan]:
    """Yield scans as they are after their way through messages: angles are float32 there."""
    store = TransformStore()
    for item in items:
        message = sent(messages.scan_to_message(item.scan, "laser"))
        stamp = message.header.stamp
        pairs = [(item.scan.mount, "base", "laser")]
        if item.odometry is not None:
            pairs.append((item.odometry, "odom", "base"))
        store.add([messages.transform_to_message(*pair, stamp) for pair in pairs])
        time_s = messages.stamp_s(stamp)
        scan = messages.scan_from_message(message, store.mount("base", "laser", time_s))
        known = item.odometry is not None
        odometry = store.lookup("odom", "base", time_s) if known else None
        yield LogScan(scan, odometry, item.line)


def offline(kind: str, items: Iterable[LogScan], **settings: Any) -> OccupancyGrid:
    """Return the map that a producer makes of scans.

    Args:
        kind: the producer.
        items: its scans.
        settings: of the producer.
    """
    producer = make_producer(
        kind, with_settings(RunConfig(), kind, **settings), open_device("auto")
    )
    for item in items:
        producer.feed(item.scan, item.odometry)
    return producer.grid()


def offline_log(kind: str, path: Path, **settings: Any) -> OccupancyGrid:
    """Return the map that a producer makes of a log that came through messages."""
    return offline(kind, as_sent(open_log(path)), **settings)
