"""Send and receive transforms, with tf2_msgs or without.

With tf2_msgs (a sourced ROS), transforms use ``/tf`` and ``/tf_static``. It is not on the Python
package index; without it our nodes exchange the same transforms as geometry_msgs/TransformStamped
on ``transforms`` and ``transforms_static``.
"""

from __future__ import annotations

import math
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

# Own transforms kept, to recognise those of others, and for how long both senders count, seconds.
OWN_KEPT = 500
RIVAL_KEPT_S = 5.0


def _topics(node: Any) -> tuple[Any, str, str]:
    """Return the type, and the topics of moving and static transforms."""
    if TFMessage is not None:
        return TFMessage, TF_TOPIC, TF_STATIC_TOPIC
    if is_first_to_say(WITHOUT_TF2):
        node.get_logger().warning(WITHOUT_TF2, once=True)
    return TransformStamped, PLAIN_TOPIC, PLAIN_STATIC_TOPIC


def _listed(message: Any) -> list[TransformStamped]:
    return list(message.transforms) if hasattr(message, "transforms") else [message]


class TransformStore:
    """A thread-safe live ``TransformTree`` of messages, with waiting lookups.

    Attributes:
        last_s: ``time.monotonic`` of the last moving transform; None before the first.
        is_awaited: whether a lookup waits for a transform now.
    """

    def __init__(self) -> None:
        self.last_s: float | None = None
        self.is_awaited = False
        self._tree = TransformTree(KEEP_S)
        self._changed = threading.Condition()

    def add(self, transforms: Iterable[TransformStamped], *, is_static: bool = False) -> None:
        """Add transforms; see ``TransformTree.add``."""
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

        TransformError: it is unknown, also after waiting for ``wait_s``; never in a callback.
        """
        return self.mount(target, source, time_s, wait_s).pose

    def mount(self, target: str, source: str, time_s: float, wait_s: float = 0.0) -> Mount:
        """Return the same as a mount."""
        until_s = time.monotonic() + wait_s
        with self._changed:
            while (left_s := until_s - time.monotonic()) > 0.0:
                try:
                    return self._tree.mount(target, source, time_s, hold_s=0.0)
                except TransformError as error:
                    if not error.may_come:
                        break
                self.is_awaited = True
                self._changed.wait(left_s)
                self.is_awaited = False
            return self._tree.mount(target, source, time_s)

    def forget_after(self, time_s: float) -> None:
        """Forget moving transforms newer than a time, after a jump back of the clock."""
        with self._changed:
            self._tree.forget_after(time_s)

    def settle(self, time_s: float) -> None:
        """See ``TransformTree.settle``."""
        with self._changed:
            self._tree.settle(time_s)
            self._changed.notify_all()

    def heard_s(self, target: str, source: str) -> float | None:
        """See ``TransformTree.heard_s``."""
        with self._changed:
            return self._tree.heard_s(target, source)

    @property
    def strays(self) -> int:
        """Transforms dropped for their stamps."""
        with self._changed:
            return self._tree.strays


class TransformInput(TransformStore):
    """Receives the transforms for an rclpy node, whose executor must spin."""

    def __init__(self, node: Any) -> None:
        super().__init__()
        kind, moving, static = _topics(node)
        node.create_subscription(kind, moving, lambda m: self.add(_listed(m)), qos.TF)
        node.create_subscription(
            kind, static, lambda m: self.add(_listed(m), is_static=True), qos.TF_STATIC_READ
        )


class TransformOutput:
    """Sends transforms, and detects other senders of the same child frames (while it spins)."""

    def __init__(self, node: Any) -> None:
        self._lock = threading.Lock()
        self._own: deque[tuple[Any, ...]] = deque(maxlen=OWN_KEPT)
        self._sent_s: dict[str, float] = {}
        self._rivals: dict[str, tuple[str, float]] = {}
        kind, moving, static = _topics(node)
        static_qos = qos.TF_STATIC if HAS_TF2 else qos.TF_STATIC_READ
        self._moving = node.create_publisher(kind, moving, qos.TF)
        self._latched = node.create_publisher(kind, static, static_qos)
        node.create_subscription(kind, moving, self._listen, qos.TF)

    def send(self, parent: str, *poses: tuple[str, Pose2, Time], is_static: bool = False) -> None:
        """Send poses of frames in another one, each with its stamp, in one message if there is /tf.

        The one static pose is latched.
        """
        items = [transform_to_message(pose, parent, child, stamp) for child, pose, stamp in poses]
        publisher = self._latched if is_static else self._moving
        if not is_static:
            with self._lock:
                self._own.extend(map(_key, items))
                children = (item.child_frame_id for item in items)
                self._sent_s |= dict.fromkeys(children, time.monotonic())
        for message in [TFMessage(transforms=items)] if HAS_TF2 and items else items:
            publisher.publish(message)

    def rival(self, first: str = "") -> tuple[str, str]:
        """Return a child frame that another node sent in the last seconds, and a sentence.

        ``first`` is preferred if there are several.
        """
        since_s = time.monotonic() - RIVAL_KEPT_S
        with self._lock:
            found = {child: own[0] for child, own in self._rivals.items() if own[1] > since_s}
        child = first if first in found else next(iter(found), "")
        if not child:
            return "", ""
        return child, f"another node sends the transform to {child!r} too (from {found[child]!r})"

    def _listen(self, message: Any) -> None:
        """Note foreign transforms to a child frame that was sent in the last seconds."""
        now_s = time.monotonic()
        with self._lock:
            for item in _listed(message):
                child = item.child_frame_id
                is_ours = now_s - self._sent_s.get(child, -math.inf) < RIVAL_KEPT_S
                if is_ours and _key(item) not in self._own:
                    self._rivals[child] = (item.header.frame_id, now_s)


def _key(item: TransformStamped) -> tuple[Any, ...]:
    move, turn = item.transform.translation, item.transform.rotation
    names = item.header.frame_id, item.child_frame_id
    return (*names, stamp_ns(item), move.x, move.y, turn.z, turn.w)
