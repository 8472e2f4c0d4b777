"""``Inbox``: what came of each input and was not looked at yet, from any thread."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace

from slamfusion.grid import OccupancyGrid

# How much the newest interval counts in the rate.
RATE_WEIGHT = 0.3


@dataclass(eq=False)
class Received:
    """What came of one input.

    Attributes:
        maps: messages that came, usable or not.
        rejected: those among them that said too little or could not be read.
        received_s: when the last one came; minus infinity before the first.
        rate_hz: messages a second, smoothed; 0 before the second.
        is_saved: read from a file: it never grows stale.
        is_new: whether anything came since the last ``Inbox.take``.
        grid: the newest map that waits; None without.
        refused: why the newest message could not be read; None: it could.
        gone: why the input is taken for lost; None: it is not.
    """

    maps: int = 0
    rejected: int = 0
    received_s: float = float("-inf")
    rate_hz: float = 0.0
    is_saved: bool = False
    is_new: bool = False
    grid: OccupancyGrid | None = None
    refused: str | None = None
    gone: str | None = None

    def count(self, received_s: float) -> None:
        """Count a message."""
        interval = received_s - self.received_s
        if self.maps and interval > 0.0:
            rate = 1.0 / interval
            first = self.maps == 1
            self.rate_hz = rate if first else self.rate_hz + RATE_WEIGHT * (rate - self.rate_hz)
        self.maps += 1
        self.received_s = received_s
        self.is_new = True
        self.gone = None


class Inbox:
    """Keeps the newest map of each input until it is taken; for any thread."""

    def __init__(self) -> None:
        """Start empty."""
        self._lock = threading.Lock()
        self._received: dict[str, Received] = {}

    def put(self, name: str, grid: OccupancyGrid, received_s: float, *, is_saved: bool) -> None:
        """Take the newest map of an input; one that waits is replaced."""
        with self._lock:
            item = self._received.setdefault(name, Received())
            item.count(received_s)
            item.grid = grid if grid.name == name else grid.with_name(name)
            item.refused, item.is_saved = None, is_saved

    def reject(self, name: str, reason: str, received_s: float) -> None:
        """Count a message that could not be read."""
        with self._lock:
            item = self._received.setdefault(name, Received())
            item.count(received_s)
            item.rejected += 1
            item.grid, item.refused = None, reason

    def drop(self, name: str, reason: str) -> None:
        """Take an input for lost until its next map."""
        with self._lock:
            item = self._received.setdefault(name, Received())
            item.is_new = True
            item.grid, item.gone = None, reason

    def recall(self, name: str, grid: OccupancyGrid | None) -> None:
        """Take an input that was dropped for present again, with the last map that it sent."""
        with self._lock:
            item = self._received.get(name)
            if item is None or item.gone is None:
                return
            item.gone, item.is_new = None, True
            item.grid = grid

    def remove(self, name: str) -> None:
        """Forget an input and whatever of it waits."""
        with self._lock:
            self._received.pop(name, None)

    def refill(self, grids: Mapping[str, OccupancyGrid | None]) -> None:
        """Let maps that were taken wait again, but where a newer one does or the input is lost."""
        with self._lock:
            for name, grid in grids.items():
                item = self._received[name]
                if item.grid is None and item.gone is None:
                    item.grid, item.is_new = grid, True

    def count_rejected(self, name: str) -> None:
        """Count a map that was taken and says too little."""
        with self._lock:
            self._received[name].rejected += 1

    @property
    def has_new(self) -> bool:
        """Whether anything waits to be taken."""
        with self._lock:
            return any(item.is_new for item in self._received.values())

    def take(self) -> tuple[dict[str, Received], dict[str, float]]:
        """Return what is new, by name, and when each input's last message came.

        Inputs that were read from a file are left out of the latter: they never grow stale.
        """
        with self._lock:
            fresh = {name: replace(item) for name, item in self._received.items() if item.is_new}
            for item in self._received.values():
                item.is_new, item.grid = False, None
            came = {
                name: item.received_s for name, item in self._received.items() if not item.is_saved
            }
        return fresh, came

    def counts(self) -> dict[str, Received]:
        """Return a copy of what came of each input, by name."""
        with self._lock:
            return {name: replace(item) for name, item in self._received.items()}
