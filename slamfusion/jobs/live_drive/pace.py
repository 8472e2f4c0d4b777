"""``Pace``: when a drive is solved, and how much of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias, get_args

import numpy as np

# After each solution: a rest of this many times its duration, and at least this number of seconds.
# Together at most 10 % of a core: in between the pose goes by scans that match what was solved, so
# new places need new solutions.
RESTS: Mapping[Depth, tuple[float, float]] = {
    "judged": (29.0, 2.0),
    "window": (24.0, 2.0),
    "whole": (39.0, 10.0),
}
# Seconds that solutions may take before they rest: the first ones of a drive are short and urgent.
AHEAD_S = 1.0
# Without a scan for so long, seconds, the drive is solved with all hits.
STILL_S = 2.0

# What is done: the inputs are compared with the scans again; the last seconds of the drive are
# solved; all of it is, and the inputs are compared; or so with all hits.
Depth: TypeAlias = Literal["judged", "window", "whole", "final"]
DEPTHS: tuple[Depth, ...] = get_args(Depth)


class Pace:
    """Says when a drive is solved, and how much of it; for one thread, on any clock in seconds."""

    def __init__(self) -> None:
        """Let the whole drive be solved first."""
        self._scans = 0
        self._seen: dict[Depth, int] = dict.fromkeys(DEPTHS, 0)
        self._due_s: dict[Depth, float] = dict.fromkeys(DEPTHS, -np.inf)
        # When all solutions so far have rested.
        self._rested_s: dict[Depth, float] = {}

    def due(self, now_s: float, scans: int) -> Depth | None:
        """Return what is due after this number of scans, or None."""
        if scans != self._scans:
            self._scans = scans
            self._due_s["final"] = now_s + STILL_S
        for depth in reversed(DEPTHS):
            if now_s >= self._due_s[depth] and self._seen[depth] != scans:
                return depth
        return None

    def done(self, depth: Depth, began_s: float, done_s: float) -> None:
        """Take note of a solution, of what ``due`` said last."""
        done = DEPTHS[: DEPTHS.index(depth) + 1] if depth in {"whole", "final"} else (depth,)
        self._seen |= dict.fromkeys(done, self._scans)
        kind: Depth = "whole" if depth == "final" else depth
        rest, least_s = RESTS[kind]
        rested_s = max(self._rested_s.get(kind, done_s), done_s) + rest * (done_s - began_s)
        self._rested_s[kind] = rested_s
        self._due_s[kind] = max(done_s + least_s, rested_s - rest * AHEAD_S)
