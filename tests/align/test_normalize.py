"""Normalised grids: one resolution, known cells only, walls kept, nothing moved in the world."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.align import normalize
from slamfusion.align.normalize import NormalizedGrid, common_resolution, normalize_grid
from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig
from slamfusion.errors import GridError
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid, trinary_cells
from slamfusion.vote.lattice import Lattice
from tests.fusion.drawings import draw, picture_of, random_grid
from tests.support.examples import examples

DEFAULTS = NormalizeConfig()
TURNED = Pose2(-3.1234, 7.0321, 0.7)


def wall_centres(grid: NormalizedGrid) -> np.ndarray:
    """World positions of the wall cells of a normalised grid."""
    return grid.grid.cell_centres(*np.nonzero(grid.cells == 1))


def nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Largest coordinate distance of each point to the nearest of the others."""
    gaps = np.abs(points[:, None, :] - others[None, :, :]).max(axis=2)
    return np.asarray(gaps.min(axis=1))


@pytest.mark.parametrize(
    ("percent", "class_"),
    [(-1, -1), (0, 0), (24, 0), (25, 0), (26, -1), (50, -1), (64, -1), (65, 1), (66, 1), (100, 1)],
)
def test_thresholds_are_inclusive(percent: int, class_: int) -> None:
    assert trinary_cells(np.array([[percent]], dtype=np.int8), DEFAULTS).tolist() == [[class_]]


def test_common_resolution_is_the_finest_or_the_given() -> None:
    grids = [draw("#.", size) for size in (0.1, 0.04, 0.05)]
    assert common_resolution(grids, DEFAULTS) == 0.04
    assert common_resolution(grids, NormalizeConfig(resolution=0.2)) == 0.2


def test_crop_leaves_the_known_cells_where_they_are(device: ComputeDevice) -> None:
    picture = """
?
   ## .
   #

      .
?        ?"""
    grid = draw(picture, origin=TURNED)
    normal = normalize_grid(grid, 0.1, DEFAULTS, device)
    rows, cols = np.nonzero((grid.cells == 0) | (grid.cells == 100))
    wanted = grid.cell_centres(rows, cols)
    found = normal.grid.cell_centres(*np.nonzero(normal.cells != -1))
    assert np.allclose(np.sort(found, axis=0), np.sort(wanted, axis=0), atol=1e-9)
    assert picture_of(normal.cells) == ["## .", "#   ", "    ", "   ."]


def test_all_unknown_is_refused_by_name_size_and_thresholds(device: ComputeDevice) -> None:
    grid = draw("? \n  \n ?", name="attic")
    with pytest.raises(GridError, match=r"^attic: all 3 x 2 cells are unknown .*25 %.*65 %"):
        normalize_grid(grid, 0.1, DEFAULTS, device)


def test_a_wall_one_cell_thick_survives_any_whole_number_of_cells(device: ComputeDevice) -> None:
    for parts in (2, 3, 4, 7):
        for at in range(parts):
            cells = np.zeros((parts, 4 * parts), dtype=np.int8)
            cells[:, parts + at] = 100
            grid = OccupancyGrid(cells, 0.05)
            normal = normalize_grid(grid, 0.05 * parts, DEFAULTS, device)
            assert picture_of(normal.cells) == [".#.."], (parts, at)


def test_a_coarse_cell_is_known_when_half_of_it_is(device: ComputeDevice) -> None:
    grid = draw("..  ..#.\n.   ..##", 0.05)
    normal = normalize_grid(grid, 0.1, DEFAULTS, device)
    assert picture_of(normal.cells) == [". .#"]


@pytest.mark.parametrize("ratio", [0.8, 0.5, 0.4, 0.25])
def test_finer_cells_keep_the_world(device: ComputeDevice, ratio: float) -> None:
    """A fine cell is what the coarse cell under its centre is, yaw and offset included.

    Centres on the line between two coarse cells may go either way.
    """
    grid = OccupancyGrid(random_grid(5).cells, 0.1, TURNED)
    normal = normalize_grid(grid, 0.1 * ratio, DEFAULTS, device)
    rows, cols = np.indices(normal.shape).reshape(2, -1)
    centres = normal.grid.cell_centres(rows, cols)
    own = TURNED.inverse().transform(centres) / 0.1
    clear = (np.abs(own - np.rint(own)) > 1e-6).all(axis=1)
    row, col = grid.cell_indices(centres)
    at = (row.clip(0, grid.height - 1), col.clip(0, grid.width - 1))
    wanted = np.where((row < grid.height) & (col < grid.width), grid.cells[at], -1)
    assert np.array_equal(normal.grid.cells.ravel()[clear], wanted[clear])
    assert clear.mean() > 0.5
    # And no wall is lost: each coarse wall cell has a fine one within half a cell.
    walls = grid.cell_centres(*np.nonzero(grid.cells == 100))
    axes = Pose2(0.0, 0.0, -TURNED.yaw_rad)
    gap = nearest(axes.transform(walls), axes.transform(wall_centres(normal)))
    assert gap.max() <= 0.05 + 1e-9


@settings(max_examples=examples(30), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    ratio=st.floats(0.3, 4.0),
    x=st.floats(-600, 600),
    y=st.floats(-600, 600),
    yaw=st.floats(-math.pi, math.pi),
)
def test_every_wall_has_a_wall_within_half_a_cell_after_resampling(
    device: ComputeDevice, seed: int, ratio: float, x: float, y: float, yaw: float
) -> None:
    grid = OccupancyGrid(random_grid(seed, 12, 30).cells, 0.1, Pose2(x, y, yaw))
    normal = normalize_grid(grid, 0.1 * ratio, DEFAULTS, device)
    axes = Pose2(0.0, 0.0, -yaw)
    before = axes.transform(grid.cell_centres(*np.nonzero(grid.cells == 100)))
    after = axes.transform(wall_centres(normal))
    reach = 0.1 * (1 + ratio) / 2 + 1e-6
    assert nearest(before, after).max() <= reach
    assert nearest(after, before).max() <= reach


def test_specks_count_as_cells_but_not_as_walls_to_align(device: ComputeDevice) -> None:
    grid = draw(
        """
#########
#.......#
#..#....#
#.......#
#....##.#
#.......#
#########
"""
    )
    normal = normalize_grid(grid, 0.1, DEFAULTS, device)
    assert normal.cells[4, 3] == 1
    assert normal.solid[4, 3] == 0, "a wall cell with eight free neighbours"
    assert normal.solid[2, 5:7].tolist() == [0, 0], "two wall cells with seven each"
    assert normal.solid[0].all()
    assert normal.solid[:, 0].all()


def test_the_area_outside_counts_known_cells_alone() -> None:
    """A row of five cells, 0.5 m each, is turned to the north: two of its known cells stick out."""
    row = OccupancyGrid(np.array([[0, 50, -1, 0, 100]], dtype=np.int8), 0.5)
    lattice = Lattice(0.5, Pose2(-1.0, 0.0, 0.0))
    for pose, count in ((Pose2(0.0, 0.0, math.pi / 2), 2), (Pose2(-1.0, 0.0, 0.0), 1)):
        area = lattice.area_outside(CellBox(0, 0, 3, 4), row, pose, NormalizeConfig())
        assert area == pytest.approx(count * 0.25)


def test_an_extent_holds_every_corner_of_a_turned_grid(device: ComputeDevice) -> None:
    inner = normalize_grid(OccupancyGrid(random_grid(2).cells, 0.1, TURNED), 0.1, DEFAULTS, device)
    outer = normalize_grid(random_grid(4), 0.1, DEFAULTS, device)
    motion = Pose2(4.0, -1.0, 1.1)
    box = inner.on(outer.lattice, motion)
    rows, cols = np.indices(inner.shape).reshape(2, -1)
    landed = motion.transform(inner.grid.cell_centres(rows, cols))
    row, col = outer.grid.cell_indices(landed)
    assert box.row0 <= row.min() < box.row0 + 2
    assert box.row1 - 2 <= row.max() < box.row1
    assert box.col0 <= col.min() < box.col0 + 2
    assert box.col1 - 2 <= col.max() < box.col1


@pytest.mark.parametrize(
    ("most", "resolution", "factor"),
    [(30_000, 0.05, 1), (29_999, 0.05, 2), (7_000, 0.05, 3), (1_000, 0.05, 3), (1_000, 0.2, 1)],
)
def test_copies_of_many_maps_are_coarser_where_little_memory_is_wanted(
    monkeypatch: pytest.MonkeyPatch, most: int, resolution: float, factor: int
) -> None:
    """Three maps of 100 x 100 known cells; cells are 0.15 m at most for it."""
    monkeypatch.setattr(normalize, "SPARING_CELLS", most)
    grids = 3 * [OccupancyGrid(np.zeros((100, 100), dtype=np.int8), resolution)]
    assert normalize.coarsening(grids, resolution) == 1
    assert normalize.coarsening(grids, resolution, is_sparing=True) == factor
