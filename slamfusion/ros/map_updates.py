"""``MapUpdates``: follows the part of a map that changed, where a SLAM or a costmap sends that.

Whoever publishes ``MAP_updates`` (map_msgs/OccupancyGridUpdate) beside ``MAP`` sends the whole map
seldom, and what changed in between. map_msgs comes with a sourced ROS and is not on the Python
package index; without it whole maps are taken alone, as before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from slamfusion.errors import GridError
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:  # only a sourced ROS has it
    OccupancyGridUpdate = None

SUFFIX = "_updates"
SHOWN_S = 10.0


class MapUpdates:
    """Puts updates into the last map; in the executor's thread.

    An update that lies outside of the map, that comes before the first one or that says too little
    is counted and named.

    Args:
        base: the node.
        name: of the input.
        topic: of its whole maps.
        on_map: called with a map that an update made, a message of its own.
    """

    def __init__(
        self, base: NodeBase, name: str, topic: str, on_map: Callable[[Any], None]
    ) -> None:
        self._base = base
        self._name = name
        self._on_map = on_map
        self._last: Any = None
        self._subscription: Any = None
        if OccupancyGridUpdate is not None:
            self._subscription = base.subscribe(
                OccupancyGridUpdate, topic + SUFFIX, self._take, qos.STREAM
            )

    def keep(self, message: Any) -> None:
        """Take a map that updates are put into."""
        if self._subscription is not None:
            self._last = message

    def close(self) -> None:
        """Hear nothing more."""
        if self._subscription is not None:
            self._base.node.destroy_subscription(self._subscription)

    def _take(self, update: Any) -> None:
        """Hand on what an update makes of the last map."""
        if self._last is None:
            self._leave_out("it came before the first map")
            return
        try:
            updated = messages.updated_map(self._last, update)
        except GridError as error:
            self._leave_out(str(error))
        else:
            self._on_map(updated)

    def _leave_out(self, reason: str) -> None:
        """Count an update that is not used, and name it."""
        key = f"update {self._name}"
        count = self._base.diagnostics.count(key) + 1
        text = f"an update of the map of {self._name!r} is left out ({count} so far): {reason}"
        self._base.diagnostics.add(key, Level.WARN, text, SHOWN_S)
