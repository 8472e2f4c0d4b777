"""``TrackingQuality``: from how scans fit the local map, whether the robot is still tracked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from slamfusion.config import GraphTrackingConfig

TrackingStatus = Literal["tracked", "unsure", "failed", "kidnapped"]


@dataclass
class TrackingQuality:
    """How the last scans fitted; it is its own state.

    Attributes:
        unsure_row: scans in a row whose place was not sure.
        bad: numbers of the bad scans among the last ``failed_scans``.
    """

    unsure_row: int = 0
    bad: list[int] = field(default_factory=list)

    def judge(
        self,
        number: int,
        fit: float,
        config: GraphTrackingConfig,
        *,
        is_sure: bool,
        has_jumped: bool,
    ) -> TrackingStatus:
        """Take how a scan fitted, and return what that says of the robot.

        Args:
            number: of the scan.
            fit: what its match is worth, in the running mean score.
            config: from where on a fit is bad, and how many bad ones are too many.
            is_sure: whether its place may be trusted.
            has_jumped: whether odometry has just been reset.

        Returns:
            ``kidnapped`` where it is no longer where the local map is; ``failed`` where it may be,
            but its place to what was before is not known; ``unsure`` for a scan that only dead
            reckoning places.
        """
        self.unsure_row = 0 if is_sure else self.unsure_row + 1
        if self.unsure_row >= config.lost_scans or (has_jumped and fit < config.reset_share):
            return "kidnapped"
        self.bad = [bad for bad in self.bad if number - bad < config.failed_scans]
        if fit < config.bad_share:
            self.bad.append(number)
        if not is_sure:
            return "unsure"
        return "failed" if len(self.bad) >= config.failed_bad else "tracked"

    def reset(self) -> None:
        """Forget what was: a new local map begins."""
        self.unsure_row, self.bad = 0, []
