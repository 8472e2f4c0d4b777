"""What a wall of one map tells about a motion when it lands in a cell of the other.

The logarithm of how much more probable the landing is when both maps show one place than when
they show two: positive beside a wall, negative in free space, and nothing where the other map
knows nothing. With d the distance to the nearest wall in units of the width of a wall, and
``c`` what a wall of any other place would find there on average,

    like(d) = exp(-d^2 / 2)
    L(d) = log((HIT like(d) + STRAY) / (HIT c + STRAY))

HIT is the share of walls that the other map shows again, STRAY what is left for walls that were
moved, doubled, or never there. A sum of L over walls is evidence in nats: a long common wall
outweighs a short one, and a large false overlap does not outweigh a small true one.

The fields are whole numbers from 0, so that kernels can add them: ``value = base + L / unit``.
Partly free cells of a coarse level weigh what contradicts by their share of free space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import DISTANCE2_MAX

# Share of a map's walls that another map of the place shows again; what is left for all others.
HIT = 0.75
STRAY = 0.04
# A place with walls so rare that one alone would decide is not believed to be that rare.
CHANCE_MIN = 0.02
# Tables that are kept, of 16 KiB each: a pair of maps asks for forty, some of them five times.
TABLES_KEPT = 128


@dataclass(frozen=True, eq=False)
class ScoreTable:
    """The worth of a wall point by its squared distance to the other map's nearest wall.

    Attributes:
        hit, miss: (4097,) uint16; ``base + hit - miss * free share`` is a field's cell.
        base: worth of a point in unknown space.
        span: largest gain over the base, so that (value - base) / span is 1 on a wall.
        name: tells tables apart.
    """

    hit: npt.NDArray[np.uint16]
    miss: npt.NDArray[np.uint16]
    base: int
    span: int
    name: str


@dataclass(frozen=True, eq=False)
class EvidenceTable(ScoreTable):
    """A table whose values count evidence.

    Attributes:
        unit: nats a value.
    """

    unit: float


def score_table(sigma: float, base: int, span: int) -> ScoreTable:
    """Return the table of ``exp(-d^2 / 2)`` less ``min(1, d / 4)`` in free space beyond 1.5.

    Args:
        sigma: the width of a wall in cells; d above is in units of it.
        base: lowest reward that is left for walls in free space.
        span: reward of a point on a wall.
    """
    d = _distances(sigma)
    hit = np.rint(span * likeness(sigma)).astype(np.uint16)
    miss = np.rint(base * np.where(d > 1.5, np.minimum(1.0, d / 4.0), 0.0)).astype(np.uint16)
    return ScoreTable(hit, miss, base, span, f"{sigma:g}/{base}/{span}")


@lru_cache(maxsize=TABLES_KEPT)
def evidence_table(chance: float, sigma: float, top: int, doubt: float = 0.0) -> EvidenceTable:
    """Return the table of L, less ``doubt`` times what L lacks of the most there is.

    Args:
        chance: c of the module's text, 0..1.
        sigma: width of a wall in cells.
        top: the greatest value of the field: 15 where a kernel adds packed values, else 255.
        doubt: see ``scores.WallPieces``; what a wall lacks in cells that the other map does not
            know counts for nothing here, too.
    """
    expected = HIT * min(1.0, max(CHANCE_MIN, chance)) + STRAY
    most, least = math.log((HIT + STRAY) / expected), math.log(STRAY / expected)
    evidence = np.log((HIT * likeness(sigma) + STRAY) / expected)
    evidence = evidence - doubt * (most - evidence)
    least -= doubt * (most - least)
    unit = (1.0 + doubt) * math.log((HIT + STRAY) / STRAY) / top
    base = round(-least / unit)
    value = np.clip(np.rint(evidence / unit), -base, top - base).astype(np.int64)
    hit, miss = (np.maximum(part, 0).astype(np.uint16) for part in (value, -value))
    name = f"evidence/{sigma:g}/{expected:.6f}/{top}/{doubt:g}"
    hit.flags.writeable = miss.flags.writeable = False
    return EvidenceTable(hit, miss, base, top - base, name, unit)


@cache
def likeness(sigma: float) -> npt.NDArray[np.float64]:
    """Return (4097,) float64 ``exp(-d^2 / 2)`` by squared distance in cells; sigma in cells."""
    d = _distances(sigma)
    table = np.exp(-0.5 * d * d)
    table.flags.writeable = False
    return np.asarray(table)


def _distances(sigma: float) -> npt.NDArray[np.float64]:
    """Return (4097,) distances in widths of a wall, by squared distance in cells."""
    return np.asarray(np.sqrt(np.arange(DISTANCE2_MAX + 1)) / sigma)
