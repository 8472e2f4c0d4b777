"""``NoReturnFinder``: which readings of a log mean "nothing seen"."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

# Readings are counted in millimetres up to a kilometre: constant memory, however long the log.
_BINS_PER_M = 1000
_LIMIT_M = 1000.0
# No laser's longest range is shorter; a tidy room of equal readings must not look like one.
_SHORTEST_MAX_M = 3.5
# A value is repeated from this number of readings on that are at least this share of all ...
_REPEATED = ((10, 0.001), (3, 0.01))
# ... unless nearly every reading is that value: then there is nothing to tell it from.
_MOST = 0.95
# What SICK lasers write instead of a range: the last nine of 13 bits (in cm or mm), of 15 in mm.
_SICK_CODES_M = ((81.83, 81.91), (8.183, 8.191), (32.759, 32.767))
_SICK_REPEATED = 2
# A code stands out from the readings below it, and may have lesser codes beside it.
_STANDS_OUT = 10.0
_LESSER_SHARE = 0.01
_BAND = 0.95
_NEIGHBOURS = 0.85
# The codes of one laser scatter by this much once a log has scaled them.
_SLACK = 0.999
_TOP_BAND = 1.01


@dataclass(frozen=True)
class NoReturn:
    """What the readings of a log say about readings that saw nothing.

    Attributes:
        from_m: readings at or above this saw nothing; None where no value is repeated.
        code_m: the commonest value that stands for it; None likewise.
        largest_m: the largest finite reading, metres; 0 without any.
    """

    from_m: float | None
    code_m: float | None
    largest_m: float


class NoReturnFinder:
    """Find the value that a laser writes where nothing came back.

    The rule: going down from the longest readings, the first value that is often repeated (10
    readings and a thousandth of all, or 3 and a hundredth; two for the codes of SICK lasers), ten
    times as often as the values 5 to 15 % below it. Repeated values up to 5 % below belong to it
    when they have a hundredth of its readings. Everything from 0.1 % below the lowest of them on
    saw nothing. A largest reading that occurs once is a reading like any other.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(int(_LIMIT_M * _BINS_PER_M), dtype=np.int64)
        self._largest_m = 0.0

    def add(self, ranges_m: npt.NDArray[np.float64]) -> None:
        """Count the readings of one scan, (N,) metres; NaN, infinity and 0 do not count."""
        usable = ranges_m[(ranges_m > 0.0) & (ranges_m < _LIMIT_M)]
        if usable.size:
            bins = np.rint(usable * _BINS_PER_M).astype(np.int64)
            np.add.at(self._counts, np.minimum(bins, len(self._counts) - 1), 1)
            self._largest_m = max(self._largest_m, float(usable.max()))

    def result(self) -> NoReturn:
        """Apply the rule to the readings so far."""
        counts = self._counts
        nothing = NoReturn(None, None, self._largest_m)
        total = int(counts.sum())
        repeated = np.flatnonzero(counts >= self._repeats_needed(total))
        if not repeated.size or repeated[-1] < _SHORTEST_MAX_M * _BINS_PER_M:
            return nothing
        top = int(repeated[-1])
        band = np.arange(int(top * _BAND), min(int(top * _TOP_BAND) + 1, len(counts)))
        code = int(band[np.argmax(counts[band])])
        most = int(counts[code])
        below = counts[int(code * _NEIGHBOURS) : int(code * _BAND)]
        usual = below[below > 0].mean() if below.any() else 0.0
        beyond = int(counts[band[-1] + 1 :].sum())
        if most < _STANDS_OUT * usual or most > _MOST * total or beyond > most / _STANDS_OUT:
            return nothing
        # One code of a family may be rarer than what would do on its own.
        enough = max(_LESSER_SHARE * most, _STANDS_OUT * usual, _SICK_REPEATED)
        lowest = int(band[np.flatnonzero(counts[band] >= enough)[0]])
        return NoReturn(lowest * _SLACK / _BINS_PER_M, code / _BINS_PER_M, self._largest_m)

    def _repeats_needed(self, total: int) -> npt.NDArray[np.float64]:
        """Return for each value how many readings make it a repeated one."""
        needed = min(max(least, share * total) for least, share in _REPEATED)
        result = np.full(len(self._counts), needed, dtype=np.float64)
        for low_m, high_m in _SICK_CODES_M:
            result[round(low_m * _BINS_PER_M) : round(high_m * _BINS_PER_M) + 1] = _SICK_REPEATED
        return result
