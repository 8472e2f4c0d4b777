"""Measures that reward no thickness, on maps small enough to count by hand."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slamfusion.config import EvaluateConfig, NormalizeConfig, RunConfig
from slamfusion.evaluation.map_error import MapError, compare_to_truth
from slamfusion.evaluation.wall_faces import outside_area, wall_thickness
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid, face_cells
from tests.evaluation import drawings
from tests.support.examples import examples

NORMALIZE = NormalizeConfig()
draw = partial(drawings.draw, resolution=0.05)


def compare(grid: OccupancyGrid, truth: OccupancyGrid) -> MapError:
    return compare_to_truth(grid, truth, IDENTITY, RunConfig(evaluate=EvaluateConfig(0.0)))


def outside(grid: OccupancyGrid, truth: OccupancyGrid, margin_m: float = 0.0) -> float:
    known, true = grid.classified(NORMALIZE), truth.classified(NORMALIZE)
    return outside_area(known, true, IDENTITY, margin_m=margin_m)


def faces(*rows: str) -> list[str]:
    """Draw where the faces are, in the order of the rows as given."""
    marked = face_cells(draw(*rows).classified(NORMALIZE).cells)
    return ["".join("f" if cell else "-" for cell in row) for row in marked[::-1]]


def test_faces_are_the_wall_cells_that_share_a_side_with_a_free_one() -> None:
    assert faces("####?", "####?", "..#??", "..#??") == ["-----", "ff---", "--f--", "--f--"]


def test_a_map_against_itself_has_perfect_faces() -> None:
    grid = draw("####", "#..#", "#..#", "####")
    result = compare(grid, grid).faces
    assert [item.f1 for item in result.agreements] == [1.0, 1.0, 1.0]
    assert result.map_to_truth_m.max == 0.0


def test_what_is_filled_behind_a_wall_changes_no_measure_of_faces() -> None:
    truth = draw("?????", "?????", "#####", ".....", ".....")
    filled = draw("#####", "#####", "#####", ".....", ".....")
    thin, thick = compare(truth, truth), compare(filled, truth)
    assert thick.faces == thin.faces
    # The share of walls within the tolerance pays for the filling, here by loss.
    assert thick.wall_precision != thin.wall_precision


def test_a_wall_grown_into_the_room_loses_its_faces() -> None:
    truth = draw("#####", ".....", ".....", ".....", ".....", ".....")
    grown = draw("#####", "#####", "#####", ".....", ".....", ".....")
    result = compare(grown, truth).faces
    # Two cells of 0.05 m off: wrong at one cell, right at two, whose tolerance is inclusive.
    assert [item.f1 for item in result.agreements] == [0.0, 1.0, 1.0]
    assert result.map_to_truth_m.mean == pytest.approx(0.1)


def test_precision_counts_the_maps_faces_and_recall_the_true_ones() -> None:
    truth = draw("##########", "..........")
    half = draw("#####?????", "..........")
    agreement = compare(half, truth).faces.agreements[0]
    assert agreement.precision == 1.0
    # Within a cell of the five found ones lies a sixth.
    assert agreement.recall == pytest.approx(0.6)
    assert agreement.f1 == pytest.approx(2 * 0.6 / 1.6)
    turned = compare(truth, half).faces.agreements[0]
    assert (turned.precision, turned.recall) == (pytest.approx(0.6), 1.0)


def test_a_map_without_faces_has_no_figures() -> None:
    truth = draw("###", "...")
    empty = draw("???", "...")
    result = compare(empty, truth)
    assert result.faces.map_to_truth_m is None
    assert result.faces.agreements[0].precision is None
    assert result.faces.agreements[0].recall == 0.0
    assert result.faces.f1(0.05) is None
    assert result.wall_thickness_m is None


@pytest.mark.parametrize("cells", [1, 2, 3, 6])
def test_thickness_is_that_across_the_wall_in_metres(cells: int) -> None:
    wall = ["#" * 30] * cells
    upright = draw("." * 30, *wall, "." * 30)
    across = OccupancyGrid(np.ascontiguousarray(upright.cells.T), 0.05)
    for grid in (upright, across):
        found = wall_thickness(grid.classified(NORMALIZE))
        # At the wall's two ends a diagonal leaves it sooner.
        assert found.median == pytest.approx(cells * 0.05)


@pytest.mark.parametrize("falls", [True, False])
def test_a_diagonal_wall_is_measured_along_the_other_diagonal(falls: bool) -> None:
    rows, cols = np.mgrid[:40, :40]
    offset = rows - cols if falls else rows + cols - 39
    cells = np.where(np.abs(offset) <= 3, 100, 0).astype(np.int8)
    found = wall_thickness(OccupancyGrid(cells, 0.05).classified(NORMALIZE))
    # Seven cells along a row, 7 / sqrt(2) across: three or four steps of a diagonal.
    assert 3 * math.sqrt(2) * 0.05 <= found.median <= 4 * math.sqrt(2) * 0.05


def test_what_is_known_outside_the_outline_is_counted_in_square_metres() -> None:
    truth = draw("?????", "?###?", "?...?", "?###?", "?????", resolution=0.5)
    found = draw("?.?#?", "?###?", "?...?", "?###?", "?????", resolution=0.5)
    assert outside(found, truth) == pytest.approx(2 * 0.25)
    assert outside(truth, truth) == 0.0


def test_what_the_truth_encloses_lies_inside() -> None:
    truth = draw("#####", "#???#", "#????", "#???#", "#####")
    closed = draw("#####", "#???#", "#???#", "#???#", "#####")
    found = draw("#####", "#...#", "#...#", "#...#", "#####")
    assert outside(found, closed) == 0.0
    # An opening in the outline leaves what is behind it outside.
    assert outside(found, truth) == pytest.approx(10 * 0.05**2)


def test_spikes_beyond_the_box_of_the_truth_count() -> None:
    truth = draw("###", "#.#", "###")
    spiked = OccupancyGrid(np.zeros((3, 200), dtype=np.int8), 0.05)
    assert outside(spiked, truth) == pytest.approx(3 * 197 * 0.05**2)
    far = OccupancyGrid(np.zeros((2, 2), dtype=np.int8), 0.05, Pose2(-500.0, 500.0))
    assert outside(far, truth) == pytest.approx(4 * 0.05**2)
    assert outside(far, truth, math.inf) == 0.0


@settings(max_examples=examples(40))
@given(
    hnp.arrays(
        np.int8,
        st.tuples(st.integers(1, 9), st.integers(1, 9)),
        elements=st.sampled_from([-1, 0, 1]),
    )
)
def test_faces_lie_on_walls_and_do_not_depend_on_the_axes(cells: np.ndarray) -> None:
    marked = face_cells(cells)
    assert not (marked & (cells != 1)).any()
    assert (face_cells(np.ascontiguousarray(cells.T)) == marked.T).all()
    assert (face_cells(np.ascontiguousarray(cells[::-1])) == marked[::-1]).all()
    # Filling the unknown behind walls makes no face and takes none away.
    filled = cells.copy()
    filled[cells == -1] = 1
    assert (face_cells(filled)[cells == 1] == marked[cells == 1]).all()
