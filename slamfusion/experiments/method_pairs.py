"""Two methods on the same drives, tested, and a way to vote against the best input."""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.evaluation import Interval, PairedDifference
from slamfusion.experiments.records import AgainstBestInputJson, MethodPairJson

__all__ = ["Against", "MethodPair", "p_value_text"]

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class MethodPair:
    """Two methods on the same drives.

    Attributes:
        condition: of the drives.
        first, second: the methods.
        pooled: p-value of [F16]'s test, which takes the repetitions for unpaired.
        paired: the difference, first minus second, with tests that know the pairs.
        holm: p-value of the paired t-test, corrected for all pairs of this condition.
    """

    condition: str
    first: str
    second: str
    pooled: float
    paired: PairedDifference
    holm: float

    def to_json(self) -> MethodPairJson:
        """Return the pair for a JSON document."""
        return {
            "condition": self.condition,
            "methods": [self.first, self.second],
            "p_pooled_t": self.pooled,
            "p_paired_t_holm": self.holm,
            "paired": self.paired.to_json(),
        }


@dataclass(frozen=True)
class Against:
    """A way to fuse against the best input of a condition.

    Attributes:
        condition: of the drives.
        fusion: the way to vote.
        best: the producer with the smallest mean error.
        ratio: mean error of the fusion over that of the best input.
        interval: 95 %, of the ratio, with the best input's mean held; None for a single drive.
        p_value: of the paired t-test, corrected; None for a single drive.
    """

    condition: str
    fusion: str
    best: str
    ratio: float
    interval: Interval | None
    p_value: float | None

    def to_json(self) -> AgainstBestInputJson:
        """Return the comparison for a JSON document."""
        return {
            "condition": self.condition,
            "fusion": self.fusion,
            "best_input": self.best,
            "ratio": self.ratio,
            "interval": None if self.interval is None else self.interval.to_json(),
            "p_value": self.p_value,
        }

    @property
    def is_better(self) -> bool:
        """Whether the fusion's error is smaller, and that is hardly chance."""
        return self.ratio < 1.0 and self.p_value is not None and self.p_value < SIGNIFICANT

    def sentence(self) -> str:
        """Say whether the fusion is better than the best input."""
        percent = 100.0 * (self.ratio - 1.0)
        where = f"{self.condition}: {self.fusion} is {abs(percent):.1f} %"
        where += f" {'below' if percent < 0.0 else 'above'} {self.best}, the best input"
        if self.interval is None or self.p_value is None:
            return f"{where} (a single drive: nothing can be tested)."
        low, high = (100.0 * (end - 1.0) for end in (self.interval.low, self.interval.high))
        shown = "" if self.p_value < SIGNIFICANT else "; may be chance"
        return (
            f"{where} (95 % interval {low:+.1f} to {high:+.1f} %, "
            f"p {p_value_text(self.p_value)} after Holm{shown})."
        )


def p_value_text(p_value: float) -> str:
    """Return a p-value as [F16] prints them: two figures, the small ones with an exponent."""
    if p_value < 1e-9:
        return "<1e-9"
    return f"{p_value:.2f}" if p_value >= 0.1 else f"{p_value:.1e}"
