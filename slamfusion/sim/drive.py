"""Drive a robot through a world, and simulate its wheel odometry.

The true motion follows from the wheels: skid steer loses a constant share on each track, more on a
ground obstacle. Odometry knows only the wheels. A driver who follows a path sees the true pose, as
a person with a joystick does; a script only turns the wheels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamfusion.config import ActionConfig, DriveConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import F64, Pose2, wrap_angle, wrap_angles
from slamfusion.sim.route import FreeSpace
from slamfusion.sim.world import World, zone_place

DRIVES: dict[str, DriveConfig] = {
    "differential": DriveConfig(),
    "bicycle": DriveConfig(model="bicycle", turn_noise=0.03),
    # Tracks that slip unequally: odometry is too long and turns.
    "tracks": DriveConfig(model="tracks", slip_left=0.045, slip_right=0.05, turn_noise=0.03),
}

# Longest step of the integration; the sweep's period is a whole number of steps.
STEP_S = 0.02
# Look-ahead distance on the path; longer with a steering wheel.
AHEAD_M = {"differential": 0.3, "tracks": 0.3, "bicycle": 0.45}
# A path's end is reached within this.
REACHED_M = {"differential": 0.06, "tracks": 0.06, "bicycle": 0.25}
# If the path is this far to the side, a robot that can turns on the spot.
TURN_FIRST_RAD = 0.7
TURN_GAIN = 2.5
STEER_RATE_RAD_S = 2.0
STEER_MAX_RAD = 0.6
ACCELERATION_MPS2 = 0.8
# A blocked bicycle backs up by this before it tries again.
BACK_UP_M = 0.4
# After meeting a corner, a robot follows the path without look-ahead for this time.
CAREFUL_S = 2.0
# Longest script: all its steps are kept in memory.
LONGEST_S = 6 * 3600.0
# Give up after standing this long, or after this multiple of the time that the path needs.
STUCK_S = 60.0
PATIENCE = 6.0
# Within this of a path's start, the start is the problem and not the end.
TRAPPED_M = 1.5


class StuckError(SimulationError):
    """A robot cannot reach ``waypoint`` (from 1); ``is_trapped``: it hardly left the one before."""

    def __init__(self, message: str, waypoint: int, *, is_trapped: bool) -> None:
        super().__init__(message)
        self.waypoint = waypoint
        self.is_trapped = is_trapped


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a robot in equal time steps.

    Attributes:
        step_s: seconds from one row to the next.
        poses: (N, 3) float64, true x, y, yaw in the map frame.
        wheels: (N, 2) float64, metres and radians that the wheels made since the row before; the
            first row is 0.
    """

    step_s: float
    poses: F64
    wheels: F64


class _Command(NamedTuple):
    """Wheel command: speed in m/s, and turning rate in rad/s."""

    speed: float
    turn: float


class _Robot:
    """A moving robot; keeps every step."""

    def __init__(self, world: World, drive: DriveConfig, start: Pose2, period_s: float) -> None:
        self.world, self.drive = world, drive
        # Steps from sweep to sweep: no step is longer than ``STEP_S``.
        self.every = math.ceil(period_s / STEP_S)
        self.step_s = period_s / self.every
        self.x, self.y, self.yaw_rad = start.x, start.y, start.yaw_rad
        self.poses = [(start.x, start.y, start.yaw_rad)]
        self.wheels = [(0.0, 0.0)]
        # Radius of each obstacle around its middle: most steps are far from all of them.
        self._zones = [
            (item, math.hypot(item.across_m, item.along_m) / 2.0) for item in world.obstacles
        ]

    def after(self, command: _Command) -> tuple[float, float, float]:
        """Return x, y, yaw after one step of a command: the chord of an arc."""
        speed, turn = command  # from here on the true ones
        drive = self.drive
        if drive.model == "tracks":
            half = drive.track_m / 2.0
            left = (speed - turn * half) * (1.0 - drive.slip_left)
            right = (speed + turn * half) * (1.0 - drive.slip_right)
            speed, turn = (left + right) / 2.0, (right - left) / drive.track_m
        for zone, reach_m in self._zones:
            if math.hypot(self.x - zone.x_m, self.y - zone.y_m) > reach_m:
                continue
            if zone_place(zone, (self.x, self.y))[1]:
                turn += zone.kick_rad_m * speed
                speed *= 1.0 - zone.slip_share
        middle = self.yaw_rad + turn * self.step_s / 2.0
        way = speed * self.step_s
        return (
            self.x + way * math.cos(middle),
            self.y + way * math.sin(middle),
            self.yaw_rad + turn * self.step_s,
        )

    def move(self, command: _Command) -> None:
        """Do one step of a command."""
        self.x, self.y, self.yaw_rad = self.after(command)
        self.poses.append((self.x, self.y, wrap_angle(self.yaw_rad)))
        self.wheels.append((command.speed * self.step_s, command.turn * self.step_s))

    def motion(self) -> Motion:
        """Stand still up to the next sweep, and return the whole motion."""
        while (len(self.poses) - 1) % self.every:
            self.move(_Command(0.0, 0.0))
        return Motion(self.step_s, np.array(self.poses), np.array(self.wheels))


def run_script(
    world: World,
    space: FreeSpace,
    drive: DriveConfig,
    start: Pose2,
    actions: Sequence[ActionConfig],
    period_s: float,
) -> Motion:
    """Run a script on the wheels; ``start`` in the map frame."""
    lasts_s = sum(action.duration_s for action in actions)
    if lasts_s > LONGEST_S:
        raise SimulationError(
            f"the script lasts {lasts_s:.0f} s, more than the {LONGEST_S:.0f} s that are simulated "
            "at once; drive faster or shorten it"
        )
    robot = _Robot(world, drive, start, period_s)
    space.place((start.x, start.y), "the start")
    for action in actions:
        if drive.model == "bicycle" and action.turn_deg:
            raise SimulationError(
                "the script turns on the spot, which a bicycle cannot; "
                "use the drive differential or tracks"
            )
        steps = max(1, round(action.duration_s / robot.step_s))
        share = 1.0 / (steps * robot.step_s)
        command = _Command(action.forward_m * share, math.radians(action.turn_deg) * share)
        for _ in range(steps):
            robot.move(command)
    motion = robot.motion()
    blocked = space.clearance_m(motion.poses[:, :2]) < drive.radius_m
    if blocked.any():
        first = int(blocked.argmax())
        x, y, _ = motion.poses[first]
        raise SimulationError(
            f"{world.grid.name}: the script drives into a wall after {first * robot.step_s:.1f} s "
            f"at ({x:.2f}, {y:.2f}) m; change its start or its way"
        )
    return motion


def follow_ways(
    world: World,
    space: FreeSpace,
    drive: DriveConfig,
    start: Pose2,
    ways: Sequence[F64],
    period_s: float,
) -> Motion:
    """Drive along paths in order, never nearer to a wall than the radius.

    Args:
        start: map frame; the first path starts there.
        ways: (N, 2) points each, metres, close together.

    Source: Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU 1992.
    """
    robot = _Robot(world, drive, start, period_s)
    driver = _Driver(robot, space)
    for number, way in enumerate(ways, start=1):
        driver.follow(way, number)
    return robot.motion()


class _Driver:
    """Chooses speed and turning rate from the pose and the path."""

    def __init__(self, robot: _Robot, space: FreeSpace) -> None:
        self.robot, self.space = robot, space
        self.drive = robot.drive
        self.speed = self.steer_rad = 0.0
        self.backing_m = self.over_rad = 0.0
        self.tries = 0
        self.careful_s = 0.0
        self.ahead_m = AHEAD_M[self.drive.model]

    def follow(self, way: F64, number: int) -> None:
        """Follow one path to its end."""
        robot = self.robot
        lengths = np.hypot(*np.diff(way, axis=0).T)
        spacing = float(lengths.mean()) if lengths.size else 1.0
        ahead = max(1, round(self.ahead_m / max(spacing, 1e-6)))
        points = way.tolist()
        needed_s = float(lengths.sum()) / self.drive.speed_mps
        needed_s += math.pi / self.drive.turn_rate_rad_s
        most = int((PATIENCE * needed_s + STUCK_S) / robot.step_s)
        still, at, last = 0, 0, len(points) - 1
        self.tries = planned = 0
        for _ in range(most):
            x, y = robot.x, robot.y
            if math.dist(points[last], (x, y)) <= REACHED_M[self.drive.model]:
                return
            while at < last and math.dist(points[at + 1], (x, y)) <= math.dist(points[at], (x, y)):
                at += 1
            target = points[min(at + (1 if self.careful_s > 0.0 else ahead), last)]
            self.careful_s -= robot.step_s
            side = wrap_angle(math.atan2(target[1] - y, target[0] - x) - robot.yaw_rad)
            command = self._bicycle(side) if self.drive.model == "bicycle" else self._wheels(side)
            robot.move(command)
            if self.tries > planned:
                planned, points, at = self.tries, self._again(points), 0
                last = len(points) - 1
            still = 0 if command.speed or command.turn else still + 1
            if still * robot.step_s > STUCK_S:
                break
        time_s = (len(robot.poses) - 1) * robot.step_s
        message = (
            f"{robot.world.grid.name}: the {self.drive.model} drive cannot follow the way to "
            f"waypoint {number} and stands after {time_s:.1f} s at ({robot.x:.2f}, {robot.y:.2f}) "
            "m; use a smaller robot, another drive or more room"
        )
        is_trapped = math.dist(way[0].tolist(), (robot.x, robot.y)) < TRAPPED_M
        raise StuckError(message, number, is_trapped=is_trapped)

    def _again(self, points: list[list[float]]) -> list[list[float]]:
        """Return a new path to the end of one that was left; the old one if there is none."""
        try:
            way = self.space.way((self.robot.x, self.robot.y), (points[-1][0], points[-1][1]))
        except SimulationError:
            return points
        return [[float(x), float(y)] for x, y in way]

    def _is_free(self, command: _Command) -> bool:
        x, y, _ = self.robot.after(command)
        return self.space.clearance_at(x, y) >= self.drive.radius_m

    def _towards(self, wanted: float) -> float:
        change = ACCELERATION_MPS2 * self.robot.step_s
        self.speed += min(max(wanted - self.speed, -change), change)
        return self.speed

    def _wheels(self, side: float) -> _Command:
        drive = self.drive
        most = drive.turn_rate_rad_s
        turn = min(max(TURN_GAIN * side, -most), most)
        if abs(side) > TURN_FIRST_RAD:
            self.speed = 0.0
            return _Command(0.0, turn)
        command = _Command(self._towards(drive.speed_mps * (1.0 - abs(side))), turn)
        if self._is_free(command):
            return command
        # A corner blocks: follow the path without look-ahead for a while.
        self.speed = 0.0
        if self.careful_s <= 0.0:
            self.careful_s = CAREFUL_S
            self.tries += 1
        return _Command(0.0, turn if abs(side) > 0.02 else 0.0)

    def _bicycle(self, side: float) -> _Command:
        """Steer towards the target; if blocked, back up with the wheel turned over."""
        drive, step_s = self.drive, self.robot.step_s
        lock = STEER_MAX_RAD
        if abs(side) < math.pi / 2.0 or not self.over_rad:
            self.over_rad = math.copysign(lock, side)  # kept while turning around
        over = self.over_rad
        if self.backing_m > 0.0:
            # Each try backs up another way, so that the next start differs.
            turn = self.tries % 3
            ways = (-over, over, 0.0)
            for steer_rad in (*ways[turn:], *ways[:turn], self.steer_rad):
                command = self._steered(-0.5 * drive.speed_mps, steer_rad)
                if self._is_free(command):
                    self.backing_m += command.speed * step_s
                    self.steer_rad = steer_rad
                    return command
            self.backing_m = 0.0
        wanted = over
        if abs(side) < math.pi / 2.0:
            wanted = math.atan(drive.wheelbase_m * 2.0 * math.sin(side) / self.ahead_m)
        wanted = min(max(wanted, -lock), lock)
        change = STEER_RATE_RAD_S * step_s if self.speed else 2.0 * lock
        self.steer_rad += min(max(wanted - self.steer_rad, -change), change)
        share = 1.0 - 0.5 * abs(self.steer_rad) / lock
        speed = self._towards(drive.speed_mps * share)
        for steer_rad in (self.steer_rad, over):
            command = self._steered(speed, steer_rad)
            if self._is_free(command):
                self.steer_rad = steer_rad
                return command
        self.speed, self.backing_m = 0.0, BACK_UP_M * (1.0 + self.tries % 4)
        self.tries += 1
        return _Command(0.0, 0.0)

    def _steered(self, speed: float, steer_rad: float) -> _Command:
        """Turning rate = V tan(gamma) / L ([B16], the bicycle model)."""
        return _Command(speed, speed * math.tan(steer_rad) / self.drive.wheelbase_m)


def read_odometry(motion: Motion, drive: DriveConfig, rng: np.random.Generator) -> F64:
    """Return the odometry (N, 3) of a motion: x, y, yaw per step, from the first true pose.

    Errors are normal with a variance that grows with distance and turn, so they do not depend on
    the step; the biases are shares of both.

    Source: Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 5.4 (the four errors).
    """
    distance, turn = motion.wheels.T
    far, around = np.abs(distance), np.abs(turn)
    distance_std = np.sqrt(drive.travel_noise**2 * far + drive.travel_turn_noise**2 * around)
    turn_std = np.sqrt(drive.turn_noise**2 * around + drive.turn_travel_noise**2 * far)
    noise = rng.standard_normal((2, len(distance)))
    read_distance = distance * (1.0 + drive.travel_bias) + distance_std * noise[0]
    read_turn = (
        turn * (1.0 + drive.turn_bias) + drive.turn_travel_bias * distance + turn_std * noise[1]
    )
    x, y, yaw_rad = motion.poses[0]
    yaws = yaw_rad + np.cumsum(read_turn)
    middles = yaws - read_turn / 2.0
    return np.stack(
        (
            x + np.cumsum(read_distance * np.cos(middles)),
            y + np.cumsum(read_distance * np.sin(middles)),
            wrap_angles(yaws),
        ),
        axis=1,
    )
