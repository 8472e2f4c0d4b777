"""``TransformBuffer``: the transforms of the last seconds, and where each frame is at a time."""

from __future__ import annotations

import math
import operator
from bisect import bisect_left
from dataclasses import dataclass, field

from geometry_msgs.msg import TransformStamped

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io.log import FARTHEST_M
from slamfusion.io.stamps import Passed, StampGate
from slamfusion.ros.messages import stamp_s

__all__ = ["Mount", "TransformBuffer", "TransformError"]

# Moving transforms are kept this long.
KEEP_S = 10.0
# Transforms this much older than the newest, several in a row, begin their frame again: a bag that
# loops.
BACK_S = 1.0
# A time this little outside of what is known takes the nearest transform; between two transforms
# it must be this near to one of them. The same as for bags.
HOLD_S = 0.05
REACH_S = 0.5
# A laser tilted by more does not see the plane.
TILT_MAX_RAD = math.radians(60.0)

# x, y, z in metres, then the unit quaternion x, y, z, w.
Row = tuple[float, float, float, float, float, float, float]
NO_MOTION: Row = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class TransformError(SlamFusionError):
    """Two frames cannot be related at a time.

    Attributes:
        may_come: a transform that arrives later may still tell.
    """

    def __init__(self, message: str, *, may_come: bool) -> None:
        super().__init__(message)
        self.may_come = may_come


@dataclass(frozen=True)
class Mount:
    """Where something sits on the robot.

    Attributes:
        pose: of its frame in the robot's base frame; where its x axis points in plan.
        is_flipped: it hangs upside down.
        is_static: it cannot move.
    """

    pose: Pose2 = IDENTITY
    is_flipped: bool = False
    is_static: bool = True


def _gate() -> StampGate[tuple[float, Row]]:
    return StampGate(BACK_S, operator.eq)


@dataclass
class _Edge:
    """The transforms of one frame in its parent, in the order of time.

    Attributes:
        heard_s: stamp of the one that came last, whether it is used or not; seconds.
        gate: holds those back that are far from the others.
    """

    parent: str
    is_static: bool
    stamps_s: list[float]
    rows: list[Row]
    heard_s: float
    gate: StampGate[tuple[float, Row]] = field(default_factory=_gate)

    def take(self, passed: Passed[tuple[float, Row]]) -> bool:
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
        if self.stamps_s[0] < newest_s - 2.0 * KEEP_S:  # now and then, not each time
            first = bisect_left(self.stamps_s, newest_s - KEEP_S)
            del self.stamps_s[:first], self.rows[:first]
        return is_news

    def at(self, child: str, wanted_s: float, hold_s: float) -> Row:
        """Return the transform at a time, or raise ``TransformError``.

        Args:
            child: the frame, for the message.
            wanted_s: the time.
            hold_s: so far outside of what is known the nearest one is taken.
        """
        if self.is_static:
            return self.rows[-1]
        stamps = self.stamps_s
        name = f"from {child!r} to {self.parent!r}"
        if wanted_s > stamps[-1] + hold_s:
            message = f"the newest transform {name} is {wanted_s - stamps[-1]:.3f} s too old"
            raise TransformError(message, may_come=True)
        if wanted_s < stamps[0] - hold_s:
            message = f"the oldest known transform {name} is {stamps[0] - wanted_s:.3f} s too new"
            raise TransformError(message, may_come=False)
        after = bisect_left(stamps, wanted_s)
        if after in {0, len(stamps)} or stamps[after] == wanted_s:
            return self.rows[min(after, len(stamps) - 1)]
        since_s, until_s = wanted_s - stamps[after - 1], stamps[after] - wanted_s
        if min(since_s, until_s) > REACH_S:
            message = f"no transform {name} within {REACH_S:g} s of {wanted_s:.3f} s"
            raise TransformError(message, may_come=False)
        return _between(self.rows[after - 1], self.rows[after], since_s / (since_s + until_s))


class TransformBuffer:
    """The transforms of the last seconds, and where each frame is at a time.

    Moving transforms are kept for ``KEEP_S`` behind the newest of their frame. Several in a row
    that are more than ``BACK_S`` older than the newest begin their frame again (time jumped back);
    a single one, or one far ahead, is left out (see ``StampGate``), and so is one that is a little
    older and comes too late. Not safe between threads; see ``TransformStore``.

    Attributes:
        strays: transforms left out for their stamps, far from those before and after them.
    """

    def __init__(self) -> None:
        self.strays = 0
        self._edges: dict[str, _Edge] = {}

    @property
    def frames(self) -> set[str]:
        """Every frame that has been named."""
        return set(self._edges) | {edge.parent for edge in self._edges.values()}

    def add(self, transform: TransformStamped, *, is_static: bool, arrived_s: float = 0.0) -> bool:
        """Take in a transform.

        Args:
            transform: of one frame in its parent.
            is_static: it holds at all times.
            arrived_s: real time of its arrival, seconds; always the same where that is not known.

        Returns:
            Whether it is used, or held back until others bear it out: finite, a rotation, in order.
        """
        move, turn = transform.transform.translation, transform.transform.rotation
        length = math.sqrt(turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2)
        values = (move.x, move.y, move.z)
        if not (all(abs(value) <= FARTHEST_M for value in values) and 1e-6 < length < math.inf):
            return False
        unit = (turn.x / length, turn.y / length, turn.z / length, turn.w / length)
        row: Row = (*values, *unit)
        parent = transform.header.frame_id.lstrip("/")
        child = transform.child_frame_id.lstrip("/")
        if not parent or not child or parent == child:
            return False
        time_s = stamp_s(transform)
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or is_static or edge.is_static:
            edge = _Edge(parent, is_static, [], [], time_s)
            self._edges[child] = edge
        edge.heard_s = time_s
        if is_static:
            edge.stamps_s, edge.rows = [time_s], [row]
            return True
        passed = edge.gate.offer(time_s, (time_s, row), arrived_s)
        self.strays += len(passed.strays)
        return edge.take(passed) if passed.items else True

    def heard_s(self, target: str, source: str) -> float | None:
        """Return the stamp that was heard last of what moves a frame in another, seconds.

        Of several moving frames between them the oldest; None where nothing moves or connects them.
        """
        try:
            up, down = self._to_common(target, source)
        except TransformError:
            return None
        edges = [self._edges[child] for child in (*up, *down)]
        return min((edge.heard_s for edge in edges if not edge.is_static), default=None)

    def settle(self, time_s: float) -> None:
        """Let in what is held back and nearer to a time than what is used: time is there now."""
        for edge in self._edges.values():
            held_s, newest_s = edge.gate.held_for_s, edge.gate.newest_s
            if held_s is None or newest_s is None:
                continue
            if abs(held_s - time_s) < abs(newest_s - time_s):
                edge.take(edge.gate.confirm())

    def forget_after(self, time_s: float) -> None:
        """Forget moving transforms newer than a time: the clock has jumped back before them."""
        for child, edge in list(self._edges.items()):
            if edge.is_static:
                continue
            kept = bisect_left(edge.stamps_s, time_s)
            del edge.stamps_s[kept:], edge.rows[kept:]
            if not edge.stamps_s:
                del self._edges[child]
            else:
                edge.gate.restart(edge.stamps_s[-1])

    def lookup(self, target: str, source: str, time_s: float) -> Pose2:
        """Return the pose of a frame in another at a time, in plan.

        Translations are interpolated linearly, rotations at constant speed the short way.

        Args:
            target: the frame the pose is in.
            source: the frame whose pose it is.
            time_s: seconds.

        Raises:
            TransformError: nothing connects the frames, or not at that time.
        """
        return self.mount(target, source, time_s).pose

    def mount(self, target: str, source: str, time_s: float, hold_s: float = HOLD_S) -> Mount:
        """Return the same as ``lookup`` and whether the frame is upside down.

        Args:
            target: the frame the pose is in.
            source: the frame whose pose it is.
            time_s: seconds.
            hold_s: so far outside of what is known the nearest transform is taken.

        Raises:
            TransformError: not connected, not at that time, or tilted by more than 60 degrees.
        """
        up, edges = self._to_common(target, source)
        row, is_static = NO_MOTION, True
        for child in edges:
            row = _chained(self._edges[child].at(child, time_s, hold_s), row)
            is_static = is_static and self._edges[child].is_static
        outer = NO_MOTION
        for child in up:
            outer = _chained(self._edges[child].at(child, time_s, hold_s), outer)
            is_static = is_static and self._edges[child].is_static
        if up:
            row = _chained(_inverted(outer), row)
        x, y, _, qx, qy, qz, qw = row
        upward = 1.0 - 2.0 * (qx * qx + qy * qy)
        tilt_rad = math.acos(min(abs(upward), 1.0))
        if tilt_rad > TILT_MAX_RAD:
            message = (
                f"frame {source!r} is tilted by {math.degrees(tilt_rad):.0f} degrees against "
                f"{target!r}; wanted one that lies level"
            )
            raise TransformError(message, may_come=False)
        yaw_rad = math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
        return Mount(Pose2(x, y, yaw_rad), upward < 0.0, is_static)

    def _to_common(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the frames from target and from source up to below their common ancestor."""
        goal, start = target.lstrip("/"), source.lstrip("/")
        above_goal, above_start = self._ancestors(goal), self._ancestors(start)
        common = next((frame for frame in above_start if frame in above_goal), None)
        if common is None:
            known = ", ".join(sorted(self.frames)) or "none"
            message = f"no transforms from {start!r} to {goal!r}; known frames: {known}"
            raise TransformError(message, may_come=True)
        return above_goal[: above_goal.index(common)], above_start[: above_start.index(common)]

    def _ancestors(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on; a ring of frames ends where it closes."""
        chain = [frame]
        while chain[-1] in self._edges:
            parent = self._edges[chain[-1]].parent
            if parent in chain:
                break
            chain.append(parent)
        return chain


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Return the product of two quaternions x, y, z, w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _turned(turn: tuple[float, ...], place: tuple[float, ...]) -> tuple[float, float, float]:
    """Return a point turned by a unit quaternion."""
    x, y, z, w = turn
    back = (-x, -y, -z, w)
    moved = _product(_product(turn, (*place, 0.0)), back)
    return moved[:3]


def _chained(outer: Row, inner: Row) -> Row:
    """Return the motion that applies ``inner`` first and then ``outer``."""
    moved = _turned(outer[3:], inner[:3])
    place = tuple(a + b for a, b in zip(outer[:3], moved, strict=True))
    return (*place, *_product(outer[3:], inner[3:]))  # type: ignore[return-value]


def _inverted(row: Row) -> Row:
    x, y, z, w = row[3:]
    turn = (-x, -y, -z, w)
    place = _turned(turn, (-row[0], -row[1], -row[2]))
    return (*place, *turn)


def _between(first: Row, second: Row, share: float) -> Row:
    """Interpolate two transforms.

    Source: Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    place = tuple(a + share * (b - a) for a, b in zip(first[:3], second[:3], strict=True))
    cosine = sum(a * b for a, b in zip(first[3:], second[3:], strict=True))
    sign = -1.0 if cosine < 0.0 else 1.0
    angle = math.acos(min(abs(cosine), 1.0))
    one, two = 1.0 - share, share
    if math.sin(angle) > 1e-6:  # nearer than that, the chord is the arc
        one = math.sin(one * angle) / math.sin(angle)
        two = math.sin(two * angle) / math.sin(angle)
    turn = [one * a + sign * two * b for a, b in zip(first[3:], second[3:], strict=True)]
    length = math.sqrt(sum(value * value for value in turn))
    return (*place, *(value / length for value in turn))  # type: ignore[return-value]
