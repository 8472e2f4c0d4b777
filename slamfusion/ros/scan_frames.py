"""``ScanFrames``: where the laser sits and where the odometry says the robot is, at a scan."""

from __future__ import annotations

import time
from typing import Any

from nav_msgs.msg import Odometry

from slamfusion.config import ProducerNodeConfig
from slamfusion.errors import ScanError, TrajectoryError
from slamfusion.geometry import Pose2
from slamfusion.io.log import FARTHEST_M
from slamfusion.io.transform_edge import TransformError
from slamfusion.io.transforms import Mount
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.frames import TransformInput, TransformStore
from slamfusion.ros.scan_gate import ODOMETRY_ALIVE_S, ArrivedScan
from slamfusion.scan import LaserScan
from slamfusion.slam.session import LeftOutError

ODOM_TOPIC = "odom"
NO_LASER_FRAME = "no transform from the laser"
NO_SCAN = "angles or ranges that cannot be a scan"
# Words on what has passed stay in the diagnostics this long, seconds.
SHOWN_S = 10.0


class ScanFrames:
    """Subscribes to what the settings ask for, and looks transforms up.

    Args:
        base: the node.
        settings: of the node; may be replaced by ``configure``.

    Attributes:
        transforms: from ``/tf``; None where nothing is taken from there.
        odometry: where odometry is kept; None: there is none.
    """

    def __init__(self, base: NodeBase, settings: ProducerNodeConfig) -> None:
        self.transforms: TransformStore | None = None
        self.odometry: TransformStore | None = None
        self._base = base
        self._settings = settings
        if "tf" in {settings.odometry_source, settings.laser_source}:
            self.transforms = TransformInput(base.node)
        if settings.odometry_source == "tf":
            self.odometry = self.transforms
        elif settings.odometry_source == "topic":
            self.odometry = TransformStore()
            base.subscribe(Odometry, ODOM_TOPIC, self._on_odometry, qos.SENSOR)

    def configure(self, settings: ProducerNodeConfig) -> None:
        """Take changed settings."""
        self._settings = settings

    @property
    def stores(self) -> set[TransformStore]:
        """Every store of transforms."""
        return {store for store in (self.transforms, self.odometry) if store is not None}

    def forget_after(self, stamp_s: float) -> None:
        """Forget the transforms of a future that has not come."""
        for store in self.stores:
            store.forget_after(stamp_s)

    def _on_odometry(self, message: Any) -> None:
        """Keep a pose of the odometry."""
        store = self.odometry
        assert store is not None  # noqa: S101  (made before the subscription)
        try:
            pose = messages.pose2_from_message(message.pose.pose)
        except TrajectoryError as error:
            self._base.diagnostics.add(
                "odometry values", Level.WARN, f"odometry left out: {error}", SHOWN_S
            )
            return
        if max(abs(pose.x), abs(pose.y)) > FARTHEST_M:
            text = f"odometry left out: ({pose.x:g}, {pose.y:g}) m is nowhere near"
            self._base.diagnostics.add("odometry values", Level.WARN, text, SHOWN_S)
            return
        child = message.child_frame_id.lstrip("/")
        if child and child != self._settings.base_frame:
            text = (
                f"odometry is that of {child!r}, not of base_frame {self._settings.base_frame!r}; "
                "it is taken for the same"
            )
            self._base.diagnostics.add("odometry frame", Level.WARN, text, SHOWN_S)
        settings = self._settings
        stamp = message.header.stamp
        store.add(
            [messages.transform_to_message(pose, settings.odom_frame, settings.base_frame, stamp)]
        )

    def read(self, scan: ArrivedScan) -> LaserScan:
        """Convert a scan.

        Raises:
            LeftOutError: it cannot be, or nobody says where its laser sits; named.
        """
        mount = self.mount(scan)
        if mount is None:
            raise LeftOutError(NO_LASER_FRAME)
        try:
            return messages.scan_from_message(scan.message, mount.pose, is_flipped=mount.is_flipped)
        except ScanError as error:
            self._base.diagnostics.add("scan", Level.WARN, str(error), SHOWN_S)
            raise LeftOutError(NO_SCAN) from error

    def mount(self, scan: ArrivedScan) -> Mount | None:
        """Return where the laser sits at a scan, or None, named, where that is not known."""
        settings = self._settings
        if settings.laser_source == "parameter":
            return Mount(Pose2(settings.laser_x, settings.laser_y, settings.laser_yaw))
        frame = scan.message.header.frame_id.lstrip("/")
        if frame == settings.base_frame:
            return Mount()
        assert self.transforms is not None  # noqa: S101  (made for this source)
        try:
            mount = self.transforms.mount(
                settings.base_frame, frame, scan.stamp_s, self._wait_s(scan, self.transforms)
            )
        except TransformError as error:
            text = (
                f"scans in {frame!r} cannot be used: {error}; send the transform, or set "
                "laser_source to parameter"
            )
            self._base.diagnostics.add("laser", Level.ERROR, text)
            return None
        self._base.diagnostics.clear("laser")
        return mount

    def odometry_at(self, scan: ArrivedScan, *, is_first: bool) -> Pose2 | None:
        """Return the odometry at a scan's time, or None, named, where it has none.

        Args:
            scan: waits for it up to ``odometry_wait_s``.
            is_first: scans without it are left out, for the map has not begun.
        """
        store, settings = self.odometry, self._settings
        if store is None:
            return None
        try:
            pose = store.lookup(
                settings.odom_frame, settings.base_frame, scan.stamp_s, self._wait_s(scan, store)
            )
        except TransformError as error:
            does = "are left out" if is_first else "are matched without it"
            text = (
                f"no odometry for the scans, which {does}: {error}; check {self._odometry_words()}"
                ", or set odometry_source to none"
            )
            self._base.diagnostics.add("odometry", Level.WARN, text)
            return None
        self._base.diagnostics.clear("odometry")
        return pose

    def _odometry_words(self) -> str:
        settings = self._settings
        if settings.odometry_source == "tf":
            return f"the transforms from {settings.base_frame!r} to {settings.odom_frame!r}"
        return f"the topic {self._base.node.resolve_topic_name(ODOM_TOPIC)!r}"

    def _wait_s(self, scan: ArrivedScan, store: TransformStore) -> float:
        """Return how long a scan may still wait for what a store is to get."""
        now_s = time.monotonic()
        if store.last_s is not None and now_s - store.last_s > ODOMETRY_ALIVE_S:
            return 0.0
        return max(0.0, scan.arrived_s + self._settings.odometry_wait_s - now_s)
