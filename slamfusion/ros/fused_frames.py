"""``FusedFrames``: the fused frame's transforms and the robot's pose in it."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from slamfusion.config import FusionNodeConfig, LiveConfig
from slamfusion.fusion.live.driving import OdomFrame, PoseSpread
from slamfusion.fusion.live.session import FusionState
from slamfusion.geometry import Pose2
from slamfusion.io.transforms import TransformError
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.frames import TransformOutput, TransformStore
from slamfusion.ros.input_health import HeardPose, MapSource

POSE_TOPIC = "fused/pose"
# A stamp of an input this far behind its last one begins a new time: a bag that loops.
BACK_NS = 10**9
# What a new fusion says of a stamp that has been told already is told this much later, so that no
# stamp comes twice; less than what float seconds of today can tell apart twice over.
STEP_NS = 1000
# A pose that is older says nothing of its producer's health now.
POSE_FRESH_S = 2.0
# publish_tf that has sent nothing for so long since somebody votes is named, seconds.
TF_LATE_S = 5.0
# A correction of fused_map -> odom that takes longer is named, seconds.
LONG_S = 2.0


class ChildFrames:
    """The frame that each input's transform is sent to, where several maps claim one.

    Two robots that run the same programs call their maps' frames the same. The first that claims a
    frame keeps it; the frame of another is put into as much of its topic's namespace as tells the
    two apart: ``graph_map`` of ``robot2/graph/map`` is ``robot2/graph_map`` where that of
    ``robot1/graph/map`` came before. What was told once stays: no frame changes its place when
    others come, go or lose their votes.

    Args:
        taken: frames that no input may have, such as the fused one.
    """

    def __init__(self, taken: Collection[str] = ()) -> None:
        self._taken = set(taken)
        # The child frame and its input's namespace, by the input's name and its map's frame.
        self._children: dict[tuple[str, str], tuple[str, tuple[str, ...]]] = {}

    def of(self, name: str, topic: str, frame: str) -> str:
        """Return the frame that an input's transform is sent to.

        Args:
            topic: of its maps, resolved.
            frame: of its maps; not empty.
        """
        key = name, frame
        if key not in self._children:
            space = _space(topic)
            others = [theirs for (_, own), (_, theirs) in self._children.items() if own == frame]
            child = next(self._names(space, frame, others)) if others else frame
            self._children[key] = child, space
            self._taken.add(child)
        return self._children[key][0]

    def renamed(self) -> dict[str, tuple[str, str]]:
        """Return the map's frame and the one that is sent, of inputs where these differ."""
        return {
            name: (frame, child)
            for (name, frame), (child, _) in self._children.items()
            if child != frame
        }

    def _names(
        self, space: tuple[str, ...], frame: str, others: Collection[tuple[str, ...]]
    ) -> Iterator[str]:
        """Yield names that nobody has, the one with the shortest namespace first."""
        for length in range(1, len(space) + 1):
            is_own = all(theirs[:length] != space[:length] for theirs in others)
            child = "/".join((*space[:length], frame))
            if is_own and child not in self._taken:
                yield child
        number = 2
        while True:
            child = "/".join((*space, f"{frame}_{number}"))
            if child not in self._taken:
                yield child
            number += 1


def _space(topic: str) -> tuple[str, ...]:
    """Return the words of a topic but the last ``map``; of a bare topic that is all."""
    words = tuple(filter(None, topic.split("/")))
    return words[:-1] if len(words) > 1 and words[-1] == "map" else words


class FusedFrames:
    """Sends fused_map -> every voter's map frame, the fused pose, and fused_map -> odom.

    Where several inputs call their frames the same, each but the first has one of its own; see
    ``ChildFrames``.

    A voter's transform goes out with every pose that it tells, at that pose's stamp; those without
    poses get the newest stamp of anything heard. The pose is that of the healthiest voter: the
    reference, or else the best score; it stays with one until that one votes no more or is silent.
    The stamps of each of them only grow: what a new fusion changes of a stamp that was told already
    is told a microsecond later, and the pose of a new leader is told from its first newer stamp on.
    The transform to the odometry frame is sent at stamps of the odometry; see ``OdomFrame``.

    Attributes:
        settings, live: may be replaced.
        sources: the inputs whose frames are sent, by name; set by the node.
        state: of the fusion; set by the node.
        corrections: by input that the scans support, the motion that carries its newest poses onto
            the fused path; set by the node, empty without scans. The pose goes by it.
        leader: name of the input whose pose is taken; empty without.
        rival: name of another node that fuses into the same topic; empty without.
    """

    def __init__(
        self,
        base: NodeBase,
        settings: FusionNodeConfig,
        live: LiveConfig,
        odometry: TransformStore | None,
    ) -> None:
        self.settings, self.live = settings, live
        self.corrections: Mapping[str, Pose2] = {}
        self.sources: Mapping[str, MapSource] = {}
        self.state = FusionState()
        self.leader = ""
        self.rival = ""
        self._base = base
        self._children = ChildFrames([settings.fused_frame])
        self._newest_s: float | None = None
        # The last stamp and what was sent with it: by child frame, and of the fused pose.
        self._sent: dict[str, tuple[int, Pose2]] = {}
        self._heard_ns: dict[str, int] = {}
        self._has_sent_odometry = False
        self._resets = 0
        self._wanted_since_s: float | None = None
        self._told = self.state
        self._output = TransformOutput(base.node)
        self._spread, self._odom_frame = PoseSpread(), OdomFrame()
        self._pose_topic = base.node.create_publisher(
            PoseWithCovarianceStamped, POSE_TOPIC, qos.STREAM
        )
        self._odometry = odometry or TransformStore()

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
        transform = self.state.transform(source.name)
        place = self.corrections.get(source.name, transform)
        if place is None:
            return
        self._note(messages.stamp_s(heard.stamp))
        if transform is not None:
            self._send_frame(source, transform, heard.stamp)
        self.leader = self._choose()
        pose = place.compose(heard.pose)
        if not is_revised:
            stamp_ns = messages.stamp_ns(heard.stamp)
            self._spread.hear(self.leader, source.name, stamp_ns, pose)
        if source.name != self.leader:
            return
        stamp = self._fresh(POSE_TOPIC, heard.stamp, pose, is_revised=is_revised)
        if stamp is not None:
            alone = self.live.pose_apart_m, self.live.pose_apart_rad
            covariance = self._spread.covariance(messages.stamp_s(stamp), *alone)
            frame = self.settings.fused_frame
            self._pose_topic.publish(messages.sure_pose_to_message(pose, covariance, frame, stamp))
        if self.settings.publish_tf:
            self._correct(pose, messages.stamp_s(heard.stamp))

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
        self._newest_s, self._odom_frame = None, OdomFrame()
        future = [key for key, (sent_ns, _) in self._sent.items() if sent_ns > stamp_ns + BACK_NS]
        for key in future:
            del self._sent[key]

    def _choose(self) -> str:
        """Return the name of the healthiest voter that tells poses; empty without."""
        now_s = time.monotonic()
        fresh = {
            name: record
            for name, record in self.state.inputs.items()
            if (record.accepted or name in self.corrections)
            and (source := self.sources.get(name)) is not None
            and source.pose is not None
            and now_s - source.pose.heard_s < POSE_FRESH_S
        }
        for name in (self.leader, self.state.reference):
            if name in fresh:
                return name
        return max(fresh, key=lambda name: fresh[name].score, default="")

    def look(self) -> None:
        """Send what a new fusion changed, and the frames of voters that tell no poses.

        And name what is wrong with frames.
        """
        now_s = time.monotonic()
        for source in self.sources.values():
            self.child_frame(source)  # claimed in the order of the inputs, whoever votes first
        if self._told is not self.state:
            self._told = self.state
            for source in self.sources.values():
                if source.pose is not None:
                    self._tell(source, source.pose, is_revised=True)
        for source in self.sources.values():
            transform = self.state.transform(source.name)
            has_pose = source.pose is not None and now_s - source.pose.heard_s < POSE_FRESH_S
            if source.stamp_s is not None:
                self._note(source.stamp_s)
            if transform is not None and not has_pose and self._newest_s is not None:
                self._send_frame(source, transform, messages.to_stamp(self._newest_s))
        self._name_shared()
        self._base.diagnostics.say("rival", self._rival_words(), Level.ERROR)
        self._name_unsent()

    def on_time_jump(self) -> None:
        """Forget what was sent for a future that has not come."""
        self._newest_s, self._odom_frame = None, OdomFrame()
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
            self._output.send(transform, parent, frame, fresh)

    def child_frame(self, source: MapSource) -> str:
        """Return the frame that an input's transform is sent to; empty without one."""
        if not source.frame or source.frame == self.settings.fused_frame:
            return ""
        topic = self._base.node.resolve_topic_name(source.topic)
        return self._children.of(source.name, topic, source.frame)

    def _name_shared(self) -> None:
        """Name frames that two inputs share, or that are the fused one."""
        told = [
            f"{name!r} is in frame {frame!r} as another map is: its transform is sent to {child!r}"
            for name, (frame, child) in self._children.renamed().items()
        ]
        said = "; ".join([*told, "give each map a frame_id of its own"])
        self._base.diagnostics.say("shared frame", f"the map of {said}" if told else None)
        fused = self.settings.fused_frame
        is_own = any(source.frame == fused for source in self.sources.values())
        text = f"an input's map is in {fused!r}, the frame of the fused map; rename one of them"
        self._base.diagnostics.say("own frame", text if is_own else None)

    def _rival_words(self) -> str | None:
        """Say who else sends one of our transforms, and what to do; None where nobody does."""
        rivals, odom_frame = self._output.rivals(), self.settings.odom_frame
        if not rivals:
            return None
        child = odom_frame if odom_frame in rivals else next(iter(rivals))
        words = f"another node sends the transform to {child!r} too (from {rivals[child]!r}): "
        if self.rival:
            return words + f"the other fusion is {self.rival!r}; end one of the two"
        if child == odom_frame:
            return words + "set publish_tf to false in all but one"
        return words + "end one of them, or give the frames of each robot names of their own"

    def _name_unsent(self) -> None:
        """Name that fused_frame -> odom_frame was never sent, though somebody votes."""
        settings, now_s = self.settings, time.monotonic()
        has_voters = any(record.accepted for record in self.state.inputs.values())
        if not (settings.publish_tf and has_voters) or self._has_sent_odometry:
            self._wanted_since_s = None
            self._base.diagnostics.clear("unsent")
            return
        if self._wanted_since_s is None:
            self._wanted_since_s = now_s
        if now_s - self._wanted_since_s < TF_LATE_S:
            return
        if settings.fused_frame == settings.odom_frame:
            why = "both are one frame; rename one of them"
        elif not self.leader:
            why = "no input that votes tells the robot's pose (NAME/pose beside NAME/map)"
        else:
            why = "the odometry does not tell where the robot is at the times of its poses"
        text = f"publish_tf: {settings.fused_frame} -> {settings.odom_frame} was never sent: {why}"
        self._base.diagnostics.say("unsent", text)

    def _correct(self, pose: Pose2, stamp_s: float) -> None:
        """Take the robot's pose in the fused frame, from which ``drive`` goes on."""
        settings, diagnostics = self.settings, self._base.diagnostics
        frames = settings.odom_frame, settings.base_frame
        try:
            odometry = self._odometry.lookup(*frames, stamp_s)
        except TransformError as error:
            text = f"no odometry for {settings.fused_frame} -> {frames[0]}: {error}"
            diagnostics.add("odometry", Level.WARN, text)
            return
        diagnostics.clear("odometry")
        if self._resets != self.state.resets:
            self._resets, self._odom_frame = self.state.resets, OdomFrame()
        self._odom_frame.correct(stamp_s, pose, odometry)
        left = self._odom_frame.left(odometry)
        away_m, turn_rad = math.hypot(left.x, left.y), abs(left.yaw_rad)
        speeds = settings.correction_speed, settings.correction_turn
        text = (
            f"{settings.fused_frame} -> {frames[0]} is corrected by {away_m:.1f} m and "
            f"{math.degrees(turn_rad):.0f} degrees, {speeds[0]:g} m and "
            f"{math.degrees(speeds[1]):.0f} degrees a second (correction_speed, correction_turn)"
        )
        is_long = away_m > LONG_S * speeds[0] or turn_rad > LONG_S * speeds[1]
        diagnostics.say("correction", text if is_long else None)

    def drive(self) -> None:
        """Send where the odometry frame lies, at the stamp of the newest odometry."""
        settings = self.settings
        frames = settings.odom_frame, settings.base_frame
        if not settings.publish_tf or settings.odom_frame == settings.fused_frame:
            return
        stamp_s = self._odometry.heard_s(*frames)
        if stamp_s is None:
            return
        try:
            odometry = self._odometry.lookup(*frames, stamp_s)
        except TransformError:
            return  # named at the next pose
        speeds = settings.correction_speed, settings.correction_turn
        moved = self._odom_frame.move(stamp_s, odometry, *speeds)
        if moved is not None:
            self._has_sent_odometry = True
            stamp = messages.to_stamp(stamp_s)
            self._output.send(moved, settings.fused_frame, settings.odom_frame, stamp)
