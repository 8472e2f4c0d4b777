"""``FusedOutput``: the fused map on its way out, no faster than asked, and its agreement."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import OccupancyGrid

from slamfusion import grid as grids
from slamfusion.config import FusionNodeConfig
from slamfusion.ros import messages, qos
from slamfusion.ros.base import NodeBase

__all__ = ["MAP_TOPIC", "Fused", "FusedOutput"]

MAP_TOPIC, AGREEMENT_TOPIC = "fused/map", "fused/agreement"
LATENCIES = 300
# A fused map waits no longer than this for maps that came while it was made: sending one of 16 MB
# keeps them waiting longer than fusing them does.
GATHER_S = 0.25


@dataclass(frozen=True, eq=False)
class Fused:
    """A fused map on its way out.

    Attributes:
        grid, agreement: of one update; the agreement goes out after it, when somebody listens.
        stamp_s: of the newest map in it; 0 where all were saved maps.
        arrived_s: when the first map came that it shows and none before it did.
    """

    grid: grids.OccupancyGrid
    agreement: grids.OccupancyGrid
    stamp_s: float
    arrived_s: float | None


class FusedOutput:
    """Publishes fused maps, of several within one period only the last.

    Written by the worker's thread, read by the executor's: each attribute is replaced as a whole.

    Args:
        base: the node.
        settings: of the node.

    Attributes:
        settings: may be replaced.
        waiting: the map that waits for its turn; the worker puts it there.
        published: the last published map as message and as grid; None before the first.
        count: maps published.
    """

    def __init__(self, base: NodeBase, settings: FusionNodeConfig) -> None:
        self.settings = settings
        self.waiting: Fused | None = None
        self.published: tuple[OccupancyGrid, grids.OccupancyGrid] | None = None
        self.count = 0
        self._untold: Fused | None = None
        self._published_s = float("-inf")
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)
        self._map_topic = base.publisher(OccupancyGrid, MAP_TOPIC, qos.MAP)
        self._agreement_topic = base.publisher(OccupancyGrid, AGREEMENT_TOPIC, qos.MAP)

    @property
    def is_wanted(self) -> bool:
        """Whether a map could go out now, or an agreement that somebody listens to."""
        return (self.waiting is not None and self._is_turn()) or self._is_agreement_wanted()

    def send(self, *, with_agreement: bool = True) -> None:
        """Publish what waits, if its turn has come; the agreement where somebody listens."""
        if self.waiting is not None and self._is_turn():
            self._publish(self.waiting)
        if with_agreement and self._is_agreement_wanted():
            fused, self._untold = self._untold, None
            if fused is not None:
                self._agreement_topic.publish(self._message(fused, fused.agreement))

    def may_gather(self, has_maps: Callable[[], bool]) -> bool:
        """Whether the map that waits goes on waiting for maps that came while it was made."""
        arrived_s = None if self.waiting is None else self.waiting.arrived_s
        is_young = arrived_s is not None and time.monotonic() - arrived_s < GATHER_S
        return is_young and has_maps()

    def latencies_ms(self) -> tuple[float, float]:
        """Return median and 95th percentile from a map's coming to its fused one's going, ms."""
        median, high = 1e3 * np.percentile([*self._latencies_s] or [0.0], (50.0, 95.0))
        return float(median), float(high)

    def _is_turn(self) -> bool:
        """Whether the last published map is old enough for another one."""
        period_s = 1.0 / self.settings.max_publish_rate_hz
        return time.monotonic() - self._published_s >= period_s

    def _is_agreement_wanted(self) -> bool:
        """Whether somebody listens to an agreement that was not sent."""
        return self._untold is not None and self._agreement_topic.get_subscription_count() > 0

    def _publish(self, fused: Fused) -> None:
        self.waiting, self._untold = None, fused
        self._published_s = time.monotonic()
        message = self._message(fused, fused.grid)
        self.published = message, fused.grid
        self._map_topic.publish(message)
        if fused.arrived_s is not None:
            self._latencies_s.append(time.monotonic() - fused.arrived_s)
        self.count += 1

    def _message(self, fused: Fused, grid: grids.OccupancyGrid) -> OccupancyGrid:
        """Return a grid of a fused map as a message in the fused frame."""
        stamp = messages.to_stamp(fused.stamp_s)
        return messages.grid_to_message(grid, self.settings.fused_frame, stamp)
