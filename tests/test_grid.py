"""Claims about the occupancy grid value."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.errors import GridError
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid, implausible, known_box

CELLS = [[-1, -1, -1, -1], [-1, 0, 100, -1], [-1, -1, 50, -1]]


def grid_of(cells: Any = CELLS, **arguments: Any) -> OccupancyGrid:
    values = {"resolution": 0.5, **arguments}
    return OccupancyGrid(np.array(cells, dtype=np.int8), **values)


def test_cells_are_frozen_and_the_callers_array_left_alone() -> None:
    array = np.array(CELLS, dtype=np.int8)
    grid = OccupancyGrid(array, 0.5)
    array[1, 1] = 77
    assert grid.cells[1, 1] == 0
    with pytest.raises(ValueError, match="read-only"):
        grid.cells[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        grid.name = "other"


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        (np.zeros((2, 2), dtype=np.int16), "int8.*found int16"),
        (np.zeros(4, dtype=np.int8), r"\(H, W\)"),
        (np.zeros((0, 3), dtype=np.int8), "at least one cell"),
        (np.full((1, 1), 101, dtype=np.int8), r"-1\.\.100, found 101\.\.101"),
        (np.full((1, 1), -2, dtype=np.int8), r"found -2\.\.-2"),
        ([[0]], "int8"),
    ],
)
def test_what_is_no_grid_is_refused(cells: Any, words: str) -> None:
    with pytest.raises(GridError, match=f"attic: .*{words}"):
        OccupancyGrid(cells, 0.05, name="attic")


@pytest.mark.parametrize("resolution", [0.0, -0.05, math.nan, math.inf])
def test_the_cell_size_is_positive_and_finite(resolution: float) -> None:
    with pytest.raises(GridError, match="resolution must be a positive"):
        grid_of(resolution=resolution)


def test_the_known_box_is_the_smallest_around_known_cells() -> None:
    box = grid_of().known_box
    assert box == CellBox(1, 1, 3, 3)
    assert (box.height, box.width, box.area) == (2, 2, 4)
    assert known_box(np.full((2, 3), -1, dtype=np.int8)) is None


def test_cropping_moves_no_cell_in_the_map_frame() -> None:
    grid = grid_of(origin=Pose2(3.0, -1.0, 0.7))
    box = CellBox(1, 1, 3, 3)
    crop = grid.crop(box)
    assert crop.cells.tolist() == [[0, 100], [-1, 50]]
    rows, cols = np.mgrid[0:2, 0:2].reshape(2, -1)
    assert crop.cell_centres(rows, cols) == pytest.approx(grid.cell_centres(rows + 1, cols + 1))


def test_a_crop_beyond_the_grid_is_unknown_there() -> None:
    crop = grid_of().crop(CellBox(-1, 2, 3, 6))
    assert crop.cells.tolist() == [[-1] * 4, [-1] * 4, [100, -1, -1, -1], [50, -1, -1, -1]]
    assert crop.origin == Pose2(1.0, -0.5, 0.0)
    assert (grid_of().crop(CellBox(10, 10, 12, 12)).cells == -1).all()


@given(
    st.integers(-50, 50),
    st.integers(-50, 50),
    st.builds(Pose2, st.floats(-100, 100), st.floats(-100, 100), st.floats(-7, 7)),
)
def test_the_cell_under_a_cells_centre_is_that_cell(row: int, col: int, origin: Pose2) -> None:
    grid = grid_of(origin=origin)
    rows, cols = grid.cell_indices(grid.cell_centres(np.array([row]), np.array([col])))
    assert (rows.tolist(), cols.tolist()) == ([row], [col])


@pytest.mark.parametrize(
    ("resolution", "origin", "words"),
    [
        (1e-4, Pose2(1e7, -1e7, 4.0 * math.pi), None),
        (100.0, Pose2(-1e7, 1e7, -4.0 * math.pi), None),
        (0.99e-4, Pose2(), "resolution must lie in 0.0001 to 100 metres per cell, found 9.9e-05"),
        (100.1, Pose2(), "resolution must lie in 0.0001 to 100 metres per cell, found 100.1"),
        (math.nan, Pose2(), "resolution must lie"),
        (0.05, Pose2(1.01e7, 0.0), "x of the origin must lie within 1e+07 metres"),
        (0.05, Pose2(0.0, -1.01e7), "y of the origin must lie within 1e+07 metres"),
        (0.05, Pose2(0.0, 0.0, 12.6), "yaw of the origin must lie within 12.57 radians, found"),
    ],
)
def test_a_cell_size_or_place_beyond_the_ranges_is_named(
    resolution: float, origin: Pose2, words: str | None
) -> None:
    found = implausible(resolution, origin)
    assert found == words if words is None else words in str(found)
