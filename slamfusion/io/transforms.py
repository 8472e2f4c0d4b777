"""``TransformTree``: transforms between frames over time, recorded or live; needs no ROS."""

from __future__ import annotations

import functools
import math
import operator
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import F32, F64, Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io.log import FARTHEST_M, REACH_S
from slamfusion.io.stamps import Passed, StampGate
from slamfusion.scan import LaserScan

# x, y, z in metres, then the unit quaternion x, y, z, w.
Row = tuple[float, float, float, float, float, float, float]
# The transforms before and after some times, (N, 7) each, and the share (N,) of the interval; for
# one time a row each and a number.
Around = tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]

# An edge, and whether it is walked from the parent to the child.
Step = tuple["Edge", bool]

# A time this far outside the known interval takes the nearest transform, seconds.
HOLD_S = 0.05
# Several live transforms in a row that are older than the newest by this restart their frame (a
# looping bag), seconds.
BACK_S = 1.0
# A constant transform of a recording is kept at this interval, seconds.
REST_S = 0.1
# Translations (m) and quaternion parts that differ by less are the same.
SAME = 1e-7
# Keeps a quotient of two zeros 0.
TINY = 1e-300
# Why transforms are left out, and of how many pairs of frames without another one that is known.
UNUSABLE, UNUSABLE_KEPT = "not finite or no rotation", 16


class TransformError(SlamFusionError):
    """Two frames cannot be related at a time; ``may_come``: a later transform may relate them."""

    def __init__(self, message: str, *, may_come: bool) -> None:
        super().__init__(message)
        self.may_come = may_come


def _gate() -> StampGate[tuple[float, Row]]:
    return StampGate(BACK_S, operator.eq)


@dataclass(eq=False)
class Edge:
    """The transforms of one frame in its parent.

    Attributes:
        stamps_s, rows: in the order of time, except a recording not yet sorted by ``samples``.
        heard_s: stamp of the last one received, used or not; seconds.
        gate: holds live transforms back whose stamps are far from the others.
        is_unusable: whether the last one received was ``UNUSABLE``.
    """

    parent: str
    child: str
    is_static: bool
    stamps_s: list[float] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    heard_s: float = 0.0
    gate: StampGate[tuple[float, Row]] = field(default_factory=_gate)
    is_unusable: bool = False
    _sorted: tuple[F64, F64] | None = None

    def restart(self, *, is_static: bool) -> None:
        """Forget every transform."""
        self.is_static, self.gate, self._sorted = is_static, _gate(), None
        self.stamps_s, self.rows = [], []

    def record(self, stamp_s: float, row: Row) -> None:
        """Keep a transform of a recording; while it is constant only some."""
        self._sorted = None
        rests = (
            len(self.rows) > 1
            and 0.0 <= stamp_s - self.stamps_s[-2] < REST_S
            and _is_same(row, self.rows[-1])
            and _is_same(row, self.rows[-2])
        )
        if rests:
            self.stamps_s[-1] = max(self.stamps_s[-1], stamp_s)
            return
        self.stamps_s.append(stamp_s)
        self.rows.append(row)

    def take(self, passed: Passed[tuple[float, Row]], keep_s: float) -> bool:
        """Take what the gate has passed; return whether any of it is new."""
        if passed.jump is not None and passed.jump.is_back:
            self.stamps_s, self.rows = [], []
        is_news = False
        for time_s, row in passed.items:
            if self.stamps_s and time_s <= self.stamps_s[-1]:
                continue
            self.stamps_s.append(time_s)
            self.rows.append(row)
            is_news = True
        newest_s = self.stamps_s[-1]
        if self.stamps_s[0] < newest_s - 2.0 * keep_s:  # not each time
            first = bisect_left(self.stamps_s, newest_s - keep_s)
            del self.stamps_s[:first], self.rows[:first]
        self._sorted = None
        return is_news

    def forget_after(self, time_s: float) -> None:
        """Forget everything newer than a time, and what is held back."""
        kept = bisect_left(self.stamps_s, time_s)
        del self.stamps_s[kept:], self.rows[kept:]
        self.gate.restart(self.stamps_s[-1] if self.stamps_s else None)
        self._sorted = None

    def samples(self) -> tuple[F64, F64]:
        """Return increasing stamps (N,) and rows (N, 7)."""
        if self._sorted is None:
            stamps, first = np.unique(np.array(self.stamps_s), return_index=True)
            self._sorted = stamps, np.array(self.rows)[first]
        return self._sorted

    def is_constant(self) -> bool:
        """Whether the transform never changes."""
        rows = self.samples()[1]
        return self.is_static or bool((np.abs(rows - rows[0]) <= SAME).all())

    def around(self, stamps_s: F64) -> Around:
        """Return the transforms around times (N,), clamped to the ends."""
        stamps, rows = self.samples()
        after = np.clip(np.searchsorted(stamps, stamps_s), 1, max(len(stamps) - 1, 1))
        before, after = after - 1, np.minimum(after, len(stamps) - 1)
        spans = np.where(after > before, stamps[after] - stamps[before], 1.0)
        shares = np.clip((stamps_s - stamps[before]) / spans, 0.0, 1.0)
        return rows[before], rows[after], shares

    def near(self, wanted_s: float, hold_s: float) -> Around:
        """Return the same for one time, or raise ``TransformError`` if it is unknown."""
        if self.is_static:
            return self.rows[-1], self.rows[-1], 0.0
        stamps = self.stamps_s
        name = f"from {self.child!r} to {self.parent!r}"
        if wanted_s > stamps[-1] + hold_s:
            message = f"the newest transform {name} is {wanted_s - stamps[-1]:.3f} s too old"
            message += f"; later ones are left out, {UNUSABLE}" if self.is_unusable else ""
            raise TransformError(message, may_come=True)
        if wanted_s < stamps[0] - hold_s:
            message = f"the oldest known transform {name} is {stamps[0] - wanted_s:.3f} s too new"
            raise TransformError(message, may_come=False)
        after = bisect_left(stamps, wanted_s)
        if after in {0, len(stamps)} or stamps[after] == wanted_s:
            row = self.rows[min(after, len(stamps) - 1)]
            return row, row, 0.0
        since_s, until_s = wanted_s - stamps[after - 1], stamps[after] - wanted_s
        if min(since_s, until_s) > REACH_S:
            message = f"no transform {name} within {REACH_S:g} s of {wanted_s:.3f} s"
            raise TransformError(message, may_come=False)
        return self.rows[after - 1], self.rows[after], since_s / (since_s + until_s)


def _is_same(one: Row, other: Row) -> bool:
    return all(abs(a - b) <= SAME for a, b in zip(one, other, strict=True))


# Live transforms are kept for this time, seconds.
KEEP_S = 10.0
# A laser tilted by more does not see the plane.
TILT_MAX_RAD = math.radians(60.0)
# A larger tilt of a laser is reported.
TILT_NOTED_RAD = math.radians(5.0)
# A shorter quaternion is no rotation.
SHORTEST = 1e-6


@dataclass(frozen=True)
class Mount:
    """The pose of a sensor on the robot.

    Attributes:
        pose: in the robot's base frame, in plan; yaw is the direction of the x axis.
        is_flipped: upside down.
        tilt_rad: between its z axis and the vertical, 0 to pi / 2.
    """

    pose: Pose2 = IDENTITY
    is_flipped: bool = False
    tilt_rad: float = 0.0

    @classmethod
    def of(cls, matrix: F64) -> Mount:
        """Return the mount of a (4, 4) pose in the base frame."""
        (ahead_x, _, _, x), (ahead_y, _, _, y), (_, _, upward, _), _ = matrix.tolist()
        tilt_rad = math.acos(min(abs(upward), 1.0))
        return cls(Pose2(x, y, math.atan2(ahead_y, ahead_x)), upward < 0.0, tilt_rad)

    def tilt_note(self, frame: str) -> str | None:
        """Return a sentence on the tilt of a laser frame; None if it is small."""
        if self.tilt_rad <= TILT_NOTED_RAD:
            return None
        how = f"tilted by {math.degrees(self.tilt_rad):.0f} degrees; its ranges are taken as level"
        return f"the laser {frame!r} is {how}: if it sits level, correct its transform"

    def scan(
        self, message: Any, stamp_s: float, ranges: F32, limit_m: float = math.inf
    ) -> LaserScan:
        """Return a sensor_msgs/LaserScan, its angles counter-clockwise seen from above."""
        turn = -1.0 if self.is_flipped else 1.0
        return LaserScan(
            stamp_s=stamp_s,
            ranges=ranges,
            angle_min_rad=turn * float(message.angle_min),
            angle_increment_rad=turn * float(message.angle_increment),
            range_min_m=max(0.0, float(message.range_min)),  # 0 also for NaN
            range_max_m=min(float(message.range_max), limit_m),
            mount=self.pose,
            time_increment_s=float(message.time_increment),
        )


def plan_poses(matrices: F64) -> F64:
    """Return plan poses (N, 3), yaw by the x axis, of poses (N, 4, 4)."""
    yaws = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.stack((matrices[:, 0, 3], matrices[:, 1, 3], yaws), axis=-1)


class TransformTree:
    """Frames and the transforms between them, recorded or live.

    A recording (``keep_s`` None) is known completely: its transforms may come in any order, and a
    frame that is sent in two parents has both. Query it with ``sample``.

    Live transforms are kept for ``keep_s`` behind the newest of their frame. Several in a row that
    are more than ``BACK_S`` older than the newest restart their frame (time jumped back); a single
    one, one far ahead (see ``StampGate``) and a slightly older one are dropped. A frame has the
    parent that was sent last. Query with ``mount``, which refuses unknown times.

    A static transform holds at every time, and the last one sent is used; a change between static
    and moving restarts it. Frames are related by the shortest path over edges in either direction,
    the first edge of equals; rings are allowed. A leading ``/`` is ignored. Not thread-safe.

    Attributes:
        strays: live transforms dropped for their stamps.
    """

    def __init__(self, keep_s: float | None = None) -> None:
        self.strays = 0
        self._keep_s = keep_s
        self._edges: dict[tuple[str, str], Edge] = {}
        self._ways: dict[tuple[str, str], list[Step] | None] = {}
        # Pairs of frames whose transforms are unusable, for messages.
        self._unusable: list[str] = []

    @property
    def frames(self) -> set[str]:
        """Every named frame."""
        return {frame for pair in self._edges for frame in pair}

    def root(self, frame: str) -> str:
        """Return the outermost ancestor of a frame, or the frame itself."""
        parents = {child: parent for parent, child in self._edges}
        seen = {frame}
        while (parent := parents.get(frame)) is not None and parent not in seen:
            frame = parent
            seen.add(frame)
        return frame

    def add(
        self,
        parent: str,
        child: str,
        stamp_s: float,
        row: Sequence[float],
        *,
        is_static: bool = False,
        arrived_s: float = 0.0,
    ) -> bool:
        """Add one transform.

        Args:
            parent: frame that the transform leads to.
            child: frame of the points.
            row: (7,) x, y, z in metres, then the quaternion x, y, z, w of any length but 0.
            arrived_s: real time of its arrival, seconds; constant if unknown. Live only.

        Returns:
            Whether it is used or held back; False for equal frames, values not finite or absurdly
            large, no rotation, and live ones out of order.
        """
        x, y, z, *turn = (float(value) for value in row)
        length = math.hypot(*turn)
        is_near = all(abs(value) <= FARTHEST_M for value in (x, y, z))
        parent, child = parent.lstrip("/"), child.lstrip("/")
        is_usable = is_near and SHORTEST < length < math.inf
        if (known := self._edges.get((parent, child))) is not None:
            known.is_unusable = not is_usable
        elif not is_usable:
            names = dict.fromkeys([*self._unusable, f"{parent!r} -> {child!r}"])
            self._unusable = [*names][-UNUSABLE_KEPT:]
        if not is_usable or not parent or not child or parent == child:
            return False
        qx, qy, qz, qw = (value / length for value in turn)
        unit: Row = (x, y, z, qx, qy, qz, qw)
        edge = self._edge(parent, child, is_static=is_static)
        edge.heard_s = stamp_s
        if is_static:
            edge.restart(is_static=True)
        if is_static or self._keep_s is None:
            edge.record(stamp_s, unit)
            return True
        passed = edge.gate.offer(stamp_s, (stamp_s, unit), arrived_s)
        self.strays += len(passed.strays)
        return edge.take(passed, self._keep_s) if passed.items else True

    def heard_s(self, target: str, source: str) -> float | None:
        """Return the last stamp received of what moves between two frames, seconds.

        Of several moving frames the oldest; None if nothing moves or connects them.
        """
        edges = [edge for edge, _ in self._way(target, source) or []]
        return min((edge.heard_s for edge in edges if not edge.is_static), default=None)

    def settle(self, time_s: float) -> None:
        """Confirm held transforms that are nearer to the given current time than the used ones."""
        for edge in self._edges.values():
            held_s, newest_s = edge.gate.held_for_s, edge.gate.newest_s
            if self._keep_s is None or held_s is None or newest_s is None:
                continue
            if abs(held_s - time_s) < abs(newest_s - time_s):
                edge.take(edge.gate.confirm(), self._keep_s)

    def forget_after(self, time_s: float) -> None:
        """Forget moving transforms newer than a time: the clock has jumped back."""
        for key, edge in list(self._edges.items()):
            if edge.is_static:
                continue
            edge.forget_after(time_s)
            if not edge.stamps_s:
                self._forget(key)

    def is_connected(self, target: str, source: str) -> bool:
        """Whether transforms connect the frames."""
        return self._way(target, source) is not None

    def is_constant(self, target: str, source: str) -> bool:
        """Whether the frames never move relative to each other."""
        return all(edge.is_constant() for edge, _ in self._way(target, source) or [])

    def change_stamps_s(self, target: str, source: str) -> F64:
        """Return the times (N,) of new transforms between the frames.

        Static edges, and constant ones if any edge moves, do not count; neither do times at which
        not every edge is known.
        """
        edges = [edge for edge, _ in self._way(target, source) or [] if not edge.is_static]
        if not edges:
            return np.empty(0)
        moving = [edge for edge in edges if not edge.is_constant()]
        spans = [edge.samples()[0] for edge in moving or edges]
        stamps = np.unique(np.concatenate(spans))
        low, high = max(span[0] for span in spans), min(span[-1] for span in spans)
        return np.asarray(stamps[(stamps >= low) & (stamps <= high)])

    def sample(self, target: str, source: str, stamps_s: npt.ArrayLike) -> F64:
        """Return the pose of the source frame in the target frame at times (N,) in seconds.

        Translations are interpolated linearly, rotations at constant speed the short way, over
        gaps of any length; beyond the ends the first or last transform holds.

        Returns:
            (N, 4, 4): a point p of the source frame is M p in the target frame, metres.
        """
        way = self._known_way(target, source)
        times = np.atleast_1d(np.asarray(stamps_s, dtype=np.float64))
        return _chained(way, [edge.around(times) for edge, _ in way], len(times))

    def mount(self, target: str, source: str, time_s: float, hold_s: float = HOLD_S) -> Mount:
        """Return where a frame sits in another at a time, interpolated as in ``sample``.

        Raises:
            TransformError: the frames are not connected, the time is unknown, or it is tilted.
        """
        way = self._known_way(target, source)
        found = [edge.near(time_s, hold_s) for edge, _ in reversed(way)]
        matrix = _chained(way, found[::-1], 1)[0]
        mount = Mount.of(matrix)
        if mount.tilt_rad > TILT_MAX_RAD:
            raise TransformError(
                f"frame {source!r} is tilted by {math.degrees(mount.tilt_rad):.0f} degrees against "
                f"{target!r}; wanted one that lies level",
                may_come=False,
            )
        return mount

    def _edge(self, parent: str, child: str, *, is_static: bool) -> Edge:
        """Return the edge between two frames, new or restarted if its kind has changed."""
        key = (parent, child)
        edge = self._edges.get(key)
        if edge is None:
            if self._keep_s is not None:
                for other in [pair for pair in self._edges if pair[1] == child]:
                    self._forget(other)
            edge = self._edges[key] = Edge(parent, child, is_static)
            self._ways.clear()
        elif edge.is_static != is_static:
            edge.restart(is_static=is_static)
        return edge

    def _forget(self, key: tuple[str, str]) -> None:
        del self._edges[key]
        self._ways.clear()

    def _known_way(self, target: str, source: str) -> list[Step]:
        way = self._way(target, source)
        if way is None:
            known = ", ".join(sorted(self.frames)) or "none"
            names = f"from {source.lstrip('/')!r} to {target.lstrip('/')!r}"
            if self._unusable:
                known += f"; left out, {UNUSABLE}: {', '.join(sorted(self._unusable))}"
            raise TransformError(f"no transforms {names}; known frames: {known}", may_come=True)
        return way

    def _way(self, target: str, source: str) -> list[Step] | None:
        """Return the steps from target to source; None if nothing connects them."""
        key = (target.lstrip("/"), source.lstrip("/"))
        if key not in self._ways:
            self._ways[key] = _shortest_way(self._edges, *key)
        return self._ways[key]


def _shortest_way(
    edges: Mapping[tuple[str, str], Edge], target: str, source: str
) -> list[Step] | None:
    """Search breadth first; of equally short paths the first one sent."""
    neighbours: dict[str, list[tuple[str, Step]]] = {}
    for (parent, child), edge in edges.items():
        neighbours.setdefault(parent, []).append((child, (edge, True)))
        neighbours.setdefault(child, []).append((parent, (edge, False)))
    ways: dict[str, list[Step]] = {target: []}
    queue = deque([target])
    while queue:
        frame = queue.popleft()
        if frame == source:
            return ways[frame]
        for other, step in neighbours.get(frame, []):
            if other not in ways:
                ways[other] = [*ways[frame], step]
                queue.append(other)
    return None


def _chained(way: Sequence[Step], found: Sequence[Around], count: int) -> F64:
    """Return the poses (N, 4, 4) along a path, all edges at once."""
    if not way:
        return np.tile(np.eye(4), (count, 1, 1))
    before, after, shares = (np.array(part, dtype=np.float64) for part in zip(*found, strict=True))
    before, after, shares = before.reshape(-1, 7), after.reshape(-1, 7), shares.reshape(-1, 1)
    turns, moves = before[:, 3:], before[:, :3]
    if shares.any():
        turns = _slerp(turns, after[:, 3:], shares)
        moves = moves + shares * (after[:, :3] - moves)
    poses = np.zeros((len(way), count, 4, 4))
    poses[..., :3, :3] = _matrices(turns).reshape(len(way), count, 3, 3)
    poses[..., :3, 3] = moves.reshape(len(way), count, 3)
    poses[..., 3, 3] = 1.0
    walked = [
        pose if is_forward else _inverse(pose)
        for (_, is_forward), pose in zip(way, poses, strict=True)
    ]
    return functools.reduce(operator.matmul, walked)


def _slerp(start: F64, end: F64, shares: F64) -> F64:
    """Return unit quaternions (N, 4) between others, as SciPy does, which loads slowly."""
    cosines = (start * end).sum(axis=1, keepdims=True)
    end, cosines = np.where(cosines < 0.0, -end, end), np.abs(cosines)
    across = end - cosines * start
    sines = np.linalg.norm(across, axis=1, keepdims=True)
    angles = shares * np.arctan2(sines, cosines)
    found = np.cos(angles) * start + np.sin(angles) * across / np.maximum(sines, TINY)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _matrices(quaternions: F64) -> F64:
    """Return the rotations (N, 3, 3) of unit quaternions (N, 4) x, y, z, w."""
    x, y, z, w = quaternions.T
    rows = (
        (w * w + x * x - y * y - z * z, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), w * w - x * x + y * y - z * z, 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), w * w - x * x - y * y + z * z),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def _inverse(poses: F64) -> F64:
    back = poses.copy()
    back[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    back[:, :3, 3:] = -(back[:, :3, :3] @ poses[:, :3, 3:])
    return back
