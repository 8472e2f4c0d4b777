"""Draw the floor of a building: a corridor, rooms with doors, clutter, one corner missing."""

from __future__ import annotations

import numpy as np

from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.sim.canvas import Canvas, Rect

MIN_SIDE_M = 6.0
DOOR_M = 0.9


def draw_building(
    rng: np.random.Generator, width_m: float, height_m: float, resolution: float = 0.05
) -> OccupancyGrid:
    """Draw a building as the map that a perfect SLAM would make of it.

    Rooms of unequal width line a corridor, one outer corner is missing, one room has a slanted
    wall: no turn of the building looks like another. Walls are 0.1 m thick (at least one cell).

    Args:
        rng: source of every random choice.
        width_m: outer size along x, at least 6 m.
        height_m: outer size along y, at least 6 m.
        resolution: metres per cell.

    Returns:
        Cells free inside, occupied on walls and clutter, unknown outside and inside of furniture.
        The map frame's zero lies in the corridor, where a robot would start.

    Raises:
        ValueError: a side below 6 m.
    """
    if min(width_m, height_m) < MIN_SIDE_M:
        message = f"a building needs sides of at least {MIN_SIDE_M} m, asked {width_m} x {height_m}"
        raise ValueError(message)
    canvas = Canvas(width_m, height_m, resolution)
    outline = (0.0, 0.0, width_m, height_m)
    canvas.fill(outline, FREE)
    canvas.outline(outline)

    corridor_m = min(rng.uniform(1.5, 2.2), 0.2 * height_m)
    south = height_m * rng.uniform(0.33, 0.5)
    north = south + corridor_m
    upper_rooms = _row_of_rooms(rng, canvas, (0.0, north, width_m, height_m), door_y=north)
    lower_rooms = _row_of_rooms(rng, canvas, (0.0, 0.0, width_m, south), door_y=south)

    for room in upper_rooms + lower_rooms:
        _furnish(rng, canvas, room)
    _slanted_wall(canvas, max(upper_rooms[:-1] or upper_rooms, key=_area))
    _cut_corner(rng, canvas, upper_rooms[-1])
    return OccupancyGrid(
        canvas.cells,
        resolution,
        Pose2(-canvas.cell(0.3 * width_m) * resolution, -canvas.cell(south + 0.7) * resolution),
        "building",
    )


def _area(rect: Rect) -> float:
    return (rect[2] - rect[0]) * (rect[3] - rect[1])


def _row_of_rooms(
    rng: np.random.Generator, canvas: Canvas, rect: Rect, door_y: float
) -> list[Rect]:
    """Divide one side of the corridor into rooms and open a door of each at ``door_y``."""
    x0, y0, x1, y1 = rect
    wall = canvas.wall_m
    canvas.fill((x0, door_y - wall / 2, x1, door_y + wall / 2), OCCUPIED)
    rooms: list[Rect] = []
    left = x0
    while left < x1:
        right = left + rng.uniform(2.5, 5.5)
        if x1 - right < 2.5:
            right = x1
        else:
            canvas.fill((right - wall / 2, y0, right + wall / 2, y1), OCCUPIED)
        rooms.append((left, y0, right, y1))
        door = rng.uniform(left + 0.3, right - 0.3 - DOOR_M)
        canvas.fill((door, door_y - wall, door + DOOR_M, door_y + wall), FREE)
        left = right
    for room in rooms[1:]:
        if rng.random() < 0.3:  # a door to the neighbouring room
            low = rng.uniform(y0 + 0.4, y1 - 0.4 - DOOR_M)
            canvas.fill((room[0] - wall, low, room[0] + wall, low + DOOR_M), FREE)
    return rooms


def _furnish(rng: np.random.Generator, canvas: Canvas, room: Rect) -> None:
    """Put cupboards (outlines, unknown inside) and table legs into a room."""
    x0, y0, x1, y1 = room
    wall = canvas.wall_m
    for _ in range(int(rng.integers(1, 4))):
        wide, deep = rng.uniform(0.4, 1.2), rng.uniform(0.3, 0.7)
        left = rng.uniform(x0 + wall, x1 - wall - wide)
        low = rng.uniform(y0 + wall, y1 - wall - deep)
        box = (left, low, left + wide, low + deep)
        if rng.random() < 0.5:
            canvas.fill(box, UNKNOWN)
            canvas.outline(box)
        else:
            leg = canvas.resolution
            for x in (left, left + wide - leg):
                for y in (low, low + deep - leg):
                    canvas.fill((x, y, x + leg, y + leg), OCCUPIED)


def _slanted_wall(canvas: Canvas, room: Rect) -> None:
    """Close off the upper left corner of a room by a wall at 30 degrees or so."""
    x0, y0, x1, y1 = room
    reach_x, reach_y = 0.6 * (x1 - x0), 0.35 * (y1 - y0)
    rows, cols = np.indices(canvas.cells.shape)
    x = (cols + 0.5) * canvas.resolution - x0
    y = y1 - (rows + 0.5) * canvas.resolution
    inside = (x > 0) & (y > 0) & (x < reach_x) & (y < reach_y)
    distance = (1 - x / reach_x - y / reach_y) / np.hypot(1 / reach_x, 1 / reach_y)
    behind = inside & (distance > canvas.wall_m) & (canvas.cells != OCCUPIED)
    canvas.cells[behind] = UNKNOWN
    canvas.cells[inside & (np.abs(distance) <= canvas.wall_m / 2)] = OCCUPIED
    canvas.cells[inside & (distance > 0) & (distance <= canvas.wall_m)] = OCCUPIED


def _cut_corner(rng: np.random.Generator, canvas: Canvas, room: Rect) -> None:
    """Take the outer part of the corner room away, so that the outline is an L."""
    x0, y0, x1, y1 = room
    cut = y1 - (y1 - y0) * rng.uniform(0.35, 0.6)
    canvas.fill((x0, cut, x1, y1), UNKNOWN)
    canvas.fill((x0 - canvas.wall_m / 2, cut, x0 + canvas.wall_m / 2, y1), OCCUPIED)
    canvas.fill((x0, cut, x1, cut + canvas.wall_m), OCCUPIED)
