"""Walls are solid: what lies behind them, and what stands before them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slamfusion.config import NormalizeConfig
from slamfusion.fusion.surfaces import REACH_CELLS, sharpen_fronts, wall_backs, with_backs
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid, trinary_cells

U, F, O = -1, 0, 1
I8 = npt.NDArray[np.int8]

cells_of_maps = hnp.arrays(
    np.int8,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=9),
    elements=st.sampled_from((U, F, O)),
)


def drawn(text: str) -> I8:
    """A map from lines of ``?``, ``.`` and ``#``."""
    return np.array([["?.#".index(c) - 1 for c in line] for line in text.split()], dtype=np.int8)


def around(cells: I8, row: int, col: int) -> list[int]:
    """The cells around one, unknown beyond the edge."""
    padded = np.pad(cells, 1, constant_values=U)
    block = padded[row : row + 3, col : col + 3].ravel().tolist()
    return block[:4] + block[5:]


def test_a_wall_that_was_seen_from_one_side_has_a_back():
    cells = drawn("""
        ..#??
        ..#??
        ..#??
        ..#??
    """)
    backs = wall_backs(cells)
    assert backs[1:3, 3].all()
    assert backs.sum() == 2


def test_the_gap_between_two_faces_is_filled():
    assert wall_backs(drawn(".#?#. .#?#. .#?#."))[:, 2].all()


def test_a_way_that_ends_in_the_unknown_stays_open():
    """Where free land ends beside a wall, no back closes the way on."""
    cells = drawn("""
        #####
        ..???
        ..???
        #####
    """)
    assert not wall_backs(cells)[:, 1:3].any()


@given(cells=cells_of_maps)
def test_backs_cell_by_cell(cells: I8):
    for (row, col), found in np.ndenumerate(wall_backs(cells)):
        near = around(cells, row, col)
        assert found == (cells[row, col] == U and near.count(O) >= 3 and near.count(F) == 0)


def test_a_disputed_hit_before_a_wall_is_cut():
    cells = drawn("...###?")
    assert sharpen_fronts(cells, np.ones_like(cells, dtype=bool)).ravel().tolist() == [
        False, False, False, True, False, False, False,
    ]  # fmt: skip
    assert not sharpen_fronts(cells, np.zeros_like(cells, dtype=bool)).any()


@pytest.mark.parametrize("row", [".#..", ".##.", "?###", "###"])
def test_thin_walls_and_walls_with_nothing_free_before_them_stay(row: str):
    cells = drawn(row)
    assert not sharpen_fronts(cells, np.ones_like(cells, dtype=bool)).any()


@given(cells=cells_of_maps, seed=st.integers(0, 99))
def test_fronts_cell_by_cell(cells: I8, seed: int):
    is_disputed = np.random.default_rng(seed).random(cells.shape) < 0.7
    padded = np.pad(cells, 2, constant_values=U)
    ways = ((0, 1), (1, 0), (0, -1), (-1, 0))

    def is_front(row: int, col: int, way: tuple[int, int]) -> bool:
        places = [(row + n * way[0], col + n * way[1]) for n in (-1, 0, 1, 2)]
        return [int(padded[i + 2, j + 2]) for i, j in places] == [F, O, O, O]

    def may_go(row: int, col: int) -> bool:
        inside = 0 <= row < cells.shape[0] and 0 <= col < cells.shape[1]
        return inside and bool(is_disputed[row, col]) and any(is_front(row, col, w) for w in ways)

    for (row, col), found in np.ndenumerate(sharpen_fronts(cells, is_disputed)):
        wanted = any(
            is_front(row, col, way)
            and not all(may_go(row + n * way[0], col + n * way[1]) for n in (1, 2))
            for way in ways
        )
        assert found == (wanted and bool(is_disputed[row, col]))


@given(cells=cells_of_maps)
@example(cells=drawn("...\n.#.\n.#.\n###\n..."))
def test_behind_every_cell_that_is_cut_some_of_the_wall_stays(cells: I8):
    cut = sharpen_fronts(cells, np.ones_like(cells, dtype=bool))
    for row, col in np.argwhere(cut):
        rest = np.where(cut, F, cells)
        behind = [
            rest[row + n * down, col + n * right]
            for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0))
            for n in (1, 2)
            if 0 <= row + n * down < cells.shape[0] and 0 <= col + n * right < cells.shape[1]
        ]
        assert O in behind


@given(seed=st.integers(0, 99))
def test_what_lies_out_of_reach_has_no_say(seed: int):
    rng = np.random.default_rng(seed)
    cells = rng.integers(-1, 2, (4 * REACH_CELLS, 4 * REACH_CELLS)).astype(np.int8)

    def solid(given: I8) -> I8:
        out = given.copy()
        out[wall_backs(out)] = O
        out[sharpen_fronts(out, np.ones_like(out, dtype=bool))] = F
        return out

    other = rng.integers(-1, 2, cells.shape).astype(np.int8)
    middle = slice(2 * REACH_CELLS - 2, 2 * REACH_CELLS + 2)
    near = slice(middle.start - REACH_CELLS, middle.stop + REACH_CELLS)
    other[near, near] = cells[near, near]
    assert np.array_equal(solid(cells)[middle, middle], solid(other)[middle, middle])


def test_a_map_is_given_backs_where_it_lies():
    cells = np.array([[10, 90, -1], [10, 80, -1], [10, 70, -1]], dtype=np.int8)
    grid = OccupancyGrid(cells, 0.1, Pose2(1.0, 2.0, 0.5), "skin")
    thick = with_backs(grid, NormalizeConfig())
    assert thick.name == "skin"
    assert thick.origin.transform((0.1, 0.1)) == pytest.approx((1.0, 2.0))
    # What it was it stays, behind its wall there is one more, and beyond its edge too.
    inner = thick.cells[1:-1, 1:-1]
    assert (inner[cells >= 0] == cells[cells >= 0]).all()
    classes = trinary_cells(thick.cells, NormalizeConfig())
    assert classes[2].tolist() == [U, F, O, O, U]
    assert (classes[:, 4] == U).all()
