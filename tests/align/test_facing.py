"""From which side a wall was seen: where free space lies from it, and where that says nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.align.features import facings
from slamfusion.compute.layout import FACES, FACING_PARTS

RESOLUTION = 0.1
QUARTER = FACING_PARTS // 4


def facings_of(cells: npt.NDArray[np.int8]) -> npt.NDArray[np.uint8]:
    return facings(cells, RESOLUTION)


def hall(thick: int, left: int, right: int) -> npt.NDArray[np.int8]:
    """A wall that stands upright, free cells to its left and right, unknown beyond."""
    sides = [-1] * 9 + [0] * left + [1] * thick + [0] * right + [-1] * 9
    return np.repeat(np.array([sides], dtype=np.int8), 21, axis=0)


def test_a_wall_faces_the_room_that_it_was_seen_from() -> None:
    cells = hall(1, 0, 10)
    faces = facings_of(cells)[10, 9]
    assert faces == FACES
    for turns in range(1, 4):
        turned = np.ascontiguousarray(np.rot90(cells, -turns))
        found = facings_of(turned)[turned == 1]
        assert found[len(found) // 2] == FACES + turns * QUARTER


@pytest.mark.parametrize(
    ("thick", "left", "right", "wanted"),
    [
        (1, 10, 10, 0),  # a board
        (2, 10, 10, 0),  # between: another map may draw it by a cell thicker
        (5, 10, 10, FACES + 2 * QUARTER),
        (1, 4, 4, 0),  # a rim of free cells behind a drawn wall, and a narrow room
        (1, 1, 10, FACES),
    ],
)
def test_a_wall_with_free_space_on_both_sides_says_nothing(
    thick: int, left: int, right: int, wanted: int
) -> None:
    """By the left surface of the wall."""
    assert facings_of(hall(thick, left, right))[10, 9 + left] == wanted


def test_far_from_walls_and_in_the_unknown_nothing_is_said() -> None:
    cells = hall(1, 20, 20)
    faces = facings_of(cells)[10]
    assert faces[9 + 20] == faces[9 + 10] == 0
    assert facings_of(np.full((7, 5), -1, dtype=np.int8)).max() == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (13, 9)])
@pytest.mark.parametrize("resolution", [0.02, 0.05, 0.3])
def test_maps_of_any_size_and_resolution(shape: tuple[int, int], resolution: float) -> None:
    cells = np.random.default_rng(1).integers(-1, 2, shape).astype(np.int8)
    found = facings(cells, resolution)
    assert found.shape == shape
    assert found.dtype == np.uint8
    assert not np.any((found < FACES) & (found != 0))
