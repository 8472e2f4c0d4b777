"""``DriveInput``: the fused path solved from scans; ``FusedFrames``: transforms and the pose."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path

from slamfusion.config import LogConfig
from slamfusion.deskew import Deskewer
from slamfusion.errors import TrajectoryError
from slamfusion.fusion.live.driving import CARRIED_M, OdomFrame
from slamfusion.fusion.live.session import FusionState
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan
from slamfusion.io.transforms import TransformError
from slamfusion.jobs.live_drive import DriveLocator, DriveMemory, DriveSolution, DriveSolver, Pace
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, Worker
from slamfusion.ros.frames import TransformOutput, TransformStore
from slamfusion.ros.input_health import HeardPose, MapSource
from slamfusion.ros.scan_input import ArrivedScan, ScanInput
from slamfusion.slam.session import LeftOutError

if TYPE_CHECKING:
    from slamfusion.ros.fusion_node import FusionNode

POSE_TOPIC, PATH_TOPIC = "fused/pose", "fused/path"
# Scans that wait to be read; then the oldest is dropped.
SCAN_QUEUE = 20
# A stamp of an input this far behind its last one starts a new time: a bag that loops.
BACK_NS = 10**9
# A revised value of a sent stamp is sent this much later, so that no stamp is repeated; below twice
# the resolution of today's float seconds.
STEP_NS = 1000
# An input is silent if its last pose is older than this, or than that of another by this, seconds.
POSE_FRESH_S = 2.0
# publish_tf without output for this long while an input votes is reported, seconds.
TF_LATE_S = 5.0
# A longer correction of fused_map -> odom, and a longer time without a matching scan, is reported,
# seconds.
LONG_S = 2.0


class DriveInput:
    """Receives ``scan`` and ``NAME/path``, solves the drive and publishes ``fused/path``.

    Scans are read in one thread, and the drive is solved in another, with its own device.

    ``on_solution`` is called with each solution, in the solver's thread.

    Attributes:
        memory: of the drive so far; takes the poses of the inputs.
        locator: has the last solution, and says where the robot is.
    """

    def __init__(
        self, node: FusionNode, device: str, on_solution: Callable[[DriveSolution], None]
    ) -> None:
        settings = node.settings
        self._node, self._on_solution = node, on_solution
        self._deskewer = Deskewer(LogConfig(deskew=settings.deskew, sweep_s=settings.sweep_s))
        self.memory = DriveMemory()
        self.locator = DriveLocator(self.memory)
        self._drive = DriveSolver(self.memory, self.locator, node.open_device(device))
        self._count, self._pace = 0, Pace()
        self._path_topic = node.node.create_publisher(Path, PATH_TOPIC, qos.MAP)
        self._reader: Worker[ArrivedScan] = Worker(self._read, SCAN_QUEUE, node.failed, "scans")
        self._solver: Worker[None] = Worker(self._solve, 1, node.failed, "drive")
        self.scans = ScanInput(node, settings, self._reader.put, self.memory.forget)

    # --- in the executor's thread --------------------------------------------------------------

    def look(self, sources: Mapping[str, MapSource]) -> None:
        """Subscribe to the inputs' paths once scans arrive; start the solver."""
        self.scans.look()
        self._solver.put(None)
        for name, source in sources.items() if self._count else ():
            source.hear_path(partial(self._on_path, name))

    def _on_path(self, name: str, data: bytes) -> None:
        try:
            path = messages.path_from_bytes(data, name)
        except TrajectoryError as error:
            text = f"the path of {name!r} is left out: {error}"
            self._node.diagnostics.note(f"path {name}", text)
            return
        self.memory.set_path(name, path)

    # --- in threads of their own ---------------------------------------------------------------

    def _read(self, arrived: ArrivedScan) -> None:
        try:
            scan = self.scans.read(arrived)
        except LeftOutError:
            return  # reported by ``read``
        within, odometry = self._deskewer.follow(
            scan, lambda times_s: self.scans.odometry_at(arrived, times_s, is_first=False)
        )
        self.memory.add_scan(LogScan(self._deskewer.moved(scan, within), odometry, 1))
        self._count += 1
        self._solver.put(None)

    def _solve(self, _: None) -> None:
        began_s = time.monotonic()
        depth = self._pace.due(began_s, self._count)
        if depth is None:
            return
        state, settings = self._node.session.snapshot, self._node.settings
        transforms = {name: state.transform(name) for name in state.inputs}
        solution = self._drive.solve(
            depth,
            lattice=state.lattice,
            transforms={name: place for name, place in transforms.items() if place is not None},
            resolution=state.resolution if settings.draw else None,
        )
        self._pace.done(depth, began_s, time.monotonic())
        is_lost = (
            solution is None and depth in {"whole", "final"} and self.locator.solution is not None
        )
        text = (
            "the drive is no longer solved, since no input has poses at its scans: the fused path "
            "and the drawn map stay as they were; check the inputs, or start the drive again "
            "(slamfusion live reset)"
        )
        self._node.diagnostics.say("solution", text if is_lost else None)
        if solution is None or not self.locator.take(solution):
            return
        self._on_solution(solution)
        if depth == "judged":
            return
        if self.locator.solution is solution and self._path_topic.get_subscription_count():
            stamp = messages.to_stamp(float(solution.path.stamps_s[-1]))
            frame = settings.fused_frame
            self._path_topic.publish(messages.path_to_bytes(solution.path, frame, stamp))

    def close(self) -> None:
        """End both threads."""
        self._reader.close()
        self._solver.close()


class ChildFrames:
    """The child frame of each input's transform, if several maps have one frame.

    The first input keeps the frame; another gets as much of its topic's namespace as is needed:
    ``graph_map`` of ``robot2/graph/map`` is ``robot2/graph_map`` if ``robot1/graph/map`` came
    first. Frames stay when others come or go. No input gets one of ``taken``.
    """

    def __init__(self, taken: Collection[str] = ()) -> None:
        self._taken = set(taken)
        # Child frame and namespace by input name and map frame.
        self._children: dict[tuple[str, str], tuple[str, tuple[str, ...]]] = {}

    def of(self, name: str, topic: str, frame: str) -> str:
        """Return the child frame of an input's map frame; ``topic`` is resolved."""
        key = name, frame
        if key not in self._children:
            words = tuple(filter(None, topic.split("/")))
            # Without the last ``map``, unless that is all.
            space = words[:-1] if len(words) > 1 and words[-1] == "map" else words
            others = [theirs for (_, own), (_, theirs) in self._children.items() if own == frame]
            child = self._free(space, frame, others) if others else frame
            self._children[key] = child, space
            self._taken.add(child)
        return self._children[key][0]

    def _free(self, space: tuple[str, ...], frame: str, others: Collection[tuple[str, ...]]) -> str:
        """Return the free name with the shortest namespace that is no other's, else a number."""
        spaces = [space[:length] for length in range(1, len(space) + 1)]
        own = [one for one in spaces if all(theirs[: len(one)] != one for theirs in others)]
        named = ("/".join((*one, frame)) for one in own)
        numbered = ("/".join((*space, f"{frame}_{number}")) for number in itertools.count(2))
        return next(it for it in itertools.chain(named, numbered) if it not in self._taken)


class FusedFrames:
    """Sends fused_map -> every voter's map frame, the fused pose, and fused_map -> odom.

    The voters' transforms are sent with each new stamp of a pose or map, in one message. The fused
    pose is that of the leader: the supported input that is nearest to the fused path, whose scan is
    matched to the walls along it; without scans the reference, or else the best score, until it
    stops voting or is silent while others send poses. Stamps only increase (``_fresh``). The
    odometry frame is sent at stamps of the odometry (``OdomFrame``).

    Attributes:
        leader: name of the input that gives the pose; empty without.
    """

    def __init__(self, node: FusionNode, odometry: TransformStore | None) -> None:
        self.leader = ""
        self._node = node
        self._odometry = odometry or TransformStore()
        self._children = ChildFrames([node.settings.fused_frame])
        # The current state and the one sent last; inputs that the scans support; and the stamp
        # since which no scan matches the fused path.
        self._state = self._sent_state = FusionState()
        self._supported: Collection[str] = ()
        self._unmatched_s: float | None = None
        self._newest_s: float | None = None
        # Last stamp and value sent, by child frame, and of the fused pose.
        self._sent: dict[str, tuple[int, Pose2]] = {}
        self._heard_ns: dict[str, int] = {}
        # Stamp of the last transform of the odometry frame; None before the first.
        self._driven_s: float | None = None
        self._resets = 0
        self._output = TransformOutput(node.node)
        self._odom_frame = OdomFrame()
        self._pose_topic = node.node.create_publisher(
            PoseWithCovarianceStamped, POSE_TOPIC, qos.STREAM
        )

    def on_pose(self, source: MapSource, heard: HeardPose) -> None:
        """Send the transforms and the pose that follow from a new pose of an input."""
        self._read()
        stamp_ns = messages.stamp_ns(heard.stamp)
        if stamp_ns < self._heard_ns.get(source.name, stamp_ns) - BACK_NS:
            self._newest_s, self._odom_frame = None, OdomFrame()
            past = {key: sent for key, sent in self._sent.items() if sent[0] <= stamp_ns + BACK_NS}
            self._sent = past
        self._heard_ns[source.name] = stamp_ns
        self._send(source, heard, is_revised=False)

    def look(self) -> None:
        """Send changes of a new fusion and frames of voters without poses; report problems."""
        self._read()
        sources = self._node.inputs.sources.values()
        if self._sent_state.inputs is not self._state.inputs:
            self._sent_state = self._state
            for source in sources:
                if source.pose is not None:
                    self._send(source, source.pose, is_revised=True)
        for source in sources:
            if source.stamp_s is not None:
                self._note(source.stamp_s)
        if self._newest_s is not None:
            self._send_frames(messages.to_stamp(self._newest_s))
        self._name_problems()

    def drive(self) -> None:
        """Send the odometry frame's transform at the stamp of the newest odometry."""
        settings = self._node.settings
        frames = settings.odom_frame, settings.base_frame
        if not self._has_odom_frame:
            self._odom_frame = OdomFrame()
            self._node.diagnostics.clear("odometry of poses")
            self._node.diagnostics.clear("correction")
            return
        stamp_s = self._odometry.heard_s(*frames)
        if stamp_s is None or stamp_s == self._driven_s:
            return
        try:
            odometry = self._odometry.lookup(*frames, stamp_s)
        except TransformError:
            return  # reported at the next pose
        speeds = settings.correction_speed, settings.correction_turn
        moved = self._odom_frame.move(stamp_s, odometry, *speeds)
        if moved is not None:
            self._driven_s = stamp_s
            stamp = messages.to_stamp(stamp_s)
            self._output.send(settings.fused_frame, (settings.odom_frame, moved, stamp))

    def on_time_jump(self) -> None:
        """Forget poses, and what was sent for later times."""
        self._newest_s, self._odom_frame = None, OdomFrame()
        for source in self._node.inputs.sources.values():
            source.pose = None
        self._sent.clear()
        self._heard_ns.clear()

    def child_frame(self, source: MapSource) -> str:
        """Return the child frame of an input's transform; empty without one."""
        if not source.frame or source.frame == self._node.settings.fused_frame:
            return ""
        topic = self._node.resolved(source.topic)
        return self._children.of(source.name, topic, source.frame)

    @property
    def _has_odom_frame(self) -> bool:
        settings = self._node.settings
        return settings.publish_tf and settings.odom_frame != settings.fused_frame

    def _read(self) -> None:
        self._state, solution = self._node.session.snapshot, self._node.drive.locator.solution
        self._supported = () if solution is None else solution.supported

    def _send(self, source: MapSource, heard: HeardPose, *, is_revised: bool) -> None:
        """Send what follows from a pose; ``is_revised``: again, after a new fusion."""
        settings = self._node.settings
        transform = self._state.transform(source.name)
        if transform is None and source.name not in self._supported:
            return
        self._note(heard.stamp_s)
        self._send_frames(heard.stamp)
        self.leader = self._choose()
        if source.name != self.leader:
            return
        located = self._node.drive.locator.locate(source.name, heard.stamp_s, heard.pose)
        if located is not None:
            pose, covariance = located.pose, located.covariance
        elif transform is None:
            return
        else:
            pose = transform.compose(heard.pose)
            voters = [name for name, one in self._state.inputs.items() if one.accepted]
            covariance = self._node.fusion.covariance(self.leader, voters, heard.stamp_s)
        if located is None or located.fits or self._unmatched_s is None:
            self._unmatched_s = heard.stamp_s
        unmatched_s = heard.stamp_s - self._unmatched_s
        text = (
            f"no scan of the last {unmatched_s:.0f} s matches the walls along the fused path: the "
            f"pose goes by {self.leader} alone"
        )
        self._node.diagnostics.say("match", text if unmatched_s > LONG_S else None)
        stamp = self._fresh(POSE_TOPIC, heard.stamp, pose, is_revised=is_revised)
        if stamp is not None:
            self._pose_topic.publish(
                messages.sure_pose_to_message(pose, covariance, settings.fused_frame, stamp)
            )
        if self._has_odom_frame:
            self._correct(pose, heard.stamp_s)

    def _fresh(self, key: str, stamp: Any, value: Pose2, *, is_revised: bool) -> Any:
        """Return the stamp for a value; None if it is not to be sent.

        A revised value is sent a microsecond after the last stamp, if it differs; the pose of a new
        leader from its first newer stamp on. ``key`` is the child frame or the topic.
        """
        stamp_ns = messages.stamp_ns(stamp)
        last = self._sent.get(key)
        if last is not None and stamp_ns <= last[0]:
            if not is_revised or last[1] == value:
                return None
            stamp_ns = last[0] + STEP_NS
        self._sent[key] = stamp_ns, value
        return messages.ns_to_stamp(stamp_ns)

    def _choose(self) -> str:
        """Return the name of the best voter whose poses keep up with all inputs'; empty without.

        If all are silent, as when the robot stands still, their last poses remain right.
        """
        heard_s = {
            name: source.pose.heard_s
            for name, source in self._node.inputs.sources.items()
            if source.pose is not None
        }
        silent_s = max(heard_s.values(), default=0.0) - POSE_FRESH_S
        fresh = {
            name: record
            for name, record in self._state.inputs.items()
            if (record.accepted or name in self._supported)
            and heard_s.get(name, silent_s) > silent_s
        }
        for name in (*self._supported, self.leader, self._state.reference):
            if name in fresh:
                return name
        return max(fresh, key=lambda name: fresh[name].fit.score, default="")

    def _note(self, stamp_s: float) -> None:
        self._newest_s = stamp_s if self._newest_s is None else max(self._newest_s, stamp_s)

    def _send_frames(self, stamp: Any) -> None:
        """Send the voters' map frames at a stamp, each value once.

        Child frames are claimed in the order of the inputs.
        """
        poses = []
        for source in self._node.inputs.sources.values():
            transform, frame = self._state.transform(source.name), self.child_frame(source)
            if transform is not None and frame:
                fresh = self._fresh(frame, stamp, transform, is_revised=True)
                if fresh is not None:
                    poses.append((frame, transform, fresh))
        self._output.send(self._node.settings.fused_frame, *poses)

    def _correct(self, pose: Pose2, stamp_s: float) -> None:
        """Correct the odometry frame by the robot's pose in the fused frame; see ``drive``."""
        settings, diagnostics = self._node.settings, self._node.diagnostics
        frames = settings.odom_frame, settings.base_frame
        known_s, odometry = self._odom_frame.posed
        try:
            if stamp_s != known_s:  # else a revised pose, whose odometry may be forgotten by now
                odometry = self._odometry.lookup(*frames, stamp_s)
        except TransformError as error:
            text = f"no odometry for {settings.fused_frame} -> {frames[0]}"
            # The scans' may be missing for the same reason.
            why = "" if diagnostics.is_on("odometry") else f": {error}"
            diagnostics.say("odometry of poses", text + why)
            return
        diagnostics.clear("odometry of poses")
        if self._resets != self._state.resets:
            self._resets, self._odom_frame = self._state.resets, OdomFrame()
        self._odom_frame.correct(stamp_s, pose, odometry)
        left = self._odom_frame.left(odometry)
        away_m, turn_rad = math.hypot(left.x, left.y), abs(left.yaw_rad)
        speed, turn = settings.correction_speed, settings.correction_turn
        text = (
            f"{settings.fused_frame} -> {frames[0]} is corrected by {away_m:.1f} m and "
            f"{math.degrees(turn_rad):.0f} degrees, {speed:g} m and {math.degrees(turn):.0f} "
            "degrees a second (correction_speed, correction_turn)"
        )
        is_long = away_m > LONG_S * speed or turn_rad > LONG_S * turn
        diagnostics.say("correction", text if is_long else None)

    def _name_problems(self) -> None:
        settings, diagnostics = self._node.settings, self._node.diagnostics
        fused, odom = settings.fused_frame, settings.odom_frame
        named = []
        for source in self._node.inputs.sources.values():
            child, frame = self.child_frame(source), source.frame
            if source.stamp_s is not None and (child != frame or not frame):
                sent = f"as another map is: its transform is sent to {child!r}"
                words = sent if child else "and has no transform"
                named.append(f"{source.name!r} is in frame {frame!r} {words}")
        words = "; ".join([*named, "give each map a frame_id of its own"])
        diagnostics.say("frames", f"the map of {words}" if named else None)
        child, words = self._output.rival(odom)
        what = "end one of them, or give the frames of each robot names of their own"
        if self._node.rival:
            what = f"the other fusion is {self._node.rival!r}; end one of the two"
        elif child == odom:
            what = "set publish_tf to false in all but one"
        diagnostics.say("rival", f"{words}: {what}" if child else None, Level.ERROR)
        has_voters = any(record.accepted for record in self._state.inputs.values())
        why = ""  # missing odometry of a leader's poses has been named
        if fused == odom:
            why = "both are one frame; rename one of them"
        elif not self.leader:
            why = "no input that votes has the robot's pose (NAME/pose next to NAME/map)"
        text = f"publish_tf: {fused} -> {odom} was never sent: {why}"
        is_unsent = settings.publish_tf and has_voters and self._driven_s is None and why
        diagnostics.say("unsent", text if is_unsent else None, after_s=TF_LATE_S)
        text = (
            f"{fused} -> {odom} is not sent any more: the robot has driven {CARRIED_M:g} m or "
            "turned once since the last fused pose; check the inputs"
        )
        diagnostics.say("too far", text if self._odom_frame.is_too_far else None, Level.ERROR)
