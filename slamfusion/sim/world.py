"""``World``: a place whose every wall, pane and person is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import GLASS, OPEN, WALL
from slamfusion.config import ObstacleConfig, PersonConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

Point = tuple[float, float]


@dataclass(frozen=True)
class Person:
    """Someone who walks to and fro; never part of the truth map.

    Attributes:
        waypoints: x and y in metres, map frame; walked from first to last and back, around walls.
        settings: speed and shape.
    """

    waypoints: tuple[Point, ...]
    settings: PersonConfig


@dataclass(frozen=True, eq=False)
class World:
    """A place to drive in; immutable.

    Attributes:
        grid: the truth: free, occupied (glass too) or unknown; unknown lets beams pass.
        glass: (H, W) bool, cells of glass among the occupied ones.
        wall_height_m: a beam that is higher than this at a wall passes over it.
        people: who walks about.
        obstacles: cables and ramps on the floor; no laser sees them.

    Raises:
        SimulationError: glass where no wall is, or of another shape.
    """

    grid: OccupancyGrid
    glass: npt.NDArray[np.bool_]
    wall_height_m: float = 2.5
    people: tuple[Person, ...] = ()
    obstacles: tuple[ObstacleConfig, ...] = ()

    def __post_init__(self) -> None:
        """Check that glass is wall, then freeze."""
        glass = np.array(self.glass, dtype=np.bool_)
        if glass.shape != self.grid.cells.shape or (self.grid.cells[glass] != OCCUPIED).any():
            message = (
                f"{self.grid.name}: glass must be occupied cells of the {self.grid.cells.shape} "
                f"truth, found {glass.shape}"
            )
            raise SimulationError(message)
        glass.flags.writeable = False
        object.__setattr__(self, "glass", glass)

    def classes(self) -> npt.NDArray[np.uint8]:
        """Return what beams meet, (H, W) uint8: 0 open, 1 wall, 2 glass."""
        solid = np.where(self.grid.cells == OCCUPIED, WALL, OPEN)
        return np.asarray(np.where(self.glass, GLASS, solid), dtype=np.uint8)


def thin_walls(truth: OccupancyGrid) -> OccupancyGrid:
    """Return a true map with only the surfaces of its walls: what a perfect lidar could map.

    An occupied cell that shares a side with a free cell stays occupied; other occupied cells, the
    inside of walls and furniture, become unknown.

    Args:
        truth: cells -1, 0 or 100.

    Returns:
        The same lattice and name.
    """
    free = np.pad(truth.cells == FREE, 1)
    next_to_free = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
    is_inside = (truth.cells == OCCUPIED) & ~next_to_free
    cells = np.where(is_inside, np.int8(UNKNOWN), truth.cells)
    return OccupancyGrid(cells, truth.resolution, truth.origin, truth.name)


def zone_place(
    obstacle: ObstacleConfig, points: npt.ArrayLike
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return how far across a ground obstacle points are, and whether they are on it.

    Args:
        obstacle: the strip on the floor.
        points: (..., 2) metres, map frame.

    Returns:
        (...) share of the way across, -0.5 to 0.5 on it; (...) bool.
    """
    own = Pose2(obstacle.x_m, obstacle.y_m, obstacle.yaw_rad).inverse().transform(points)
    across = own[..., 0] / obstacle.across_m
    on = (np.abs(across) <= 0.5) & (np.abs(own[..., 1]) <= obstacle.along_m / 2.0)
    return across, on


def tilt_of(world: World, poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return how the ground obstacles tilt a robot.

    The wheels climb one after the other: on the near half the leading side is up, on the far half
    it is down.

    Args:
        world: with its obstacles.
        poses: (N, 3) x, y, yaw of the robot in the map frame.

    Returns:
        (N, 2) radians: pitch (nose up is positive) and roll (left side up is positive).
    """
    tilt = np.zeros((len(poses), 2))
    for obstacle in world.obstacles:
        across, on = zone_place(obstacle, poses[:, :2])
        rise = np.where(on, -obstacle.pitch_rad * np.sin(2.0 * np.pi * across), 0.0)
        heading = poses[:, 2] - obstacle.yaw_rad
        tilt[:, 0] += rise * np.cos(heading)
        tilt[:, 1] -= rise * np.sin(heading)
    return tilt
