"""``FusedFrames``: the fused frame's transforms and the robot's pose in it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry

from slamfusion.config import FusionNodeConfig
from slamfusion.errors import TrajectoryError
from slamfusion.fusion.live import LiveInput
from slamfusion.geometry import Pose2
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.frames import TransformError, TransformInput, TransformOutput, TransformStore
from slamfusion.ros.map_source import HeardPose, MapSource

__all__ = ["Believed", "FusedFrames"]

ODOM_TOPIC, POSE_TOPIC = "odom", "fused/pose"
# A pose that is older says nothing of its producer's health now.
POSE_FRESH_S = 2.0
SHOWN_S = 10.0


@dataclass(frozen=True)
class Believed:
    """What the last fusion believes; replaced as a whole, so that threads need no lock.

    Attributes:
        inputs: by name.
        reference: name of the input that others are aligned to.
    """

    inputs: Mapping[str, LiveInput] = field(default_factory=dict)
    reference: str = ""

    def transform(self, name: str) -> Pose2 | None:
        """Return an input's map frame in the fused frame; None while it does not vote."""
        record = self.inputs.get(name)
        return None if record is None or not record.accepted else record.transform


class FusedFrames:
    """Sends fused_map -> every voter's map frame, the fused pose, and fused_map -> odom.

    A voter's transform goes out with every pose that it tells, at that pose's stamp; those without
    poses get the newest stamp of anything heard. The pose is that of the healthiest voter: the
    reference, or else the best score; it stays with one until that one votes no more or is silent.

    Args:
        base: the node.
        settings: of the node.

    Attributes:
        settings: may be replaced.
        believed: set by whoever fuses.
        leader: name of the input whose pose is taken; empty without.
    """

    def __init__(self, base: NodeBase, settings: FusionNodeConfig) -> None:
        self.settings = settings
        self.believed = Believed()
        self.leader = ""
        self._base = base
        self._sources: dict[str, MapSource] = {}
        self._newest_s: float | None = None
        self._sent: dict[str, tuple[float, Pose2]] = {}
        self._told = self.believed
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
        transform = self.believed.transform(source.name)
        if heard is None or transform is None:
            return
        self._note(messages.stamp_s(heard.stamp))
        self._send_frame(source, transform, heard.stamp)
        self.leader = self._choose()
        if source.name == self.leader:
            pose = transform.compose(heard.pose)
            frame = self.settings.fused_frame
            self._pose_topic.publish(messages.pose_to_message(pose, frame, heard.stamp))
            if self.settings.publish_tf:
                self._send_odometry(pose, heard)

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
        if self._told is not self.believed:
            self._told = self.believed
            for source in self._sources.values():
                self.on_pose(source)
        for source in self._sources.values():
            transform = self.believed.transform(source.name)
            has_pose = source.pose is not None and now_s - source.pose.heard_s < POSE_FRESH_S
            if source.stamp_s is not None:
                self._note(source.stamp_s)
            if transform is not None and not has_pose and self._newest_s is not None:
                self._send_frame(source, transform, messages.to_stamp(self._newest_s))
        self._name_frames()

    def on_time_jump(self, now_s: float) -> None:
        """Forget what came of a future that has not come; ``now_s`` is the node's time."""
        self._odometry.forget_after(now_s)
        self._newest_s = None
        self._sent.clear()

    def _note(self, stamp_s: float) -> None:
        self._newest_s = stamp_s if self._newest_s is None else max(self._newest_s, stamp_s)

    def _send_frame(self, source: MapSource, transform: Pose2, stamp: Any) -> None:
        """Send where an input's map frame lies, once the same, and for one input a frame."""
        frame, parent = source.frame, self.settings.fused_frame
        if not frame or frame == parent or self._owner(frame) != source.name:
            return
        told = messages.stamp_s(stamp), transform
        if self._sent.get(frame) == told:
            return
        self._sent[frame] = told
        self._output.send([messages.transform_to_message(transform, parent, frame, stamp)])

    def _owner(self, frame: str) -> str:
        """Return the first voter whose map has this frame."""
        for source in self._sources.values():
            if source.frame == frame and self.believed.transform(source.name) is not None:
                return source.name
        return ""

    def _send_odometry(self, pose: Pose2, heard: HeardPose) -> None:
        """Send where the odometry frame lies, from the robot's pose in the fused frame."""
        settings, troubles = self.settings, self._base.troubles
        stamp_s = messages.stamp_s(heard.stamp)
        try:
            odometry = self._odometry.lookup(settings.odom_frame, settings.base_frame, stamp_s)
        except TransformError as error:
            troubles.add(
                "odometry",
                Level.WARN,
                f"no odometry for {settings.fused_frame} -> {settings.odom_frame}: {error}",
            )
            return
        troubles.clear("odometry")
        self._output.send(
            [
                messages.transform_to_message(
                    pose.compose(odometry.inverse()),
                    settings.fused_frame,
                    settings.odom_frame,
                    heard.stamp,
                )
            ]
        )

    def _on_odometry(self, message: Any) -> None:
        """Keep a pose of the odometry."""
        try:
            pose = messages.pose2_from_message(message.pose.pose)
        except TrajectoryError as error:
            text = f"odometry left out: {error}"
            self._base.troubles.add("odometry values", Level.WARN, text, SHOWN_S)
            return
        names = self.settings.odom_frame, self.settings.base_frame
        stamp = message.header.stamp
        self._odometry.add([messages.transform_to_message(pose, *names, stamp)])

    def _name_frames(self) -> None:
        """Name frames that two inputs share, that are the fused one, and rivals on a transform."""
        frames = [source.frame for source in self._sources.values() if source.frame]
        shared = sorted({frame for frame in frames if frames.count(frame) > 1})
        self._say(
            "shared frame",
            f"{len(frames)} maps, and more than one is in frame {shared[0]!r}: the transform of "
            "the first is sent; give each its own frame_id"
            if shared
            else None,
        )
        fused = self.settings.fused_frame
        self._say(
            "own frame",
            f"an input's map is in {fused!r}, the frame of the fused map; rename one of them"
            if fused in frames
            else None,
        )
        rivals = self._output.rivals()
        child = next(iter(rivals), None)
        self._say(
            "rival",
            None
            if child is None
            else f"another node sends the transform to {child!r} too (from {rivals[child]!r}): set "
            "publish_tf to false in all but one",
            Level.ERROR,
        )

    def _say(self, key: str, text: str | None, level: Level = Level.WARN) -> None:
        if text is None:
            self._base.troubles.clear(key)
        else:
            self._base.troubles.add(key, level, text)
