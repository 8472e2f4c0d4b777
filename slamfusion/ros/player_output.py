"""``ScanSender``: a log's scans as messages, with time, transforms and odometry."""

from __future__ import annotations

from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from slamfusion.config import PlayerNodeConfig
from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan
from slamfusion.ros import messages, qos
from slamfusion.ros.base import NodeBase
from slamfusion.ros.frames import TransformOutput

SCAN_TOPIC, ODOM_TOPIC, CLOCK_TOPIC = "scan", "odom", "/clock"
# Reliable readers are given this long to take the last messages.
ACKNOWLEDGE_S = 5.0


class ScanSender:
    """Sends ``scan``, ``odom``, transforms and ``/clock``, all with the log's stamps.

    Args:
        base: the node.
        settings: its frames, and what of the odometry is sent.

    Attributes:
        sent: scans sent so far, each counted once.
        sent_again: how often one of them was repeated.
        stamp_s: of the last scan; None before the first.
    """

    def __init__(self, base: NodeBase, settings: PlayerNodeConfig) -> None:
        self.sent = 0
        self.sent_again = 0
        self.stamp_s: float | None = None
        self._settings = settings
        self._scans = base.publisher(LaserScan, SCAN_TOPIC, qos.STREAM)
        self._odometry = base.publisher(Odometry, ODOM_TOPIC, qos.STREAM)
        self._clock = base.publisher(Clock, CLOCK_TOPIC, qos.STREAM)
        self._transforms = TransformOutput(base.node)
        self._mount: Pose2 | None = None

    def listeners(self) -> int:
        """Return how many subscriptions the scans have."""
        return int(self._scans.get_subscription_count())

    def rivals(self) -> dict[str, str]:
        """Return the parents of frames that another node sends too, by child; see ``frames``."""
        return self._transforms.rivals()

    def send(self, item: LogScan) -> None:
        """Send a scan with its time, transforms and odometry, the scan last."""
        settings, scan = self._settings, item.scan
        stamp = messages.to_stamp(scan.stamp_s)
        self.stamp_s = scan.stamp_s
        self.send_clock(scan.stamp_s)
        if scan.mount != self._mount:
            self._mount = scan.mount
            self._transforms.send_static(
                [
                    messages.transform_to_message(
                        scan.mount, settings.base_frame, settings.laser_frame, stamp
                    )
                ]
            )
        pose = item.odometry
        if pose is not None and settings.odometry in {"tf", "both"}:
            self._transforms.send(
                [
                    messages.transform_to_message(
                        pose, settings.odom_frame, settings.base_frame, stamp
                    )
                ]
            )
        if pose is not None and settings.odometry in {"topic", "both"}:
            self._odometry.publish(
                messages.odometry_to_message(pose, settings.odom_frame, settings.base_frame, stamp)
            )
        self._scans.publish(messages.scan_to_message(scan, settings.laser_frame))
        self.sent += 1

    def send_again(self, item: LogScan) -> None:
        """Repeat a scan that was sent."""
        self.send(item)
        self.sent -= 1
        self.sent_again += 1

    def send_clock(self, stamp_s: float) -> None:
        """Send the log's time, where that is asked for."""
        if self._settings.publish_clock:
            self._clock.publish(Clock(clock=messages.to_stamp(max(stamp_s, 0.0))))

    def wait_for_delivery(self) -> None:
        """Give reliable readers the time to take the last messages."""
        for publisher in (self._scans, self._odometry):
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_S))
