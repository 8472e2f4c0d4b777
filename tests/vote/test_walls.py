"""Walls are voted for with a tolerance: drawn once, no thicker and no thinner than the inputs'."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.compute.layout import (
    VOTE_ONE,
    WALL_FACE,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.geometry import I8
from slamfusion.vote.walls import margin_cells, wall_codes
from tests.vote.rooms import EDGE, INNER, bent, cells_of, fuse, moved, room


def walls_per_row(cells: I8) -> list[int]:
    """Return the wall cells of the inner wall, in each of its rows away from its ends."""
    return (cells[EDGE + 5 : 25, INNER - 8 : INNER + 9] == 1).sum(axis=1).tolist()


@pytest.mark.parametrize("away", [1, -1])
def test_a_wall_that_two_maps_draw_a_cell_apart_is_drawn_once(away: int) -> None:
    for maps in (
        {"a": room(), "b": moved(room(), away, away)},
        {"a": room(), "b": moved(room(), away, away), "c": room()},
    ):
        fused = cells_of(fuse(maps))
        assert set(walls_per_row(fused)) == {1}
        # Each wall runs from end to end, with no hole where the one map draws or the other.
        assert (fused == 1).sum() == pytest.approx((room() == 1).sum(), abs=4)


@pytest.mark.parametrize("order", list(permutations((0, 1, 2))))
def test_a_wall_that_three_maps_draw_a_cell_apart_is_drawn_once(order: tuple[int, ...]) -> None:
    """The one in the middle supports both others, which are too far apart to support each other."""
    maps = []
    for away in range(3):
        cells = np.zeros((25, 25), dtype=np.int8)
        cells[:, 12 + away :] = -1
        cells[:, 12 + away] = 1
        maps.append(wall_codes(cells, 0.1))
    weights = np.full((3, 1, 1), VOTE_ONE, dtype=np.uint8)
    ranks = np.array(order, dtype=np.uint16)[:, None, None]
    votes = NumpyDevice().vote_walls(
        maps, weights, ranks, weights[:, 0, 0], reach=4, shift=5, phase=(0, 0)
    )
    assert (votes.fused == 1).sum(axis=1).tolist() == [1] * 25


def test_a_thick_map_among_thin_ones_does_not_thicken() -> None:
    thick = room()
    thick[EDGE:30, INNER - 1 : INNER + 2] = 1
    fused = cells_of(fuse({"a": room(), "b": room(), "thick": thick}))
    assert np.array_equal(fused, room())


def test_two_faces_of_one_thin_wall_seen_by_two_robots_both_stay() -> None:
    """West of the wall one has been, east of it the other; it is three cells thick."""
    west, east = room(), room()
    west[:, INNER - 1] = np.where(west[:, INNER - 1] == 0, 1, west[:, INNER - 1])
    west[:, INNER:] = -1
    east[:, INNER + 1] = np.where(east[:, INNER + 1] == 0, 1, east[:, INNER + 1])
    east[:, : INNER + 1] = -1
    fused = cells_of(fuse({"west": west, "east": east}))
    rows = slice(EDGE + 1, -EDGE - 1)
    assert (fused[rows, INNER - 1] == 1).all()
    assert (fused[rows, INNER + 1] == 1).all()
    assert (fused[rows, INNER] == -1).all()


@pytest.mark.parametrize("mode", ["consensus", "majority"])
def test_a_map_alone_is_its_own_fusion(mode: str) -> None:
    result = fuse({"a": bent(room())}, mode=mode)
    assert np.array_equal(cells_of(result), bent(room()))
    assert not result.bent


def test_a_tie_of_two_is_a_wall() -> None:
    """The one has a box in the room, the other has seen the floor there."""
    box = room()
    box[40:44, 20:24] = 1
    assert np.array_equal(cells_of(fuse({"a": room(), "b": box})), box)
    three = cells_of(fuse({"a": room(), "b": box, "c": room()}))
    assert np.array_equal(three, room())


def test_a_map_that_ends_in_the_middle_of_the_room_takes_nothing_away() -> None:
    part = room()
    part[:, 60:] = -1
    for maps in ({"part": part, "whole": room()}, {"whole": room(), "part": part}):
        assert np.array_equal(cells_of(fuse(maps)), room())


def test_codes_say_what_a_wall_is_and_which_way_it_faces() -> None:
    """A wall along column 12, floor west of it, nothing known behind it; cells of 0.1 m."""
    cells = np.full((25, 25), -1, dtype=np.int8)
    cells[:, :12] = 0
    cells[:, 12] = 1
    row = wall_codes(cells, 0.1)[12]
    west = 1 << WALL_SIDES + 1
    assert row[12] == WALL_OCCUPIED | WALL_NEAR | WALL_FACE | west
    assert row[11] == WALL_FREE | WALL_NEAR | west
    assert row[13] == WALL_NEAR | west
    # The same wall elsewhere: up to 0.4 m away, on both sides.
    assert [int(code) for code in row[7:11]] == [WALL_FREE] + [WALL_FREE | west] * 3
    assert [int(code) for code in row[14:18]] == [west] * 3 + [0]
    nothing = np.full((3, 3), -1, dtype=np.int8)
    assert not wall_codes(nothing, 0.1).any()


def test_lone_beams_and_their_ends_show_nothing() -> None:
    room = np.full((40, 60), -1, dtype=np.int8)
    room[10:30, 5:30] = 1
    room[11:29, 6:29] = 0
    leaking = room.copy()
    leaking[20, 29:50] = 0
    leaking[20, 50] = 1
    leaking[np.arange(29, 38), np.arange(10, 19)] = 0
    through = [(20, 29), (29, 10)]  # here the wall is open
    known = wall_codes(leaking, 0.1) & (WALL_OCCUPIED | WALL_FREE)
    wanted = wall_codes(room, 0.1) & (WALL_OCCUPIED | WALL_FREE)
    for row, col in through:
        around = np.s_[row - 1 : row + 2, col - 1 : col + 2]
        known[around] = wanted[around]
    assert np.array_equal(known, wanted)


def test_beams_side_by_side_and_walls_without_free_cells_stay() -> None:
    fan = np.full((20, 40), -1, dtype=np.int8)
    fan[2:18:3, :30] = 0
    fan[2:18:3, 30] = 1
    drawn = np.full((20, 40), -1, dtype=np.int8)
    drawn[5, 3:35] = drawn[5:15, 3] = 1
    for cells in (fan, drawn):
        codes = wall_codes(cells, 0.1)
        assert np.array_equal(codes & WALL_OCCUPIED != 0, cells == 1)
        assert np.array_equal(codes & WALL_FREE != 0, cells == 0)


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.4])
def test_cells_beyond_the_margin_have_no_say(resolution: float) -> None:
    rng = np.random.default_rng(0)
    cells = rng.integers(-1, 2, (60, 64)).astype(np.int8)
    margin = margin_cells(resolution)
    inner = np.s_[20:40, 20:44]
    changed = cells.copy()
    outside = np.ones(cells.shape, dtype=bool)
    outside[20 - margin : 40 + margin, 20 - margin : 44 + margin] = False
    assert outside.any()
    changed[outside] = rng.integers(-1, 2, cells.shape)[outside]
    one, other = (wall_codes(given, resolution)[inner] for given in (cells, changed))
    assert np.array_equal(one, other)
