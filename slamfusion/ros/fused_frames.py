"""``FusedFrames``: the fused frame's transforms and the robot's pose in it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry

from slamfusion.config import FusionNodeConfig
from slamfusion.errors import TrajectoryError
from slamfusion.fusion.live.session import Believed
from slamfusion.geometry import Pose2
from slamfusion.io.transform_edge import TransformError
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.child_frames import ChildFrames
from slamfusion.ros.frame_warnings import FrameWarnings
from slamfusion.ros.frames import TransformInput, TransformOutput, TransformStore
from slamfusion.ros.map_source import HeardPose, MapSource

ODOM_TOPIC, POSE_TOPIC = "odom", "fused/pose"
# A stamp of an input this far behind its last one begins a new time: a bag that loops.
BACK_NS = 10**9
# What a new fusion says of a stamp that has been told already is told this much later, so that no
# stamp comes twice; less than what float seconds of today can tell apart twice over.
STEP_NS = 1000
# A pose that is older says nothing of its producer's health now.
POSE_FRESH_S = 2.0
SHOWN_S = 10.0


class FusedFrames:
    """Sends fused_map -> every voter's map frame, the fused pose, and fused_map -> odom.

    Where several inputs call their frames the same, each but the first has one of its own; see
    ``ChildFrames``.

    A voter's transform goes out with every pose that it tells, at that pose's stamp; those without
    poses get the newest stamp of anything heard. The pose is that of the healthiest voter: the
    reference, or else the best score; it stays with one until that one votes no more or is silent.
    The stamps of each of them only grow: what a new fusion changes of a stamp that was told already
    is told a microsecond later, and the pose of a new leader is told from its first newer stamp on.

    Args:
        base: the node.
        settings: of the node.

    Attributes:
        settings: may be replaced.
        believed: set by whoever fuses.
        leader: name of the input whose pose is taken; empty without.
        rival: name of another node that fuses into the same topic; empty without.
    """

    def __init__(self, base: NodeBase, settings: FusionNodeConfig) -> None:
        self.settings = settings
        self.believed = Believed()
        self.leader = ""
        self.rival = ""
        self._base = base
        self._sources: dict[str, MapSource] = {}
        self._children = ChildFrames([settings.fused_frame])
        self._newest_s: float | None = None
        # The last stamp and what was sent with it: by child frame, and of the fused pose.
        self._sent: dict[str, tuple[int, Pose2]] = {}
        self._heard_ns: dict[str, int] = {}
        self._has_sent_odometry = False
        self._told = self.believed
        self._warnings = FrameWarnings(base.diagnostics)
        self._output = TransformOutput(base.node)
        self._pose_topic = base.publisher(PoseStamped, POSE_TOPIC, qos.STREAM)
        self._odometry: TransformStore
        if settings.odometry_source == "tf":
            self._odometry = TransformInput(base.node)
        else:
            self._odometry = TransformStore()
            base.subscribe(Odometry, ODOM_TOPIC, self._on_odometry, qos.SENSOR)

    def watch(self, sources: Mapping[str, MapSource]) -> None:
        """Take the inputs whose frames are sent."""
        self._sources = dict(sources)

    def on_pose(self, source: MapSource) -> None:
        """Send what a new pose of an input tells."""
        heard = source.pose
        if heard is None:
            return
        stamp_ns = messages.stamp_ns(heard.stamp)
        if stamp_ns < self._heard_ns.get(source.name, stamp_ns) - BACK_NS:
            self._go_back(stamp_ns)
        self._heard_ns[source.name] = stamp_ns
        self._tell(source, heard, is_revised=False)

    def _tell(self, source: MapSource, heard: HeardPose, *, is_revised: bool) -> None:
        """Send what a pose says; ``is_revised``: it was told before, and may be told otherwise."""
        transform = self.believed.transform(source.name)
        if transform is None:
            return
        self._note(messages.stamp_s(heard.stamp))
        self._send_frame(source, transform, heard.stamp)
        self.leader = self._choose()
        if source.name != self.leader:
            return
        settings = self.settings
        pose = transform.compose(heard.pose)
        stamp = self._fresh(POSE_TOPIC, heard.stamp, pose, is_revised=is_revised)
        if stamp is not None:
            frame = settings.fused_frame
            self._pose_topic.publish(messages.pose_to_message(pose, frame, stamp))
        if settings.publish_tf:
            self._send_odometry(pose, heard, is_revised=is_revised)

    def _fresh(self, key: str, stamp: Any, value: Pose2, *, is_revised: bool) -> Any:
        """Return the stamp that a value is to be sent with; None where it is not to be sent.

        Args:
            key: the child frame, or the topic.
            stamp: builtin_interfaces/Time that the value holds for.
            value: what is sent.
            is_revised: an older stamp may be told again, later, where the value is another now.
        """
        stamp_ns = messages.stamp_ns(stamp)
        last = self._sent.get(key)
        if last is not None and stamp_ns <= last[0]:
            if not is_revised or last[1] == value:
                return None
            stamp_ns = last[0] + STEP_NS
        self._sent[key] = stamp_ns, value
        return messages.ns_to_stamp(stamp_ns)

    def _go_back(self, stamp_ns: int) -> None:
        """Forget what was sent for a future that has not come: time begins at a stamp."""
        self._newest_s = None
        future = [key for key, (sent_ns, _) in self._sent.items() if sent_ns > stamp_ns + BACK_NS]
        for key in future:
            del self._sent[key]

    def _choose(self) -> str:
        """Return the name of the healthiest voter that tells poses; empty without."""
        now_s = time.monotonic()
        fresh = {
            name: record
            for name, record in self.believed.inputs.items()
            if record.accepted
            and (source := self._sources.get(name)) is not None
            and source.pose is not None
            and now_s - source.pose.heard_s < POSE_FRESH_S
        }
        for name in (self.leader, self.believed.reference):
            if name in fresh:
                return name
        return max(fresh, key=lambda name: fresh[name].score, default="")

    def look(self) -> None:
        """Send what a new fusion changed, and the frames of voters that tell no poses.

        And name what is wrong with frames.
        """
        now_s = time.monotonic()
        for source in self._sources.values():
            self.child_frame(source)  # claimed in the order of the inputs, whoever votes first
        if self._told is not self.believed:
            self._told = self.believed
            for source in self._sources.values():
                if source.pose is not None:
                    self._tell(source, source.pose, is_revised=True)
        for source in self._sources.values():
            transform = self.believed.transform(source.name)
            has_pose = source.pose is not None and now_s - source.pose.heard_s < POSE_FRESH_S
            if source.stamp_s is not None:
                self._note(source.stamp_s)
            if transform is not None and not has_pose and self._newest_s is not None:
                self._send_frame(source, transform, messages.to_stamp(self._newest_s))
        self._warnings.update(
            self.settings,
            self.believed,
            frames=[source.frame for source in self._sources.values() if source.frame],
            renamed=self._children.renamed(),
            rivals=self._output.rivals(),
            other_fusion=self.rival,
            leader=self.leader,
            has_sent_odometry=self._has_sent_odometry,
        )

    def on_time_jump(self, now_s: float) -> None:
        """Forget what came of a future that has not come; ``now_s`` is the node's time."""
        self._odometry.forget_after(now_s)
        self._newest_s = None
        self._sent.clear()
        self._heard_ns.clear()

    def _note(self, stamp_s: float) -> None:
        self._newest_s = stamp_s if self._newest_s is None else max(self._newest_s, stamp_s)

    def _send_frame(self, source: MapSource, transform: Pose2, stamp: Any) -> None:
        """Send where an input's map frame lies, once the same."""
        frame, parent = self.child_frame(source), self.settings.fused_frame
        if not frame:
            return
        fresh = self._fresh(frame, stamp, transform, is_revised=True)
        if fresh is not None:
            self._output.send([messages.transform_to_message(transform, parent, frame, fresh)])

    def child_frame(self, source: MapSource) -> str:
        """Return the frame that an input's transform is sent to; empty without one."""
        if not source.frame or source.frame == self.settings.fused_frame:
            return ""
        topic = self._base.node.resolve_topic_name(source.topic)
        return self._children.of(source.name, topic, source.frame)

    def _send_odometry(self, pose: Pose2, heard: HeardPose, *, is_revised: bool) -> None:
        """Send where the odometry frame lies, from the robot's pose in the fused frame."""
        settings, diagnostics = self.settings, self._base.diagnostics
        parent, child = settings.fused_frame, settings.odom_frame
        try:
            odometry = self._odometry.lookup(
                child, settings.base_frame, messages.stamp_s(heard.stamp)
            )
        except TransformError as error:
            diagnostics.add("odometry", Level.WARN, f"no odometry for {parent} -> {child}: {error}")
            return
        diagnostics.clear("odometry")
        moved = pose.compose(odometry.inverse())
        stamp = self._fresh(child, heard.stamp, moved, is_revised=is_revised)
        if stamp is not None and child != parent:
            self._has_sent_odometry = True
            self._output.send([messages.transform_to_message(moved, parent, child, stamp)])

    def _on_odometry(self, message: Any) -> None:
        """Keep a pose of the odometry."""
        try:
            pose = messages.pose2_from_message(message.pose.pose)
        except TrajectoryError as error:
            text = f"odometry left out: {error}"
            self._base.diagnostics.add("odometry values", Level.WARN, text, SHOWN_S)
            return
        names = self.settings.odom_frame, self.settings.base_frame
        stamp = message.header.stamp
        self._odometry.add([messages.transform_to_message(pose, *names, stamp)])
