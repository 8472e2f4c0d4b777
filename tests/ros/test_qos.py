from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import String

from slamfusion.ros import qos
from tests.ros.live import Observer

pytestmark = pytest.mark.ros

VOLATILE, LATCHED = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL


def test_the_offered_durability_is_that_of_the_weakest_writer(domain: int, observer: Observer):
    assert qos.offered_durability(observer.node, "map") is None
    with Observer(domain, "writer") as other:
        other.publisher(String, "map", qos.MAP)
        observer.wait(lambda: qos.offered_durability(observer.node, "map") == LATCHED)
        other.publisher(String, "map", qos.STREAM)
        observer.wait(lambda: qos.offered_durability(observer.node, "map") == VOLATILE)
    observer.wait(lambda: qos.offered_durability(observer.node, "map") is None)


@pytest.mark.parametrize("offered", [qos.MAP, qos.STREAM])
def test_a_map_is_heard_as_it_is_offered(domain: int, observer: Observer, offered: object):
    with Observer(domain, "writer") as other:
        writer = other.publisher(String, "map", offered)
        durability = observer.wait(lambda: qos.offered_durability(observer.node, "map"))
        heard = observer.collect(String, "map", qos.map_qos(durability))
        observer.wait(writer.get_subscription_count, what="the reader")

        def is_heard() -> bool:
            writer.publish(String(data="here"))
            return bool(heard)

        observer.wait(is_heard, what="the map")
    assert heard[0].data == "here"


def test_a_map_topic_is_asked_for_as_ours_are_offered():
    assert qos.map_qos(None).durability == LATCHED
    assert qos.map_qos(VOLATILE).durability == VOLATILE
    assert qos.map_qos(VOLATILE).reliability == ReliabilityPolicy.RELIABLE
