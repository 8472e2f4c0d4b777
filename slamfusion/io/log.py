"""What every log reader gives: scans in the order of time, and a count of what it left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from slamfusion.geometry import Pose2
from slamfusion.scan import LaserScan

__all__ = ["LogScan", "ScanLog", "Skips"]

LINES_KEPT = 5


@dataclass(frozen=True, eq=False)
class LogScan:
    """One scan of a log.

    Attributes:
        scan: the sweep, with its time.
        odometry: pose of the robot's base in the odometry frame at that time; None where the log
            has no odometry.
        line: where it stands in the source: line or message number, from 1.
    """

    scan: LaserScan
    odometry: Pose2 | None
    line: int


@dataclass
class Skips:
    """What was left out, by reason: how often, and the first lines where it happened."""

    counts: dict[str, int] = field(default_factory=dict)
    lines: dict[str, list[int]] = field(default_factory=dict)

    def add(self, reason: str, line: int) -> None:
        """Count one thing left out at a line or message number."""
        self.counts[reason] = self.counts.get(reason, 0) + 1
        kept = self.lines.setdefault(reason, [])
        if len(kept) < LINES_KEPT:
            kept.append(line)

    @property
    def total(self) -> int:
        """Things left out."""
        return sum(self.counts.values())

    def sentences(self) -> tuple[str, ...]:
        """Return one sentence a reason, with its first line numbers."""
        return tuple(
            f"{count} x {reason} (line {', '.join(map(str, self.lines[reason]))}"
            f"{', ...' if count > len(self.lines[reason]) else ''})"
            for reason, count in sorted(self.counts.items())
        )

    def to_json(self) -> list[dict[str, Any]]:
        """Return the counts for a JSON document."""
        return [
            {"reason": reason, "count": count, "first_lines": list(self.lines[reason])}
            for reason, count in sorted(self.counts.items())
        ]


class ScanLog(Protocol):
    """A log or bag, read as a stream; each iteration starts anew.

    Attributes:
        path: where it lies.
        skips: what the last iteration left out so far.
        notes: sentences for the user: e.g. that stamps are broken and index time is used.
        fraction_read: how far the current iteration is, 0 to 1.
    """

    path: Path
    skips: Skips
    notes: list[str]
    fraction_read: float

    def __iter__(self) -> Iterator[LogScan]:
        """Yield the scans; stamps strictly increase.

        Raises:
            LogError: the file is not such a log, or is damaged beyond a line.
        """
