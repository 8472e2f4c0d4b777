"""Evidence of a wall of one map that falls on a cell of the other.

The logarithm of the ratio of two probabilities: that both maps show one place, and that they show
two. It is positive next to a wall, negative in free space, and 0 where the other map is
unknown. With d the distance to the nearest wall in widths of a wall, and ``c`` the mean
likeness of the wall of any other place,

    like(d) = exp(-d^2 / 2)
    L(d) = log((HIT like(d) + STRAY) / (HIT c + STRAY))

HIT is the share of walls that the other map shows again; STRAY covers walls that were moved,
doubled, or never there. The sum of L over walls is evidence in nats: a long common wall outweighs a
short one, and a large false overlap does not outweigh a small true one.

The fields are whole numbers from 0, so that kernels can add them: ``value = base + L / unit``.
On coarse levels contradicting evidence is weighed by the share of free space of a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from slamfusion.compute.layout import DISTANCE2_MAX
from slamfusion.geometry import F64, U16

# Share of a map's walls that another map of the place shows again, and the rest.
HIT = 0.75
STRAY = 0.04
# Lower limit of the chance, so that one rare wall does not decide.
CHANCE_MIN = 0.02


@dataclass(frozen=True, eq=False)
class ScoreTable:
    """The worth of a wall point by its squared distance to the other map's nearest wall.

    Attributes:
        worths: (4097,) uint16 hit, and miss above 8 bits; a field's cell is ``base + hit - miss *
            free share``.
        base: worth of a point in unknown space.
        span: largest gain over the base, so that (value - base) / span is 1 on a wall.
        unit: nats a value, where the values count evidence.
    """

    worths: U16
    base: int
    span: int
    unit: float = 0.0


def score_table(sigma: float, base: int, span: int) -> ScoreTable:
    """Return the table of ``exp(-d^2 / 2)`` less ``min(1, d / 4)`` in free space beyond 1.5.

    ``sigma`` is the width of a wall in cells, the unit of d; ``base`` the lowest value, left for
    walls in free space; ``span`` the gain on a wall.
    """
    d = _distances(sigma)
    hit = np.rint(span * likeness(sigma)).astype(np.uint16)
    miss = np.rint(base * np.where(d > 1.5, np.minimum(1.0, d / 4.0), 0.0)).astype(np.uint16)
    return ScoreTable(hit | miss << np.uint16(8), base, span)


def evidence_table(chance: float, sigma: float, top: int, doubt: float = 0.0) -> ScoreTable:
    """Return the table of L, less ``doubt`` times the shortfall from its maximum.

    Args:
        chance: c of the module's text, 0..1.
        sigma: width of a wall in cells.
        top: the greatest value of the field: 15 where a kernel adds packed values, else 255.
        doubt: see ``scores.WallPieces``; it does not apply in unknown cells of the other map.
    """
    expected = HIT * min(1.0, max(CHANCE_MIN, chance)) + STRAY
    most, least = math.log((HIT + STRAY) / expected), math.log(STRAY / expected)
    evidence = _log_likely(sigma) - math.log(expected)
    evidence -= doubt * (most - evidence)
    least -= doubt * (most - least)
    unit = (1.0 + doubt) * math.log((HIT + STRAY) / STRAY) / top
    base = round(-least / unit)
    value = np.clip(np.rint(evidence / unit), -base, top - base).astype(np.int16)
    worths = np.where(value < 0, -value << 8, value).view(np.uint16)
    worths.flags.writeable = False
    return ScoreTable(worths, base, top - base, unit)


@cache
def likeness(sigma: float) -> F64:
    """Return (4097,) float64 ``exp(-d^2 / 2)`` by squared distance in cells; sigma in cells."""
    d = _distances(sigma)
    table = np.exp(-0.5 * d * d)
    table.flags.writeable = False
    return np.asarray(table)


@cache
def _log_likely(sigma: float) -> F64:
    """Return (4097,) the logarithm of how likely a wall is, by squared distance in cells."""
    return np.asarray(np.log(HIT * likeness(sigma) + STRAY))


def _distances(sigma: float) -> F64:
    """Return (4097,) distances in widths of a wall, by squared distance in cells."""
    return np.asarray(np.sqrt(np.arange(DISTANCE2_MAX + 1)) / sigma)
