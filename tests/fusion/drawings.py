"""Tiny maps drawn in the source, small drawn buildings, and how far an alignment is off."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, FusionConfig, NormalizeConfig
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid
from slamfusion.sim import draw_building
from tests.support.degrade import Degradation, degrade_map

SIGNS = {"#": OCCUPIED, ".": FREE, " ": UNKNOWN, "?": 50}


def draw(picture: str, resolution: float = 0.1, **arguments: Any) -> OccupancyGrid:
    """Return a map drawn in text, north up: # wall, . free, blank unknown, ? half occupied."""
    lines = picture.strip("\n").splitlines()
    width = max(map(len, lines))
    cells = [[SIGNS[sign] for sign in line.ljust(width)] for line in reversed(lines)]
    return OccupancyGrid(np.array(cells, dtype=np.int8), resolution, **arguments)


def picture_of(cells: np.ndarray) -> list[str]:
    """Return trinary cells as text, north up."""
    return ["".join(" .#"[value + 1] for value in row) for row in cells[::-1]]


@cache
def building(
    seed: int, width_m: float = 9.0, height_m: float = 7.0, resolution: float = 0.1
) -> OccupancyGrid:
    """Return a drawn building; the same seed gives the same."""
    grid = draw_building(np.random.default_rng(seed), width_m, height_m, resolution)
    return grid.with_name(f"building {seed}")


def degraded(
    truth: OccupancyGrid, seed: int, name: str = "moving", **faults: Any
) -> tuple[OccupancyGrid, Pose2]:
    """Return a faulty map of a place and the pose of its frame in the truth's."""
    grid, pose = degrade_map(truth, np.random.default_rng(seed), Degradation(**faults))
    return grid.with_name(name), pose


def random_cells(seed: int, low: int = 20, high: int = 60) -> np.ndarray:
    """Return cells of a small random place: free rooms in unknown space, walls and boxes."""
    rng = np.random.default_rng(seed)
    height, width = rng.integers(low, high + 1, size=2)
    cells = np.full((height, width), UNKNOWN, dtype=np.int8)
    for _ in range(int(rng.integers(1, 5))):
        row, col = rng.integers(0, height - 8), rng.integers(0, width - 8)
        rows, cols = rng.integers(8, height - row + 1), rng.integers(8, width - col + 1)
        cells[row : row + rows, col : col + cols] = OCCUPIED
        cells[row + 1 : row + rows - 1, col + 1 : col + cols - 1] = FREE
    cells[0, 0] = cells[-1, -1] = OCCUPIED
    noise = rng.random(cells.shape)
    cells[noise < rng.uniform(0.0, 0.03)] = OCCUPIED
    return cells


def random_grid(seed: int, low: int = 20, high: int = 60) -> OccupancyGrid:
    return OccupancyGrid(random_cells(seed, low, high), 0.1, name=f"random {seed}")


def features_of(
    grid: OccupancyGrid, device: ComputeDevice, resolution: float | None = None
) -> GridFeatures:
    """Return a grid normalised with the defaults and ready to be searched."""
    normalized = normalize_grid(grid, resolution or grid.resolution, NormalizeConfig(), device)
    return GridFeatures(normalized, device)


def fusion_config(**align: Any) -> FusionConfig:
    """Return the defaults with the given settings of the search."""
    return FusionConfig(align=AlignConfig(**align))


def with_origin(grid: OccupancyGrid, origin: Pose2) -> OccupancyGrid:
    """Return the grid in another map frame."""
    return replace(grid, origin=origin)


def padded(grid: OccupancyGrid, south: int, west: int, north: int, east: int) -> OccupancyGrid:
    """Return the grid with unknown cells around it, unmoved in its map frame."""
    return grid.crop(CellBox(-south, -west, grid.height + north, grid.width + east))


def off_by(moving: OccupancyGrid, found: Pose2, wanted: Pose2) -> tuple[float, float]:
    """Return how far the centre of the moving known box is off, in cells, and the yaw in deg."""
    box = moving.known_box
    size = moving.resolution
    own = ((box.col0 + box.col1) / 2 * size, (box.row0 + box.row1) / 2 * size)
    centre = moving.origin.transform(own)
    shift = math.dist(found.transform(centre), wanted.transform(centre)) / size
    return shift, abs(math.degrees(wrap_angle(found.yaw_rad - wanted.yaw_rad)))


def assert_right(
    alignment: Alignment,
    moving: OccupancyGrid,
    wanted: Pose2,
    cells: float = 1.0,
    degrees: float = 0.5,
) -> None:
    """Assert that an alignment is accepted and near the wanted transform."""
    shift, turn = off_by(moving, alignment.transform, wanted)
    found = f"{shift:.2f} cells, {turn:.2f} deg off; {alignment.reason}"
    assert shift <= cells, found
    assert turn <= degrees, found
    assert alignment.accepted, found


def part(grid: OccupancyGrid, low: float, high: float, name: str) -> OccupancyGrid:
    """Return what lies between two shares of a map's width; the rest is unknown, the frame kept."""
    shares = (np.arange(grid.width) + 0.5) / grid.width
    is_kept = (shares >= low) & (shares < high)
    return replace(grid, cells=np.where(is_kept, grid.cells, np.int8(UNKNOWN)), name=name)


def building_parts(
    seed: int, share: float, yaw_rad: float
) -> tuple[OccupancyGrid, OccupancyGrid, Pose2]:
    """Two parts of a drawn building that share so much of each; one turned, with a frame its own.

    Returns:
        The western part, the eastern one as another SLAM would save it, and the pose of its frame
        in that of the first.
    """
    whole = building(seed, 16.0, 8.0, 0.05)
    each = round(whole.width / (2.0 - share))
    west = whole.crop(CellBox(0, 0, whole.height, each))
    east = whole.crop(CellBox(0, whole.width - each, whole.height, whole.width))
    moved, pose = degraded(
        east, seed, yaw_rad=yaw_rad, shift_share=(0.3, -0.2), flip_share=0.01, speckle_share=0.02
    )
    return west.with_name("west"), moved, pose
