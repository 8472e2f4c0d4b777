"""The measures against the truth, on maps small enough to count by hand."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slamfusion.config import EvaluateConfig, FusionConfig, NormalizeConfig, RunConfig
from slamfusion.errors import GridError
from slamfusion.evaluation.map_error import (
    AGREE_FREE,
    AGREE_UNKNOWN,
    AGREE_WALL,
    EXTRA_FREE,
    EXTRA_WALL,
    MISSING_FREE,
    MISSING_WALL,
    MapError,
    compare_to_truth,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.json_values import plain
from tests.evaluation.drawings import draw
from tests.support.examples import examples


def compare(
    grid: OccupancyGrid,
    truth: OccupancyGrid,
    transform: Pose2 = IDENTITY,
    tolerance_m: float = 1.0,
    *,
    is_plan: bool = False,
) -> MapError:
    config = RunConfig(evaluate=EvaluateConfig(tolerance_m))
    return compare_to_truth(grid, truth, transform, config, is_plan=is_plan)


def test_error_counts_each_pair_of_classes() -> None:
    truth = draw("###", "...", "..#")
    found = draw("##.", ".?.", "#.?")
    # wall as free 1, free as unknown 1, free as wall 1, wall as unknown 4.
    assert compare(found, truth).error == pytest.approx(math.sqrt(7))


def test_error_is_summed_over_the_known_box_of_the_truth_only() -> None:
    truth = draw("?????", "?#.??", "?..??", "?????")
    found = draw("#####", "##.##", "#..##", "#####")
    result = compare(found, truth)
    assert result.error == 0.0
    assert result.difference.shape == (2, 2)


def test_cells_outside_the_map_count_as_unknown() -> None:
    truth = draw("##..", "##..")
    found = draw("##", "##")
    # Four free cells of the truth lie outside the map: (0 - (-1))^2 each.
    assert compare(found, truth).error == pytest.approx(2.0)
    assert compare(found, truth).coverage == 0.5


def test_thresholds_decide_the_classes_inclusively() -> None:
    truth = OccupancyGrid(np.array([[100, 0, -1, 100]], dtype=np.int8), 1.0)
    found = OccupancyGrid(np.array([[65, 25, 26, 64]], dtype=np.int8), 1.0)
    # 65 is a wall, 25 is free, 26 and 64 are unknown.
    assert compare(found, truth).error == pytest.approx(2.0)
    strict = FusionConfig(normalize=NormalizeConfig(occupied_percent=90.0, free_percent=10.0))
    result = compare_to_truth(found, truth, IDENTITY, RunConfig(fusion=strict))
    assert result.error == pytest.approx(math.sqrt(4 + 1 + 0 + 4))


def test_a_finer_map_is_read_at_the_centres_of_the_truth() -> None:
    truth = draw("#.", "..", resolution=1.0)
    finer = OccupancyGrid(np.kron(truth.cells, np.ones((3, 3), np.int8)), 1.0 / 3.0)
    assert compare(finer, truth).error == 0.0
    noisy = finer.cells.copy()
    noisy[0, :] = 100  # not at the centres of the truth's cells
    assert compare(OccupancyGrid(noisy, 1.0 / 3.0), truth).error == 0.0


def counts(error: MapError) -> npt.NDArray[np.int64]:
    """The confusion as a table."""
    return np.array([list(row.values()) for row in error.confusion.values()])


def test_confusion_has_the_truth_in_rows() -> None:
    truth = draw("?.#", "#.#")
    found = draw("#?.", "#.#")
    assert counts(compare(found, truth)).tolist() == [[0, 0, 1], [1, 1, 0], [0, 1, 2]]


def test_difference_names_each_kind_of_mismatch() -> None:
    truth = draw("?.##", "?#.?", "?.##")
    found = draw("?.#.", "##?.", "?.##")
    assert compare(found, truth).difference.tolist() == [
        [AGREE_FREE, AGREE_WALL, AGREE_WALL],
        [AGREE_WALL, MISSING_FREE, EXTRA_FREE],
        [AGREE_FREE, AGREE_WALL, MISSING_WALL],
    ]
    truth = draw(".?.")
    found = draw("#?.")
    assert compare(found, truth).difference.tolist() == [[EXTRA_WALL, AGREE_UNKNOWN, AGREE_FREE]]


def test_walls_within_the_tolerance_are_right_and_found() -> None:
    truth = draw("#........#")
    found = draw(".#..#....#")
    near = compare(found, truth, tolerance_m=1.0)
    assert near.wall_precision == pytest.approx(2 / 3)
    assert near.wall_recall == 1.0
    assert near.wall_f1 == pytest.approx(0.8)
    exact = compare(found, truth, tolerance_m=0.5)
    assert exact.wall_precision == pytest.approx(1 / 3)
    assert exact.wall_recall == 0.5
    assert exact.iou_occupied == pytest.approx(1 / 4)


def test_wall_distances_are_between_centres_in_metres() -> None:
    truth = draw("#....", ".....", ".....", resolution=0.5)
    found = draw(".....", ".....", "....#", resolution=0.5)
    result = compare(found, truth)
    assert result.map_to_truth_m.mean == pytest.approx(math.hypot(2.0, 1.0))
    assert result.truth_to_map_m == result.map_to_truth_m


def test_walls_outside_the_box_of_the_truth_still_count_against_the_map() -> None:
    truth = draw("#..", "...")
    found = draw("#.......#", ".........")
    result = compare(found, truth)
    assert result.error == 0.0
    assert result.wall_precision == 0.5
    assert result.map_to_truth_m.max == 8.0


def test_measures_without_walls_are_none_and_survive_json() -> None:
    truth = draw("#.", "..")
    empty = draw("..", "..")
    result = compare(empty, truth)
    assert result.wall_precision is None
    assert result.wall_f1 is None
    assert result.map_to_truth_m is None
    assert result.truth_to_map_m is None
    assert result.wall_recall == 0.0
    values = plain(result)
    assert list(values)[:2] == ["name", "error"]
    reversed_result = compare(truth, empty)
    assert reversed_result.wall_recall is None
    assert reversed_result.wall_precision == 0.0


def test_of_a_plan_counts_what_the_map_has_seen() -> None:
    plan = draw("##########", "#...#....#", "##########")
    # The robot saw the left room alone, and of its right wall the face.
    seen = draw("####??????", "#...#?????", "####??????")
    of_map = compare(seen, plan, tolerance_m=0.0)
    assert of_map.mapped is None
    assert of_map.wall_recall == pytest.approx(10 / 23)
    of_plan = compare(seen, plan, tolerance_m=0.0, is_plan=True)
    assert of_plan.mapped == pytest.approx(10 / 23)
    assert (of_plan.wall_recall, of_plan.wall_precision) == (1.0, 1.0)
    assert of_plan.faces.f1(0.05) == 1.0
    assert of_plan.coverage == 1.0
    assert np.count_nonzero(of_plan.difference == MISSING_WALL) == 0
    # A wall of the plan that is near known ground, and not in the map, is missing.
    near = compare(seen, plan, is_plan=True)
    assert near.mapped == pytest.approx(12 / 23)
    away = compare(seen, plan, Pose2(50.0), is_plan=True)
    assert (away.mapped, away.wall_recall) == (0.0, None)


def test_a_truth_without_known_cells_is_refused_by_name() -> None:
    unknown = draw("?~", "~?").with_name("plan")
    with pytest.raises(GridError, match="plan: no cell is surely"):
        compare(draw("#."), unknown)


def test_ssim_equals_the_formula_written_out_cell_by_cell() -> None:
    rng = np.random.default_rng(0)
    truth = OccupancyGrid(rng.choice(np.array([-1, 0, 100], np.int8), size=(11, 11)), 1.0)
    found = OccupancyGrid(rng.choice(np.array([-1, 0, 100], np.int8), size=(11, 11)), 1.0)
    result = compare(found, truth)
    assert result.ssim == pytest.approx(brute_force_ssim(found, truth), abs=1e-4)


def brute_force_ssim(found: OccupancyGrid, truth: OccupancyGrid) -> float:
    """Wang 2004, eq. 13, cell by cell with a mirrored border."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    weights = np.outer(window, window) / window.sum() ** 2
    x = np.pad(np.where(truth.cells < 0, 0.0, 0.5 + truth.cells / 200.0), 5, mode="symmetric")
    y = np.pad(np.where(found.cells < 0, 0.0, 0.5 + found.cells / 200.0), 5, mode="symmetric")
    values = []
    for row in range(truth.height):
        for col in range(truth.width):
            a, b = x[row : row + 11, col : col + 11], y[row : row + 11, col : col + 11]
            ma, mb = (weights * a).sum(), (weights * b).sum()
            va, vb = (weights * (a - ma) ** 2).sum(), (weights * (b - mb) ** 2).sum()
            cov = (weights * (a - ma) * (b - mb)).sum()
            values.append(
                (2 * ma * mb + 1e-4)
                * (2 * cov + 9e-4)
                / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
            )
    return float(np.mean(values))


CLASSES = hnp.arrays(
    np.int8,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=8),
    elements=st.sampled_from([-1, 0, 100]),
)


@given(CLASSES)
@settings(deadline=None, max_examples=examples(50))
def test_any_map_agrees_with_itself(cells: npt.NDArray[np.int8]) -> None:
    cells[0, 0] = 0
    grid = OccupancyGrid(cells, 0.05, Pose2(1.0, 2.0, 0.3))
    result = compare(grid, grid)
    assert result.error == 0.0
    assert np.array_equal(counts(result), np.diag(np.diag(counts(result))))
    assert result.ssim == pytest.approx(1.0)


@given(CLASSES, st.floats(-600, 600), st.floats(-600, 600), st.floats(-3.1, 3.1))
@settings(deadline=None, max_examples=examples(50))
def test_a_rigid_motion_of_the_map_and_its_inverse_change_nothing(
    cells: npt.NDArray[np.int8], x: float, y: float, yaw_rad: float
) -> None:
    cells[0, 0] = 0
    truth = OccupancyGrid(cells, 0.05)
    moved = OccupancyGrid(cells, 0.05, Pose2(x, y, yaw_rad))
    assert compare(moved, truth, Pose2(x, y, yaw_rad).inverse()).error == 0.0
