"""Transforms between frames, sent and followed, with tf2_msgs or without.

Where tf2_msgs can be imported (a sourced ROS), transforms go over ``/tf`` and ``/tf_static`` as
everywhere. It is not on the Python package index; without it the same transforms go out one by one
as geometry_msgs/TransformStamped on ``transforms`` and ``transforms_static``, and come in from
there, which only our own nodes listen to; the log says so once.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped

from slamfusion.geometry import Pose2
from slamfusion.io.transforms import KEEP_S, Mount, TransformError, TransformTree
from slamfusion.ros import qos
from slamfusion.ros.base import is_first_to_say
from slamfusion.ros.messages import stamp_ns, stamp_s, transform_to_message

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # only a sourced ROS has it
    TFMessage = None

HAS_TF2 = TFMessage is not None

TF_TOPIC, TF_STATIC_TOPIC = "/tf", "/tf_static"
PLAIN_TOPIC, PLAIN_STATIC_TOPIC = "transforms", "transforms_static"
WITHOUT_TF2 = (
    "tf2_msgs cannot be imported, so there is no /tf: transforms go over the topics "
    f"{PLAIN_TOPIC!r} and {PLAIN_STATIC_TOPIC!r} (geometry_msgs/TransformStamped); source a ROS "
    "for /tf"
)

# Own transforms that are remembered, to know those of others by.
OWN_KEPT = 500
RIVAL_KEPT_S = 5.0


def _topics(node: Any) -> tuple[Any, str, str]:
    """Return the type, and the topics of moving and of static transforms."""
    if TFMessage is not None:
        return TFMessage, TF_TOPIC, TF_STATIC_TOPIC
    if is_first_to_say(WITHOUT_TF2):
        node.get_logger().warning(WITHOUT_TF2, once=True)
    return TransformStamped, PLAIN_TOPIC, PLAIN_STATIC_TOPIC


def _listed(message: Any) -> list[TransformStamped]:
    """Return the transforms of a message of either kind."""
    return list(message.transforms) if hasattr(message, "transforms") else [message]


class TransformStore:
    """A live ``TransformTree`` of messages, safe between threads, that can be waited for.

    Attributes:
        last_s: when a moving one was taken in last, ``time.monotonic``; None before the first.
    """

    def __init__(self) -> None:
        self.last_s: float | None = None
        self._tree = TransformTree(KEEP_S)
        self._changed = threading.Condition()

    def add(self, transforms: Iterable[TransformStamped], *, is_static: bool = False) -> None:
        """Take in transforms; see ``TransformTree.add``."""
        now_s = time.monotonic()
        with self._changed:
            for item in transforms:
                move, turn = item.transform.translation, item.transform.rotation
                is_used = self._tree.add(
                    item.header.frame_id,
                    item.child_frame_id,
                    stamp_s(item),
                    (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w),
                    is_static=is_static,
                    arrived_s=now_s,
                )
                if is_used and not is_static:
                    self.last_s = now_s
            self._changed.notify_all()

    def lookup(self, target: str, source: str, time_s: float, wait_s: float = 0.0) -> Pose2:
        """Return the pose of the frame ``source`` in ``target`` at a time; see ``TransformTree``.

        Args:
            wait_s: wait so long for a transform that is still to come; never in a callback.

        Raises:
            TransformError: it is not known, also after the wait.
        """
        return self.mount(target, source, time_s, wait_s).pose

    def mount(self, target: str, source: str, time_s: float, wait_s: float = 0.0) -> Mount:
        """Return the same and whether the frame is upside down."""
        until_s = time.monotonic() + wait_s
        with self._changed:
            while (left_s := until_s - time.monotonic()) > 0.0:
                try:
                    return self._tree.mount(target, source, time_s, hold_s=0.0)
                except TransformError as error:
                    if not error.may_come:
                        break
                self._changed.wait(left_s)
            return self._tree.mount(target, source, time_s)

    def forget_after(self, time_s: float) -> None:
        """Forget moving transforms newer than a time: the clock has jumped back before them."""
        with self._changed:
            self._tree.forget_after(time_s)

    def settle(self, time_s: float) -> None:
        """Let in what is held back: time is there now; see ``TransformTree.settle``."""
        with self._changed:
            self._tree.settle(time_s)
            self._changed.notify_all()

    def heard_s(self, target: str, source: str) -> float | None:
        """Return the stamp heard last of what moves a frame; see ``TransformTree.heard_s``."""
        with self._changed:
            return self._tree.heard_s(target, source)

    @property
    def strays(self) -> int:
        """Transforms left out for their stamps, far from those before and after them."""
        with self._changed:
            return self._tree.strays

    @property
    def frames(self) -> set[str]:
        """Every frame that has been named."""
        with self._changed:
            return self._tree.frames


class TransformInput(TransformStore):
    """Follows the transforms that others send to an rclpy node, whose executor must spin."""

    def __init__(self, node: Any) -> None:
        super().__init__()
        kind, moving, static = _topics(node)
        self._subscriptions = [
            node.create_subscription(kind, moving, lambda m: self.add(_listed(m)), qos.TF),
            node.create_subscription(
                kind, static, lambda m: self.add(_listed(m), is_static=True), qos.TF_STATIC_READ
            ),
        ]


class TransformOutput:
    """Sends transforms, and notices when another node sends the same.

    Two senders of one child frame make it jump between two places; see ``rival``.

    Args:
        node: an rclpy node; its executor must spin for ``rival``.
    """

    def __init__(self, node: Any) -> None:
        self._lock = threading.Lock()
        self._own: deque[tuple[Any, ...]] = deque(maxlen=OWN_KEPT)
        self._children: set[str] = set()
        self._rivals: dict[str, tuple[str, float]] = {}
        kind, moving, static = _topics(node)
        static_qos = qos.TF_STATIC if HAS_TF2 else qos.TF_STATIC_READ
        self._moving = node.create_publisher(kind, moving, qos.TF)
        self._latched = node.create_publisher(kind, static, static_qos)
        self._subscription = node.create_subscription(kind, moving, self._listen, qos.TF)

    def send(self, pose: Pose2, parent: str, child: str, stamp: Time) -> None:
        """Send the pose of a frame in another one, which holds at a stamp."""
        item = transform_to_message(pose, parent, child, stamp)
        with self._lock:
            self._own.append(_key(item))
            self._children.add(child)
        self._publish(self._moving, item)

    def send_static(self, pose: Pose2, parent: str, child: str, stamp: Time) -> None:
        """Send one that holds from now on, the only one; a late listener gets it too."""
        self._publish(self._latched, transform_to_message(pose, parent, child, stamp))

    def rival(self, first: str = "") -> tuple[str, str]:
        """Return a child frame that another node sent in the last seconds, and that in words.

        Args:
            first: the frame that is named where there are several.
        """
        since_s = time.monotonic() - RIVAL_KEPT_S
        with self._lock:
            rivals = self._rivals.items()
            found = {child: parent for child, (parent, seen_s) in rivals if seen_s > since_s}
        child = first if first in found else next(iter(found), "")
        if not child:
            return "", ""
        return child, f"another node sends the transform to {child!r} too (from {found[child]!r})"

    @staticmethod
    def _publish(publisher: Any, item: TransformStamped) -> None:
        publisher.publish(TFMessage(transforms=[item]) if HAS_TF2 else item)

    def _listen(self, message: Any) -> None:
        """Take note of foreign transforms to a child frame of ours."""
        with self._lock:
            for item in _listed(message):
                if item.child_frame_id in self._children and _key(item) not in self._own:
                    self._rivals[item.child_frame_id] = (item.header.frame_id, time.monotonic())


def _key(item: TransformStamped) -> tuple[Any, ...]:
    """Return what tells one transform from another's."""
    move, turn = item.transform.translation, item.transform.rotation
    place = move.x, move.y, turn.z, turn.w
    return (item.header.frame_id, item.child_frame_id, stamp_ns(item), *place)
