"""``TransformTree``: the transforms of a recording, and where each frame is at a time."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slamfusion.io.log import FARTHEST_M

__all__ = ["TransformTree", "rotation_matrices"]

Floats = npt.NDArray[np.float64]

# A transform that stays the same is kept this often, however often it was sent.
_KEEP_EVERY_S = 0.1
# Translations (m) and quaternion parts that differ by less are the same.
_SAME = 1e-7


@dataclass
class _Edge:
    """The transforms from one frame to its child; rows are x, y, z, qx, qy, qz, qw."""

    is_static: bool
    stamps_s: list[float] = field(default_factory=list)
    rows: list[Floats] = field(default_factory=list)
    _sorted: tuple[Floats, Floats] | None = None

    def add(self, stamp_s: float, row: Floats) -> None:
        """Keep a transform; of long rests only some."""
        self._sorted = None
        rests = (
            len(self.rows) > 1
            and 0.0 <= stamp_s - self.stamps_s[-2] < _KEEP_EVERY_S
            and _is_same(row, self.rows[-1])
            and _is_same(row, self.rows[-2])
        )
        if rests:
            self.stamps_s[-1] = max(self.stamps_s[-1], stamp_s)
            return
        self.stamps_s.append(stamp_s)
        self.rows.append(row)

    def samples(self) -> tuple[Floats, Floats]:
        """Return stamps (N,) that increase and rows (N, 7) whose quaternions turn the short way."""
        if self._sorted is None:
            stamps, first = np.unique(np.array(self.stamps_s), return_index=True)
            rows = np.array(self.rows)[first]
            turns = np.einsum("ij,ij->i", rows[1:, 3:], rows[:-1, 3:])
            signs = np.cumprod(np.where(turns < 0.0, -1.0, 1.0))
            rows[1:, 3:] *= signs[:, None]
            self._sorted = stamps, rows
        return self._sorted

    def is_constant(self) -> bool:
        """Whether the transform never changes."""
        rows = self.samples()[1]
        return self.is_static or bool((np.abs(rows - rows[0]) <= _SAME).all())

    def at(self, stamps_s: Floats) -> tuple[Floats, Floats]:
        """Return rotations (N, 3, 3) and translations (N, 3), the end ones beyond the ends."""
        stamps, rows = self.samples()
        if len(rows) == 1:
            wanted = np.broadcast_to(rows, (len(stamps_s), 7))
            return rotation_matrices(wanted[:, 3:]), wanted[:, :3]
        after = np.clip(np.searchsorted(stamps, stamps_s), 1, len(stamps) - 1)
        share = (stamps_s - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        share = np.clip(share, 0.0, 1.0)[:, None]
        first, second = rows[after - 1], rows[after]
        moved = first[:, :3] + share * (second[:, :3] - first[:, :3])
        return rotation_matrices(_between(first[:, 3:], second[:, 3:], share)), moved


class TransformTree:
    """Frames and the transforms between them, as a recording sends them.

    A point of frame b becomes one of frame a by R p + t of ``sample(a, b, ...)``.
    """

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], _Edge] = {}
        self._ways: dict[tuple[str, str], list[tuple[_Edge, bool]] | None] = {}

    def add(
        self, parent: str, child: str, stamp_s: float, row: Floats, *, is_static: bool = False
    ) -> bool:
        """Take in one transform.

        Args:
            parent: frame that the transform leads to; a leading ``/`` means nothing.
            child: frame of the points.
            stamp_s: its time, seconds.
            row: (7,) x, y, z in metres, then the quaternion x, y, z, w of any length but 0.
            is_static: it holds at every time.

        Returns:
            Whether it could be used: finite, not absurdly far, and a rotation.
        """
        values = np.asarray(row, dtype=np.float64)
        length = float(np.linalg.norm(values[3:]))
        is_near = bool((np.abs(values[:3]) <= FARTHEST_M).all())
        if not (is_near and math.isfinite(length) and length > _SAME):
            return False
        key = (parent.lstrip("/"), child.lstrip("/"))
        edge = self._edges.get(key)
        if edge is None:
            edge = self._edges[key] = _Edge(is_static)
            self._ways.clear()
        edge.add(stamp_s, np.concatenate((values[:3], values[3:] / length)))
        return True

    @property
    def frames(self) -> set[str]:
        """Every frame that has been named."""
        return {frame for pair in self._edges for frame in pair}

    def is_connected(self, target: str, source: str) -> bool:
        """Whether transforms lead from one frame to the other."""
        return self._way(target, source) is not None

    def is_constant(self, target: str, source: str) -> bool:
        """Whether the frames never move against each other."""
        return all(edge.is_constant() for edge, _ in self._way(target, source) or [])

    def change_stamps_s(self, target: str, source: str) -> Floats:
        """Return the times (N,) at which something between the frames was sent anew.

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

    def sample(self, target: str, source: str, stamps_s: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Return the pose of the source frame in the target frame at given times.

        Translations are interpolated linearly, rotations at constant speed the short way.

        Args:
            target: a frame.
            source: a frame connected with it.
            stamps_s: (N,) seconds.

        Returns:
            (N, 3, 3) rotations and (N, 3) translations, metres.

        Raises:
            KeyError: nothing connects the frames; ask ``is_connected`` first.
        """
        way = self._way(target, source)
        if way is None:
            raise KeyError((target, source))
        times = np.atleast_1d(np.asarray(stamps_s, dtype=np.float64))
        rotation = np.broadcast_to(np.eye(3), (len(times), 3, 3))
        translation = np.zeros((len(times), 3))
        for edge, is_forward in way:
            turn, move = edge.at(times)
            if not is_forward:
                turn = np.swapaxes(turn, 1, 2)
                move = -np.einsum("nij,nj->ni", turn, move)
            translation = translation + np.einsum("nij,nj->ni", rotation, move)
            rotation = rotation @ turn
        return rotation, translation

    def _way(self, target: str, source: str) -> list[tuple[_Edge, bool]] | None:
        """Return the edges from target to source, each with whether it is walked to its child."""
        key = (target.lstrip("/"), source.lstrip("/"))
        if key not in self._ways:
            self._ways[key] = self._search(*key)
        return self._ways[key]

    def _search(self, target: str, source: str) -> list[tuple[_Edge, bool]] | None:
        """Search breadth first: the shortest way, and the first sent of equals."""
        neighbours: dict[str, list[tuple[str, _Edge, bool]]] = {}
        for (parent, child), edge in self._edges.items():
            neighbours.setdefault(parent, []).append((child, edge, True))
            neighbours.setdefault(child, []).append((parent, edge, False))
        ways: dict[str, list[tuple[_Edge, bool]]] = {target: []}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            if frame == source:
                return ways[frame]
            for other, edge, is_forward in neighbours.get(frame, []):
                if other not in ways:
                    ways[other] = [*ways[frame], (edge, is_forward)]
                    queue.append(other)
        return None


def rotation_matrices(quaternions: Floats) -> Floats:
    """Return the rotation matrices (N, 3, 3) of unit quaternions (N, 4) x, y, z, w."""
    x, y, z, w = np.moveaxis(np.asarray(quaternions, dtype=np.float64), -1, 0)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _between(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate unit quaternions (N, 4) on the great circle between them; share (N, 1).

    Source: Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    cosine = np.clip(np.einsum("ij,ij->i", first, second), -1.0, 1.0)[:, None]
    angle = np.arccos(cosine)
    sine = np.sin(angle)
    # Too near for the quotient: the chord is the arc.
    is_near = sine < 1e-6
    safe = np.where(is_near, 1.0, sine)
    one = np.where(is_near, 1.0 - share, np.sin((1.0 - share) * angle) / safe)
    two = np.where(is_near, share, np.sin(share * angle) / safe)
    blended = one * first + two * second
    return np.asarray(blended / np.linalg.norm(blended, axis=1, keepdims=True))


def _is_same(one: Floats, other: Floats) -> bool:
    return bool(np.abs(one - other).max() <= _SAME)
