"""Draw the places of the simulator, from an office to a yard; or take a map file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.config import NormalizeConfig, WorldConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, trinary_cells
from slamfusion.io.map_server import load_map
from slamfusion.sim.building import (
    Canvas,
    draw_building,
    draw_pillars,
    draw_ring,
    draw_rooms,
    draw_wings,
)

Point = tuple[float, float]

# Panes are about this long; thicker walls than this are masonry.
PANE_M = 1.5
PANE_THICK_M = 0.25


@dataclass(frozen=True)
class Floor:
    """A drawn place and how to see it.

    Attributes:
        grid: the truth, trinary.
        start: where a drive begins, map frame; None: anywhere free.
        stops: waypoints that show the place, map frame; empty: planned.
    """

    grid: OccupancyGrid
    start: Pose2 | None = None
    stops: tuple[Point, ...] = ()


def draw_floor(config: WorldConfig, rng: np.random.Generator, folder: Path) -> Floor:
    """Draw a place, or load the map that is taken for one."""
    if (config.name == "map") != (config.map is not None):
        message = f"world {config.name!r} and map file {config.map!r}: give both or neither"
        raise SimulationError(message)
    if config.map is not None:
        return _map_floor(folder / config.map)
    return _DRAWINGS[config.name](rng, config.resolution)


def pick_glass(
    grid: OccupancyGrid, share: float, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """Turn parts of thin straight walls into glass; return them, (H, W) bool."""
    walls = grid.cells == OCCUPIED
    glass = np.zeros(walls.shape, dtype=np.bool_)
    long_cells = max(2, round(PANE_M / grid.resolution))
    thick_cells = round(PANE_THICK_M / grid.resolution)
    wanted = share * np.count_nonzero(walls)
    # Middles of straight runs: a pane fits along one axis, and across the wall soon ends.
    pane_x = scipy.ndimage.binary_opening(walls, np.ones((1, long_cells), dtype=bool))
    pane_y = scipy.ndimage.binary_opening(walls, np.ones((long_cells, 1), dtype=bool))
    thick = scipy.ndimage.binary_opening(walls, np.ones((thick_cells + 1,) * 2, dtype=bool))
    places = np.argwhere((pane_x | pane_y) & ~(pane_x & pane_y) & ~thick)
    for row, col in rng.permutation(places):
        if np.count_nonzero(glass) >= wanted:
            break
        half, deep = long_cells // 2, thick_cells
        tall, wide = (deep, half) if pane_x[row, col] else (half, deep)
        box = np.s_[max(row - tall, 0) : row + tall + 1, max(col - wide, 0) : col + wide + 1]
        along = pane_x if pane_x[row, col] else pane_y
        glass[box] |= along[box] & walls[box]
    return glass


def _map_floor(path: Path) -> Floor:
    grid = load_map(path)
    classes = trinary_cells(grid.cells, NormalizeConfig())
    cells = np.where(classes == 1, OCCUPIED, classes).astype(np.int8)
    return Floor(OccupancyGrid(cells, grid.resolution, grid.origin, grid.name))


def _office(rng: np.random.Generator, resolution: float) -> Floor:
    """A floor of rooms with doors along a corridor, furnished."""
    return Floor(draw_building(rng, 20.0, 14.0, resolution).with_name("office"), Pose2())


def _corridor(rng: np.random.Generator, resolution: float) -> Floor:
    """A corridor of 2 m around a core, with a few niches and pillars to tell its parts apart."""
    wide, high, way = 28.0, 18.0, 2.0
    canvas = Canvas(wide, high, resolution)
    wall = canvas.wall_m
    inner = (way, way, wide - way, high - way)
    canvas.fill((0.0, 0.0, wide, high), FREE)
    canvas.outline((0.0, 0.0, wide, high))
    canvas.fill(inner, UNKNOWN)
    canvas.outline(inner)
    for x in rng.uniform(4.0, wide - 5.0, 5):
        low, top = (way, way + 0.5) if rng.random() < 0.5 else (high - way - 0.5, high - way)
        canvas.outline((x, low, x + 1.0, top))
        mouth = (low, top - wall) if low == way else (low + wall, top)
        canvas.fill((x + wall, mouth[0], x + 1.0 - wall, mouth[1]), FREE)
    for y in rng.uniform(4.0, high - 5.0, 4):
        x = 0.0 if rng.random() < 0.5 else wide - 0.35
        canvas.fill((x, y, x + 0.35, y + 0.3), OCCUPIED)
    middle = way / 2.0
    corners = [(middle, middle), (wide - middle, middle), (wide - middle, high - middle)]
    corners.append((middle, high - middle))
    start = (wide / 2.0, middle)
    # Once around, and on to the second corner: the places seen first are seen again.
    loop = [*corners[1:], corners[0], start, corners[1], corners[2]]
    stops = tuple((x - start[0], y - start[1]) for x, y in loop)
    origin = Pose2(-start[0], -start[1])
    return Floor(OccupancyGrid(canvas.cells, resolution, origin, "corridor"), Pose2(), stops)


def _hall(rng: np.random.Generator, resolution: float) -> Floor:
    """A hall of 24 m x 16 m with columns, crates at any angle and a shelf or two."""
    wide, high = 24.0, 16.0
    canvas = Canvas(wide, high, resolution)
    canvas.fill((0.0, 0.0, wide, high), FREE)
    canvas.outline((0.0, 0.0, wide, high))
    for x in (6.0, 12.0, 18.0):
        for y in (5.0, 11.0):
            if rng.random() < 0.8:
                canvas.disc((x, y), 0.25, OCCUPIED)
    for _ in range(int(rng.integers(2, 4))):
        x, y = rng.uniform(2.0, wide - 6.0), rng.uniform(2.0, high - 2.5)
        canvas.turned_box((x + 1.5, y), (3.0, 0.5), 0.0, OCCUPIED)
    for _ in range(16):
        centre = (rng.uniform(1.0, wide - 1.0), rng.uniform(1.0, high - 1.0))
        size = (rng.uniform(0.4, 1.4), rng.uniform(0.3, 0.9))
        canvas.turned_box(centre, size, rng.uniform(0.0, math.pi), OCCUPIED)
    start = (wide / 2.0 + 1.5, high / 2.0)
    canvas.disc(start, 1.2, FREE)
    origin = Pose2(-start[0], -start[1])
    return Floor(OccupancyGrid(canvas.cells, resolution, origin, "hall"), Pose2())


def _atrium(rng: np.random.Generator, resolution: float) -> Floor:
    """[F16]'s small atrium: an open rectangle with pillars and benches; its middle row is free."""
    wide, high = 9.0, 5.6
    canvas = Canvas(wide, high, resolution)
    canvas.fill((0.0, 0.0, wide, high), FREE)
    canvas.outline((0.0, 0.0, wide, high))
    for x in (2.3, 6.7):
        for y in (1.1, 4.5):
            canvas.disc((x + rng.uniform(-0.3, 0.3), y), 0.2, OCCUPIED)
    for y in (0.5, 5.1):
        canvas.turned_box((rng.uniform(3.5, 5.5), y), (1.6, 0.4), 0.0, OCCUPIED)
    planter = (rng.uniform(4.0, 5.0), rng.choice((1.6, 4.0)))
    canvas.turned_box(planter, (0.8, 0.5), rng.uniform(0.3, 1.2), OCCUPIED)
    canvas.fill((wide - 1.0, 0.0, wide, 1.2), OCCUPIED)
    start = (1.8, high / 2.0)
    origin = Pose2(-start[0], -start[1])
    return Floor(OccupancyGrid(canvas.cells, resolution, origin, "atrium"), Pose2())


def _yard(rng: np.random.Generator, resolution: float) -> Floor:
    """[B16]'s outdoor yard: barricades around an irregular place and some across it.

    Between the barricades beams leave and nothing comes back; what lies outside is unknown.
    """
    side = 18.0
    canvas = Canvas(side, side, resolution)
    middle = (side / 2.0, side / 2.0)
    corners = 11
    turns = (np.arange(corners) + rng.uniform(-0.25, 0.25, corners)) * math.tau / corners
    reach = rng.uniform(5.0, 7.5, corners)
    ring = np.stack((np.cos(turns), np.sin(turns)), axis=1) * reach[:, None] + middle
    canvas.cells[_inside(ring, canvas)] = FREE
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        _barricades(canvas, a, b)
    for turn in np.arange(5) * math.tau / 5 + rng.uniform(0.0, 1.0):
        away = rng.uniform(2.0, 3.4)
        centre = (middle[0] + away * math.cos(turn), middle[1] + away * math.sin(turn))
        canvas.turned_box(centre, (1.5, 0.15), turn + rng.uniform(0.8, 2.2), OCCUPIED)
    origin = Pose2(-middle[0], -middle[1])
    return Floor(OccupancyGrid(canvas.cells, resolution, origin, "yard"), Pose2())


def _barricades(canvas: Canvas, start: F64, end: F64) -> None:
    """Set barricades of about 1.5 m along a line, a hand's breadth apart."""
    x, y = end - start
    length, yaw = math.hypot(x, y), math.atan2(y, x)
    count = max(1, round(length / 1.6))
    for share in (np.arange(count) + 0.5) / count:
        centre = (start[0] + share * x, start[1] + share * y)
        canvas.turned_box(centre, (length / count - 0.15, 0.15), yaw, OCCUPIED)


def _inside(ring: F64, canvas: Canvas) -> npt.NDArray[np.bool_]:
    """Return which cell centres lie inside a closed ring of corners (N, 2), metres: even-odd."""
    rows, cols = ((np.arange(size) + 0.5) * canvas.resolution for size in canvas.cells.shape)
    x, y = cols[None, :], rows[:, None]
    inside = np.zeros(canvas.cells.shape, dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        crosses = (y0 <= y) != (y1 <= y)
        inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def _toured(drawn: tuple[OccupancyGrid, tuple[Point, ...]]) -> Floor:
    """Return a drawn place that begins at zero and knows its stops."""
    grid, stops = drawn
    return Floor(grid, Pose2(), stops)


_DRAWINGS: dict[str, Callable[[np.random.Generator, float], Floor]] = {
    "office": _office,
    "corridor": _corridor,
    "hall": _hall,
    "atrium": _atrium,
    "yard": _yard,
    "ring-100": lambda rng, cell_m: _toured(draw_ring(rng, 100.0, cell_m)),
    "ring-300": lambda rng, cell_m: _toured(draw_ring(rng, 300.0, cell_m)),
    "wings": lambda rng, cell_m: _toured(draw_wings(rng, cell_m)),
    "pillars": lambda rng, cell_m: _toured(draw_pillars(rng, cell_m)),
    "rooms": lambda rng, cell_m: _toured(draw_rooms(rng, cell_m)),
}
