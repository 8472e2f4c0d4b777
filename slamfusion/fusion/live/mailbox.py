"""``Mailbox``: messages of inputs and scans that are not fused yet, from any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.vote.lattice import Lattice

# Weight of the newest interval in the rate.
RATE_WEIGHT = 0.3


@dataclass(eq=False)
class InputMessage:
    """The messages of one input.

    Attributes:
        maps: messages that came, usable or not.
        rejected: those among them that contain too little or cannot be read.
        received_s: when the last one came; minus infinity before the first.
        rate_hz: messages a second, smoothed; 0 before the second.
        is_saved: read from a file: it never grows stale.
        is_new: whether anything came since the last ``Mailbox.take``.
        waits_since_s: when the first message came since then; None without.
        grid: the newest map that waits, or what reads it; None without.
        gone: why the input is lost; None: it is not.
    """

    maps: int = 0
    rejected: int = 0
    received_s: float = float("-inf")
    rate_hz: float = 0.0
    is_saved: bool = False
    is_new: bool = False
    waits_since_s: float | None = None
    grid: OccupancyGrid | Callable[[], OccupancyGrid] | None = None
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
        if self.waits_since_s is None:
            self.waits_since_s = received_s

    def read(self) -> OccupancyGrid | None:
        """Return the map that waits; raises a SlamFusionError where it cannot be read."""
        return self.grid() if callable(self.grid) else self.grid


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of the scans of a drive for its inputs.

    Attributes:
        transforms: of each input whose poses were scored on the scans: its map frame into the fused
            frame, as its poses say; metres, radians.
        doubts: why an input has no vote, by name, one line.
        lattice: of ``drawn``.
        drawn: the map drawn from the scans, in the fused frame; None: the maps of all inputs vote.
    """

    transforms: Mapping[str, Pose2]
    doubts: Mapping[str, str]
    lattice: Lattice
    drawn: OccupancyGrid | None = None


class Mailbox:
    """Keeps the newest map of each input, and the evidence, until taken; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._received: dict[str, InputMessage] = {}
        self._removed: list[str] = []
        self._evidence: Evidence | None = None

    def put_evidence(self, evidence: Evidence) -> None:
        """Take what the scans say now; what waits is replaced."""
        with self._lock:
            self._evidence = evidence

    def put(
        self,
        name: str,
        grid: OccupancyGrid | Callable[[], OccupancyGrid],
        received_s: float,
        *,
        is_saved: bool = False,
    ) -> None:
        """Take the newest map of an input; one that waits is replaced.

        ``grid`` may be a function that reads the map later; if it raises a SlamFusionError the
        input does not vote until one can be read. ``received_s`` is on the clock of
        ``LiveFusion.update``; a saved map never grows stale.
        """
        with self._lock:
            item = self._received.setdefault(name, InputMessage())
            item.count(received_s)
            item.grid, item.gone, item.is_saved, item.is_new = grid, None, is_saved, True

    def drop(self, name: str, reason: str) -> None:
        """Mark an input as lost; it does not vote, and comes back with its next map."""
        with self._lock:
            item = self._received.setdefault(name, InputMessage())
            item.grid, item.gone, item.is_new = None, reason, True

    def recall(self, name: str) -> None:
        """Mark a dropped input as present again, with its last map."""
        with self._lock:
            item = self._received.get(name)
            if item is not None and item.gone is not None:
                item.gone, item.is_new = None, True

    def remove(self, name: str) -> None:
        """Forget an input, its vote and its place; under its name a new one may come."""
        with self._lock:
            self._received.pop(name, None)
            self._removed.append(name)

    def refill(self, grids: Mapping[str, OccupancyGrid | None]) -> None:
        """Put taken maps back, unless a newer one waits or the input is lost."""
        with self._lock:
            for name, grid in grids.items():
                item = self._received.get(name)
                if item is not None and item.grid is None and item.gone is None:
                    item.grid, item.is_new = grid, True

    def count_rejected(self, name: str) -> None:
        """Count a map that was taken and cannot be used."""
        with self._lock:
            if name in self._received:
                self._received[name].rejected += 1

    @property
    def has_new(self) -> bool:
        """Whether anything waits to be taken; quick, so that it may be asked often."""
        with self._lock:
            is_waiting = bool(self._removed) or self._evidence is not None
            return is_waiting or any(item.is_new for item in self._received.values())

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a message."""
        with self._lock:
            return name in self._received and self._received[name].maps > 0

    def take(self) -> tuple[list[str], dict[str, InputMessage]]:
        """Return what came since the last call, as of one moment.

        Returns:
            The inputs that were removed, which is older than all else; and what is new, by name.
        """
        with self._lock:
            removed, self._removed = self._removed, []
            fresh = {name: replace(item) for name, item in self._received.items() if item.is_new}
            for item in self._received.values():
                item.is_new, item.grid, item.waits_since_s = False, None, None
        return removed, fresh

    def take_evidence(self) -> Evidence | None:
        """Return the evidence that came since the last call; None: none did."""
        with self._lock:
            evidence, self._evidence = self._evidence, None
        return evidence

    def counts(self) -> dict[str, InputMessage]:
        """Return a copy of what each input sent, by name."""
        with self._lock:
            return {name: replace(item) for name, item in self._received.items()}
