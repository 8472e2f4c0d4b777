"""Doubled walls on drawn maps whose answer is plain to the eye."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.evaluation import doubled_walls
from slamfusion.evaluation.doubled_walls import doubled_wall_share, fused_doubled_shares
from slamfusion.grid import CellBox

Line = tuple[tuple[int, int], tuple[int, int]]

HORIZONTAL = ((5, 40), (75, 40))


def draw_walls(*lines: Line, thickness: int = 1) -> npt.NDArray[np.bool_]:
    """Draw lines from (x, y) to (x, y) on 80 x 80 cells."""
    image = np.zeros((80, 80), dtype=np.uint8)
    for start, end in lines:
        cv2.line(image, start, end, 1, thickness)
    return image.astype(np.bool_)


def pair(distance: float, angle_deg: float) -> npt.NDArray[np.bool_]:
    """Two parallel walls of 60 cells, ``distance`` cells apart, at an angle."""
    angle = math.radians(angle_deg)
    along = np.array([math.cos(angle), math.sin(angle)])
    normal = np.array([-along[1], along[0]])
    lines: list[Line] = []
    for offset in (0.0, distance):
        centre = np.array([40.0, 40.0]) + offset * normal
        start, end = np.rint(centre - 30 * along), np.rint(centre + 30 * along)
        lines.append(((int(start[0]), int(start[1])), (int(end[0]), int(end[1]))))
    return draw_walls(*lines)


@pytest.mark.parametrize("thickness", [1, 2, 3, 7, 21])
def test_one_wall_is_not_doubled_however_thick(thickness: int) -> None:
    assert doubled_wall_share(draw_walls(HORIZONTAL, thickness=thickness)) == 0.0


@pytest.mark.parametrize("angle_deg", [0, 15, 30, 45, 60, 90])
@pytest.mark.parametrize("distance", [3, 5, 7])
def test_two_parallel_walls_nearby_are_doubled(distance: int, angle_deg: float) -> None:
    assert doubled_wall_share(pair(distance, angle_deg)) > 0.9


@pytest.mark.parametrize("angle_deg", [0, 15, 30, 45, 60, 90])
@pytest.mark.parametrize("distance", [1, 11, 20])
def test_touching_and_distant_walls_are_not_doubled(distance: int, angle_deg: float) -> None:
    assert doubled_wall_share(pair(distance, angle_deg)) < 0.05


def test_corners_and_junctions_are_not_doubled() -> None:
    corner = draw_walls(((20, 20), (60, 20)), ((20, 20), (20, 60)))
    junction = draw_walls(((10, 20), (60, 20)), ((30, 20), (30, 60)))
    assert doubled_wall_share(corner) < 0.03
    assert doubled_wall_share(junction) < 0.03


def test_specks_do_not_double_a_wall() -> None:
    rng = np.random.default_rng(0)
    walls = draw_walls(HORIZONTAL) | (rng.random((80, 80)) < 0.02)
    assert doubled_wall_share(walls) < 0.05


def test_a_slipped_copy_of_a_room_raises_the_share_with_its_size() -> None:
    room: list[Line] = [
        ((10, 10), (70, 10)),
        ((70, 10), (70, 70)),
        ((70, 70), (10, 70)),
        ((10, 70), (10, 10)),
    ]
    walls = draw_walls(*room)
    shares = []
    for kept in (0, 20, 40, 60):
        copy = np.roll(walls, (4, 4), axis=(0, 1))
        copy[:, kept + 10 :] = False
        shares.append(doubled_wall_share(walls | copy))
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] > 0.6


def test_a_slip_is_added_by_the_fusion_and_a_narrow_passage_is_not():
    passage = np.zeros((40, 60), dtype=np.int8)
    passage[10, 5:55] = passage[16, 5:55] = 1
    whole = CellBox(0, 0, 40, 60)
    wanted = doubled_wall_share(passage == 1)
    assert fused_doubled_shares(passage, [(passage == 1, whole)] * 2) == (wanted, 0.0)
    # A map of a part of the place.
    part = CellBox(4, 3, 30, 57)
    assert fused_doubled_shares(passage, [(passage[4:30, 3:57] == 1, part)])[1] == 0.0
    assert (
        fused_doubled_shares(passage, [(passage[4:30, 3:30] == 1, CellBox(4, 3, 30, 30))])[1] > 0.3
    )
    single, slipped = np.zeros_like(passage), np.zeros_like(passage)
    single[10, 5:55] = slipped[15, 5:55] = 1
    both = [(single == 1, whole), (slipped == 1, whole)]
    assert fused_doubled_shares(np.maximum(single, slipped), both)[1] > 0.8
    assert fused_doubled_shares(np.zeros_like(passage), [(passage == 1, whole)])[1] == 0.0


def test_tiles_tell_the_same_of_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs that know a part of the place each, some of it doubled in them, too."""
    fused = np.zeros((150, 190), dtype=np.int8)
    fused[5:145:23, 4:180] = fused[10:150:23, 4:90] = 1
    first, second = CellBox(0, 30, 150, 190), CellBox(60, 0, 121, 80)
    inputs = [
        (fused[box.row0 : box.row1, box.col0 : box.col1] == 1, box) for box in (first, second)
    ]
    inputs[0][0][:, 50:] = False
    wanted = fused_doubled_shares(fused, inputs)
    assert wanted[0] > 2 * wanted[1] > 0.1
    for side in (40, 77):
        monkeypatch.setattr(doubled_walls, "TILE_CELLS", side)
        assert fused_doubled_shares(fused, inputs) == wanted
