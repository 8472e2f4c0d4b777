from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import String

from slamfusion.ros import qos
from tests.ros.live import Observer

pytestmark = pytest.mark.ros

BEST_EFFORT = ReliabilityPolicy.BEST_EFFORT


@pytest.mark.parametrize("offered", [qos.MAP, qos.STREAM, qos.SENSOR])
def test_a_map_is_heard_as_it_is_offered(domain: int, observer: Observer, offered: object):
    assert qos.map_qos(observer.node, "map") is None
    with Observer(domain, "writer") as other:
        writer = other.publisher(String, "map", offered)
        profile = observer.wait(lambda: qos.map_qos(observer.node, "map"))
        heard = observer.collect(String, "map", profile)
        observer.wait(writer.get_subscription_count, what="the reader")

        def is_heard() -> bool:
            writer.publish(String(data="here"))
            return bool(heard)

        observer.wait(is_heard, what="the map")
        assert heard[0].data == "here"
        # Of several writers the one that offers least counts.
        other.publisher(String, "map", qos.SENSOR)

        def is_asked_for_less() -> bool:
            asked = qos.map_qos(observer.node, "map")
            wanted = DurabilityPolicy.VOLATILE, BEST_EFFORT
            return asked is not None and (asked.durability, asked.reliability) == wanted

        observer.wait(is_asked_for_less, what="the second writer")
