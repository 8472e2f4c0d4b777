"""``MapSource``: one input of the fusion node, a topic with maps and one with poses."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy

from slamfusion.errors import TrajectoryError
from slamfusion.geometry import Pose2
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.clocks import Clocks
from slamfusion.ros.heartbeat import Heartbeat
from slamfusion.ros.input_entries import MAP_SUFFIX
from slamfusion.ros.map_updates import MapUpdates
from slamfusion.ros.stamps import Stamps

SHOWN_S = 10.0


@dataclass(frozen=True)
class HeardPose:
    """Where an input's SLAM says that the robot is.

    Attributes:
        pose: of the base in the input's map frame; metres, radians.
        stamp: builtin_interfaces/Time of it.
        heard_s: when it came, ``time.monotonic``.
    """

    pose: Pose2
    stamp: Any
    heard_s: float


class MapSource:
    """A map topic and the pose topic beside it.

    The callback keeps the newest message; ``take`` hands it out once. The map is read with the
    durability that is offered: a reader that asks for kept maps never hears a writer that keeps
    none. The pose comes on ``NAME/pose`` for ``NAME/map``. Stamps far ahead of all else are named
    and not used, nor are poses that have them.

    Args:
        base: the node.
        name: of the input.
        topic: of its maps; what changed of them is heard beside it, see ``MapUpdates``.
        lost_after_s: an input whose process gave no sign of life for this long is lost, and one
            that nobody publishes; may be replaced by ``ask``.
        stamps: of all inputs.
        clocks: of all inputs.
        on_map: called in the executor's thread when a map has come, or a process fell silent.
        on_pose: called there with this when a pose has come.

    Attributes:
        name, topic: as given.
        frame: of the newest map; empty before the first.
        stamp_s: of the newest map handed out whose stamp can be right; None before the first.
        pose: the newest; None before the first.
        silent_since_s: since when nobody publishes the map, ``time.monotonic``; None: somebody
            does.
    """

    def __init__(
        self,
        base: NodeBase,
        name: str,
        topic: str,
        lost_after_s: float,
        stamps: Stamps,
        clocks: Clocks,
        on_map: Callable[[], None],
        on_pose: Callable[[MapSource], None],
    ) -> None:
        self.name = name
        self.topic = topic
        self.frame = ""
        self.stamp_s: float | None = None
        self.pose: HeardPose | None = None
        self.silent_since_s: float | None = time.monotonic()
        self._base = base
        self._stamps = stamps
        self._clocks = clocks
        self._lost_after_s = lost_after_s
        self._on_map, self._on_pose = on_map, on_pose
        self._lock = threading.Lock()
        self._newest: tuple[Any, float] | None = None
        self._durability: DurabilityPolicy | None = None
        self._updates = MapUpdates(base, name, topic, self._keep)
        self._subscription = self._listen()
        self._heartbeat: Heartbeat | None = None
        self._poses: Any = None
        if topic.endswith(MAP_SUFFIX):
            pose_topic = topic.removesuffix(MAP_SUFFIX) + "/pose"
            self._poses = base.subscribe(PoseStamped, pose_topic, self._take_pose, qos.SENSOR)
            self._heartbeat = Heartbeat(base, pose_topic, lost_after_s, on_map)

    @property
    def lost(self) -> str:
        """Why the input is lost, one line; empty while it is not."""
        if self._heartbeat is not None and self._heartbeat.is_dead:
            return (
                f"lost: its process gave no sign of life for {self._lost_after_s:g} s (killed, "
                "frozen or cut off)"
            )
        since_s = self.silent_since_s
        if since_s is not None and time.monotonic() - since_s > self._lost_after_s:
            topic = self._base.node.resolve_topic_name(self.topic)
            return f"lost: nobody publishes {topic!r} any more"
        return ""

    @property
    def is_back(self) -> bool:
        """Whether the process that was lost is the one that lives again, with the same map."""
        return self._heartbeat is not None and self._heartbeat.is_back

    def ask(self, lost_after_s: float) -> None:
        """Take another time after which the input is lost."""
        self._lost_after_s = lost_after_s
        if self._heartbeat is not None:
            self._heartbeat.ask(lost_after_s)

    def close(self) -> None:
        """Hear nothing more."""
        self._base.node.destroy_subscription(self._subscription)
        self._updates.close()
        if self._poses is not None:
            self._base.node.destroy_subscription(self._poses)
        if self._heartbeat is not None:
            self._heartbeat.close()

    def _listen(self) -> Any:
        profile = qos.map_qos(self._durability)
        return self._base.subscribe(OccupancyGrid, self.topic, self._keep, profile)

    def look(self) -> None:
        """See who publishes the map, and read it and its signs of life as they are offered."""
        if self._heartbeat is not None:
            self._heartbeat.look()
        durability = qos.offered_durability(self._base.node, self.topic)
        if durability is None:
            if self.silent_since_s is None:
                self.silent_since_s = time.monotonic()
            return
        self.silent_since_s = None
        was_latched = self._durability != DurabilityPolicy.VOLATILE
        is_latched = durability != DurabilityPolicy.VOLATILE
        self._durability = durability
        if was_latched != is_latched:
            self._base.node.destroy_subscription(self._subscription)
            self._subscription = self._listen()

    def _keep(self, message: Any) -> None:
        self._clocks.hear(self.name, "map", messages.stamp_s(message))
        # Whoever sent it lives, though the last one who promised signs of life does not.
        self.silent_since_s = None
        if self._heartbeat is not None:
            self._heartbeat.forgive()
        self._updates.keep(message)
        with self._lock:
            self._newest = message, time.monotonic()
        self._on_map()

    @property
    def is_waiting(self) -> bool:
        """Whether a map waits to be taken."""
        with self._lock:
            return self._newest is not None

    def take(self) -> tuple[Any, float] | None:
        """Return the newest map and when it came, once; None where none waits."""
        with self._lock:
            taken, self._newest = self._newest, None
        if taken is not None:
            self.frame = taken[0].header.frame_id.lstrip("/")
            stamp_s = messages.stamp_s(taken[0])
            if not self._is_ahead("map", stamp_s, "the fused map is stamped by the others"):
                self.stamp_s = stamp_s
        return taken

    def _is_ahead(self, what: str, stamp_s: float, outcome: str) -> bool:
        """Whether a stamp lies in a future that nobody else knows of; named while it does."""
        ahead_s = self._stamps.ahead_s(self.name, stamp_s)
        if ahead_s is None:
            return False
        text = (
            f"the {what} of {self.name!r} is stamped {ahead_s:.0f} s ahead of the clock, and "
            f"other inputs are not: {outcome}; set the clock of its machine"
        )
        self._base.diagnostics.add(f"ahead {what} {self.name}", Level.WARN, text, SHOWN_S)
        return True

    def _take_pose(self, message: Any) -> None:
        key = f"pose {self.name}"
        try:
            pose = messages.pose2_from_message(message.pose)
        except TrajectoryError as error:
            text = f"a pose of {self.name!r} is left out: {error}"
            self._base.diagnostics.add(key, Level.WARN, text, SHOWN_S)
            return
        self._clocks.hear(self.name, "pose", messages.stamp_s(message))
        if self._is_ahead("pose", messages.stamp_s(message), "it is left out"):
            return
        self.pose = HeardPose(pose, message.header.stamp, time.monotonic())
        self._on_pose(self)
