"""The pictures themselves: up is up, colours add, turned maps are turned."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.palette import DISAGREEMENT_RGB as RED
from slamfusion.palette import colours_of
from slamfusion.report import maps as plots
from tests.report.drawn import centre, pixels

WALL = (18, 22, 28)


def test_rows_grow_upward() -> None:
    cells = np.zeros((40, 40), dtype=np.int8)
    cells[30:38, 2:8] = 1  # upper left
    x, y = centre(pixels(plots.map_picture(cells, 0.1, Pose2())), WALL, 0)
    assert x < 0.4
    assert y < 0.4


def test_the_yaw_of_the_origin_turns_the_picture() -> None:
    cells = np.zeros((40, 40), dtype=np.int8)
    cells[2:8, 30:38] = 1  # to the lower right; a quarter turn brings it to the upper right
    x, y = centre(pixels(plots.map_picture(cells, 0.1, Pose2(7, 8, math.pi / 2))), WALL, 0)
    assert x > 0.6
    assert y < 0.4


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_agreeing_layers_are_walls_and_single_ones_keep_their_colour(count: int) -> None:
    layers = [np.zeros((20, 40), dtype=np.int8) for _ in range(count)]
    for index, layer in enumerate(layers):
        layer[:, :20] = 1
        layer[:, 22 + 2 * index : 24 + 2 * index] = 1
    colours = list(colours_of("abcdefg"[:count]).values())
    image = pixels(plots.overlay_picture(layers, colours, 0.1, Pose2()))
    if count > 1:
        assert centre(image, WALL, 0)[0] < 0.5
        for colour in colours:
            assert (np.abs(image.astype(int) - colour).max(axis=2) <= 1).any()
    else:
        assert centre(image, colours[0], 0)[0] < 0.6


def test_full_agreement_is_white_and_the_worst_cell_of_a_block_shows() -> None:
    agreement = np.full((3000, 3000), 100, dtype=np.int8)
    agreement[1500, 1500] = 33
    image = pixels(plots.agreement_picture(OccupancyGrid(agreement, 0.05)))
    assert (image == plots.agreement_colour(33)).all(axis=2).any()
    assert plots.agreement_colour(100) == (255, 255, 255)


def test_outvoted_cells_are_drawn_over_the_map() -> None:
    fused = np.zeros((30, 30), dtype=np.int8)
    dissent = np.zeros((30, 30), dtype=np.bool_)
    dissent[20:25, 20:25] = True
    image = pixels(plots.map_picture(fused, 0.1, Pose2(), outvoted=dissent))
    x, y = centre(image, RED, 0)
    assert x > 0.5
    assert y < 0.5


def test_in_a_small_picture_of_a_large_map_only_whole_outvoted_walls_are_marked() -> None:
    cells, dissent = np.zeros((1600, 1600), dtype=np.int8), np.zeros((1600, 1600), dtype=np.bool_)
    cells[:, 300:303] = cells[:, 1200:1203] = 1
    dissent[::2, 300:303] = dissent[:, 1200:1203] = True
    image = pixels(plots.map_picture(cells, 0.05, Pose2(), outvoted=dissent))
    row = image[len(image) // 2]
    columns = [np.flatnonzero((row == rgb).all(axis=1)) for rgb in (WALL, RED)]
    assert columns[0].max() < len(row) / 2 < columns[1].min()


@pytest.mark.parametrize("shape", [(700, 760), (760, 100), (1500, 1400), (4000, 500)])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.6])
def test_no_wall_of_one_cell_is_lost(shape: tuple[int, int], yaw_rad: float) -> None:
    # Walls far enough apart to be counted after shrinking, all along the middle.
    cells = np.zeros(shape, dtype=np.int8)
    spacing = max(shape) // 20
    image = plots.map_picture(cells, 0.05, Pose2(0, 0, yaw_rad))
    blank = int(np.count_nonzero((pixels(image) == WALL).all(axis=2)))
    assert blank == 0
    for first in range(spacing // 2, shape[0], spacing):
        cells[first] = 1
    walls = (pixels(plots.map_picture(cells, 0.05, Pose2(0, 0, yaw_rad))) == WALL).all(axis=2)
    if not yaw_rad:
        walls = walls[:, walls.shape[1] // 2 :]  # the scale bar lies over the left half
    count, _ = cv2.connectedComponents(walls.astype(np.uint8), connectivity=8)
    assert count - 1 == len(range(spacing // 2, shape[0], spacing))


@pytest.mark.parametrize("shape", [(1, 1), (1, 400), (400, 1), (3, 2)])
def test_odd_shapes_and_all_unknown_maps_can_be_drawn(shape: tuple[int, int]) -> None:
    for value in (-1, 1):
        cells = np.full(shape, value, dtype=np.int8)
        image = pixels(plots.map_picture(cells, 0.05, Pose2(1e6, -1e6, 0.3)))
        assert max(image.shape) < 2000
