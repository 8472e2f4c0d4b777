"""``World``: the simulated place, and what a lidar measures in it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import GLASS, OPEN, WALL
from slamfusion.config import LidarConfig, ObstacleConfig, PersonConfig
from slamfusion.geometry import B8, F32, F64, U8, Pose2, compose_poses
from slamfusion.grid import OCCUPIED, UNKNOWN, OccupancyGrid, face_cells


@dataclass(frozen=True, eq=False)
class World:
    """A place to drive in.

    Attributes:
        grid: the truth: free, occupied (glass too) or unknown, which beams pass.
        glass: (H, W) bool, glass among the occupied cells.
        wall_height_m: a beam higher than this passes over walls.
        obstacles: cables and ramps on the floor, invisible to lasers.
    """

    grid: OccupancyGrid
    glass: B8
    wall_height_m: float = 2.5
    people: tuple[PersonConfig, ...] = ()
    obstacles: tuple[ObstacleConfig, ...] = ()

    def classes(self) -> U8:
        """Return beam targets, (H, W) uint8: 0 open, 1 wall, 2 glass."""
        solid = np.where(self.grid.cells == OCCUPIED, WALL, OPEN)
        return np.asarray(np.where(self.glass, GLASS, solid), dtype=np.uint8)


def thin_walls(truth: OccupancyGrid) -> OccupancyGrid:
    """Return a true map with only the surfaces of its walls, as a perfect lidar would map it.

    An occupied cell stays if it shares a side with a free cell; other occupied cells become
    unknown.
    """
    is_inside = (truth.cells == OCCUPIED) & ~face_cells(truth.cells)
    cells = np.where(is_inside, np.int8(UNKNOWN), truth.cells)
    return OccupancyGrid(cells, truth.resolution, truth.origin, truth.name)


def zone_place(obstacle: ObstacleConfig, points: npt.ArrayLike) -> tuple[F64, B8]:
    """Return where points (..., 2) are across an obstacle, and whether they are on it.

    Points in metres, map frame; the share across is -0.5 to 0.5 on the obstacle.
    """
    own = Pose2(obstacle.x_m, obstacle.y_m, obstacle.yaw_rad).inverse().transform(points)
    across = own[..., 0] / obstacle.across_m
    on = (np.abs(across) <= 0.5) & (np.abs(own[..., 1]) <= obstacle.along_m / 2.0)
    return across, on


def tilt_of(world: World, poses: F64) -> F64:
    """Return how the ground obstacles tilt a robot at poses (N, 3) in the map frame.

    The wheels climb one after the other: on the near half the leading side is up, on the far half
    it is down.

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


# Kinect's noise is the axial one of Nguyen, Izadi and Lovell (3DIMPVT 2012), 0.0012 m and
# 0.0019 (r - 0.4 m)^2 / m, rounded to the terms in 1 and r^2; a laser scan is made of every second
# column of its picture.
# Hokuyo, RPLIDAR and LDS-01 are of the size that their data sheets (UTM-30LX, A1, LDS-01) state.
# The A1, here at its fastest, turns clockwise, and [B16] found its far returns noisy and often
# missing. These two turn so slowly that the robot moves within a sweep; the UTM-30LX takes 0.02 s.
LIDARS: dict[str, LidarConfig] = {
    "kinect": LidarConfig(
        model="kinect",
        beams=320,
        view_rad=math.radians(57.0),
        rate_hz=10.0,
        range_min_m=0.45,
        range_max_m=4.0,
        noise_m=0.001,
        noise_per_m=0.0,
        noise_per_m2=0.0017,
        dropout_share=0.005,
        dropout_far_share=0.05,
        outlier_share=0.0,
        mixed_share=0.1,
    ),
    "hokuyo": LidarConfig(),
    "rplidar": LidarConfig(
        model="rplidar",
        beams=360,
        view_rad=math.radians(359.0),
        clockwise=True,
        rate_hz=10.0,
        turn_s=0.1,
        range_min_m=0.15,
        range_max_m=6.0,
        noise_m=0.005,
        noise_per_m=0.01,
        noise_per_m2=0.0,
        dropout_share=0.02,
        dropout_far_share=0.6,
        outlier_share=0.005,
        mixed_share=0.4,
        mount_x_m=0.0,
    ),
    "lds01": LidarConfig(
        model="lds01",
        beams=360,
        view_rad=math.radians(359.0),
        rate_hz=5.0,
        turn_s=0.2,
        range_min_m=0.12,
        range_max_m=3.5,
        noise_m=0.01,
        noise_per_m=0.01,
        dropout_share=0.02,
        dropout_far_share=0.3,
        outlier_share=0.005,
        mixed_share=0.4,
        mount_x_m=-0.03,
    ),
}

# Rays of one launch, in whole sweeps.
RAYS = 1 << 18
# Neighbouring beams that differ by this are at a depth edge.
EDGE_M = 0.3
# Share of beams that glass reflects at normal incidence; from this angle on, none.
GLASS_RETURN_SHARE, GLASS_ANGLE_RAD = 0.9, 0.35


def mount_of(lidar: LidarConfig) -> Pose2:
    """Return the laser's pose in the base frame."""
    return Pose2(lidar.mount_x_m, lidar.mount_y_m, lidar.mount_yaw_rad)


def beam_angles(lidar: LidarConfig) -> tuple[float, float]:
    """Return first angle and step in the laser's frame, radians; its middle looks along x."""
    if lidar.beams == 1:
        return 0.0, lidar.view_rad
    turn = -1.0 if lidar.clockwise else 1.0
    return -turn * lidar.view_rad / 2.0, turn * lidar.view_rad / (lidar.beams - 1)


def sweep_ranges(
    world: World,
    lidar: LidarConfig,
    poses: F64,
    people: tuple[F64, F64],
    device: ComputeDevice,
    rng: np.random.Generator,
) -> Iterator[F32]:
    """Yield one sweep from each pose.

    Args:
        poses: (N, B, 3) true x, y, yaw of the base in the map frame at each beam, or (N, 1, 3) if
            all beams of a sweep have one time.
        people: (N, D, 2) centres and (D,) radii of discs, from ``people.walk``.

    Yields:
        (B,) float32 metres, by REP-117: +inf no return or a failed reading, -inf too close.
    """
    sight = _Sight(world, lidar, device)
    at_once = max(1, RAYS // lidar.beams)
    centres, radii = people
    for first in range(0, len(poses), at_once):
        some = np.s_[first : first + at_once]
        true = sight.see(poses[some], centres[some], radii, rng)
        yield from _with_errors(true, lidar, rng)


class _Sight:
    """True ranges, without measurement errors."""

    def __init__(self, world: World, lidar: LidarConfig, device: ComputeDevice) -> None:
        self.world, self.lidar, self.device = world, lidar, device
        self.cells = device.upload(world.classes())
        first, step = beam_angles(lidar)
        self.angles: F64 = np.asarray(first + step * np.arange(lidar.beams), dtype=np.float64)

    def see(self, poses: F64, centres: F64, radii: F64, rng: np.random.Generator) -> F64:
        """Return the true ranges (N, B), metres; infinite if nothing is in reach."""
        mount = mount_of(self.lidar)
        laser = compose_poses(poses, (mount.x, mount.y, mount.yaw_rad))
        directions = laser[..., 2] + self.angles
        cos, sin = np.cos(directions), np.sin(directions)
        flat = self._walls(laser, cos, sin, rng)
        for disc, radius_m in enumerate(radii):
            flat = np.minimum(flat, _to_disc(laser, centres[:, disc], float(radius_m), cos, sin))
        return self._tilted(flat, tilt_of(self.world, poses[:, 0]))

    def _walls(self, laser: F64, cos: F64, sin: F64, rng: np.random.Generator) -> F64:
        """Return distances in the plane to the first wall or reflecting glass."""
        grid, lidar = self.world.grid, self.lidar
        origin = grid.origin
        own = origin.inverse().transform(laser[..., :2]) / grid.resolution
        turn_cos, turn_sin = math.cos(origin.yaw_rad), math.sin(origin.yaw_rad)
        rays = np.empty((*cos.shape, 4), dtype=np.float32)
        rays[..., :2] = own
        rays[..., 2] = turn_cos * cos + turn_sin * sin
        rays[..., 3] = turn_cos * sin - turn_sin * cos
        reach = (lidar.range_max_m + 1.0) / grid.resolution
        hits = self.device.cast_rays(self.cells, rays.reshape(-1, 4), reach)
        first, met, cosine, behind = hits.astype(np.float64).T
        # Glass reflects nearly normal beams; the rest passes every pane.
        slant = np.arccos(np.clip(cosine, 0.0, 1.0)) / GLASS_ANGLE_RAD
        chance = GLASS_RETURN_SHARE * np.clip(1.0 - slant, 0.0, 1.0)
        passes = (met == GLASS) & (rng.random(len(met)) >= chance)
        return np.asarray(np.where(passes, behind, first) * grid.resolution).reshape(cos.shape)

    def _tilted(self, flat: F64, tilt: F64) -> F64:
        """Return ranges along a tilted laser plane.

        A beam that rises by e meets a wall at distance d at d / cos e, or passes over it; one that
        falls meets the floor at h / sin e. Beams keep their bearing.
        """
        some = np.flatnonzero(tilt.any(axis=1))
        if not some.size:
            return flat
        height_m = self.lidar.height_m
        bearings = self.angles + self.lidar.mount_yaw_rad
        pitch, roll = tilt[some, 0, None], tilt[some, 1, None]
        rise = pitch * np.cos(bearings) + roll * np.sin(bearings)
        seen = flat[some]
        at_wall = height_m + seen * np.tan(rise)
        ranges = np.where(at_wall > self.world.wall_height_m, np.inf, seen / np.cos(rise))
        with np.errstate(divide="ignore"):
            floor = np.where(rise < 0.0, height_m / np.abs(np.sin(rise)), np.inf)
        out = flat.copy()
        out[some] = np.minimum(ranges, floor)
        return out


def _to_disc(laser: F64, centres: F64, radius_m: float, cos: F64, sin: F64) -> F64:
    """Return the distance (N, B) to a disc; infinite if missed, behind the laser or from inside."""
    x, y = np.moveaxis(centres[:, None] - laser[..., :2], -1, 0)
    along = x * cos + y * sin
    inside = radius_m**2 - (x**2 + y**2) + along**2
    hit = (inside > 0.0) & (along > 0.0) & (np.hypot(x, y) > radius_m)
    return np.asarray(np.where(hit, along - np.sqrt(np.maximum(inside, 0.0)), np.inf))


def _with_errors(true: F64, lidar: LidarConfig, rng: np.random.Generator) -> F32:
    """Return the measured ranges for true ranges (N, B), by REP-117."""
    shape = true.shape
    ranges = np.where(true > lidar.range_max_m, np.inf, true)

    # A beam half on an edge reads a value between near and far.
    behind = np.roll(ranges, -1, axis=1)
    behind[:, -1] = ranges[:, -1]
    edge = np.isfinite(ranges) & np.isfinite(behind)
    gap = np.subtract(behind, ranges, out=np.zeros(shape), where=edge)
    mixed = (np.abs(gap) > EDGE_M) & (rng.random(shape) < lidar.mixed_share)
    ranges = np.where(mixed, ranges + rng.random(shape) * gap, ranges)

    # Dust, rain, stray light: the beam stops early.
    reach = np.minimum(ranges, lidar.range_max_m)
    short = lidar.range_min_m + rng.random(shape) * np.maximum(reach - lidar.range_min_m, 0.0)
    ranges = np.where(rng.random(shape) < lidar.outlier_share, np.minimum(short, ranges), ranges)

    finite = np.where(np.isfinite(ranges), ranges, 0.0)
    std = lidar.noise_m + lidar.noise_per_m * finite + lidar.noise_per_m2 * finite**2
    ranges += std * rng.standard_normal(shape)

    far = np.minimum(finite / lidar.range_max_m, 1.0)
    failed = rng.random(shape) < lidar.dropout_share + lidar.dropout_far_share * far**2
    ranges[failed | (ranges >= lidar.range_max_m)] = np.inf
    ranges[ranges < lidar.range_min_m] = -np.inf
    return ranges.astype(np.float32)
