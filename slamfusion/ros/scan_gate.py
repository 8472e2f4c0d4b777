"""``ScanGate``: which scans go on to a SLAM by their stamps, and in which time they are."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from slamfusion.io.stamps import Passed, StampGate
from slamfusion.ros import messages
from slamfusion.ros.base import Diagnostics, Level
from slamfusion.ros.frames import TransformStore

# Odometry that has not been heard for longer has no say, seconds.
ODOMETRY_ALIVE_S = 1.0
# Scans that go on later than the last one by more are worth a word, seconds.
FORWARD_JUMP_S = 10.0
# Words on what has passed stay in the diagnostics this long, seconds.
SHOWN_S = 10.0


@dataclass(frozen=True, eq=False)
class ArrivedScan:
    """A scan as it came.

    Attributes:
        message: sensor_msgs/LaserScan.
        stamp_s: its stamp, seconds.
        arrived_s: when it came, ``time.monotonic``.
    """

    message: Any
    stamp_s: float
    arrived_s: float


def _is_same(one: ArrivedScan, other: ArrivedScan) -> bool:
    """Whether a scan was sent again; bytes, for NaN equals nothing."""
    return bool(one.message.ranges.tobytes() == other.message.ranges.tobytes())


class ScanGate:
    """A ``StampGate`` for scans: the odometry has a say in jumps, and all is named.

    Args:
        diagnostics: of the node, where strays and jumps are named.
        back_s: a scan older by more is held back, seconds; see ``StampGate``.
        odometry: where odometry is kept; None: there is none.
        frames: of the odometry: target and source.
        stores: every store of transforms; told of a jump that is confirmed.

    Attributes:
        strays: scans left out for their stamps so far.
        jumps_back: how often time has gone back so far.
    """

    def __init__(
        self,
        diagnostics: Diagnostics,
        back_s: float,
        odometry: TransformStore | None,
        frames: tuple[str, str],
        stores: Collection[TransformStore],
    ) -> None:
        self.strays = 0
        self.jumps_back = 0
        self._diagnostics = diagnostics
        self._gate: StampGate[ArrivedScan] = StampGate(back_s, _is_same)
        self._odometry = odometry
        self._frames = frames
        self._stores = stores
        self._strays_named = 0

    @property
    def held(self) -> int:
        """Scans that are held back for their stamps now."""
        return self._gate.held

    def set_back(self, back_s: float) -> None:
        """Change ``back_s``."""
        self._gate.back_s = back_s

    def offer(self, message: Any) -> Passed[ArrivedScan]:
        """Take a scan that has come; return what goes on and whether time has jumped before it."""
        scan = ArrivedScan(message, messages.stamp_s(message), time.monotonic())
        before_s = self._gate.newest_s
        passed = self._gate.offer(scan.stamp_s, scan, scan.arrived_s, self._odometry_agrees)
        if before_s is None:
            return passed
        self._name_strays(passed.strays, before_s)
        if passed.items:
            self._name_jump(passed, before_s)
        if passed.jump is not None:
            for store in self._stores:
                store.settle(passed.items[-1].stamp_s)
        return passed

    def name_odometry(self) -> None:
        """Name odometry that was left out for its stamps since the last call."""
        strays = 0 if self._odometry is None else self._odometry.strays
        if strays > self._strays_named:
            text = (
                "odometry (or another transform) is left out: its stamp is far from those before "
                "and after it; check the clock of its sender"
            )
            self._diagnostics.add("stray odometry", Level.WARN, text, SHOWN_S)
        self._strays_named = strays

    def _odometry_agrees(self, before_s: float, after_s: float) -> bool:
        """Whether the odometry has jumped with the scans, or says nothing."""
        odometry = self._odometry
        if odometry is None or odometry.last_s is None:
            return True
        heard_s = odometry.heard_s(*self._frames)
        is_silent = time.monotonic() - odometry.last_s > ODOMETRY_ALIVE_S
        if heard_s is None or is_silent or abs(heard_s - after_s) < abs(heard_s - before_s):
            return True
        text = (
            f"scans jumped {_way(before_s, after_s)} and the odometry did not: they are left out, "
            "and the map stays; check the clocks of both"
        )
        self._diagnostics.add("clocks", Level.ERROR, text)
        return False

    def _name_strays(self, strays: tuple[ArrivedScan, ...], before_s: float) -> None:
        if not strays:
            return
        self.strays += len(strays)
        stamp_s = strays[-1].stamp_s
        off_s = abs(stamp_s - before_s)
        how = "older than" if stamp_s < before_s else "ahead of"
        text = (
            f"a scan is left out: its stamp {stamp_s:.3f} s is {off_s:.3f} s {how} the last one's, "
            f"and those after it are not ({self.strays} so far); check the clock of the laser"
        )
        self._diagnostics.add("stray scan", Level.WARN, text, SHOWN_S)

    def _name_jump(self, passed: Passed[ArrivedScan], before_s: float) -> None:
        self._diagnostics.clear("clocks")
        after_s = passed.items[0].stamp_s
        if passed.jump is not None and passed.jump.is_back:
            self.jumps_back += 1
            text = f"scans jumped {_way(before_s, after_s)}: a new map begins"
            self._diagnostics.clear("back")
            self._diagnostics.add("back", Level.WARN, text, SHOWN_S)
        elif after_s > before_s + FORWARD_JUMP_S:
            text = f"scans jumped {_way(before_s, after_s)}"
            self._diagnostics.add("forward", Level.WARN, text, SHOWN_S)


def _way(before_s: float, after_s: float) -> str:
    way = "back" if after_s < before_s else "forward"
    return f"{way} by {abs(after_s - before_s):.3f} s to {after_s:.3f} s"
