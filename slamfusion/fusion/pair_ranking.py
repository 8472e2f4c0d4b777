"""Which pairs of many maps are worth an alignment, from what is computed once a map.

A pair is promising by how much its best shift at the yaws at which walls are parallel (see
``parallel_walls``) gives more than the best shift elsewhere. This ranks pairs and decides nothing:
what is promising is searched and judged in full.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from slamfusion.align.features import GridFeatures
from slamfusion.align.shifts import (
    KeptSpectra,
    TurnedMap,
    level_for,
    parallel_shifts,
    wall_directions,
)
from slamfusion.compute import ComputeDevice


@dataclass(frozen=True)
class RankedPair:
    """Two maps and how promising it is to align them.

    Attributes:
        a, b: indices of the maps, the lower one first.
        lead: evidence for the best place above that for the best one elsewhere, in square roots of
            the latter: so chance grows with the walls that two maps have, and large and small maps
            are compared.
        ratio: evidence for the best place over that for the best one elsewhere, at least 1.
    """

    a: int
    b: int
    lead: float
    ratio: float


def rank_pairs(maps: Sequence[GridFeatures], device: ComputeDevice) -> list[RankedPair]:
    """Return every pair of maps that have walls, the most promising first.

    Args:
        maps: at one resolution.
        device: computed the maps.
    """
    able = [index for index, item in enumerate(maps) if len(item.wall_points)]
    walls = {index: wall_directions(maps[index].grid.solid) for index in able}
    coarse: dict[tuple[int, tuple[int, int]], TurnedMap] = {}
    kept = KeptSpectra()
    pairs = []
    for a, b in itertools.combinations(able, 2):
        level = level_for(max(*maps[a].shape, *maps[b].shape), maps[a].grid.grid.resolution)
        for index in (a, b):
            if (index, level) not in coarse:
                coarse[index, level] = TurnedMap(maps[index], *level, walls[index], device, kept)
        pairs.append(_ranked(a, coarse[a, level], b, coarse[b, level]))
    return sorted(pairs, key=lambda pair: (-pair.lead, pair.a, pair.b))


def _ranked(a: int, reference: TurnedMap, b: int, moving: TurnedMap) -> RankedPair:
    """Return how much the best place of one map over another has above the best one elsewhere."""
    shifts = parallel_shifts(reference, moving)
    top, place = shifts.peak()
    shifts.forget(place)
    second = max(shifts.peak()[0], 1.0)
    return RankedPair(a, b, (top - second) / math.sqrt(second), top / second)
