"""``StampGate``: accepts a jump of time only when several stamps in a row confirm it.

One wrong stamp (a restarted driver, a set clock, a damaged message) must neither discard a map nor
block every later scan.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

T = TypeVar("T")

# Items in a row that confirm a jump of time.
CONFIRMING = 3
# A stamp may run ahead of the last one by the elapsed real time plus this, seconds.
AHEAD_S = 1.0
# Most items held back; while the odometry contradicts, the oldest are dropped.
HELD_MOST = 20


@dataclass(frozen=True)
class Jump:
    """A confirmed jump of time, between two stamps in seconds."""

    before_s: float
    after_s: float

    @property
    def is_back(self) -> bool:
        """Whether time went back."""
        return self.after_s < self.before_s


@dataclass(frozen=True, eq=False)
class Passed(Generic[T]):
    """What a gate lets through after one more item.

    Attributes:
        items: to be used, in their order; none while an item is held back.
        strays: items that are dropped.
        jump: of time, before the first of ``items``.
    """

    items: tuple[T, ...] = ()
    strays: tuple[T, ...] = ()
    jump: Jump | None = None


class StampGate(Generic[T]):
    """Passes items whose stamps continue the last ones; holds the others back.

    An item is held back if it is older than the newest one by more than ``back_s``, or further
    ahead than the elapsed real time plus ``ahead_s`` (or twice the usual step, if that is longer).
    When ``CONFIRMING`` held items follow in order, with nothing from the old time between, time
    has jumped: all pass. When the old time continues, they were strays. A held item that is sent
    again unchanged confirms itself: its sender waits for it.

    An item slightly older than the newest one passes; the user of the gate skips it.

    Args:
        is_same: whether two items of one stamp are the same one, sent again; default: never.

    Attributes:
        back_s: may be changed.
        newest_s: newest stamp that passed, seconds; None before the first.
    """

    def __init__(
        self, back_s: float, is_same: Callable[[T, T], bool] | None = None, ahead_s: float = AHEAD_S
    ) -> None:
        self.back_s = back_s
        self.newest_s: float | None = None
        self._is_same = is_same
        self._ahead_s = ahead_s
        self._arrived_s = 0.0
        # The last stamps that passed as the newest, and the held items.
        self._last_s: deque[float] = deque(maxlen=CONFIRMING)
        self._held: list[tuple[float, float, T]] = []
        self._said = 0

    @property
    def held(self) -> int:
        """Items that are held back."""
        return len(self._held)

    @property
    def held_for_s(self) -> float | None:
        """Newest stamp that is held back, seconds; None where none is."""
        return self._held[-1][0] if self._held else None

    def offer(
        self,
        stamp_s: float,
        item: T,
        arrived_s: float = 0.0,
        agrees: Callable[[float, float], bool] | None = None,
    ) -> Passed[T]:
        """Take one more item.

        Args:
            arrived_s: real time of its arrival, seconds; constant if unknown.
            agrees: called with the newest stamp before and after a confirmed jump; while it
                returns False, the items are held back. Default: True.
        """
        newest_s = self.newest_s
        if newest_s is None or self._is_regular(newest_s, stamp_s, arrived_s):
            strays = self._drop_held()
            self._note(stamp_s, arrived_s)
            return Passed((item,), strays)
        strays = self._hold(newest_s, stamp_s, arrived_s, item)
        if self._said >= CONFIRMING and (agrees is None or agrees(newest_s, stamp_s)):
            passed = self.confirm()
            return Passed(passed.items, strays, passed.jump)
        return Passed((), strays)

    def confirm(self) -> Passed[T]:
        """Pass the held items: something else has confirmed them, or nothing follows."""
        if not self._held or self.newest_s is None:
            return Passed()
        jump = Jump(self.newest_s, self._held[0][0])
        if jump.is_back:
            self.newest_s = None
            self._last_s.clear()
        items = []
        for stamp_s, arrived_s, item in self._held:
            items.append(item)
            self._note(stamp_s, arrived_s)
        self._held, self._said = [], 0
        return Passed(tuple(items), (), jump)

    def restart(self, newest_s: float | None) -> None:
        """Forget everything but the given newest stamp, seconds."""
        self._held, self._said = [], 0
        self._last_s.clear()
        self.newest_s = newest_s
        if newest_s is not None:
            self._last_s.append(newest_s)

    def _is_regular(self, newest_s: float, stamp_s: float, arrived_s: float) -> bool:
        """Whether a stamp continues the last ones."""
        if stamp_s <= newest_s:
            # Behind only the last two: one of these ran ahead.
            return stamp_s >= newest_s - self.back_s or stamp_s > self._last_s[0]
        steps_s = [after_s - before_s for before_s, after_s in pairwise(self._last_s)]
        usual_s = min(steps_s) if len(steps_s) == CONFIRMING - 1 else 0.0
        passed_s = max(0.0, arrived_s - self._arrived_s)
        return stamp_s - newest_s <= max(self._ahead_s, 2.0 * usual_s) + passed_s

    def _note(self, stamp_s: float, arrived_s: float) -> None:
        if self.newest_s is None or stamp_s > self.newest_s:
            self.newest_s, self._arrived_s = stamp_s, arrived_s
            self._last_s.append(stamp_s)

    def _hold(self, newest_s: float, stamp_s: float, arrived_s: float, item: T) -> tuple[T, ...]:
        """Hold an item back; return the strays that it reveals."""
        strays: tuple[T, ...] = ()
        is_next = True
        if self._held:
            (first_s, *_), (last_s, _, last) = self._held[0], self._held[-1]
            if stamp_s == last_s and self._is_same is not None and self._is_same(last, item):
                self._said += 1
                return ()
            if stamp_s < first_s or (stamp_s > newest_s) != (first_s > newest_s):
                strays = self._drop_held()
            else:  # a late one, or one of another sensor, confirms nothing
                is_next = stamp_s > max(held_s for held_s, *_ in self._held)
        self._held.append((stamp_s, arrived_s, item))
        self._said += is_next
        if len(self._held) > HELD_MOST:
            return (*strays, self._held.pop(0)[2])
        return strays

    def _drop_held(self) -> tuple[T, ...]:
        strays = tuple(item for *_, item in self._held)
        self._held, self._said = [], 0
        return strays
