"""``MapTransform``: the transform from a producer's map to the odometry frame or the robot."""

from __future__ import annotations

import time
from typing import Any

from slamfusion.config import ProducerNodeConfig
from slamfusion.geometry import Pose2
from slamfusion.ros import messages
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.frames import TransformOutput

# Scans that come for so long without a transform are a reason to name it, seconds.
NEVER_SENT_S = 5.0


class MapTransform:
    """Sends where the odometry frame lies in the map while ``publish_tf`` is on.

    Args:
        base: the node.
        settings: of the node.
        map_frame: parent of the transform.
    """

    def __init__(self, base: NodeBase, settings: ProducerNodeConfig, map_frame: str) -> None:
        self._base = base
        self._map_frame = map_frame
        self._output: TransformOutput | None = None
        # Written by the worker that sends, read by the executor.
        self._sent_s: float | None = None
        self._due_since_s: float | None = None
        self.configure(settings)

    def configure(self, settings: ProducerNodeConfig) -> None:
        """Take changed settings."""
        self._settings = settings
        if settings.publish_tf and self._output is None:
            self._output = TransformOutput(self._base.node)

    @property
    def _child(self) -> str:
        """The frame whose place is sent: without odometry the robot itself."""
        settings = self._settings
        return settings.base_frame if settings.odometry_source == "none" else settings.odom_frame

    def send(self, pose: Pose2, odometry: Pose2 | None, stamp: Any) -> None:
        """Send the transform, where that is asked for and can be said.

        Args:
            pose: of the robot in the map; metres, radians.
            odometry: of the robot in the odometry frame at that time; None where it is not known.
            stamp: builtin_interfaces/Time of both.
        """
        settings = self._settings
        if self._output is None or not settings.publish_tf:
            return
        if settings.odometry_source != "none":
            if odometry is None:
                return
            pose = pose.compose(odometry.inverse())
        self._output.send(
            [messages.transform_to_message(pose, self._map_frame, self._child, stamp)]
        )
        self._sent_s = time.monotonic()

    def name(self, *, are_scans_coming: bool) -> None:
        """Name a transform that is not sent although scans come, and other senders of the same."""
        self._name_unsent(is_due=are_scans_coming and self._settings.publish_tf)
        rivals = {} if self._output is None else self._output.rivals()
        if rivals:
            child, parent = next(iter(rivals.items()))
            text = (
                f"another node sends the transform to {child!r} too (from {parent!r}): set "
                "publish_tf to false in all but one"
            )
            self._base.diagnostics.add("rival", Level.ERROR, text)
        else:
            self._base.diagnostics.clear("rival")

    def _name_unsent(self, *, is_due: bool) -> None:
        now_s = time.monotonic()
        if not is_due:
            self._due_since_s = None
        elif self._due_since_s is None:
            self._due_since_s = now_s
        since_s = max(self._due_since_s or now_s, self._sent_s or 0.0)
        if now_s - since_s <= NEVER_SENT_S:
            self._base.diagnostics.clear("unsent")
            return
        settings = self._settings
        wanted = {
            "topic": "odometry at the scans' times; check its topic and its stamps",
            "tf": f"transforms from {settings.base_frame!r} to {settings.odom_frame!r} at the "
            "scans' times; check base_frame and odom_frame",
            "none": "scans that are used; see what else is said",
        }[settings.odometry_source]
        text = (
            f"publish_tf is on and {self._map_frame!r} -> {self._child!r} cannot be sent: it needs "
            f"{wanted}"
        )
        self._base.diagnostics.add("unsent", Level.ERROR, text)
