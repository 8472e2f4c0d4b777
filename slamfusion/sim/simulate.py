"""Drive a course, read the laser and the odometry, and write both with the truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from slamfusion.compute import ComputeDevice
from slamfusion.config import ObstacleConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import F64, Pose2, interpolate_poses, travelled
from slamfusion.io.carmen import write_carmen
from slamfusion.io.files import AtomicFiles, write_atomic
from slamfusion.io.lines import saved_files
from slamfusion.io.log import LogScan, deskewed_scans, odometry_path
from slamfusion.io.map_server import save_map
from slamfusion.io.trajectories import write_tum
from slamfusion.scan import LaserScan
from slamfusion.sim.courses import Course, course_to_mapping
from slamfusion.sim.drive import Motion, StuckError, follow_ways, read_odometry, run_script
from slamfusion.sim.people import PERSON_RADIUS_M, draw_people, walk
from slamfusion.sim.route import MARGIN_M, FreeSpace, Point
from slamfusion.sim.world import World, beam_angles, mount_of, sweep_ranges, thin_walls
from slamfusion.sim.worlds import Floor, draw_floor, pick_glass
from slamfusion.trajectory import Trajectory

Progress = Callable[[str, int, int], None]

# Each use of random numbers has its own stream, so that one change leaves the others as they were.
WORLD_STREAM, GLASS_STREAM, START_STREAM, PEOPLE_STREAM, ODOMETRY_STREAM, LASER_STREAM = range(6)
# A planned tour has stops this share of the place's width apart, within limits; a short one is
# driven back again, so that places are seen twice.
SPACING_SHARE, SPACING_LEAST_M, SPACING_MOST_M = 1.0 / 3.0, 1.5, 8.0
MOST_STOPS = 30
SHORT_TOUR_M = 60.0


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulated drive; all poses in the map frame of the truth.

    Attributes:
        course: with every random choice made: it gives the same recording again.
        scans: in the order of time, with odometry, deskewed by it.
        truth: true pose of the base at each scan; the first is the first odometry.
        left_out: planned waypoints that this robot could not reach.
    """

    course: Course
    world: World
    scans: tuple[LogScan, ...]
    truth: Trajectory
    left_out: tuple[Point, ...] = ()

    def duration_s(self) -> float:
        """Return the time from the first to the last scan."""
        return float(self.truth.stamps_s[-1] - self.truth.stamps_s[0])

    def odometry(self) -> Trajectory:
        """Return the odometry at each scan."""
        return odometry_path(self.scans, "odometry")


def simulate(course: Course, device: ComputeDevice, progress: Progress | None = None) -> Recording:
    """Drive a course and record it; the same course gives the same recording on every device.

    Raises:
        SimulationError: the course cannot be driven: a wall, no path, a robot too large.
        MapFileError: the world's map file cannot be read.
    """
    floor = draw_floor(course.world, _chance(course, WORLD_STREAM))
    glass_rng = _chance(course, GLASS_STREAM)
    glass = pick_glass(floor.grid, course.world.glass_share, glass_rng)
    drive, period_s = course.drive, 1.0 / course.lidar.rate_hz
    space = FreeSpace(floor.grid, drive.radius_m, MARGIN_M[drive.model])
    start = floor.start if course.start is None else Pose2(*course.start)
    start = start or Pose2(*space.any_place(_chance(course, START_STREAM)))
    walkers = FreeSpace(floor.grid, PERSON_RADIUS_M)
    people = course.people
    if isinstance(people, int):
        people = draw_people(walkers, people, _chance(course, PEOPLE_STREAM))
    world = World(floor.grid, glass, course.world.wall_height_m, people)

    stops, left_out = _stops(course, floor, space, start), []
    while True:
        ways = _ways(space, start, stops)
        world = replace(world, obstacles=_obstacles(course, start, ways))
        try:
            if course.script:
                motion = run_script(world, space, drive, start, course.script, period_s)
            else:
                motion = follow_ways(world, space, drive, start, ways, period_s)
            break
        except StuckError as error:
            if course.waypoints is not None or len(stops) == 1:
                raise
            worst = max(error.waypoint - (2 if error.is_trapped else 1), 0)
            left_out.append(stops[worst])
            stops = (*stops[:worst], *stops[worst + 1 :])
    chosen = replace(
        course,
        start=(start.x, start.y, start.yaw_rad),
        waypoints=None if course.script else stops,
        people=people,
        obstacles=world.obstacles,
    )
    every = round(1.0 / (course.lidar.rate_hz * motion.step_s))  # steps from sweep to sweep
    discs = walk(people, walkers, motion.poses[::every, :2], period_s)
    scans, truth = _record(chosen, world, motion, every, discs, device, progress)
    return Recording(chosen, world, scans, truth, tuple(left_out))


def write_recording(recording: Recording, folder: str | Path) -> list[Path]:
    """Write the log, the true maps, the true trajectory and the course; all of them or none.

    Old files of the same names are replaced.

    Returns:
        The files: ``<name>.log.gz`` (CARMEN), ``truth`` and ``truth_thin`` as ``.yaml`` and
        ``.pgm`` (the true map with solid walls, and with only their surfaces), ``truth.tum`` and
        ``course.yaml``.

    Raises:
        MapFileError: a file cannot be written; nothing was changed.
    """
    folder = Path(folder)
    course = recording.course
    paths = recording_files(course, folder)
    log, *_, tum, settings = paths
    if course.world.map is not None:  # the truth is that map, and lies beside the course
        world = replace(course.world, map="truth.yaml")
        course = replace(course, world=world)
    text = yaml.safe_dump(course_to_mapping(course), sort_keys=False)
    with AtomicFiles():
        write_carmen(log, recording.scans)
        truth = recording.world.grid
        save_map(truth, folder / "truth")
        save_map(thin_walls(truth), folder / "truth_thin")
        write_tum(tum, recording.truth)
        write_atomic(settings, text.encode())
    return paths


def recording_files(course: Course, folder: Path) -> list[Path]:
    """Return the files of ``write_recording``."""
    maps = [file for name in ("truth", "truth_thin") for file in saved_files(folder / name)]
    return [folder / f"{course.name}.log.gz", *maps, folder / "truth.tum", folder / "course.yaml"]


def _chance(course: Course, stream: int) -> np.random.Generator:
    seed = course.seed
    if stream in {WORLD_STREAM, GLASS_STREAM} and course.world.seed is not None:
        seed = course.world.seed
    return np.random.default_rng([seed, stream])


def _stops(course: Course, floor: Floor, space: FreeSpace, start: Pose2) -> tuple[Point, ...]:
    if course.script:
        return ()
    if course.waypoints is not None:
        return course.waypoints
    if floor.stops:
        return floor.stops
    area_m2 = np.count_nonzero(floor.grid.cells == 0) * floor.grid.resolution**2
    spacing_m = min(max(SPACING_SHARE * math.sqrt(area_m2), SPACING_LEAST_M), SPACING_MOST_M)
    tour = space.tour((start.x, start.y), spacing_m, MOST_STOPS)
    if (
        len(tour) > 1
        and sum(travelled(way)[-1] for way in _ways(space, start, tour)) < SHORT_TOUR_M
    ):
        tour += [*tour[-2::-1], tour[-1]]
    return tuple(tour)


def _ways(space: FreeSpace, start: Pose2, stops: tuple[Point, ...] | list[Point]) -> list[F64]:
    ways: list[F64] = []
    here = (start.x, start.y)
    for number, stop in enumerate(stops, start=1):
        ways.append(space.way(here, stop, f"waypoint {number}"))
        here = stop
    return ways


def _obstacles(course: Course, start: Pose2, ways: list[F64]) -> tuple[ObstacleConfig, ...]:
    """Return the ground obstacles: a list, none, or one across the middle of the path."""
    if not isinstance(course.obstacles, bool):
        return course.obstacles
    if not course.obstacles:
        return ()
    way = (
        _script_way(course, start) if course.script else np.concatenate(ways or [np.zeros((1, 2))])
    )
    steps = np.hypot(*np.diff(way, axis=0).T)
    if not steps.sum():
        message = f"{course.name}: the robot stays where it is, so no obstacle lies on its way"
        raise SimulationError(message)
    middle = int(np.searchsorted(np.cumsum(steps), steps.sum() / 2.0))
    (x0, y0), (x1, y1) = way[middle], way[middle + 1]
    yaw_rad = math.atan2(y1 - y0, x1 - x0)
    return (
        ObstacleConfig(x_m=round(float(x0), 3), y_m=round(float(y0), 3), yaw_rad=round(yaw_rad, 4)),
    )


def _script_way(course: Course, start: Pose2) -> F64:
    """Return the path of a script without wheel slip, (N, 2) points 0.05 m apart."""
    pose, points = start, [(start.x, start.y)]
    for action in course.script:
        pose = pose.compose(Pose2(0.0, 0.0, math.radians(action.turn_deg)))
        pieces = max(1, math.ceil(abs(action.forward_m) / 0.05))
        for _ in range(pieces):
            pose = pose.compose(Pose2(action.forward_m / pieces))
            points.append((pose.x, pose.y))
    return np.array(points)


def _record(
    course: Course,
    world: World,
    motion: Motion,
    every: int,
    discs: tuple[F64, F64],
    device: ComputeDevice,
    progress: Progress | None,
) -> tuple[tuple[LogScan, ...], Trajectory]:
    lidar = course.lidar
    poses = motion.poses[::every]
    odometry = read_odometry(motion, course.drive, _chance(course, ODOMETRY_STREAM))[::every]
    stamps_s = np.arange(len(poses)) / lidar.rate_hz
    angle_min_rad, step_rad = beam_angles(lidar)
    increment_s = lidar.turn_s * abs(step_rad) / math.tau
    sweeps = poses[:, None]
    if increment_s:
        times_s = stamps_s[:, None] + increment_s * np.arange(lidar.beams)
        steps_s = motion.step_s * np.arange(len(motion.poses), dtype=np.float64)
        sweeps = interpolate_poses(times_s, steps_s, motion.poses)
    ranges = sweep_ranges(world, lidar, sweeps, discs, device, _chance(course, LASER_STREAM))
    mount = mount_of(lidar)
    scans = []
    for index, (row, pose) in enumerate(zip(ranges, odometry.tolist(), strict=True)):
        scan = LaserScan(
            float(stamps_s[index]),
            row,
            angle_min_rad,
            step_rad,
            lidar.range_min_m,
            lidar.range_max_m,
            mount,
            increment_s,
        )
        scans.append(LogScan(scan, Pose2(*pose), index + 1))
        if progress is not None and index % 256 == 0:
            progress("scans", index, len(poses))
    if progress is not None:
        progress("scans", len(poses), len(poses))
    return tuple(deskewed_scans(scans)), Trajectory(stamps_s, poses, "truth")
