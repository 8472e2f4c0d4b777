"""Quality of service of our topics, and of others' maps.

A reader that requests more than the writer offers receives nothing: a transient-local reader of a
volatile map, or a reliable reader of a best-effort scan.
"""

from __future__ import annotations

from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

# Liveliness lease of poses, seconds: DDS renews it three times in two leases, in its own thread.
LEASE_S = 0.5


def profile(
    depth: int, *, reliable: bool, latched: bool, lease_s: float | None = None
) -> QoSProfile:
    """Return a quality of service.

    A reader with the liveliness lease ``lease_s`` hears no writer with none or a longer one.
    """
    found = QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    if lease_s is not None:
        found.liveliness = LivelinessPolicy.AUTOMATIC
        found.liveliness_lease_duration = Duration(seconds=lease_s)
    return found


# Scans and odometry, read: compatible with every writer.
SENSOR = profile(50, reliable=False, latched=False)
# Scans, odometry and poses, written: compatible with every reader.
STREAM = profile(50, reliable=True, latched=False)
# Poses, written: with a lease, so that a reader can detect the writer's end.
POSE = profile(50, reliable=True, latched=False, lease_s=LEASE_S)
# Maps: a late reader receives the last one.
MAP = profile(1, reliable=True, latched=True)
# As in tf2; and static transforms of several writers, read.
TF = profile(100, reliable=True, latched=False)
TF_STATIC = profile(1, reliable=True, latched=True)
TF_STATIC_READ = profile(100, reliable=True, latched=True)


def map_qos(node: Any, topic: str) -> QoSProfile | None:
    """Return a profile for a map topic that is compatible with every writer; None without one."""
    infos = node.get_publishers_info_by_topic(topic)  # applies remappings
    if not infos:
        return None
    profiles = [info.qos_profile for info in infos]
    return profile(
        1,
        reliable=all(one.reliability == ReliabilityPolicy.RELIABLE for one in profiles),
        latched=all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in profiles),
    )
