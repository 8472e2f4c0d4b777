"""``FusedOutput``: the topics of the fused map and of its agreement."""

from __future__ import annotations

from collections.abc import Callable

from nav_msgs.msg import OccupancyGrid

from slamfusion import grid as grids
from slamfusion.config import FusionNodeConfig
from slamfusion.fusion.live.outbox import Fused, Outbox
from slamfusion.ros import messages, qos
from slamfusion.ros.base import NodeBase

MAP_TOPIC, AGREEMENT_TOPIC = "fused/map", "fused/agreement"


class FusedOutput:
    """Publishes what is due of an outbox.

    Args:
        base: the node.
        settings: of the node.
        outbox: where fused maps wait.
        sent: told every map that was published.

    Attributes:
        settings: may be replaced.
        published: the last published map as message and as grid, replaced as a whole; None before
            the first.
    """

    def __init__(
        self,
        base: NodeBase,
        settings: FusionNodeConfig,
        outbox: Outbox,
        sent: Callable[[Fused], None] = lambda _: None,
    ) -> None:
        self.settings = settings
        self._sent = sent
        self.published: tuple[OccupancyGrid, grids.OccupancyGrid] | None = None
        self._outbox = outbox
        self._map_topic = base.publisher(OccupancyGrid, MAP_TOPIC, qos.MAP)
        self._agreement_topic = base.publisher(OccupancyGrid, AGREEMENT_TOPIC, qos.MAP)

    def is_heard(self) -> bool:
        """Whether somebody listens to the agreement."""
        return bool(self._agreement_topic.get_subscription_count() > 0)

    def send(self, *, with_agreement: bool = True) -> None:
        """Publish the map that waits, if its turn has come, and the agreement where it is heard."""
        fused = self._outbox.take()
        if fused is not None:
            message = self._message(fused, fused.grid)
            self.published = message, fused.grid
            self._map_topic.publish(message)
            self._outbox.count(fused)
            self._sent(fused)
        if with_agreement and self._outbox.has_agreement and self.is_heard():
            self._publish_agreement()

    def _publish_agreement(self) -> None:
        """Publish the agreement of the last map, once."""
        fused = self._outbox.take_agreement()
        if fused is not None:
            self._agreement_topic.publish(self._message(fused, fused.agreement))

    def _message(self, fused: Fused, grid: grids.OccupancyGrid) -> OccupancyGrid:
        """Return a grid of a fused map as a message in the fused frame."""
        stamp = messages.to_stamp(fused.stamp_s)
        return messages.grid_to_message(grid, self.settings.fused_frame, stamp)
