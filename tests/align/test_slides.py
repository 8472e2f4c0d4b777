"""Rivals a step away: a straight wall slides along itself, a room does not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.hypotheses import SLIDE_REACH, slides
from slamfusion.align.pair import Pair
from slamfusion.align.scores import wall_pieces
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

SIGMA, NEAREST = 3.0, 20.0


def corridor(length: int, name: str) -> OccupancyGrid:
    """Two straight walls, 2 m apart, cells of 0.05 m; unknown ground at both ends."""
    cells = np.zeros((41, length), dtype=np.int8)
    cells[[0, -1]] = 100
    return OccupancyGrid(cells, 0.05, name=name)


def test_slides_lie_in_a_ring_apart_from_each_other(device: ComputeDevice) -> None:
    grid = features_of(building(2, 11.0, 9.0, 0.05), device)
    answer = np.array([*grid.centre, 0.3])
    found = slides(Pair(grid, grid), answer, SIGMA, NEAREST)
    assert 1 <= len(found) <= 3
    far = np.hypot(*(found[:, :2] - answer[:2]).T)
    assert np.all((far > NEAREST) & (far <= SLIDE_REACH * NEAREST))
    assert np.all(found[:, 2] == answer[2])
    for a in range(len(found)):
        for b in range(a):
            assert math.dist(found[a, :2], found[b, :2]) >= NEAREST


def test_a_corridor_slides_along_itself(device: ComputeDevice) -> None:
    grid = features_of(corridor(200, "corridor"), device)
    answer = np.array([*grid.centre, 0.0])
    (best, *_) = slides(Pair(grid, grid), answer, SIGMA, NEAREST)
    assert abs(best[1] - answer[1]) <= SIGMA
    assert abs(best[0] - answer[0]) >= NEAREST - SIGMA
    pieces = wall_pieces(Pair(grid, grid), np.stack((answer, best)), SIGMA)
    assert pieces.total[1] > 0.8 * pieces.total[0]


def test_a_straight_wall_in_common_is_not_enough(device: ComputeDevice) -> None:
    """Two buildings that share one outer wall fit back to back, and all the better the longer."""
    a = building(34, 12.0, 10.0, 0.1).with_name("a")
    b = building(74, 12.0, 10.0, 0.1).with_name("b")
    found = align_pair(Pair(features_of(a, device), features_of(b, device)), AlignConfig())
    assert not found.accepted, found.reason


def test_a_room_in_common_is_enough_although_it_slides(device: ComputeDevice) -> None:
    place = building(7, 14.0, 9.0, 0.05)
    cells = place.cells.copy()
    cells[:, : round(0.55 * cells.shape[1])] = -1
    right = replace(place, cells=cells).with_name("right")
    found = align_pair(Pair(features_of(place, device), features_of(right, device)), AlignConfig())
    assert found.accepted, found.reason
    assert found.evidence is not None
    assert found.evidence.good_maps
