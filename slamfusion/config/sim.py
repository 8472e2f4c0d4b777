"""Settings of simulated places, lasers, robots and drives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from slamfusion.config.core import Checked, option
from slamfusion.config.run import LidarName
from slamfusion.errors import ConfigError

# Places that are drawn; a world may also be a map file.
DrawnPlace: TypeAlias = Literal[
    "office",
    "corridor",
    "hall",
    "atrium",
    "yard",
    "ring-100",
    "ring-300",
    "wings",
    "pillars",
    "rooms",
]
PlaceName: TypeAlias = Literal[DrawnPlace, "map"]


@dataclass(frozen=True)
class WorldConfig(Checked):
    """A simulated place."""

    name: PlaceName = option("office", "which drawn place, or map for a map file")
    map: str | None = option(None, "map file of the world `map`; from the course file's folder")
    seed: int | None = option(None, "seed of the drawing; default: the run's seed", low=0)
    resolution: float = option(
        0.05, "cell size of a drawn truth; a map file has its own", unit="m", low=0.01, high=0.25
    )
    wall_height_m: float = option(
        2.5, "beams of a tilted laser pass over walls at this", low=0.1, high=20.0
    )
    glass_share: float = option(0.0, "share of the wall cells that are glass")


@dataclass(frozen=True)
class LidarConfig(Checked):
    """A planar laser: what it can see, how it errs, and where it sits."""

    model: LidarName = option("hokuyo", "its kind")
    beams: int = option(541, "beams in a sweep", low=1, high=100_000)
    view_rad: float = option(
        math.radians(270.0), "angle from first to last beam", low=0.0, high=math.tau
    )
    clockwise: bool = option(False, "the first beam is the leftmost one")
    rate_hz: float = option(10.0, "sweeps a second", low=0.1, high=100.0)
    turn_s: float = option(
        0.0,
        "time of a whole turn, each beam at its own time; 0: all beams of a sweep at one",
        low=0.0,
        high=10.0,
    )
    range_min_m: float = option(0.1, "nearer things are too close", low=0.0, high=10.0)
    range_max_m: float = option(30.0, "farther things are not seen", low=0.1, high=1000.0)
    noise_m: float = option(0.01, "standard deviation of a range at 0 m", low=0.0, high=1.0)
    noise_per_m: float = option(0.0005, "what a metre of range adds to it", low=0.0, high=1.0)
    noise_per_m2: float = option(
        0.0, "what the square of a metre of range adds to it", unit="1/m", low=0.0, high=1.0
    )
    dropout_share: float = option(0.001, "share of readings that fail")
    dropout_far_share: float = option(
        0.0,
        "share of readings at the longest range that fail beside these; falls with the square of "
        "the range",
    )
    outlier_share: float = option(0.0005, "share of readings that stop short anywhere on their way")
    mixed_share: float = option(
        0.2, "share of readings at an edge in depth that lie between both sides"
    )
    mount_x_m: float = option(0.1, "laser ahead of the robot's origin", low=-10.0, high=10.0)
    mount_y_m: float = option(0.0, "laser left of the robot's origin", low=-10.0, high=10.0)
    mount_yaw_rad: float = option(
        0.0, "turn of the laser on the robot", low=-math.tau, high=math.tau
    )
    height_m: float = option(0.25, "laser above the floor", low=0.01, high=10.0)


@dataclass(frozen=True)
class DriveConfig(Checked):
    """How a robot moves, and how its odometry errs."""

    model: Literal["differential", "bicycle", "tracks"] = option("differential", "its kind")
    radius_m: float = option(0.2, "disc that holds the robot; keeps off walls", low=0.01, high=5.0)
    speed_mps: float = option(0.6, "speed on a free way", low=0.01, high=10.0)
    turn_rate_rad_s: float = option(1.0, "turning speed at most", low=0.01, high=10.0)
    wheelbase_m: float = option(0.3, "bicycle: between the axles", low=0.05, high=5.0)
    track_m: float = option(0.4, "tracks: between left and right", low=0.05, high=5.0)
    slip_left: float = option(
        0.0, "tracks: share of the left track's motion that is lost", low=0.0, high=0.9
    )
    slip_right: float = option(
        0.0, "tracks: share of the right track's motion that is lost", low=0.0, high=0.9
    )
    travel_noise: float = option(
        0.02, "error of the way after a metre; grows with the square root", low=0.0, high=1.0
    )
    travel_turn_noise: float = option(
        0.005, "error of the way in metres after a turn of a radian", low=0.0, high=1.0
    )
    turn_noise: float = option(
        0.02, "error of a turn of a radian; grows with the square root", low=0.0, high=1.0
    )
    turn_travel_noise: float = option(
        0.01, "error of the heading in radians after a metre", low=0.0, high=1.0
    )
    travel_bias: float = option(
        0.01, "share by which odometry reads distances too long", low=-0.5, high=0.5
    )
    turn_bias: float = option(
        0.01, "share by which odometry reads turns too large", low=-0.5, high=0.5
    )
    turn_travel_bias: float = option(
        0.001, "heading error of odometry for each metre", unit="rad/m", low=-0.5, high=0.5
    )


@dataclass(frozen=True)
class ObstacleConfig(Checked):
    """A cable or low ramp on the floor, [F16]'s ground obstacle: wheels slip, the body tilts."""

    x_m: float = option(0.0, "its middle in the map frame", low=-1e7, high=1e7)
    y_m: float = option(0.0, "its middle in the map frame", low=-1e7, high=1e7)
    yaw_rad: float = option(0.0, "direction straight across it", low=-math.tau, high=math.tau)
    across_m: float = option(0.6, "way across it on which it is felt", low=0.01, high=10.0)
    along_m: float = option(1.6, "its length", low=0.01, high=100.0)
    slip_share: float = option(
        0.3, "share of the wheels' motion that is lost on it", low=-0.9, high=0.9
    )
    kick_rad_m: float = option(
        0.15, "turn that a metre on it adds unseen by the wheels", low=-3.0, high=3.0
    )
    pitch_rad: float = option(
        0.09, "tilt of the body at most: nose up, then down", low=0.0, high=0.7
    )


@dataclass(frozen=True)
class PersonConfig(Checked):
    """Someone who walks to and fro; never part of the truth map.

    Attributes:
        waypoints: x and y in metres, map frame; walked from first to last and back, around walls.
    """

    waypoints: tuple[tuple[float, float], ...] = ()
    speed_mps: float = option(1.0, "walking speed", low=0.05, high=5.0)
    body: Literal["legs", "disc"] = option("legs", "what the laser meets: two legs, or one body")


@dataclass(frozen=True)
class ActionConfig(Checked):
    """One command of a script, as the wheels measure it: a turn, a straight way, or a wait."""

    turn_deg: float = option(0.0, "turn on the spot, counter-clockwise", low=-36e3, high=36e3)
    speed_deg_s: float = option(90.0, "speed of a turn", low=0.1, high=1000.0)
    forward_m: float = option(0.0, "straight way; negative goes backwards", low=-1e4, high=1e4)
    speed_mps: float = option(0.5, "speed of a straight way", low=0.001, high=10.0)
    wait_s: float = option(0.0, "stand still", low=0.0, high=3600.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [name for name in ("turn_deg", "forward_m", "wait_s") if getattr(self, name)]
        if len(given) != 1:
            found = " and ".join(given) or "none of them"
            raise ConfigError(f"a command is one of turn_deg, forward_m and wait_s, found {found}")

    @property
    def duration_s(self) -> float:
        """How long it takes."""
        turn_s = abs(self.turn_deg) / self.speed_deg_s
        return turn_s + abs(self.forward_m) / self.speed_mps + self.wait_s


# Long drives are fast; a short view leaves similar places similar.
_BRISK = {"model": "differential", "speed_mps": 1.2}
_SPARSE = {"model": "hokuyo", "beams": 361, "rate_hz": 5.0}
_SHORT = {**_SPARSE, "range_max_m": 8.0}

# Name: what it is, and its course file.
COURSES: dict[str, tuple[str, dict[str, Any]]] = {
    "office": (
        "a floor of rooms: every room, through its doors",
        {"world": {"name": "office", "glass_share": 0.02}, "people": 2},
    ),
    "corridor": ("a corridor loop with few features, once around and on", {"world": "corridor"}),
    "hall": ("a large hall with clutter", {"world": "hall", "people": 3}),
    "atrium": ("a small atrium with pillars and benches", {"world": "atrium", "lidar": "kinect"}),
    "yard": (
        "a yard of barricades outdoors [B16]",
        {
            "world": {"name": "yard", "wall_height_m": 1.0},
            "lidar": "rplidar",
            "drive": "bicycle",
            "people": 1,
        },
    ),
    "yard-tracks": (
        "the yard on tracks, of which the right one slips by 15 %",
        {
            "world": {"name": "yard", "wall_height_m": 1.0},
            "lidar": "rplidar",
            "drive": {"model": "tracks", "slip_left": 0.0, "slip_right": 0.15},
            "people": 1,
        },
    ),
    "ring-100": (
        "a ring of 100 m of corridor, once around and on",
        {"world": "ring-100", "lidar": _SPARSE, "drive": _BRISK},
    ),
    "ring-300": (
        "a ring of 300 m of corridor, once around and on",
        {"world": "ring-300", "lidar": _SPARSE, "drive": _BRISK},
    ),
    "wings": (
        "two wings that are copies of each other, seen to 8 m",
        {"world": "wings", "lidar": _SHORT},
    ),
    "pillars": (
        "a ring of 80 m whose pillars and doors are all alike, seen to 8 m",
        {"world": "pillars", "lidar": _SHORT, "drive": _BRISK},
    ),
    "rooms": (
        "eight rooms in a row that are copies of each other, seen to 8 m",
        {"world": "rooms", "lidar": _SHORT},
    ),
    "loop": (
        "a corridor loop with few features, driven briskly once around and on",
        {"world": "corridor", "lidar": _SPARSE, "drive": _BRISK},
    ),
    "glass": (
        "an office floor of whose walls three in ten are glass",
        {"world": {"name": "office", "glass_share": 0.3}, "lidar": _SPARSE, "drive": _BRISK},
    ),
    "crowd": (
        "an office floor in which ten people walk about",
        {"world": "office", "lidar": _SPARSE, "drive": _BRISK, "people": 10},
    ),
    "slip": (
        "an office floor on tracks that slip throughout, the right one more",
        {
            "world": "office",
            "lidar": _SPARSE,
            "drive": {"model": "tracks", "speed_mps": 1.2, "slip_left": 0.1, "slip_right": 0.2},
        },
    ),
    "f16": (
        "turn 360 deg at 90 deg/s, 5 m forward at 0.5 m/s over an obstacle, turn 360 deg [F16]",
        {
            "world": "atrium",
            "lidar": "kinect",
            "obstacles": True,
            "script": [
                {"turn_deg": 360.0, "speed_deg_s": 90.0},
                {"forward_m": 5.0, "speed_mps": 0.5},
                {"turn_deg": 360.0, "speed_deg_s": 90.0},
            ],
        },
    ),
}
