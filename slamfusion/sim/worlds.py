"""Draw the places of the simulator, from an office to a yard, or load a map file.

In a ring, loops close late. In wings, pillars and rooms parts are exact copies of one another, so
that only the path tells them apart.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from slamfusion.config import NormalizeConfig, WorldConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import B8, F64, I8, Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, trinary_cells
from slamfusion.io.map_server import load_map
from slamfusion.sim.route import Point

# A rectangle as x0, y0, x1, y1 in metres from the canvas's lower-left corner.
Rect = tuple[float, float, float, float]

WALL_M = 0.1
# Length of a pane; walls thicker than this are masonry.
PANE_M = 1.5
PANE_THICK_M = 0.25


@dataclass(frozen=True)
class Floor:
    """A drawn place.

    Attributes:
        grid: the truth, trinary.
        start: of a drive, map frame; None: anywhere free.
        stops: waypoints, map frame; empty: planned.
    """

    grid: OccupancyGrid
    start: Pose2 | None = None
    stops: tuple[Point, ...] = ()


def draw_floor(config: WorldConfig, rng: np.random.Generator) -> Floor:
    """Draw a place, or load its map file."""
    if (config.name == "map") != (config.map is not None):
        found = f"name {config.name} and map {config.map}"
        raise SimulationError(f"world: wanted the name of a drawn place or a map, found {found}")
    if config.map is not None:
        grid = load_map(config.map)
        classes = trinary_cells(grid.cells, NormalizeConfig())
        return Floor(replace(grid, cells=np.where(classes == 1, np.int8(OCCUPIED), classes)))
    return _DRAWINGS[config.name](rng, config.resolution)


def pick_glass(grid: OccupancyGrid, share: float, rng: np.random.Generator) -> B8:
    """Turn parts of thin straight walls into glass, (H, W) bool."""
    walls = grid.cells == OCCUPIED
    glass = np.zeros(walls.shape, dtype=np.bool_)
    long_cells = max(2, round(PANE_M / grid.resolution))
    thick_cells = round(PANE_THICK_M / grid.resolution)
    wanted = share * np.count_nonzero(walls)
    # Middles of straight runs: a pane fits along one axis, and the wall is thin across.
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


class Canvas:
    """Cells (H, W) int8, unknown at first, to draw on in metres from the lower-left corner."""

    def __init__(self, width_m: float, height_m: float, resolution: float) -> None:
        self.resolution = resolution
        shape = (self.cell(height_m), self.cell(width_m))
        self.cells: I8 = np.full(shape, UNKNOWN, dtype=np.int8)
        self.wall_m = max(WALL_M, resolution)

    def cell(self, length_m: float) -> int:
        """Return the nearest whole number of cells."""
        return int(length_m / self.resolution + 0.5)

    def fill(self, rect: Rect, value: int) -> None:
        """Set every cell of a rectangle, clipped to the canvas."""
        x0, y0, x1, y1 = (max(self.cell(length), 0) for length in rect)
        self.cells[y0:y1, x0:x1] = value

    def outline(self, rect: Rect) -> None:
        """Draw the walls just inside the edges of a rectangle."""
        x0, y0, x1, y1 = rect
        wall = self.wall_m
        for side in (
            (x0, y0, x1, y0 + wall),
            (x0, y1 - wall, x1, y1),
            (x0, y0, x0 + wall, y1),
            (x1 - wall, y0, x1, y1),
        ):
            self.fill(side, OCCUPIED)

    def room(self, rect: Rect, inside: int = FREE) -> None:
        """Fill a rectangle and draw its walls."""
        self.fill(rect, inside)
        self.outline(rect)

    def turned_box(
        self, centre: tuple[float, float], size: tuple[float, float], yaw_rad: float, value: int
    ) -> None:
        """Set the cells whose centre lies in a turned rectangle; metres.

        A side is at least a cell and a half, so that a thin turned wall has no holes.
        """
        x, y = self.offsets(centre)
        along = np.abs(math.cos(yaw_rad) * x + math.sin(yaw_rad) * y)
        across = np.abs(math.cos(yaw_rad) * y - math.sin(yaw_rad) * x)
        half_x, half_y = (max(side, 1.5 * self.resolution) / 2.0 for side in size)
        self.cells[(along <= half_x) & (across <= half_y)] = value

    def disc(self, centre: tuple[float, float], radius_m: float, value: int) -> None:
        """Set the cells whose centre lies in a disc."""
        x, y = self.offsets(centre)
        self.cells[np.hypot(x, y) <= max(radius_m, self.resolution)] = value

    def offsets(self, centre: tuple[float, float]) -> tuple[F64, F64]:
        """Return x (1, W) and y (H, 1) of every cell centre from a point, metres."""
        rows, cols = (np.arange(size, dtype=np.float64) + 0.5 for size in self.cells.shape)
        x = np.asarray(cols * self.resolution - centre[0], dtype=np.float64)
        y = np.asarray(rows * self.resolution - centre[1], dtype=np.float64)
        return x[None, :], y[:, None]

    def floor(self, name: str, start: Point, stops: Iterable[Point] = ()) -> Floor:
        """Return the floor; the start is the origin of the map frame."""
        x0, y0 = start
        grid = OccupancyGrid(self.cells, self.resolution, Pose2(-x0, -y0), name)
        return Floor(grid, Pose2(), tuple((x - x0, y - y0) for x, y in stops))


DOOR_M = 0.9


def draw_building(
    rng: np.random.Generator, width_m: float, height_m: float, resolution: float = 0.05
) -> OccupancyGrid:
    """Draw a building as the map of a perfect SLAM.

    Rooms of unequal width along a corridor, one outer corner missing, one slanted wall: no rotation
    of the building looks like another. Walls are 0.1 m thick (at least one cell).

    Args:
        width_m: outer size along x, at least 6 m.
        height_m: outer size along y, at least 6 m.
        resolution: metres per cell.

    Returns:
        Cells free inside, occupied on walls and clutter, unknown outside and inside of furniture.
        The map frame's origin lies in the corridor.
    """
    canvas = Canvas(width_m, height_m, resolution)
    canvas.room((0.0, 0.0, width_m, height_m))

    corridor_m = min(rng.uniform(1.5, 2.2), 0.2 * height_m)
    south = height_m * rng.uniform(0.33, 0.5)
    north = south + corridor_m
    upper_rooms = _row_of_rooms(rng, canvas, (0.0, north, width_m, height_m), door_y=north)
    lower_rooms = _row_of_rooms(rng, canvas, (0.0, 0.0, width_m, south), door_y=south)

    for room in upper_rooms + lower_rooms:
        _furnish(rng, canvas, room)
    largest = max(upper_rooms[:-1] or upper_rooms, key=lambda r: (r[2] - r[0]) * (r[3] - r[1]))
    _slanted_wall(canvas, largest)
    _cut_corner(rng, canvas, upper_rooms[-1])
    return OccupancyGrid(
        canvas.cells,
        resolution,
        Pose2(-canvas.cell(0.3 * width_m) * resolution, -canvas.cell(south + 0.7) * resolution),
        "building",
    )


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
            canvas.room(box, UNKNOWN)
        else:
            leg = canvas.resolution
            for x in (left, left + wide - leg):
                for y in (low, low + deep - leg):
                    canvas.fill((x, y, x + leg, y + leg), OCCUPIED)


def _slanted_wall(canvas: Canvas, room: Rect) -> None:
    """Close off the upper left corner of a room by a wall at about 30 degrees."""
    x0, y0, x1, y1 = room
    reach_x, reach_y = 0.6 * (x1 - x0), 0.35 * (y1 - y0)
    x, up = canvas.offsets((x0, y1))
    y = -up
    inside = (x > 0) & (y > 0) & (x < reach_x) & (y < reach_y)
    distance = (1 - x / reach_x - y / reach_y) / np.hypot(1 / reach_x, 1 / reach_y)
    behind = inside & (distance > canvas.wall_m) & (canvas.cells != OCCUPIED)
    canvas.cells[behind] = UNKNOWN
    is_wall = (distance >= -canvas.wall_m / 2) & (distance <= canvas.wall_m)
    canvas.cells[inside & is_wall] = OCCUPIED


def _cut_corner(rng: np.random.Generator, canvas: Canvas, room: Rect) -> None:
    x0, y0, x1, y1 = room
    cut = y1 - (y1 - y0) * rng.uniform(0.35, 0.6)
    canvas.fill((x0, cut, x1, y1), UNKNOWN)
    canvas.fill((x0 - canvas.wall_m / 2, cut, x0 + canvas.wall_m / 2, y1), OCCUPIED)
    canvas.fill((x0, cut, x1, cut + canvas.wall_m), OCCUPIED)


def _office(rng: np.random.Generator, resolution: float) -> Floor:
    """A floor of rooms with doors along a corridor, furnished."""
    return Floor(draw_building(rng, 20.0, 14.0, resolution).with_name("office"), Pose2())


def _corridor(rng: np.random.Generator, resolution: float) -> Floor:
    """A corridor of 2 m around a core, with niches and pillars as landmarks."""
    wide, high, way = 28.0, 18.0, 2.0
    canvas = Canvas(wide, high, resolution)
    wall = canvas.wall_m
    canvas.room((0.0, 0.0, wide, high))
    canvas.room((way, way, wide - way, high - way), UNKNOWN)
    for x in rng.uniform(4.0, wide - 5.0, 5):
        low, top = (way, way + 0.5) if rng.random() < 0.5 else (high - way - 0.5, high - way)
        canvas.outline((x, low, x + 1.0, top))
        mouth = (low, top - wall) if low == way else (low + wall, top)
        canvas.fill((x + wall, mouth[0], x + 1.0 - wall, mouth[1]), FREE)
    for y in rng.uniform(4.0, high - 5.0, 4):
        x = 0.0 if rng.random() < 0.5 else wide - 0.35
        canvas.fill((x, y, x + 0.35, y + 0.3), OCCUPIED)
    middle = way / 2.0
    right, top = wide - middle, high - middle
    corners = [(middle, middle), (right, middle), (right, top), (middle, top)]
    start = (wide / 2.0, middle)
    # Once around and on to the second corner, so that places are seen twice.
    stops = [*corners[1:], corners[0], start, corners[1], corners[2]]
    return canvas.floor("corridor", start, stops)


def _hall(rng: np.random.Generator, resolution: float) -> Floor:
    """A hall of 24 m x 16 m with columns, crates at any angle and a shelf or two."""
    wide, high = 24.0, 16.0
    canvas = Canvas(wide, high, resolution)
    canvas.room((0.0, 0.0, wide, high))
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
    return canvas.floor("hall", start)


def _atrium(rng: np.random.Generator, resolution: float) -> Floor:
    """[F16]'s small atrium: an open rectangle with pillars and benches; its middle row is free."""
    wide, high = 9.0, 5.6
    canvas = Canvas(wide, high, resolution)
    canvas.room((0.0, 0.0, wide, high))
    for x in (2.3, 6.7):
        for y in (1.1, 4.5):
            canvas.disc((x + rng.uniform(-0.3, 0.3), y), 0.2, OCCUPIED)
    for y in (0.5, 5.1):
        canvas.turned_box((rng.uniform(3.5, 5.5), y), (1.6, 0.4), 0.0, OCCUPIED)
    planter = (rng.uniform(4.0, 5.0), rng.choice((1.6, 4.0)))
    canvas.turned_box(planter, (0.8, 0.5), rng.uniform(0.3, 1.2), OCCUPIED)
    canvas.fill((wide - 1.0, 0.0, wide, 1.2), OCCUPIED)
    return canvas.floor("atrium", (1.8, high / 2.0))


def _yard(rng: np.random.Generator, resolution: float) -> Floor:
    """[B16]'s outdoor yard: barricades around and across it; beams between them have no return."""
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
    return canvas.floor("yard", middle)


def _barricades(canvas: Canvas, start: F64, end: F64) -> None:
    """Set barricades of about 1.5 m along a line with gaps of 0.15 m."""
    x, y = end - start
    length, yaw = math.hypot(x, y), math.atan2(y, x)
    count = max(1, round(length / 1.6))
    for share in (np.arange(count) + 0.5) / count:
        centre = (start[0] + share * x, start[1] + share * y)
        canvas.turned_box(centre, (length / count - 0.15, 0.15), yaw, OCCUPIED)


def _inside(ring: F64, canvas: Canvas) -> B8:
    """Return which cell centres lie inside a closed ring of corners (N, 2), metres (even-odd)."""
    x, y = canvas.offsets((0.0, 0.0))
    inside = np.zeros(canvas.cells.shape, dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        crosses = (y0 <= y) != (y1 <= y)
        inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


WAY_M = 2.2
RING_DOOR_M = 1.0
RECESS_M = 0.3
# Rooms lie outside of a ring, in this margin of the canvas.
ROOM_M, MARGIN_M = 3.0, 3.6
# Period of pillars and doors that look alike.
PERIOD_M = 2.5
# Width kept free of furniture along the robot's path.
STRIP_M = 1.1


@dataclass(frozen=True)
class _Side:
    """The outer or inner wall of one side of a ring; lengths in metres.

    Attributes:
        start: corner of the corridor's middle line.
        step: unit vector along it.
        out: unit vector from the middle line to the wall.
        length_m: to the next corner.
    """

    canvas: Canvas
    start: Point
    step: Point
    out: Point
    length_m: float

    def middle(self) -> Point:
        """Return the middle of the side, metres."""
        x, y = (self.start[axis] + self.step[axis] * self.length_m / 2.0 for axis in (0, 1))
        return x, y

    def fill(self, along: Point, depth: Point, value: int) -> None:
        """Set a rectangle, by metres along the side and from its middle line."""
        corners = [
            [self.start[axis] + at * self.step[axis] + far * self.out[axis] for axis in (0, 1)]
            for at, far in zip(along, depth, strict=True)
        ]
        (x0, x1), (y0, y1) = (sorted(values) for values in zip(*corners, strict=True))
        self.canvas.fill((x0, y0, x1, y1), value)

    def recess(self, at: float, deep_m: float) -> None:
        """Draw a door set back into the wall."""
        half, wall = RING_DOOR_M / 2.0, self.canvas.wall_m
        face = WAY_M / 2.0 - wall
        self.fill((at - half - wall, at + half + wall), (face, face + deep_m + wall), OCCUPIED)
        self.fill((at - half, at + half), (face - wall, face + deep_m), FREE)

    def pillar(self, at: float, size: float) -> None:
        """Draw a square pillar at the wall."""
        face = WAY_M / 2.0
        self.fill((at - size / 2.0, at + size / 2.0), (face - size, face), OCCUPIED)

    def room(self, at: float, rng: np.random.Generator) -> None:
        """Open a room with a cupboard next to the corridor."""
        wall, half = self.canvas.wall_m, rng.uniform(1.2, 1.5)
        face, deep = WAY_M / 2.0 - wall, rng.uniform(2.0, ROOM_M)
        self.fill((at - half, at + half), (face, face + deep), OCCUPIED)
        self.fill((at - half + wall, at + half - wall), (face + wall, face + deep - wall), FREE)
        door = (at - RING_DOOR_M / 2.0, at + RING_DOOR_M / 2.0)
        self.fill(door, (face - wall, face + 2.0 * wall), FREE)
        left = rng.uniform(at - half, at + half - 0.5)
        back = face + deep - rng.uniform(0.4, 0.8)
        self.fill((left, left + 0.5), (back, face + deep), OCCUPIED)


def _ring(length_m: float, resolution: float) -> tuple[tuple[_Side, _Side], ...]:
    """Draw a ring of corridor; return the outer and the inner wall of each side."""
    long, high, half = 0.3 * length_m, 0.2 * length_m, WAY_M / 2.0
    low = MARGIN_M + half
    canvas = Canvas(long + 2.0 * low, high + 2.0 * low, resolution)
    canvas.room((low - half, low - half, low + long + half, low + high + half))
    canvas.room((low + half, low + half, low + long - half, low + high - half), UNKNOWN)
    outer = (
        _Side(canvas, (low, low), (1.0, 0.0), (0.0, -1.0), long),
        _Side(canvas, (low + long, low), (0.0, 1.0), (1.0, 0.0), high),
        _Side(canvas, (low + long, low + high), (-1.0, 0.0), (0.0, 1.0), long),
        _Side(canvas, (low, low + high), (0.0, -1.0), (-1.0, 0.0), high),
    )
    return tuple((side, replace(side, out=(-side.out[0], -side.out[1]))) for side in outer)


def _toured_ring(sides: tuple[tuple[_Side, _Side], ...], name: str) -> Floor:
    """Return a ring with a drive once around and to the middle of the next side."""
    first, second, *_ = (outer for outer, _ in sides)
    corners = [outer.start for outer, _ in sides]
    start = first.middle()
    stops = [*corners[1:], corners[0], start, corners[1], second.middle()]
    return first.canvas.floor(name, start, stops)


def _random_ring(rng: np.random.Generator, length_m: float, resolution: float) -> Floor:
    """A ring with random doors, rooms and pillars; ``length_m`` once around, at least 60 m."""
    sides = _ring(length_m, resolution)
    for side in itertools.chain(*sides):
        at = rng.uniform(2.2, 5.0)
        while at < side.length_m - 2.2:
            kind, size = rng.random(), rng.uniform(0.2, 0.4)
            # Near corners the rooms of two sides would overlap.
            is_free = MARGIN_M + WAY_M < at < side.length_m - MARGIN_M - WAY_M
            if kind < 0.3 and is_free:
                side.room(at, rng)
            elif kind < 0.8:
                side.recess(at, RECESS_M)
            else:
                side.pillar(at, size)
            at += rng.uniform(3.0, 7.0)
    return _toured_ring(sides, f"ring-{length_m:g}")


def _pillars(rng: np.random.Generator, resolution: float) -> Floor:
    """A ring of 80 m with pillars and doors ``PERIOD_M`` apart."""
    sides = _ring(80.0, resolution)
    deep_m, thick_m = rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.35)
    for outer, inner in sides:
        count = int((outer.length_m - 2.0 * WAY_M) / PERIOD_M)
        first = (outer.length_m - (count - 1) * PERIOD_M) / 2.0
        for at in first + PERIOD_M * np.arange(count):
            outer.recess(float(at), deep_m)
            inner.pillar(float(at), thick_m)
    return _toured_ring(sides, "pillars")


def _wings(rng: np.random.Generator, resolution: float) -> Floor:
    """Two identical wings on a plain hallway; the drive visits the first, the second, the first."""
    wide, deep, apart, way = 8.0, 9.0, 3.0, 2.4
    wing = Canvas(wide, deep, resolution)
    wing.fill((0.0, 0.0, wide, deep), FREE)
    door, middle = (wide / 2.0, 0.0), deep / 2.0
    inside = [(4.0, 1.5), (2.0, 3.0), (2.0, 6.8), (2.0, 3.0), (6.0, 3.0), (6.0, 6.8), (6.0, 3.0)]
    _fill_room(wing, rng, 14, [door, *inside, (4.0, 1.5)])
    wall = wing.wall_m
    wing.fill((0.0, middle - wall / 2.0, wide, middle + wall / 2.0), OCCUPIED)
    wing.fill((door[0] - wall / 2.0, middle, door[0] + wall / 2.0, deep), OCCUPIED)
    wing.outline((0.0, 0.0, wide, deep))
    for x, y in (door, (2.0, middle), (6.0, middle)):
        wing.fill((x - RING_DOOR_M / 2.0, y - wall, x + RING_DOOR_M / 2.0, y + wall), FREE)

    long = 2.0 * wide + 3.0 * apart
    canvas = Canvas(long, way + deep, resolution)
    canvas.room((0.0, 0.0, long, way))
    lefts = (apart, 2.0 * apart + wide)
    for left in lefts:
        _paste(canvas, wing, (left, way - wall))
    start = (lefts[0] + door[0], way / 2.0)
    visits = [
        [(left + x, way + y) for x, y in (*inside, inside[0])] + [(left + door[0], way / 2.0)]
        for left in lefts
    ]
    stops = [*visits[0], (lefts[1] + door[0], way / 2.0), *visits[1], start, *visits[0]]
    return canvas.floor("wings", start, stops)


def _rooms(rng: np.random.Generator, resolution: float) -> Floor:
    """Eight identical rooms along a plain corridor; the drive returns to some of them."""
    count, side, way = 8, 4.0, 2.0
    door, turn = (side / 2.0, 0.0), (side / 2.0, side / 2.0)
    room = Canvas(side, side, resolution)
    room.fill((0.0, 0.0, side, side), FREE)
    _fill_room(room, rng, 7, [door, turn])
    room.outline((0.0, 0.0, side, side))
    wall = room.wall_m
    room.fill((door[0] - RING_DOOR_M / 2.0, 0.0, door[0] + RING_DOOR_M / 2.0, wall), FREE)

    long = count * side + wall
    canvas = Canvas(long, way + side, resolution)
    canvas.room((0.0, 0.0, long, way))
    for number in range(count):
        _paste(canvas, room, (number * side, way - wall))
    canvas.fill((long - 2.0 * wall, way, long, way + side), OCCUPIED)
    stops: list[Point] = []
    for number in (*range(count), 5, 2, 0):
        x = number * side + door[0]
        stops += [(x, way / 2.0), (x, way + turn[1]), (x, way / 2.0)]
    return canvas.floor("rooms", stops[0], stops[1:])


def _fill_room(canvas: Canvas, rng: np.random.Generator, count: int, way: list[Point]) -> None:
    """Put cupboards and crates into a place, except on the robot's path."""
    high, wide = (size * canvas.resolution for size in canvas.cells.shape)
    for _ in range(count):
        centre = (rng.uniform(0.0, wide), rng.uniform(0.0, high))
        size = (rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.6))
        canvas.turned_box(centre, size, rng.choice((0.0, 0.4, np.pi / 2.0)), OCCUPIED)
    for (x0, y0), (x1, y1) in itertools.pairwise(way):
        middle, length = ((x0 + x1) / 2.0, (y0 + y1) / 2.0), np.hypot(x1 - x0, y1 - y0)
        yaw_rad = float(np.arctan2(y1 - y0, x1 - x0))
        canvas.turned_box(middle, (float(length) + STRIP_M, STRIP_M), yaw_rad, FREE)


def _paste(canvas: Canvas, part: Canvas, corner: Point) -> None:
    """Copy a part's cells, with its lower-left corner at ``corner``."""
    col, row = (canvas.cell(length) for length in corner)
    height, width = part.cells.shape
    place = canvas.cells[row : row + height, col : col + width]
    place[:] = part.cells[: place.shape[0], : place.shape[1]]


_DRAWINGS: dict[str, Callable[[np.random.Generator, float], Floor]] = {
    "office": _office,
    "corridor": _corridor,
    "hall": _hall,
    "atrium": _atrium,
    "yard": _yard,
    "ring-100": lambda rng, cell_m: _random_ring(rng, 100.0, cell_m),
    "ring-300": lambda rng, cell_m: _random_ring(rng, 300.0, cell_m),
    "wings": _wings,
    "pillars": _pillars,
    "rooms": _rooms,
}
