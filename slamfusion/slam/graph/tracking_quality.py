"""``TrackingQuality``: from how scans fit the local map, whether the robot is still tracked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

TrackingStatus = Literal["tracked", "unsure", "failed", "kidnapped"]

# A match worth less than this share of the usual one is bad. Right after a reset of the odometry
# one that is worth less than the second share is enough: the robot was perhaps switched off and
# moved.
BAD_SHARE, RESET_SHARE = 0.6, 0.8
# Scans in a row without a sure place after which the robot is kidnapped. One or two bad scans are a
# door or a crowd.
LOST_SCANS = 4
# Tracking has failed after this number of bad scans among this number of the last ones.
FAILED_BAD, FAILED_SCANS = 3, 10


@dataclass
class TrackingQuality:
    """How the last scans fitted; it is its own state.

    Attributes:
        unsure_row: scans in a row whose place was not sure.
        bad: numbers of the bad scans among the last ``FAILED_SCANS``.
    """

    unsure_row: int = 0
    bad: list[int] = field(default_factory=list)

    def judge(self, number: int, fit: float, *, is_sure: bool, has_jumped: bool) -> TrackingStatus:
        """Take how a scan fitted, and return what that says of the robot.

        Args:
            number: of the scan.
            fit: what its match is worth, in the running mean score.
            is_sure: whether its place may be trusted.
            has_jumped: whether odometry has just been reset.

        Returns:
            ``kidnapped`` where it is no longer where the local map is; ``failed`` where it may be,
            but its place to what was before is not known; ``unsure`` for a scan that only dead
            reckoning places.
        """
        self.unsure_row = 0 if is_sure else self.unsure_row + 1
        if self.unsure_row >= LOST_SCANS or (has_jumped and fit < RESET_SHARE):
            return "kidnapped"
        self.bad = [bad for bad in self.bad if number - bad < FAILED_SCANS]
        if fit < BAD_SHARE:
            self.bad.append(number)
        if not is_sure:
            return "unsure"
        return "failed" if len(self.bad) >= FAILED_BAD else "tracked"

    def reset(self) -> None:
        """Forget what was: a new local map begins."""
        self.unsure_row, self.bad = 0, []
