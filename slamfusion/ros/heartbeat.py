"""``Heartbeat``: whether the process that writes a topic still lives, however little it sends.

A robot that stands still, or whose log has ended, makes no maps and no poses, and its SLAMs are
well; one whose process was killed or frozen must lose its vote. Neither messages nor diagnostics
tell the two apart soon enough: a node that is busy with a loop closure is late with both. So the
poses of our producers are offered with a DDS liveliness lease, which the process renews three times
a second from a thread that neither Python nor a long computation holds up, and a second reader of
the pose topic asks for that lease. A reader that asks hears nothing from writers that offer none
(the SLAMs of others), so it is no part of the reading of poses, and such inputs are told from dead
ones only by DDS itself, after the lease of a participant (20 s by default).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError

from slamfusion.ros import qos
from slamfusion.ros.base import NodeBase

# A lease that ran out is believed after this long, seconds: when this process itself was stopped,
# every lease seems to have run out at once, and the next sign of life is a third of a second away.
DOUBT_S = 0.5
# Kept of the time after which a writer is dead, seconds, to see it and to say so.
NOTICE_S = 0.2


class Liveliness:
    """What the events of a lease say of the writers of a topic, seconds on a growing clock.

    Attributes:
        is_back: whether the writer that lives now is the one that had fallen silent. It stands
            until all are silent again: under load a lease may run out and be renewed more than once
            before anybody asks.
    """

    def __init__(self) -> None:
        """Start without writers."""
        self.is_back = False
        self._silent_since_s: float | None = None
        self._lives = False

    def take(self, alive: int, alive_change: int, not_alive_change: int, now_s: float) -> bool:
        """Take an event; return whether there are writers that live now, or none any more.

        Of a writer that is given up before its first sign of life Fast DDS takes one from the
        living that it was never added to, so a count may be too small from then on, and a change
        tells more.

        Args:
            alive: writers that renew their lease, or fewer.
            alive_change: how many more do since the last event.
            not_alive_change: how many more do not.
            now_s: when.
        """
        had, self._lives = self._lives, alive > 0 or alive_change > 0
        if self._lives:
            self._silent_since_s = None
            if not had:
                self.is_back = not_alive_change < 0
        else:
            self.is_back = False
            if not_alive_change > 0 and self._silent_since_s is None:
                self._silent_since_s = now_s
        # Without any writer: one that said good-bye is missed by who reads the maps, one that had
        # fallen silent has now been given up by DDS, and stays dead.
        return had != self._lives

    def is_dead(self, now_s: float) -> bool:
        """Whether every writer has fallen silent, and none has taken its place."""
        since_s = self._silent_since_s
        return since_s is not None and now_s - since_s > DOUBT_S

    def forgive(self) -> None:
        """Take the writers for living ones until their lease runs out anew."""
        self._silent_since_s = None


class Heartbeat:
    """Watches the liveliness lease that the writers of a pose topic offer.

    All in the executor's thread.

    Args:
        base: the node.
        topic: of poses.
        lost_after_s: a writer without a sign of life for this long is dead; below one second it is
            taken for one.
        on_change: called when a writer has fallen silent or is back.

    """

    def __init__(
        self, base: NodeBase, topic: str, lost_after_s: float, on_change: Callable[[], None]
    ) -> None:
        self._base = base
        self._topic = topic
        self._on_change = on_change
        self._writers = Liveliness()
        self._lost_after_s = lost_after_s
        self._subscription: Any = None

    @property
    def is_dead(self) -> bool:
        """Whether every writer with a lease has fallen silent, and none has taken its place."""
        return self._writers.is_dead(time.monotonic())

    @property
    def is_back(self) -> bool:
        """Whether the writer that lives now is the one that had fallen silent."""
        return self._writers.is_back

    def look(self) -> None:
        """Begin to watch when a writer offers a lease."""
        if self._subscription is None:
            infos = self._base.node.get_publishers_info_by_topic(self._topic)
            leases_s = [1e-9 * i.qos_profile.liveliness_lease_duration.nanoseconds for i in infos]
            if any(0.0 < lease_s <= self._lease_s for lease_s in leases_s):
                self._subscription = self._listen()

    @property
    def _lease_s(self) -> float:
        return max(self._lost_after_s - DOUBT_S - NOTICE_S, qos.LEASE_S)

    def forgive(self) -> None:
        """Take note that somebody sends: the topic lives, whatever became of the lease."""
        if self.is_dead:
            self._writers.forgive()

    def ask(self, lost_after_s: float) -> None:
        """Ask for another lease, if it is one."""
        if lost_after_s == self._lost_after_s:
            return
        self._lost_after_s = lost_after_s
        self.close()
        self._writers = Liveliness()
        self.look()

    def close(self) -> None:
        """Watch no more."""
        if self._subscription is not None:
            self._base.node.destroy_subscription(self._subscription)
            self._subscription = None

    def _listen(self) -> Any:
        profile = qos.heartbeat(self._lease_s)
        try:
            return self._base.node.create_subscription(
                PoseStamped,
                self._topic,
                _ignore,
                profile,
                # Without the default ones: that others offer no lease is nothing to warn of.
                event_callbacks=SubscriptionEventCallbacks(
                    use_default_callbacks=False, liveliness=self._on_liveliness
                ),
                raw=True,
            )
        except UnsupportedEventTypeError:
            # This middleware has no leases; its own word that nobody publishes must do.
            return self._base.node.create_subscription(
                PoseStamped, self._topic, _ignore, profile, raw=True
            )

    def _on_liveliness(self, event: Any) -> None:
        counts = event.alive_count, event.alive_count_change, event.not_alive_count_change
        if self._writers.take(*counts, time.monotonic()):
            self._on_change()


def _ignore(_: Any) -> None:
    """Take no note of a pose; it is the lease that counts."""
