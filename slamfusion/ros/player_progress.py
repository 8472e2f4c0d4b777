"""``ProgressLines``: how far a log is, now and then, in a line of the player's log."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

# A line for each tenth of the log, but no more often than this, seconds.
PARTS, APART_S = 10, 5.0


class ProgressLines:
    """Says each tenth of a log that was played; of a short log not all of them.

    Args:
        say: takes a line.
        clock_s: seconds that never go back.
    """

    def __init__(
        self, say: Callable[[str], None], clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._say, self._clock_s = say, clock_s
        self._part = 0
        self._told_s = clock_s()

    def tell(self, share: float, words: str) -> None:
        """Take how far the log is.

        Args:
            share: of it that was read, 0 to 1; less than before: it is played again.
            words: what was done so far.
        """
        part = math.floor(PARTS * share)
        if part < self._part:
            self._part = 0
        now_s = self._clock_s()
        if part > self._part and part < PARTS and now_s - self._told_s >= APART_S:
            self._part, self._told_s = part, now_s
            self._say(f"played {share:.0%}: {words}")
