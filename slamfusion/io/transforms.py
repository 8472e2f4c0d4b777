"""``TransformTree``: the transforms between frames, and where each frame is at a time.

One tree for what a recording sends and for what a robot sends now; it needs no ROS. ``Edge`` has
the transforms of one frame in another. Rotations are SciPy's.
"""

from __future__ import annotations

import functools
import importlib
import math
import operator
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io.log import FARTHEST_M, REACH_S
from slamfusion.io.stamps import Passed, StampGate

# x, y, z in metres, then the unit quaternion x, y, z, w.
Row = tuple[float, float, float, float, float, float, float]
# The transforms before and after some times, (N, 7) each, and the shares (N,) of the way between;
# of one time a row each and a number.
Around = tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]

# An edge between two frames, and whether it is walked from the parent to the child.
Step = tuple["Edge", bool]

# A time this little outside of what is known takes the nearest transform, seconds.
HOLD_S = 0.05
# Live transforms this much older than the newest, several in a row, begin their frame again: a bag
# that loops. Seconds.
BACK_S = 1.0
# In a recording a transform that stays the same is kept this often, however often it was sent.
REST_S = 0.1
# Translations (m) and quaternion parts that differ by less are the same.
SAME = 1e-7


class TransformError(SlamFusionError):
    """Two frames cannot be related at a time.

    Attributes:
        may_come: a transform that arrives later may still tell.
    """

    def __init__(self, message: str, *, may_come: bool) -> None:
        super().__init__(message)
        self.may_come = may_come


def _gate() -> StampGate[tuple[float, Row]]:
    return StampGate(BACK_S, operator.eq)


@dataclass(eq=False)
class Edge:
    """The transforms of one frame in its parent.

    Attributes:
        stamps_s, rows: in the order of time, but for a recording that ``samples`` has yet to sort.
        heard_s: stamp of the one that came last, whether it is used or not; seconds.
        gate: holds those back that are far from the others; of what is sent live.
    """

    parent: str
    child: str
    is_static: bool
    stamps_s: list[float] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    heard_s: float = 0.0
    gate: StampGate[tuple[float, Row]] = field(default_factory=_gate)
    _sorted: tuple[F64, F64] | None = None

    def restart(self, *, is_static: bool) -> None:
        """Forget every transform; those to come are static or not."""
        self.is_static, self.gate, self._sorted = is_static, _gate(), None
        self.stamps_s, self.rows = [], []

    def record(self, stamp_s: float, row: Row) -> None:
        """Keep a transform of a recording; of long rests only some."""
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
        """Take in what the gate has let through; return whether any of it is news."""
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
        if self.stamps_s[0] < newest_s - 2.0 * keep_s:  # now and then, not each time
            first = bisect_left(self.stamps_s, newest_s - keep_s)
            del self.stamps_s[:first], self.rows[:first]
        self._sorted = None
        return is_news

    def forget_after(self, time_s: float) -> None:
        """Forget what is newer than a time, and what is held back."""
        kept = bisect_left(self.stamps_s, time_s)
        del self.stamps_s[kept:], self.rows[kept:]
        self.gate.restart(self.stamps_s[-1] if self.stamps_s else None)
        self._sorted = None

    def samples(self) -> tuple[F64, F64]:
        """Return stamps (N,) that increase, and rows (N, 7)."""
        if self._sorted is None:
            stamps, first = np.unique(np.array(self.stamps_s), return_index=True)
            self._sorted = stamps, np.array(self.rows)[first]
        return self._sorted

    def is_constant(self) -> bool:
        """Whether the transform never changes."""
        rows = self.samples()[1]
        return self.is_static or bool((np.abs(rows - rows[0]) <= SAME).all())

    def around(self, stamps_s: F64) -> Around:
        """Return what lies around times (N,); beyond the ends it is the end."""
        stamps, rows = self.samples()
        after = np.clip(np.searchsorted(stamps, stamps_s), 1, max(len(stamps) - 1, 1))
        before, after = after - 1, np.minimum(after, len(stamps) - 1)
        spans = np.where(after > before, stamps[after] - stamps[before], 1.0)
        shares = np.clip((stamps_s - stamps[before]) / spans, 0.0, 1.0)
        return rows[before], rows[after], shares

    def near(self, wanted_s: float, hold_s: float) -> Around:
        """Return the same of one time, or raise ``TransformError`` where it is not known."""
        if self.is_static:
            return self.rows[-1], self.rows[-1], 0.0
        stamps = self.stamps_s
        name = f"from {self.child!r} to {self.parent!r}"
        if wanted_s > stamps[-1] + hold_s:
            message = f"the newest transform {name} is {wanted_s - stamps[-1]:.3f} s too old"
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


# Of what is sent live, so much is kept, seconds.
KEEP_S = 10.0
# A laser tilted by more does not see the plane.
TILT_MAX_RAD = math.radians(60.0)
# A shorter quaternion is no rotation.
SHORTEST = 1e-6


@dataclass(frozen=True)
class Mount:
    """Where something sits on the robot.

    Attributes:
        pose: of its frame in the robot's base frame; where its x axis points in plan.
        is_flipped: it hangs upside down.
        is_static: it cannot move.
        tilt_rad: between its z axis and the vertical, upside down or not; 0 to pi / 2.
    """

    pose: Pose2 = IDENTITY
    is_flipped: bool = False
    is_static: bool = True
    tilt_rad: float = 0.0

    @classmethod
    def of(cls, matrix: F64, *, is_static: bool) -> Mount:
        """Return the mount of a (4, 4) pose in the base frame."""
        (ahead_x, _, _, x), (ahead_y, _, _, y), (_, _, upward, _), _ = matrix.tolist()
        tilt_rad = math.acos(min(abs(upward), 1.0))
        return cls(Pose2(x, y, math.atan2(ahead_y, ahead_x)), upward < 0.0, is_static, tilt_rad)


def plan_poses(matrices: F64) -> F64:
    """Return poses (N, 3) in plan, x, y and where the x axis points, of poses (N, 4, 4)."""
    yaws = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.stack((matrices[:, 0, 3], matrices[:, 1, 3], yaws), axis=-1)


class TransformTree:
    """Frames and the transforms between them, of a recording or as they are sent.

    A recording (``keep_s`` None) is known as a whole: its transforms may come in any order, all are
    kept, and a frame that is sent in two parents has both. Ask it with ``sample``.

    What is sent live is kept for ``keep_s`` behind the newest of its frame. Several transforms in a
    row that are more than ``BACK_S`` older than the newest begin their frame again (time jumped
    back); a single one, or one far ahead, is left out (see ``StampGate``), and so is one that is a
    little older and comes too late. A frame has the parent that was sent last. Ask it with
    ``mount``, which refuses a time that is not known.

    In both a static transform holds at every time, and the one that was sent last is used; one that
    is static from now on, or no more, begins again. Frames are related by the shortest way over
    edges in either direction, by the edge that was named first where two are equally short; a ring
    of frames is no harm. A leading ``/`` of a frame's name means nothing. Not safe between threads.

    Attributes:
        strays: live transforms left out for their stamps, far from those before and after them.
    """

    def __init__(self, keep_s: float | None = None) -> None:
        # It loads slowly: here, not at the first lookup.
        importlib.import_module("scipy.spatial.transform")
        self.strays = 0
        self._keep_s = keep_s
        self._edges: dict[tuple[str, str], Edge] = {}
        self._ways: dict[tuple[str, str], list[Step] | None] = {}

    @property
    def frames(self) -> set[str]:
        """Every frame that has been named."""
        return {frame for pair in self._edges for frame in pair}

    def root(self, frame: str) -> str:
        """Return the outermost frame that holds a frame, which may be itself."""
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
        """Take in one transform.

        Args:
            parent: frame that the transform leads to.
            child: frame of the points.
            row: (7,) x, y, z in metres, then the quaternion x, y, z, w of any length but 0.
            arrived_s: real time of its arrival, seconds; the same each time where that is not
                known. Only what is sent live needs it.

        Returns:
            Whether it is used, or held back until others bear it out: of two frames, finite, not
            absurdly far, a rotation, and live in order.
        """
        x, y, z, *turn = (float(value) for value in row)
        length = math.hypot(*turn)
        is_near = all(abs(value) <= FARTHEST_M for value in (x, y, z))
        if not (is_near and SHORTEST < length < math.inf):
            return False
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if not parent or not child or parent == child:
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
        """Return the stamp that was heard last of what moves a frame in another, seconds.

        Of several moving frames between them the oldest; None where nothing moves or connects them.
        """
        edges = [edge for edge, _ in self._way(target, source) or []]
        return min((edge.heard_s for edge in edges if not edge.is_static), default=None)

    def settle(self, time_s: float) -> None:
        """Let in what is held back and nearer to a time than what is used: time is there now."""
        for edge in self._edges.values():
            held_s, newest_s = edge.gate.held_for_s, edge.gate.newest_s
            if self._keep_s is None or held_s is None or newest_s is None:
                continue
            if abs(held_s - time_s) < abs(newest_s - time_s):
                edge.take(edge.gate.confirm(), self._keep_s)

    def forget_after(self, time_s: float) -> None:
        """Forget moving transforms newer than a time: the clock has jumped back before them."""
        for key, edge in list(self._edges.items()):
            if edge.is_static:
                continue
            edge.forget_after(time_s)
            if not edge.stamps_s:
                self._forget(key)

    def is_connected(self, target: str, source: str) -> bool:
        """Whether transforms lead from one frame to the other."""
        return self._way(target, source) is not None

    def is_constant(self, target: str, source: str) -> bool:
        """Whether the frames never move against each other."""
        return all(edge.is_constant() for edge, _ in self._way(target, source) or [])

    def change_stamps_s(self, target: str, source: str) -> F64:
        """Return the times (N,) at which something between the frames was sent again.

        Only what is not static counts, and within it what moves, if anything does; times at which
        not everything is known yet, or no more, are left out.
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
        """Return the pose of the source frame in the target frame at given times.

        Translations are interpolated linearly, rotations at constant speed the short way, over
        gaps of any length; before the first transform of a frame it is the first, after the last
        the last.

        Args:
            target: a frame.
            source: a frame connected with it.
            stamps_s: (N,) seconds, or one number.

        Returns:
            (N, 4, 4): a point p of the source frame is M p in the target frame, metres.
        """
        way = self._known_way(target, source)
        times = np.atleast_1d(np.asarray(stamps_s, dtype=np.float64))
        return _chained(way, [edge.around(times) for edge, _ in way], len(times))

    def mount(self, target: str, source: str, time_s: float, hold_s: float = HOLD_S) -> Mount:
        """Return where a frame sits in another at a time, interpolated as in ``sample``.

        Raises:
            TransformError: nothing connects the frames, the time is not known, or it is tilted.
        """
        way = self._known_way(target, source)
        found = [edge.near(time_s, hold_s) for edge, _ in reversed(way)]
        matrix = _chained(way, found[::-1], 1)[0]
        mount = Mount.of(matrix, is_static=all(edge.is_static for edge, _ in way))
        if mount.tilt_rad > TILT_MAX_RAD:
            raise TransformError(
                f"frame {source!r} is tilted by {math.degrees(mount.tilt_rad):.0f} degrees against "
                f"{target!r}; wanted one that lies level",
                may_come=False,
            )
        return mount

    def _edge(self, parent: str, child: str, *, is_static: bool) -> Edge:
        """Return the edge between two frames, new or begun again where its kind has changed."""
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
            raise TransformError(f"no transforms {names}; known frames: {known}", may_come=True)
        return way

    def _way(self, target: str, source: str) -> list[Step] | None:
        """Return the steps from target to source; None where nothing connects them."""
        key = (target.lstrip("/"), source.lstrip("/"))
        if key not in self._ways:
            self._ways[key] = _shortest_way(self._edges, *key)
        return self._ways[key]


def _shortest_way(
    edges: Mapping[tuple[str, str], Edge], target: str, source: str
) -> list[Step] | None:
    """Search breadth first: the shortest way, and by the first sent of equals."""
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
    """Return the poses (N, 4, 4) along a way.

    All edges at once: what takes time is making SciPy's objects, not what they hold.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (who reads maps needs none)

    if not way:
        return np.tile(np.eye(4), (count, 1, 1))
    before, after, shares = (np.array(part, dtype=np.float64) for part in zip(*found, strict=True))
    before, after, shares = before.reshape(-1, 7), after.reshape(-1, 7), shares.reshape(-1, 1)
    start, moves = Rotation.from_quat(before[:, 3:]), before[:, :3]
    turns = start.as_matrix()
    if shares.any():
        # What SciPy's Slerp does; an object of that holds the rotations of one edge alone.
        between = (start.inv() * Rotation.from_quat(after[:, 3:])).as_rotvec()
        turns = turns @ Rotation.from_rotvec(shares * between).as_matrix()
        moves = moves + shares * (after[:, :3] - moves)
    poses = np.zeros((len(way), count, 4, 4))
    poses[..., :3, :3] = turns.reshape(len(way), count, 3, 3)
    poses[..., :3, 3] = moves.reshape(len(way), count, 3)
    poses[..., 3, 3] = 1.0
    walked = [
        pose if is_forward else _inverse(pose)
        for (_, is_forward), pose in zip(way, poses, strict=True)
    ]
    return functools.reduce(operator.matmul, walked)


def _inverse(poses: F64) -> F64:
    back = poses.copy()
    back[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    back[:, :3, 3:] = -(back[:, :3, :3] @ poses[:, :3, 3:])
    return back
