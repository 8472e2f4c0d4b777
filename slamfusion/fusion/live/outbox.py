"""``Outbox``: fused maps on their way out, no faster than asked, of several only the last."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamfusion.grid import OccupancyGrid

LATENCIES = 300
# A fused map waits no longer than this for maps that came while it was made, seconds: sending one
# of 16 MB keeps them waiting longer than fusing them does.
GATHER_S = 0.25


@dataclass(frozen=True, eq=False)
class Fused:
    """A fused map on its way out.

    Attributes:
        grid, agreement: of one update; the agreement goes out after it, when somebody listens.
        stamp_s: of the newest map in it; 0 where all were saved maps.
        arrived_s: when the first map came that it shows and none before it did.
    """

    grid: OccupancyGrid
    agreement: OccupancyGrid
    stamp_s: float
    arrived_s: float | None


@dataclass(frozen=True)
class Sent:
    """What went out so far; replaced as a whole, so that any thread may read it.

    Attributes:
        maps: how many.
        median_ms, high_ms: median and 95th percentile from a map's coming to its fused one's going.
    """

    maps: int = 0
    median_ms: float = 0.0
    high_ms: float = 0.0


class Outbox:
    """Keeps the newest fused map until its turn, and its agreement until somebody listens.

    In the worker's thread, apart from ``is_due``, ``sent`` and ``rate_hz``.

    Args:
        rate_hz: maps a second that may go out at most.
        clock: seconds, growing.

    Attributes:
        rate_hz: may be replaced.
        waiting: the map that waits for its turn; None without.
        sent: what went out so far.
    """

    def __init__(self, rate_hz: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate_hz = rate_hz
        self.waiting: Fused | None = None
        self.sent = Sent()
        self._clock = clock
        self._untold: Fused | None = None
        self._sent_s = float("-inf")
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)

    def offer(self, fused: Fused) -> None:
        """Let a map wait in the place of an older one; what came first for that still counts."""
        before = self.waiting
        if before is not None:
            fused = Fused(fused.grid, fused.agreement, fused.stamp_s, before.arrived_s)
        self.waiting = fused

    @property
    def has_agreement(self) -> bool:
        """Whether the agreement of the map that went out last was not taken yet."""
        return self._untold is not None

    def is_due(self, is_heard: Callable[[], bool]) -> bool:
        """Whether a map could go out now, or an agreement.

        Args:
            is_heard: whether somebody listens to the agreement; asked only where one is left.
        """
        return (self.waiting is not None and self._is_turn()) or (self.has_agreement and is_heard())

    def take(self) -> Fused | None:
        """Return the map that waits, if its turn has come, to be sent at once."""
        fused = self.waiting
        if fused is None or not self._is_turn():
            return None
        self.waiting, self._untold = None, fused
        self._sent_s = self._clock()
        return fused

    def take_agreement(self) -> Fused | None:
        """Return the map that went out last, once, for its agreement."""
        fused, self._untold = self._untold, None
        return fused

    def count(self, fused: Fused) -> None:
        """Take note that a map was sent."""
        if fused.arrived_s is not None:
            self._latencies_s.append(self._clock() - fused.arrived_s)
        median, high = 1e3 * np.percentile([*self._latencies_s] or [0.0], (50.0, 95.0))
        self.sent = Sent(self.sent.maps + 1, float(median), float(high))

    def may_gather(self, has_maps: Callable[[], bool]) -> bool:
        """Whether the map that waits goes on waiting for maps that came while it was made."""
        arrived_s = None if self.waiting is None else self.waiting.arrived_s
        is_young = arrived_s is not None and self._clock() - arrived_s < GATHER_S
        return is_young and has_maps()

    def _is_turn(self) -> bool:
        """Whether the last map that was sent is old enough for another one."""
        return self._clock() - self._sent_s >= 1.0 / self.rate_hz
