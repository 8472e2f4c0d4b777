"""Draw floors: buildings with rooms, and corridors and copies of rooms that mislead a SLAM.

A ring closes late, when the odometry has drifted. In the others parts are copies of one another, to
the cell: two wings, a row of rooms, a ring of pillars and doors that are all one distance apart. A
match on the wrong copy is as good as one on the right copy; only the way there tells them apart.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import F64, Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

WALL_M = 0.1
# A rectangle as x0, y0, x1, y1 in metres from the canvas's lower-left corner.
Rect = tuple[float, float, float, float]


class Canvas:
    """Cells to draw on in metres from the lower-left corner; all unknown at first.

    Attributes:
        cells: (H, W) int8, in {-1, 0, 100}.
        resolution: metres per cell.
        wall_m: how thick walls are drawn: 0.1 m, at least one cell.
    """

    def __init__(self, width_m: float, height_m: float, resolution: float) -> None:
        self.resolution = resolution
        shape = (self.cell(height_m), self.cell(width_m))
        self.cells: npt.NDArray[np.int8] = np.full(shape, UNKNOWN, dtype=np.int8)
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

    def turned_box(
        self, centre: tuple[float, float], size: tuple[float, float], yaw_rad: float, value: int
    ) -> None:
        """Set the cells whose centre lies in a rectangle that may be turned.

        Args:
            centre: metres.
            size: length along its own x and y, metres; at least a cell and a half, so that a thin
                turned wall has no holes.
        """
        x, y = self._offsets(centre)
        along = np.abs(math.cos(yaw_rad) * x + math.sin(yaw_rad) * y)
        across = np.abs(math.cos(yaw_rad) * y - math.sin(yaw_rad) * x)
        half_x, half_y = (max(side, 1.5 * self.resolution) / 2.0 for side in size)
        self.cells[(along <= half_x) & (across <= half_y)] = value

    def disc(self, centre: tuple[float, float], radius_m: float, value: int) -> None:
        """Set the cells whose centre lies in a disc."""
        x, y = self._offsets(centre)
        self.cells[np.hypot(x, y) <= max(radius_m, self.resolution)] = value

    def _offsets(self, centre: tuple[float, float]) -> tuple[F64, F64]:
        """Return x (1, W) and y (H, 1) of every cell centre from a point, metres."""
        rows, cols = (np.arange(size, dtype=np.float64) + 0.5 for size in self.cells.shape)
        x = np.asarray(cols * self.resolution - centre[0], dtype=np.float64)
        y = np.asarray(rows * self.resolution - centre[1], dtype=np.float64)
        return x[None, :], y[:, None]


MIN_SIDE_M = 6.0
DOOR_M = 0.9


def draw_building(
    rng: np.random.Generator, width_m: float, height_m: float, resolution: float = 0.05
) -> OccupancyGrid:
    """Draw a building as the map that a perfect SLAM would make of it.

    Rooms of unequal width line a corridor, one outer corner is missing, one room has a slanted
    wall: no turn of the building looks like another. Walls are 0.1 m thick (at least one cell).

    Args:
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
    x0, y0, x1, y1 = room
    cut = y1 - (y1 - y0) * rng.uniform(0.35, 0.6)
    canvas.fill((x0, cut, x1, y1), UNKNOWN)
    canvas.fill((x0 - canvas.wall_m / 2, cut, x0 + canvas.wall_m / 2, y1), OCCUPIED)
    canvas.fill((x0, cut, x1, cut + canvas.wall_m), OCCUPIED)


Point = tuple[float, float]

WAY_M = 2.2
RING_DOOR_M = 1.0
RECESS_M = 0.3
# Rooms lie outside of a ring, and this much of the canvas is theirs.
ROOM_M, MARGIN_M = 3.0, 3.6
# Pillars and doors that look like the next one are this far from it.
PERIOD_M = 2.5
# A strip of this width is kept free of furniture where the robot is to drive.
STRIP_M = 1.1


@dataclass(frozen=True)
class _Side:
    """One side of a ring.

    Attributes:
        start: corner of the middle line where it begins, metres.
        step: unit vector along it.
        out: unit vector away from the ring's inside.
        length_m: to the next corner.
    """

    start: Point
    step: Point
    out: Point
    length_m: float

    def rect(self, along: tuple[float, float], depth: tuple[float, float]) -> Rect:
        """Return a rectangle, by metres along the side and metres outwards of its middle line."""
        corners = [
            [self.start[axis] + at * self.step[axis] + far * self.out[axis] for axis in (0, 1)]
            for at, far in zip(along, depth, strict=True)
        ]
        (x0, x1), (y0, y1) = (sorted(values) for values in zip(*corners, strict=True))
        return x0, y0, x1, y1


def draw_ring(
    rng: np.random.Generator, length_m: float, resolution: float
) -> tuple[OccupancyGrid, tuple[Point, ...]]:
    """Draw a ring of corridor with doors, rooms and pillars at random.

    Args:
        length_m: of the middle line once around, at least 60 m.
        resolution: metres per cell.

    Returns:
        The truth, zero of the map frame in the middle of the lower side; and the stops of a drive
        once around and on to the middle of the next side, metres.
    """
    canvas, sides = _ring(length_m, resolution)
    for side in sides:
        for outwards in (1.0, -1.0):
            at = rng.uniform(2.2, 5.0)
            while at < side.length_m - 2.2:
                _feature(canvas, side, at, outwards, rng)
                at += rng.uniform(3.0, 7.0)
    return _toured_ring(canvas, sides, f"ring-{length_m:g}")


def draw_pillars(
    rng: np.random.Generator, resolution: float
) -> tuple[OccupancyGrid, tuple[Point, ...]]:
    """Draw a ring of 80 m with pillars and doors ``PERIOD_M`` apart, as ``draw_ring`` returns it.

    Args:
        resolution: metres per cell.
    """
    canvas, sides = _ring(80.0, resolution)
    deep_m, thick_m = rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.35)
    for side in sides:
        count = int((side.length_m - 2.0 * WAY_M) / PERIOD_M)
        first = (side.length_m - (count - 1) * PERIOD_M) / 2.0
        for at in first + PERIOD_M * np.arange(count):
            _recess(canvas, side, float(at), 1.0, deep_m)
            _pillar(canvas, side, float(at), -1.0, thick_m)
    return _toured_ring(canvas, sides, "pillars")


def draw_wings(
    rng: np.random.Generator, resolution: float
) -> tuple[OccupancyGrid, tuple[Point, ...]]:
    """Draw two wings, each a copy of the other, on one side of a plain hallway.

    Args:
        resolution: metres per cell.

    Returns:
        The truth, zero of the map frame before the first wing's door; and the stops of a drive
        through the first wing, the second, and the first again, metres.
    """
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
    canvas.fill((0.0, 0.0, long, way), FREE)
    canvas.outline((0.0, 0.0, long, way))
    lefts = (apart, 2.0 * apart + wide)
    for left in lefts:
        _paste(canvas, wing, (left, way - wall))
    start = (lefts[0] + door[0], way / 2.0)
    visits = [
        [(left + x, way + y) for x, y in (*inside, inside[0])] + [(left + door[0], way / 2.0)]
        for left in lefts
    ]
    stops = [*visits[0], (lefts[1] + door[0], way / 2.0), *visits[1], start, *visits[0]]
    return _from(start, canvas, stops, "wings")


def draw_rooms(
    rng: np.random.Generator, resolution: float
) -> tuple[OccupancyGrid, tuple[Point, ...]]:
    """Draw eight rooms in a row, each a copy of the others, along a plain corridor.

    Args:
        resolution: metres per cell.

    Returns:
        The truth, zero of the map frame before the first room's door; and the stops of a drive
        into every room and back into some of them, metres.
    """
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
    canvas.fill((0.0, 0.0, long, way), FREE)
    canvas.outline((0.0, 0.0, long, way))
    for number in range(count):
        _paste(canvas, room, (number * side, way - wall))
    canvas.fill((long - 2.0 * wall, way, long, way + side), OCCUPIED)
    stops: list[Point] = []
    for number in (*range(count), 5, 2, 0):
        x = number * side + door[0]
        stops += [(x, way / 2.0), (x, way + turn[1]), (x, way / 2.0)]
    return _from(stops[0], canvas, stops[1:], "rooms")


# --- parts ---------------------------------------------------------------------------------------


def _ring(length_m: float, resolution: float) -> tuple[Canvas, tuple[_Side, ...]]:
    long, high, half = 0.3 * length_m, 0.2 * length_m, WAY_M / 2.0
    low = MARGIN_M + half
    canvas = Canvas(long + 2.0 * low, high + 2.0 * low, resolution)
    outer = (low - half, low - half, low + long + half, low + high + half)
    inner = (low + half, low + half, low + long - half, low + high - half)
    canvas.fill(outer, FREE)
    canvas.outline(outer)
    canvas.fill(inner, UNKNOWN)
    canvas.outline(inner)
    return canvas, (
        _Side((low, low), (1.0, 0.0), (0.0, -1.0), long),
        _Side((low + long, low), (0.0, 1.0), (1.0, 0.0), high),
        _Side((low + long, low + high), (-1.0, 0.0), (0.0, 1.0), long),
        _Side((low, low + high), (0.0, -1.0), (-1.0, 0.0), high),
    )


def _toured_ring(
    canvas: Canvas, sides: tuple[_Side, ...], name: str
) -> tuple[OccupancyGrid, tuple[Point, ...]]:
    corners = [side.start for side in sides]
    start = _half_way(sides[0])
    stops = [*corners[1:], corners[0], start, corners[1], _half_way(sides[1])]
    return _from(start, canvas, stops, name)


def _half_way(side: _Side) -> Point:
    x, y = (side.start[axis] + side.step[axis] * side.length_m / 2.0 for axis in (0, 1))
    return x, y


def _feature(
    canvas: Canvas, side: _Side, at: float, outwards: float, rng: np.random.Generator
) -> None:
    """Draw a door, a room or a pillar at a place of one wall."""
    kind, size = rng.random(), rng.uniform(0.2, 0.4)
    # In the corners the room of one side would meet that of the next.
    is_free = MARGIN_M + WAY_M < at < side.length_m - MARGIN_M - WAY_M
    if kind < 0.3 and is_free:
        _room(canvas, side, at, outwards, rng)
    elif kind < 0.8:
        _recess(canvas, side, at, outwards, RECESS_M)
    else:
        _pillar(canvas, side, at, outwards, size)


def _recess(canvas: Canvas, side: _Side, at: float, outwards: float, deep_m: float) -> None:
    half, wall = RING_DOOR_M / 2.0, canvas.wall_m
    face = WAY_M / 2.0 - wall
    around, mouth = (at - half - wall, at + half + wall), (at - half, at + half)
    canvas.fill(side.rect(around, _out(outwards, face, face + deep_m + wall)), OCCUPIED)
    canvas.fill(side.rect(mouth, _out(outwards, face - wall, face + deep_m)), FREE)


def _pillar(canvas: Canvas, side: _Side, at: float, outwards: float, size: float) -> None:
    face = WAY_M / 2.0
    along = (at - size / 2.0, at + size / 2.0)
    canvas.fill(side.rect(along, _out(outwards, face - size, face)), OCCUPIED)


def _room(
    canvas: Canvas, side: _Side, at: float, outwards: float, rng: np.random.Generator
) -> None:
    """Open a room with a cupboard beside the corridor."""
    wall, half = canvas.wall_m, rng.uniform(1.2, 1.5)
    face, deep = WAY_M / 2.0 - wall, rng.uniform(2.0, ROOM_M)
    canvas.fill(side.rect((at - half, at + half), _out(outwards, face, face + deep)), OCCUPIED)
    inside = (at - half + wall, at + half - wall)
    canvas.fill(side.rect(inside, _out(outwards, face + wall, face + deep - wall)), FREE)
    door = (at - RING_DOOR_M / 2.0, at + RING_DOOR_M / 2.0)
    canvas.fill(side.rect(door, _out(outwards, face - wall, face + 2.0 * wall)), FREE)
    left = rng.uniform(at - half, at + half - 0.5)
    back = face + deep - rng.uniform(0.4, 0.8)
    canvas.fill(side.rect((left, left + 0.5), _out(outwards, back, face + deep)), OCCUPIED)


def _out(outwards: float, near: float, far: float) -> tuple[float, float]:
    """Return depths on the outer side of a ring, or on the inner one (-1)."""
    return outwards * near, outwards * far


def _fill_room(canvas: Canvas, rng: np.random.Generator, count: int, way: list[Point]) -> None:
    """Put cupboards and crates into a place, but not where the robot is to drive."""
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
    """Copy a part's cells, its lower-left corner at a place."""
    col, row = (canvas.cell(length) for length in corner)
    height, width = part.cells.shape
    place = canvas.cells[row : row + height, col : col + width]
    place[:] = part.cells[: place.shape[0], : place.shape[1]]


def _from(
    start: Point, canvas: Canvas, stops: list[Point], name: str
) -> tuple[OccupancyGrid, tuple[Point, ...]]:
    """Return grid and stops with the zero of the map frame at the start."""
    grid = OccupancyGrid(canvas.cells, canvas.resolution, Pose2(-start[0], -start[1]), name)
    return grid, tuple((x - start[0], y - start[1]) for x, y in stops)
