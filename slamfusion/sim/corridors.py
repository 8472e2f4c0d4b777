"""Draw floors that mislead a SLAM: long rings of corridor, and places that look like others.

A ring closes late, when the odometry has drifted. In the others parts are copies of one another, to
the cell: two wings, a row of rooms, a ring of pillars and doors that are all one distance apart. A
match on the wrong copy is as good as one on the right copy; only the way there tells them apart.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.sim.canvas import Canvas, Rect

Point = tuple[float, float]

WAY_M = 2.2
DOOR_M = 1.0
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
        rng: source of every random choice.
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
    """Draw a ring of 80 m whose pillars and doors are all ``PERIOD_M`` apart, on every side.

    Args:
        rng: how deep the doors and how thick the pillars are; all of them alike.
        resolution: metres per cell.

    Returns:
        See ``draw_ring``.
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
        rng: furniture of the wing.
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
    _furnish(wing, rng, 14, [door, *inside, (4.0, 1.5)])
    wall = wing.wall_m
    wing.fill((0.0, middle - wall / 2.0, wide, middle + wall / 2.0), OCCUPIED)
    wing.fill((door[0] - wall / 2.0, middle, door[0] + wall / 2.0, deep), OCCUPIED)
    wing.outline((0.0, 0.0, wide, deep))
    for x, y in (door, (2.0, middle), (6.0, middle)):
        wing.fill((x - DOOR_M / 2.0, y - wall, x + DOOR_M / 2.0, y + wall), FREE)

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
        rng: furniture of the room.
        resolution: metres per cell.

    Returns:
        The truth, zero of the map frame before the first room's door; and the stops of a drive
        into every room and back into some of them, metres.
    """
    count, side, way = 8, 4.0, 2.0
    door, turn = (side / 2.0, 0.0), (side / 2.0, side / 2.0)
    room = Canvas(side, side, resolution)
    room.fill((0.0, 0.0, side, side), FREE)
    _furnish(room, rng, 7, [door, turn])
    room.outline((0.0, 0.0, side, side))
    wall = room.wall_m
    room.fill((door[0] - DOOR_M / 2.0, 0.0, door[0] + DOOR_M / 2.0, wall), FREE)

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
    """Draw a bare ring, three to two, and return its sides, the lower one first."""
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
    """Set a closed door back from the wall."""
    half, wall = DOOR_M / 2.0, canvas.wall_m
    face = WAY_M / 2.0 - wall
    around, mouth = (at - half - wall, at + half + wall), (at - half, at + half)
    canvas.fill(side.rect(around, _out(outwards, face, face + deep_m + wall)), OCCUPIED)
    canvas.fill(side.rect(mouth, _out(outwards, face - wall, face + deep_m)), FREE)


def _pillar(canvas: Canvas, side: _Side, at: float, outwards: float, size: float) -> None:
    """Set a pillar before the wall."""
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
    door = (at - DOOR_M / 2.0, at + DOOR_M / 2.0)
    canvas.fill(side.rect(door, _out(outwards, face - wall, face + 2.0 * wall)), FREE)
    left = rng.uniform(at - half, at + half - 0.5)
    back = face + deep - rng.uniform(0.4, 0.8)
    canvas.fill(side.rect((left, left + 0.5), _out(outwards, back, face + deep)), OCCUPIED)


def _out(outwards: float, near: float, far: float) -> tuple[float, float]:
    """Return depths on the outer side of a ring, or on the inner one (-1)."""
    return outwards * near, outwards * far


def _furnish(canvas: Canvas, rng: np.random.Generator, count: int, way: list[Point]) -> None:
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
