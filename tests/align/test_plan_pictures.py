"""Pictures of floor plans as architects make them: each finds its scale and its place."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, OccupancyGrid
from slamfusion.jobs.align import align_plan
from slamfusion.jobs.inputs import load_truth
from tests.fusion.drawings import building
from tests.support.cuts import along, kept

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

Picture = npt.NDArray[np.uint8]
BLACK, GREY, LINE = (0, 0, 0), (150, 150, 150), (60, 60, 60)
# Pixels of a drawing before it is reduced to half, and white around the building.
FINE_M, MARGIN = 0.0175, 150


def rooms_of(walls: Picture) -> list[npt.NDArray[np.bool_]]:
    """Return the ground of each room, half a metre from its walls; the first is the outside."""
    inner = cv2.erode(255 - walls, np.ones((61, 61)))
    count, rooms = cv2.connectedComponents(inner)
    return [rooms == room for room in range(1, count)]


def black_walls(walls: Picture) -> Picture:
    """Return walls in black on white paper."""
    return np.where(walls[..., None] > 0, np.uint8(0), np.full((1, 1, 3), 255, np.uint8))


def coloured_rooms(walls: Picture) -> Picture:
    """Return brown walls, and rooms filled in light colours."""
    picture = np.where(walls[..., None] > 0, np.array((20, 40, 90), np.uint8), np.uint8(255))
    for room, mask in enumerate(rooms_of(walls)):
        picture[mask] = np.array((255, 255, 255)) - 12 * np.array((room % 5, room % 4, room % 3))
    return picture


def words_and_sizes(walls: Picture) -> Picture:
    """Return a drawing with the names of rooms, lines that give sizes, and a frame."""
    picture = black_walls(walls)
    height, width = walls.shape
    for mask in rooms_of(walls)[1:]:
        row, col = (int(place.mean()) for place in np.nonzero(mask))
        cv2.putText(picture, "Office", (col - 60, row), cv2.FONT_HERSHEY_DUPLEX, 1.0, LINE, 2)
    for place in (60, 100):
        cv2.line(picture, (MARGIN, place), (width - MARGIN, place), LINE, 2)
        for col in range(MARGIN, width - MARGIN + 1, 190):
            cv2.line(picture, (col - 12, place + 12), (col + 12, place - 12), LINE, 2)
            cv2.putText(picture, "3.41", (col + 60, place - 8), cv2.FONT_HERSHEY_PLAIN, 2, LINE, 2)
    cv2.rectangle(picture, (20, 20), (width - 20, height - 20), LINE, 3)
    return picture


def doors_as_arcs(walls: Picture) -> Picture:
    """Return a drawing with a leaf and an arc at the ends of walls, as doors are drawn."""
    picture = black_walls(walls)
    ends = cv2.goodFeaturesToTrack(walls, 60, 0.1, 50)
    for x, y in ends[:, 0].astype(int):
        cv2.ellipse(picture, (int(x), int(y)), (50, 50), 0, 0, 90, BLACK, 2)
        cv2.line(picture, (int(x), int(y)), (int(x), int(y) + 50), BLACK, 2)
    return picture


def filled_walls(walls: Picture) -> Picture:
    """Return walls as two lines with grey between them."""
    thick = cv2.dilate(walls, np.ones((9, 9)))
    picture = np.where(thick[..., None] > 0, np.uint8(150), np.full((1, 1, 3), 255, np.uint8))
    outlines, _ = cv2.findContours(thick, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, BLACK, 3)
    return picture


def drawn(
    path: Path, truth: OccupancyGrid, draw: Callable[[Picture], Picture], yaw_deg: float
) -> Pose2:
    """Draw a building as a picture, turned, with soft edges; the top is +y.

    Returns:
        The pose of the building's frame in that of the picture, metres of the building.
    """
    factor = truth.resolution / FINE_M
    walls = (truth.cells == OCCUPIED).view(np.uint8)[::-1] * np.uint8(255)
    walls = cv2.resize(walls, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    walls = np.pad(walls, MARGIN)
    picture = draw(walls)
    side = 2 * math.ceil(math.hypot(*walls.shape) / 2.0)
    turn = cv2.getRotationMatrix2D((walls.shape[1] / 2.0, walls.shape[0] / 2.0), yaw_deg, 1.0)
    turn[:, 2] += (side - walls.shape[1]) / 2.0, (side - walls.shape[0]) / 2.0
    turned = cv2.warpAffine(picture, turn, (side, side), borderValue=(255, 255, 255))
    small = cv2.resize(turned, (side // 2, side // 2), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small)
    half = side * FINE_M / 2.0
    centre = truth.origin.transform(np.array((truth.width, truth.height)) * truth.resolution / 2.0)
    turned_pose = Pose2(half, half, math.radians(yaw_deg))
    return turned_pose.compose(Pose2(-float(centre[0]), -float(centre[1])))


@pytest.mark.parametrize(
    ("draw", "yaw_deg"),
    [
        (black_walls, 33.0),
        (coloured_rooms, -90.0),
        (words_and_sizes, 0.0),
        (doors_as_arcs, 171.0),
        (filled_walls, 78.0),
    ],
)
def test_a_picture_finds_its_scale_and_its_place(
    tmp_path: Path, device: ComputeDevice, draw: Callable[[Picture], Picture], yaw_deg: float
) -> None:
    truth = building(0, 24.0, 18.0, 0.05)
    pose = drawn(tmp_path / "plan.png", truth, draw, yaw_deg)
    # The robot did not enter the rooms at one end.
    seen = kept(truth, along(truth, truth, Pose2(), "x"), (0, 360)).with_name("seen")
    plan = load_truth(tmp_path / "plan.png", RunConfig(), scale="free")
    found = align_plan(seen, plan, device=device, scale=(0.028, 0.042))
    assert found.alignment.accepted, found.alignment.reason
    assert found.plan.resolution == pytest.approx(2.0 * FINE_M, rel=0.01)
    for corner in ((0.0, 0.0), (10.0, 0.0), (0.0, 10.0)):
        there = found.of_map.transform.transform(corner)
        assert there == pytest.approx(pose.transform(corner), abs=0.25)


def test_a_drawing_without_a_unit_finds_its_scale(tmp_path: Path, device: ComputeDevice) -> None:
    ezdxf = pytest.importorskip("ezdxf", reason="ezdxf comes with the plans extra")
    truth = building(2, 24.0, 18.0, 0.05)
    walls = (truth.cells == OCCUPIED).view(np.uint8)
    outlines, _ = cv2.findContours(walls, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    document = ezdxf.new()
    document.units = 0
    for outline in outlines:
        # In feet, far from the origin.
        points = truth.cell_centres(outline[:, 0, 1], outline[:, 0, 0]) / 0.3048 + 1000.0
        document.modelspace().add_lwpolyline(points, close=True)
    document.saveas(tmp_path / "plan.dxf")
    plan = load_truth(tmp_path / "plan.dxf", RunConfig(), scale="free")
    found = align_plan(truth, plan, device=device, scale=(0.02, 0.03))
    assert found.alignment.accepted, found.alignment.reason
    assert found.plan.resolution == pytest.approx(23.95 / 1000.0, rel=0.01)
