"""``MapSource``, an input; ``Liveliness`` detects dead processes, ``Clocks`` wrong clocks."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError

from slamfusion.errors import GridError, TrajectoryError
from slamfusion.fusion.live.inputs import Reason
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.ros import messages, qos
from slamfusion.ros.base import SHOWN_S, TIME_JUMP, Diagnostics, Level, NodeBase, type_name

MAP_SUFFIX = "/map"
POSES = {type_name(kind): kind for kind in (PoseStamped, PoseWithCovarianceStamped)}

# Delay before an expired lease counts, seconds: if this process was stopped, all leases seem to
# have expired, and the next sign of life is a third of a second away.
DOUBT_S = 0.5
# Part of the time limit for detecting and reporting a dead writer, seconds.
NOTICE_S = 0.2

# A stamp further ahead is wrong; unsynchronised clocks differ by less, seconds.
AHEAD_S = 60.0
# Clocks that differ by less are equal, and messages may be this late, seconds.
SKEW_S = 2.0
# Stamps kept of each input; the number and time span needed to estimate a clock, so that a latched
# map does not count. Seconds.
KEPT, LEAST, SPAN_S = 50, 4, 1.0
# Quantile from above that estimates the clock, robust to stray stamps.
UPPER = 0.25


class Liveliness:
    """The liveliness of a topic's writers by lease events, seconds on a monotonic clock.

    Attributes:
        is_back: the living writer is the one that had fallen silent. Stays until all are silent
            again: under load a lease may expire and be renewed more than once between two looks.
        silent_since_s: None while a writer lives.
        alive: number of writers that renew their lease, or fewer.
    """

    def __init__(self) -> None:
        self.alive = 0
        self.is_back = False
        self.silent_since_s: float | None = None
        self._lives = False

    def take(self, alive: int, alive_change: int, not_alive_change: int, now_s: float) -> bool:
        """Take an event; return whether the topic gained its first or lost its last living writer.

        Fast DDS may count one too few alive after a writer was given up before its first sign of
        life, so changes are more reliable than counts.

        Args:
            alive, alive_change: writers that renew their lease (or fewer), and their change.
            not_alive_change: change of the number that do not.
        """
        self.alive = alive
        had, self._lives = self._lives, alive > 0 or alive_change > 0
        if self._lives:
            self.silent_since_s = None
            if not had:
                self.is_back = not_alive_change < 0
        else:
            self.is_back = False
            if not_alive_change > 0 and self.silent_since_s is None:
                self.silent_since_s = now_s
        # Without any writer: a regular end is seen by the map's reader; a silent writer has been
        # given up by DDS, and stays dead.
        return had != self._lives

    def is_dead(self, now_s: float) -> bool:
        """Whether every writer has fallen silent and none has replaced it."""
        since_s = self.silent_since_s
        return since_s is not None and now_s - since_s > DOUBT_S


class Clocks:
    """Compares the clocks of the inputs' machines with each other and with this one's.

    A stamp is ahead of the node's clock by the offset of the sender's clock minus the delay of the
    message, so an upper quantile of the last stamps estimates the offset. Inputs with common pose
    stamps map the scans of one sensor: they share a clock, and the later one has a queue. The
    majority, this machine included, is taken as right. Wrong clocks are reported, but only single
    stamps are refused: far ahead of the node's clock while another input's is not.

    In the executor's thread, except ``is_too_far_ahead``.

    Args:
        clock_s: the node's time, seconds; <= 0 while unknown (before the first simulated time).
    """

    def __init__(self, clock_s: Callable[[], float], diagnostics: Diagnostics) -> None:
        self._clock_s = clock_s
        self._diagnostics = diagnostics
        # Stamps, and their lead over the node's clock, by name and kind of message.
        self._heard: dict[tuple[str, str], deque[tuple[float, float]]] = {}
        # Lead of each input's last stamp, and arrival and lead of its last that was too far ahead;
        # each use is one atomic operation.
        self._ahead_s: dict[str, float] = {}
        self._stray_s: dict[str, tuple[float, float]] = {}

    def is_too_far_ahead(self, name: str, stamp_s: float) -> bool:
        """Note a stamp of an input; return whether it is far ahead of the clock and the others."""
        now_s = self._clock_s()
        if now_s <= 0.0:
            return False
        ahead_s = self._ahead_s[name] = stamp_s - now_s
        others = [other for key, other in list(self._ahead_s.items()) if key != name]
        is_wrong = bool(others) and ahead_s > AHEAD_S and ahead_s - min(others) > AHEAD_S
        if is_wrong and not self._diagnostics.is_on(TIME_JUMP):  # else it may be of before that
            self._stray_s[name] = time.monotonic(), ahead_s
        return is_wrong

    def hear(self, name: str, kind: str, stamp_s: float) -> None:
        """Take the stamp of a new message; a smaller one of the same kind restarts."""
        now_s = self._clock_s()
        if now_s <= 0.0:
            return
        heard = self._heard.setdefault((name, kind), deque(maxlen=KEPT))
        if heard and stamp_s == heard[-1][0]:
            return
        if heard and stamp_s < heard[-1][0]:
            heard.clear()
        heard.append((stamp_s, stamp_s - now_s))

    def look(self, names: Collection[str]) -> None:
        """Report inputs with wrong clocks; ``names`` are all of them."""
        ahead_s: dict[str, float] = {}
        stamps: dict[str, set[float]] = {}
        for (name, _), heard in self._heard.items():
            if len(heard) >= LEAST and heard[-1][0] - heard[0][0] >= SPAN_S:
                own_s = sorted(ahead for _, ahead in heard)[-1 - int(UPPER * len(heard))]
                ahead_s[name] = max(own_s, ahead_s.get(name, own_s))
                stamps.setdefault(name, set()).update(stamp for stamp, _ in heard)
        ahead_s = {
            name: max(ahead_s[other] for other, theirs in stamps.items() if own & theirs)
            for name, own in stamps.items()
        }
        ordered = sorted([0.0, *ahead_s.values()])
        right_s = min(ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2], key=abs)
        now_s, is_settled = time.monotonic(), not self._diagnostics.is_on(TIME_JUMP)
        for name in names:
            # A clock alone is compared with none.
            lead_s = ahead_s[name] - right_s if name in ahead_s and len(ahead_s) > 1 else 0.0
            is_off = abs(lead_s) > SKEW_S
            way = "ahead of" if lead_s > 0.0 else "behind"
            late = "" if lead_s > 0.0 else ", or its messages come that late"
            text = f"the clock of {name!r} is {abs(lead_s):.1f} s {way} the others'{late}"
            outcome = "its maps count all the same"
            arrived_s, stray_s = self._stray_s.get(name, (-math.inf, 0.0))
            if is_stray := now_s - arrived_s < SHOWN_S:
                outcome = "such poses are left out, and the fused map is stamped by other inputs"
            if not is_off:
                text = f"{name!r} has a stamp {stray_s:.0f} s ahead of the clock and other inputs"
            text += f"; {outcome}; set the clock of its machine"
            is_named = is_settled and (is_off or is_stray)
            self._diagnostics.say(f"clock {name}", text if is_named else None)

    def remove(self, name: str) -> None:
        """Forget the stamps of an input that was removed."""
        self._ahead_s.pop(name, None)
        self._stray_s.pop(name, None)
        self._heard = {key: heard for key, heard in self._heard.items() if key[0] != name}
        self._diagnostics.clear(f"clock {name}")

    def forget(self) -> None:
        """Forget every stamp, after a jump back of the clock."""
        self._heard.clear()
        self._ahead_s.clear()
        self._stray_s.clear()


def name_writers(base: NodeBase, sources: Mapping[str, MapSource], output: str) -> str:
    """Report inputs with several writers; return another node that writes the output, or empty."""
    outcome = (
        "their maps take turns as one input: end one, or give each a topic of its own in inputs"
    )
    for name, source in sources.items():
        is_sure = source.liveliness.alive > 1
        base.name_writers(f"writers {name}", source.topic, outcome, is_sure=is_sure)
    own, writers = base.node.get_fully_qualified_name(), base.writers(output)
    namesake = own if writers.count(own) > 1 else ""
    rival = next((node for node in writers if node != own), namesake)
    text = (
        f"another node, {rival!r}, publishes {base.resolved(output)!r} too: end one of the two, or "
        "start it in a namespace of its own (-r __ns:=/NAME)"
    )
    is_other = rival and rival != own  # a namesake is in the diagnostics of every node
    base.diagnostics.say("other fusion", text if is_other else None, Level.ERROR)
    return rival


@dataclass(frozen=True)
class HeardPose:
    """The robot's pose in an input's map frame, and its arrival by ``time.monotonic``."""

    pose: Pose2
    stamp: Any  # builtin_interfaces/Time
    stamp_s: float
    heard_s: float


class MapSource:
    """A map topic and the pose topic next to it: ``NAME/pose`` for ``NAME/map``.

    The map is read with the offered quality of service, and the pose in the type that is published:
    PoseStamped, or PoseWithCovarianceStamped without its covariance. ``MAP_updates``
    (map_msgs/OccupancyGridUpdate) are applied to the last whole map. Maps and poses with stamps far
    ahead of all others are reported and not used.

    A robot that stands still sends no maps and poses but is healthy; a killed or frozen process
    must lose its vote. A busy node is late with messages and diagnostics, so our producers offer
    poses with a DDS liveliness lease, renewed three times a second by a thread independent of
    Python, and a second reader of the pose topic requests it. Inputs without a lease are dead when
    DDS says so (20 s by default).

    In the executor's thread, except ``read``.

    Args:
        lost_after_s: an input is lost after this long without a sign of life or a publisher; at
            least one second.
        on_map: called with a new map, and with None when the process fell silent or is back.

    Attributes:
        frame: of the newest map that was read; empty before the first.
        stamp_s: of the newest map with a plausible stamp; None before the first.
        pose: the newest; None before the first.
        liveliness: of the pose writers that offer a lease.
        silent_since_s: ``time.monotonic`` since when no node publishes the map; None if one does.
    """

    def __init__(
        self,
        base: NodeBase,
        name: str,
        topic: str,
        lost_after_s: float,
        clocks: Clocks,
        on_map: Callable[[MapSource, Any], None],
        on_pose: Callable[[MapSource, HeardPose], None],
    ) -> None:
        self.name, self.topic = name, topic
        self.frame = ""
        self.stamp_s: float | None = None
        self.pose: HeardPose | None = None
        self.silent_since_s: float | None = time.monotonic()
        self._base = base
        self._clocks = clocks
        self._lost_after_s = lost_after_s
        self._on_map, self._on_pose = on_map, on_pose
        # The last map, for updates, and the number of unusable updates.
        self._last: Any = None
        self._left_out = 0
        self._profile = qos.MAP
        self.liveliness = Liveliness()
        # By content: map, updates, pose, path and lease.
        self._subscriptions: dict[str, Any] = {}
        if messages.MapUpdate is not None:
            updates = messages.MapUpdate, f"{topic}_updates", self._take_update
            self._subscribe("updates", *updates, qos.STREAM)
        self._subscribe("map", OccupancyGrid, topic, self._take_map, self._profile)
        # NAME of NAME/map, empty for /map; None for other topics.
        self._stem = topic.removesuffix(MAP_SUFFIX) if topic.endswith(MAP_SUFFIX) else None
        self._pose_type: Any = PoseStamped
        self._hear_poses()

    @property
    def lost(self) -> str:
        """Why the input is lost, one line; else empty."""
        now_s = time.monotonic()
        if self.liveliness.is_dead(now_s):
            return Reason.SILENT.says(seconds=self._lost_after_s)
        since_s = self.silent_since_s
        if since_s is not None and now_s - since_s > self._lost_after_s:
            return Reason.UNPUBLISHED.says(topic=self._base.resolved(self.topic))
        return ""

    def ask(self, lost_after_s: float) -> None:
        """Change the time after which the input is lost."""
        if lost_after_s != self._lost_after_s:
            self._lost_after_s = lost_after_s
            self._close("lease")
            self.liveliness = Liveliness()
            self._watch()

    def hear_path(self, on_path: Callable[[bytes], None]) -> None:
        """Subscribe to ``NAME/path``, serialized."""
        if self._stem is not None and "path" not in self._subscriptions:
            self._subscribe("path", Path, f"{self._stem}/path", on_path, qos.MAP, raw=True)

    def close(self) -> None:
        """End all subscriptions."""
        self._base.diagnostics.clear(f"pose type {self.name}")
        self._base.diagnostics.clear(f"pose frame {self.name}")
        for what in [*self._subscriptions]:
            self._close(what)

    def look(self) -> None:
        """Check the map's publishers, and adapt the subscriptions to what they offer."""
        self._hear_poses()
        self._watch()
        profile = qos.map_qos(self._base.node, self.topic)
        if profile is None:
            if self.silent_since_s is None:
                self.silent_since_s = time.monotonic()
            return
        self.silent_since_s = None
        if profile != self._profile:
            self._profile = profile
            self._close("map")
            self._subscribe("map", OccupancyGrid, self.topic, self._take_map, profile)

    def _subscribe(self, what: str, *wanted: Any, **more: Any) -> None:
        self._subscriptions[what] = self._base.subscribe(*wanted, **more)

    def _close(self, what: str) -> None:
        if what in self._subscriptions:
            self._base.node.destroy_subscription(self._subscriptions.pop(what))

    def _hear_poses(self) -> None:
        """Subscribe to the poses in a type that is published."""
        if self._stem is None:
            return
        topic = f"{self._stem}/pose"
        infos = self._base.node.get_publishers_info_by_topic(topic)
        types = [POSES[one.topic_type] for one in infos if one.topic_type in POSES]
        others = sorted({one.topic_type for one in infos} - POSES.keys())
        text = f"{self._base.resolved(topic)!r} carries {', '.join(others)}, which is not read"
        text += f"; wanted {' or '.join(POSES)}"
        self._base.diagnostics.say(f"pose type {self.name}", text if others else None)
        if types and self._pose_type not in types:
            self._pose_type = types[0]
            # The topic gets its new type at the next look, without a reader of the old one.
            self._close("pose")
            self._close("lease")
        elif "pose" not in self._subscriptions:
            self._subscribe("pose", self._pose_type, topic, self._take_pose, qos.SENSOR)

    def _watch(self) -> None:
        """Request liveliness once a pose writer offers a lease that is short enough."""
        if "pose" not in self._subscriptions or "lease" in self._subscriptions:
            return
        node, topic = self._base.node, f"{self._stem}/pose"
        asked_s = max(self._lost_after_s - DOUBT_S - NOTICE_S, qos.LEASE_S)
        infos = node.get_publishers_info_by_topic(topic)
        leases_s = [1e-9 * one.qos_profile.liveliness_lease_duration.nanoseconds for one in infos]
        if not any(0.0 < lease_s <= asked_s for lease_s in leases_s):
            return
        profile = qos.profile(1, reliable=False, latched=False, lease_s=asked_s)
        # Only the lease counts, not the poses.
        wanted = self._pose_type, topic, lambda _: None, profile
        # No default callbacks: writers without a lease are no problem.
        events = SubscriptionEventCallbacks(
            use_default_callbacks=False, liveliness=self._on_liveliness
        )
        try:
            lease = node.create_subscription(*wanted, raw=True, event_callbacks=events)
        except UnsupportedEventTypeError:
            # Middleware without leases: rely on its list of publishers.
            lease = node.create_subscription(*wanted, raw=True)
        self._subscriptions["lease"] = lease

    def _on_liveliness(self, event: Any) -> None:
        counts = event.alive_count, event.alive_count_change, event.not_alive_count_change
        if self.liveliness.take(*counts, time.monotonic()):
            self._on_map(self, None)

    def _take_map(self, message: Any) -> None:
        self._clocks.hear(self.name, "map", messages.stamp_s(message))
        # The sender lives, even if the last one with a lease does not.
        self.silent_since_s = None
        if self.liveliness.is_dead(time.monotonic()):
            self.liveliness.silent_since_s = None
        if messages.MapUpdate is not None:
            self._last = message
        self._on_map(self, message)

    def _take_update(self, update: Any) -> None:
        try:
            self._take_map(messages.updated_map(self._last, update))
        except GridError as error:
            self._left_out += 1
            count = f"{self._left_out} so far"
            text = f"an update of the map of {self.name!r} is left out ({count}): {error}"
            self._base.diagnostics.note(f"update {self.name}", text)

    def _take_pose(self, message: Any) -> None:
        try:
            pose = messages.pose2_from_message(getattr(message.pose, "pose", message.pose))
        except TrajectoryError as error:
            text = f"a pose of {self.name!r} is left out: {error}"
            self._base.diagnostics.note(f"pose {self.name}", text)
            return
        frame = message.header.frame_id.lstrip("/")
        text = (
            f"the pose of {self.name!r} is in frame {frame!r} and its map in {self.frame!r}: it is "
            "taken as one in the map's; publish it in that frame"
        )
        is_other = frame and self.frame and frame != self.frame
        self._base.diagnostics.say(f"pose frame {self.name}", text if is_other else None)
        stamp_s = messages.stamp_s(message)
        self._clocks.hear(self.name, "pose", stamp_s)
        if not self._clocks.is_too_far_ahead(self.name, stamp_s):
            self.pose = HeardPose(pose, message.header.stamp, stamp_s, time.monotonic())
            self._on_pose(self, self.pose)

    def read(self, message: Any) -> Grid:
        """Convert a received map, in the worker's thread; GridError if it is no grid."""
        before, self.frame = self.frame, message.header.frame_id.lstrip("/")
        if before and self.frame != before:
            text = f"the map of {self.name!r} was in {before!r} and is in {self.frame!r} now"
            self._base.diagnostics.note(f"frame {self.name}", text)
        stamp_s = messages.stamp_s(message)
        if not self._clocks.is_too_far_ahead(self.name, stamp_s):
            self.stamp_s = stamp_s
        return messages.grid_from_message(message, self.name)
