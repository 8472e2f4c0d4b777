"""Two robots on halves of one drive through a drawn building, and the maps that they make."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig, WorldConfig
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.io.map_server import save_map
from slamfusion.sim import Course, Recording, draw_building, simulate
from slamfusion.sim.courses import named_course
from slamfusion.sim.route import FreeSpace
from slamfusion.slam.registry import make_producer

WIDTH_M, HEIGHT_M = 22.0, 14.0
# No place is farther from a stop; a room is passed, not searched.
SPACING_M = 4.5
# A short view and few beams: little is seen of rooms that were not entered.
RANGE_M, BEAMS, RATE_HZ = 8.0, 181, 1.25


@dataclass(frozen=True, eq=False)
class Halves:
    """What two robots recorded, each from its own start.

    Attributes:
        scans: of the first and of the second robot, with the odometry of each from its own zero.
        second_in_first: pose of the second robot's start in the first one's frame; metres, radians.
    """

    scans: tuple[tuple[LogScan, ...], tuple[LogScan, ...]]
    second_in_first: Pose2


def drive_through(seed: int, folder: Path, device: ComputeDevice) -> Recording:
    """Return a drive from one end of a drawn building to the other, through its rooms.

    Args:
        seed: of the building and of every error of the sensors.
        folder: the building's map is written here.
        device: casts the rays.
    """
    place = draw_building(np.random.default_rng(seed), WIDTH_M, HEIGHT_M)
    save_map(place, folder / "place")
    brisk = named_course("loop", seed)
    space = FreeSpace(place, brisk.drive.radius_m)
    stops = sorted(space.tour((0.0, 0.0), SPACING_M, 60))
    course = Course(
        "wings",
        seed,
        WorldConfig(name="map", map=str(folder / "place.yaml")),
        replace(brisk.lidar, range_max_m=RANGE_M, beams=BEAMS, rate_hz=RATE_HZ),
        brisk.drive,
        start=(*stops[0], 0.0),
        waypoints=tuple(stops[1:]),
    )
    return simulate(course, device)


def cut_drive(recording: Recording, overlap: float) -> Halves:
    """Cut a drive by time into two of one length, which have a share of their way in common.

    Args:
        recording: of the whole drive.
        overlap: of each half, below 1.
    """
    scans, poses = recording.scans, recording.truth.poses
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    way = np.concatenate(([0.0], np.cumsum(steps)))
    half = way[-1] / (2.0 - overlap)
    first = np.flatnonzero(way <= half)
    second = np.flatnonzero(way >= way[-1] - half)
    starts = [Pose2(*(float(v) for v in poses[part[0]])) for part in (first, second)]
    parts = tuple(_from_zero([scans[int(k)] for k in part]) for part in (first, second))
    return Halves((parts[0], parts[1]), starts[0].inverse().compose(starts[1]))


def _from_zero(scans: list[LogScan]) -> tuple[LogScan, ...]:
    """Return scans whose odometry begins at zero."""
    zero = scans[0].odometry
    assert zero is not None
    return tuple(
        replace(scan, odometry=zero.inverse().compose(scan.odometry))
        for scan in scans
        if scan.odometry is not None
    )


def map_of(
    scans: tuple[LogScan, ...], name: str, device: ComputeDevice, kind: str = "graph"
) -> OccupancyGrid:
    """Return the map that a producer makes of a robot's scans."""
    producer = make_producer(kind, RunConfig(), device)
    for item in scans:
        producer.feed(item.scan, item.odometry)
    return producer.grid().with_name(name)


def off_by_m(found: Pose2, wanted: Pose2) -> float:
    """Return how far a transform carries the origin from where it belongs, metres."""
    return math.hypot(found.x - wanted.x, found.y - wanted.y)


def off_by_rad(found: Pose2, wanted: Pose2) -> float:
    """Return how far a transform is turned from where it belongs, radians."""
    return abs(wrap_angle(found.yaw_rad - wanted.yaw_rad))
