"""What an answer is held against: shifts of itself, other poses, poses away from a start."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.decide import Reading
from slamfusion.align.hypotheses import hit_share, slides, weigh
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, OccupancyGrid
from tests.fusion.drawings import building, degraded, features_of, part

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

CONFIG = AlignConfig()


def corridor(length: int, name: str) -> OccupancyGrid:
    """Two straight walls, 2 m apart, cells of 0.05 m; unknown ground at both ends."""
    cells = np.zeros((41, length), dtype=np.int8)
    cells[[0, -1]] = 100
    return OccupancyGrid(cells, 0.05, name=name)


@pytest.mark.parametrize("length", [200, 400])
def test_two_parts_of_a_corridor_are_not_laid_on_each_other(
    device: ComputeDevice, length: int
) -> None:
    """They fit best where most of them meets, which is not where they belong."""
    whole = corridor(2 * length, "corridor")
    a, b = (
        features_of(
            replace(whole, cells=whole.cells[:, low : low + length]).with_name(name), device
        )
        for name, low in (("a", 0), ("b", length // 2))
    )
    pair = Pair(a, b)
    found = align_pair(pair, CONFIG)
    assert not found.accepted, found.reason
    motion = pair.motion_of(found.transform)
    for reading in get_args(Reading):
        own, *slid = weigh(pair, np.stack((motion, *slides(pair, motion, reading))), reading).total
        assert max(slid) > 0.6 * own, reading


def test_a_corridor_with_doors_alike_is_not_believed(device: ComputeDevice) -> None:
    """A door every 4.5 m: the parts fit as well some doors farther, but for what is seen less."""
    cells = corridor(600, "doors").cells.copy()
    for door in (20, 110, 200, 290, 380, 470, 560):
        cells[0, door : door + 18] = 0
    a, b = (
        features_of(OccupancyGrid(cells[:, low : low + 400], 0.05, name=name), device)
        for name, low in (("a", 0), ("b", 200))
    )
    found = align_pair(Pair(a, b), CONFIG)
    assert not found.accepted, found.reason


def test_a_room_in_common_is_enough_although_it_slides(device: ComputeDevice) -> None:
    place = building(7, 14.0, 9.0, 0.05)
    right = part(place, 0.55, 1.0, "right")
    found = align_pair(Pair(features_of(place, device), features_of(right, device)), CONFIG)
    assert found.accepted, found.reason
    assert found.evidence.reading == "good"


def test_walls_of_a_bent_map_lie_beside_those_of_the_other(device: ComputeDevice) -> None:
    """On a map that is not bent they lie on them, and a broad width says less than a narrow one."""
    truth = building(2, 14.0, 11.0, 0.05)
    right = features_of(truth, device)
    on_itself = np.array([*right.centre, 0.0])
    assert hit_share(Pair(right, right), on_itself) == 0.0
    bent, pose = degraded(truth, 2, yaw_rad=0.0, bend_cells=16.0)
    pair = Pair(right, features_of(bent, device))
    assert hit_share(pair, pair.motion_of(pose)) > 0.5


# -- the whole decision ----------------------------------------------------------------------------


def furnished(place: OccupancyGrid, pieces: int) -> OccupancyGrid:
    """Return a place with further walls in its free space, the first ones the same."""
    cells = place.cells.copy()
    rng = np.random.default_rng(11)
    for _ in range(pieces):
        row, col = rng.integers(10, np.array(cells.shape) - 40)
        height, width = rng.permutation((3, 30))
        part = cells[row : row + height, col : col + width]
        part[part == FREE] = OCCUPIED
    return replace(place, cells=cells).with_name("furnished")


@pytest.mark.parametrize("seed", range(3))
def test_more_walls_that_contradict_never_make_a_refusal_an_acceptance(
    device: ComputeDevice, seed: int
) -> None:
    place = building(seed, 14.0, 11.0, 0.05)
    features = features_of(place, device)
    accepted = []
    for pieces in (0, 10, 30, 90, 300):
        moving = features_of(furnished(place, pieces), device)
        accepted.append(align_pair(Pair(features, moving), CONFIG).accepted)
    assert accepted == sorted(accepted, reverse=True)
    assert accepted[0]


@pytest.mark.parametrize("others", [False, True])
def test_a_pair_that_is_turned_is_decided_the_same(device: ComputeDevice, *, others: bool) -> None:
    place = building(5, 14.0, 11.0, 0.05)
    still = features_of(place, device)
    moved = building(6, 14.0, 11.0, 0.05) if others else place
    found = []
    for quarter in range(4):
        cells = np.ascontiguousarray(np.rot90(moved.cells, quarter))
        turned = OccupancyGrid(cells, moved.resolution, Pose2(), "turned")
        found.append(align_pair(Pair(still, features_of(turned, device)), CONFIG))
    assert {pair.accepted for pair in found} == {not others}
    if not others:
        shares = [pair.evidence.share for pair in found if pair.evidence is not None]
        assert shares == pytest.approx([shares[0]] * 4, abs=0.02)
        # A picture is turned clockwise where the cells of the map, rows upwards, are too.
        turns = [(pair.transform.yaw_rad - found[0].transform.yaw_rad) for pair in found]
        steps = [math.degrees(turn) / 90.0 % 4.0 for turn in turns]
        assert {round(step) % 4 for step in steps} == {0, 1, 2, 3}
        assert max(abs(step - round(step)) for step in steps) < 0.01
