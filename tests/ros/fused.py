"""Maps for the fusion node as messages, and what a live fusion makes of them without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry

from slamfusion.compute import open_device
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.ros import messages, qos
from tests.fusion.live.maps import live_fusion, three
from tests.ros.live import Observer, Processes, values

INPUTS = ["a/map", "b/map", "c/map"]
NAMES = "abc"


class Makers:
    """The test itself publishes the maps of three SLAMs."""

    def __init__(self, observer: Observer, names: str = NAMES, prefix: str = "") -> None:
        self.observer = observer
        self.prefix = prefix
        self.stamp_s = 100.0
        self.topics = {
            name: observer.publisher(OccupancyGrid, f"{prefix}{name}/map", qos.MAP)
            for name in names
        }

    def send(self, grid: Grid, **changes: Any) -> OccupancyGrid:
        """Publish a map, a second later than the last one; ``changes`` are put into the message."""
        self.stamp_s += 1.0
        stamp = messages.to_stamp(changes.get("stamp_s", self.stamp_s))
        message = messages.grid_to_message(grid, f"{grid.name}_map", stamp)
        if "resolution" in changes:
            message.info.resolution = changes["resolution"]
        if "width" in changes:
            message.info.width = changes["width"]
        if "frame" in changes:
            message.header.frame_id = changes["frame"]
        self.topics[grid.name].publish(message)
        return message

    def send_all(self, grids: Mapping[str, Grid] | None = None) -> None:
        """Publish every input's map."""
        for name, grid in (grids or three()).items():
            if name in self.topics:
                self.send(grid)

    def stop(self, name: str) -> None:
        """End a publisher, as when its process has died."""
        self.observer.node.destroy_publisher(self.topics.pop(name))

    def start(self, name: str) -> None:
        """Begin to publish again."""
        topic = f"{self.prefix}{name}/map"
        self.topics[name] = self.observer.publisher(OccupancyGrid, topic, qos.MAP)


class Robot:
    """Tells where it is, to every SLAM in its own frame, and its odometry."""

    def __init__(self, observer: Observer, names: str = "abc") -> None:
        self.odometry = observer.publisher(Odometry, "odom")
        self.poses = {name: observer.publisher(PoseStamped, f"{name}/pose") for name in names}
        self.drift = Pose2(3.0, 4.0, 0.5)

    def at(self, stamp_s: float, place: Pose2, transforms: dict[str, Pose2]) -> None:
        """Tell that it is at a place of the fused frame."""
        stamp = messages.to_stamp(stamp_s)
        self.odometry.publish(
            messages.odometry_to_message(self.drift.compose(place), "odom", "base_link", stamp)
        )
        for name, publisher in self.poses.items():
            pose = transforms[name].inverse().compose(place)
            frame = f"{name}_map"
            message = messages.pose_to_message(pose, frame, stamp)
            if publisher.msg_type is not PoseStamped:
                message = messages.sure_pose_to_message(pose, np.zeros((3, 3)), frame, stamp)
            publisher.publish(message)


def told_transforms(observer: Observer) -> dict[str, Pose2]:
    """Return every voter's transform as the diagnostics tell it (four digits)."""
    out = {}
    for name in "abc":
        figures = values(observer.statuses()[f"fusion: input {name}"])
        out[name] = Pose2(*(float(figures[key]) for key in ("x [m]", "y [m]", "yaw [rad]")))
    return out


def start_fusion(processes: Processes, *ros_arguments: str, **parameters: Any) -> Any:
    """Start the fusion node on a, b and c; however slow the machine, none grows stale by itself."""
    patient = {"live__search_pause_s": 0.0, "live__stale_after_s": 1000.0}
    settings = {"inputs": INPUTS, **patient, **parameters}
    return processes.node("fusion", *ros_arguments, **settings)


def fused_without_ros(grids: Mapping[str, Grid] | None = None) -> Grid:
    """Return what the live fusion makes of the maps in one update."""
    live = live_fusion(open_device())
    for grid in (grids or three()).values():
        live.put(grid.name, grid, 0.0)
    update = live.update(0.0)
    assert update.fused is not None
    return update.fused


def share_equal(message: Any, wanted: Grid) -> float:
    """Return the share of the known cells that are equal where the wanted map has them.

    Maps that come one by one are aligned otherwise by fractions of a cell, and walls are drawn from
    one map: of the same maps 0.9 and more are equal.
    """
    found = messages.grid_from_message(message, "found")
    own = wanted.origin.inverse().compose(found.origin)
    row, col = round(own.y / wanted.resolution), round(own.x / wanted.resolution)
    whole = np.full((wanted.height + 400, wanted.width + 400), -1, dtype=np.int8)
    whole[200 + row : 200 + row + found.height, 200 + col : 200 + col + found.width] = found.cells
    here = whole[200 : 200 + wanted.height, 200 : 200 + wanted.width]
    known = (wanted.cells >= 0) | (here >= 0)
    return float((here == wanted.cells)[known].mean())


def unlike(grid: Grid) -> Grid:
    """Return the map upside down."""
    return Grid(np.ascontiguousarray(grid.cells[::-1]), grid.resolution, grid.origin, grid.name)
