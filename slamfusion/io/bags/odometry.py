"""The first pass over a bag: transforms, and odometry from messages or transforms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, counted
from slamfusion.geometry import F64, Pose2, blend_poses, compose_poses, pose_of, quaternion_yaw_rad
from slamfusion.io.bags.reader import SCAN_TYPES, TRANSFORM_TYPES, OpenBag, open_bag, stamp_s
from slamfusion.io.log import BEFORE_ODOMETRY, FARTHEST_M, REACH_S
from slamfusion.io.transforms import HOLD_S, TransformTree, plan_poses

_ODOMETRY_TYPES = ("nav_msgs/msg/Odometry",)
_POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    *_ODOMETRY_TYPES,
)
_BASE_FRAMES = ("base_footprint", "base_link")

AFTER_ODOMETRY = "laser after odometry"
NO_ODOMETRY = f"no odometry within {REACH_S:g} s of the laser"


@dataclass(frozen=True)
class BagOdometry:
    """Poses (N, 3) of the base frame in the odometry frame at increasing stamps (N,)."""

    stamps_s: F64
    poses: F64
    base_frame: str

    def at(self, stamp_s: float) -> Pose2 | str:
        """Return the pose at a time, linear between neighbours, or why it is unknown."""
        if stamp_s < self.stamps_s[0] - HOLD_S:
            return BEFORE_ODOMETRY
        if stamp_s > self.stamps_s[-1] + HOLD_S:
            return AFTER_ODOMETRY
        after = int(np.searchsorted(self.stamps_s, stamp_s))
        if after in {0, len(self.stamps_s)}:
            return Pose2(*self.poses[min(after, len(self.stamps_s) - 1)].tolist())
        since_s = stamp_s - float(self.stamps_s[after - 1])
        until_s = float(self.stamps_s[after]) - stamp_s
        if min(since_s, until_s) > REACH_S:
            return NO_ODOMETRY
        around, share = self.poses[after - 1 : after + 1], since_s / (since_s + until_s)
        return pose_of(blend_poses(around[:1], around[1:], np.array([share]))[0])

    def track(self, stamps_s: F64) -> F64 | None:
        """Return the poses (N, 3) at times (N,); None if any is unknown."""
        poses = [self.at(stamp_s) for stamp_s in stamps_s.tolist()]
        rows = [(pose.x, pose.y, pose.yaw_rad) for pose in poses if isinstance(pose, Pose2)]
        return np.array(rows) if len(rows) == len(poses) else None


class BagFrames:
    """The transforms of a bag, in ``tree``, and the odometry."""

    def __init__(
        self, bag: OpenBag, config: LogConfig, scan_topic: str = "", laser_frame: str = ""
    ) -> None:
        """Read the transforms; of several robots those in the namespace of ``scan_topic``."""
        self.tree = TransformTree()
        self._bag, self._config = bag, config
        self._scan_topic, self._laser_frame = scan_topic, laser_frame
        self._read_transforms()

    def odometry(self) -> BagOdometry | None:
        """Return it by messages, else by transforms; refuse an unknown configured base frame."""
        found = self._found_odometry()
        wanted = self._config.base_frame
        known = self.tree.frames | ({found.base_frame} if found else set())
        if wanted is not None and wanted.lstrip("/") not in known:
            raise LogError(self._no_way(self._config.odom_frame, wanted))
        return found

    def _read_transforms(self) -> None:
        unusable = 0
        senders: dict[str, str] = {}
        for topic, _, message in self._bag.messages(*self._transform_topics()):
            is_static = topic.endswith("tf_static")
            for item in () if message is None else message.transforms:
                namespace = topic.rpartition("/")[0]
                other = senders.setdefault(item.child_frame_id, namespace)
                if other != namespace:
                    raise LogError(
                        f"{self._bag.path}: frame {item.child_frame_id!r} is sent on {other}/tf "
                        f"and on {namespace}/tf: two robots? choose one with --tf-topic"
                    )
                move, turn = item.transform.translation, item.transform.rotation
                row = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
                unusable += not self.tree.add(
                    item.header.frame_id,
                    item.child_frame_id,
                    stamp_s(item),
                    row,
                    is_static=is_static,
                )
            unusable += message is None
        if unusable:
            self._bag.notes.append(
                f"{counted(unusable, 'transform', 'are')} not finite, no rotation, or not of two "
                "frames; left out"
            )

    def _transform_topics(self) -> list[str]:
        wanted = self._config.tf_topic
        found = self._bag.topics(TRANSFORM_TYPES, self._scan_topic if wanted is None else "")
        if wanted is None:
            return found
        names = {wanted.strip("/"), f"{wanted.strip('/')}_static"}
        own = [topic for topic in found if topic.strip("/") in names]
        if not own:
            raise LogError(
                f"{self._bag.path}: no transforms on {wanted!r}; found "
                f"{', '.join(found) or 'none'}; change --tf-topic or leave it out"
            )
        return own

    def _found_odometry(self) -> BagOdometry | None:
        config, bag = self._config, self._bag
        if config.odom_topic == "none":
            return None
        if config.odom_topic != "tf" and (config.odom_topic or bag.topics(_ODOMETRY_TYPES)):
            topic = bag.choose_topic(
                _ODOMETRY_TYPES, config.odom_topic, "--odom-topic", self._scan_topic
            )
            odometry = self._odometry_by_messages(topic)
            if odometry is not None:
                return odometry
            self._bag.notes.append(f"no usable odometry on {topic}; the transforms are used")
        for base_frame in (config.base_frame,) if config.base_frame else _BASE_FRAMES:
            odometry = self._odometry_by_transforms(base_frame)
            if odometry is not None:
                return odometry
        return None

    def _odometry_by_messages(self, topic: str) -> BagOdometry | None:
        table, first = _topic_poses(self._bag, topic)
        if first is None:
            return None
        base_frame = self._moving_frame(topic, first)
        times = table[:, 0]
        yaws = [quaternion_yaw_rad(*turn) for turn in table[:, 4:].tolist()]
        rows = np.column_stack((table[:, 1:3], yaws))
        wanted = self._config.base_frame
        if wanted is None or wanted.lstrip("/") == base_frame:
            return BagOdometry(times, rows, base_frame)
        if not self.tree.is_connected(base_frame, wanted):
            raise LogError(self._no_way(base_frame, wanted))
        rows = compose_poses(rows, plan_poses(self.tree.sample(base_frame, wanted, times)))
        return BagOdometry(times, rows, wanted.lstrip("/"))

    def _moving_frame(self, topic: str, message: Any) -> str:
        """Return the frame of the odometry's pose: the named one, or else the base."""
        named, own = message.child_frame_id.lstrip("/"), message.header.frame_id.lstrip("/")
        frames = self.tree.frames
        odd = {own, "", "map", self._config.odom_frame, self._laser_frame}
        if self._laser_frame not in frames or (named in frames and named not in odd):
            return str(named)
        rigid = {
            frame
            for frame in frames - odd
            if self.tree.is_connected(frame, self._laser_frame)
            and self.tree.is_constant(frame, self._laser_frame)
        }
        bases = [frame for frame in (*_BASE_FRAMES, *sorted(rigid)) if frame in rigid]
        if not bases:
            return str(named)
        self._bag.notes.append(
            f"odometry on {topic} says that it is of {named!r}, which is no frame of the robot; "
            f"taken: {bases[0]!r}, which moves with the laser"
        )
        return bases[0]

    def _no_way(self, base_frame: str, wanted: str) -> str:
        known = ", ".join(sorted(self.tree.frames)) or "none"
        return (
            f"{self._bag.path}: no transforms from {base_frame!r} to base_frame {wanted!r}; frames "
            f"in it: {known}; change --base-frame or leave it out"
        )

    def _odometry_by_transforms(self, base_frame: str) -> BagOdometry | None:
        """Return the poses of a frame in the odometry frame, at the times of its transforms."""
        frame = base_frame.lstrip("/")
        if not self.tree.is_connected(self._config.odom_frame, frame):
            return None
        stamps_s = self.tree.change_stamps_s(self._config.odom_frame, frame)
        if not stamps_s.size:
            return None
        poses = plan_poses(self.tree.sample(self._config.odom_frame, frame, stamps_s))
        return BagOdometry(stamps_s, poses, frame)

    def base_poses(self) -> F64:
        """Return the poses of the robot's base in the outermost frame of the transforms.

        (N, 8) t x y z qx qy qz qw, at the times of the transforms.
        """
        from scipy.spatial.transform import Rotation  # noqa: PLC0415  (who reads maps needs none)

        base = self.base_frame(None)
        world = self.tree.root(base)
        stamps_s = self.tree.change_stamps_s(world, base)
        if not stamps_s.size:
            known = ", ".join(sorted(self.tree.frames)) or "none"
            raise LogError(
                f"{self._bag.path}: no transforms move the robot's frame {base!r}; frames in it: "
                f"{known}; name the robot's with --base-frame, or a topic with --pose-topic"
            )
        matrices = self.tree.sample(world, base, stamps_s)
        turns = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
        self._bag.notes.append(f"taken as its path: {base!r} in {world!r}, by transforms")
        return np.column_stack((stamps_s, matrices[:, :3, 3], turns))

    def base_frame(self, odometry: BagOdometry | None) -> str:
        """Return the frame of the odometry's pose; empty if unknown."""
        if odometry is not None and odometry.base_frame:
            return odometry.base_frame
        if self._config.base_frame is not None:
            return self._config.base_frame.lstrip("/")
        known = self.tree.frames
        return next((frame for frame in _BASE_FRAMES if frame in known), "")


def read_poses(path: Path, config: LogConfig, wanted: str | None, notes: list[str]) -> F64 | None:
    """Return a path of a bag, with or without scans.

    Args:
        config: ``base_frame`` is used for transforms.
        wanted: a topic of poses, or ``tf`` for the robot's base frame in the outermost frame of the
            transforms; None: the only such topic, else tf.

    Returns:
        (N, 8) t x y z qx qy qz qw in the order of time; None for a bag with scans and no ``wanted``
        topic, whose path is the odometry of its scans.
    """
    with open_bag(path, notes) as bag:
        others = bag.topics(_POSE_TYPES)
        if wanted is None and bag.topics(SCAN_TYPES):
            poses = [topic for topic in others if topic not in bag.topics(_ODOMETRY_TYPES)]
            if poses:
                notes.append(
                    "taken as its path: the odometry of its scans; choose another topic with "
                    f"--pose-topic: {', '.join(poses)}"
                )
            return None
        if wanted == "tf" or (wanted is None and not others):
            return BagFrames(bag, config).base_poses()
        topic = bag.choose_topic(_POSE_TYPES, wanted, "--pose-topic")
        table, first = _topic_poses(bag, topic)
    if first is None:
        raise LogError(f"{path}: no usable pose on {topic}; choose another topic with --pose-topic")
    return table


def _topic_poses(bag: OpenBag, topic: str) -> tuple[F64, Any]:
    """Return the poses of a topic, and its first usable message or None."""
    rows, first, unusable = [], None, 0
    for _, _, message in bag.messages(topic):
        row: list[float] = []
        if message is not None:
            pose = getattr(message.pose, "pose", message.pose)
            place, turn = pose.position, pose.orientation
            row = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
        # NaN is no less than any number.
        if not (row and abs(row[0]) <= FARTHEST_M and abs(row[1]) <= FARTHEST_M) or math.isnan(
            quaternion_yaw_rad(*row[3:])
        ):
            unusable += 1
            continue
        first = message if first is None else first
        rows.append([stamp_s(message), *row])
    if unusable:
        bag.notes.append(
            f"{counted(unusable, 'message')} on {topic} without a finite pose; left out"
        )
    table = np.array(rows).reshape(-1, 8)
    return table[np.unique(table[:, 0], return_index=True)[1]], first
