"""The qualities of service that our topics have, and what others offer.

A reader that asks for more than the writer offers hears nothing: a transient-local reader of a
volatile map, or a reliable reader of a best-effort scan.
"""

from __future__ import annotations

from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

# Poses are offered with this liveliness lease, seconds: DDS says three times in two of these that
# the process lives, from a thread of its own that needs no interpreter.
LEASE_S = 0.5


def profile(
    depth: int, *, reliable: bool, latched: bool, lease_s: float | None = None
) -> QoSProfile:
    """Return a quality of service.

    Args:
        lease_s: writers offer to renew their liveliness within this time, seconds; a reader that
            asks for it hears nothing from those that offer none, or a longer one.
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


# Scans and odometry, read: hears every writer.
SENSOR = profile(50, reliable=False, latched=False)
# Scans, odometry and poses, written: every reader can hear them.
STREAM = profile(50, reliable=True, latched=False)
# Poses, written: the same, and a reader that asks for it hears within its lease that the writer has
# gone.
POSE = profile(50, reliable=True, latched=False, lease_s=LEASE_S)
# Maps: a late reader gets the last one at once.
MAP = profile(1, reliable=True, latched=True)
# As tf2 has them; and static transforms of several writers, read.
TF = profile(100, reliable=True, latched=False)
TF_STATIC = profile(1, reliable=True, latched=True)
TF_STATIC_READ = profile(100, reliable=True, latched=True)


def map_qos(node: Any, topic: str) -> QoSProfile | None:
    """Return how to read a map topic, so that every writer of it is heard.

    Reliable as far as all writers are; transient local as far as all are, or else no map from
    before the reader came is heard. None while the topic has no writer.
    """
    infos = node.get_publishers_info_by_topic(topic)  # applies remappings
    if not infos:
        return None
    profiles = [info.qos_profile for info in infos]
    return profile(
        1,
        reliable=all(one.reliability == ReliabilityPolicy.RELIABLE for one in profiles),
        latched=all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in profiles),
    )
