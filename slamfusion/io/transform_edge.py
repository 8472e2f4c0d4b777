"""``Edge``: the transforms of one frame in another, and which of them a time lies between."""

from __future__ import annotations

import operator
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.errors import SlamFusionError
from slamfusion.io.stamps import Passed, StampGate

Floats = npt.NDArray[np.float64]
# x, y, z in metres, then the unit quaternion x, y, z, w.
Row = tuple[float, float, float, float, float, float, float]
# The transforms before and after some times, (N, 7) each, and the shares (N,) of the way between;
# of one time a row each and a number.
Around = tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]

# A time this little outside of what is known takes the nearest transform; between two transforms
# it must be this near to one of them. Seconds.
HOLD_S = 0.05
REACH_S = 0.5
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
    _sorted: tuple[Floats, Floats] | None = None

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

    def samples(self) -> tuple[Floats, Floats]:
        """Return stamps (N,) that increase, and rows (N, 7)."""
        if self._sorted is None:
            stamps, first = np.unique(np.array(self.stamps_s), return_index=True)
            self._sorted = stamps, np.array(self.rows)[first]
        return self._sorted

    def is_constant(self) -> bool:
        """Whether the transform never changes."""
        rows = self.samples()[1]
        return self.is_static or bool((np.abs(rows - rows[0]) <= SAME).all())

    def around(self, stamps_s: Floats) -> Around:
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


class Step(NamedTuple):
    """An edge on the way from one frame to another.

    Attributes:
        edge: the transforms.
        is_forward: it is walked from the parent to the child.
    """

    edge: Edge
    is_forward: bool


def _is_same(one: Row, other: Row) -> bool:
    return all(abs(a - b) <= SAME for a, b in zip(one, other, strict=True))
