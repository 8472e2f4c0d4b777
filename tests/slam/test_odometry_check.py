"""A path that contradicts the odometry is named with its likely cause, and only that."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.geometry import Pose2, compose_poses, invert_poses, wrap_angles
from slamfusion.slam.common.odometry_check import (
    contradictions,
    fit_odometry,
    frozen_span,
    laser_fault,
)
from slamfusion.trajectory import Trajectory

STAMPS_S = np.arange(40, dtype=np.float64)


def drive(stands: slice | None = None) -> Trajectory:
    """0.2 m a second along x; during ``stands`` the pose is repeated."""
    poses = np.zeros((40, 3))
    poses[:, 0] = 0.2 * STAMPS_S
    if stands is not None:
        poses[stands] = poses[stands.start]
    return Trajectory(STAMPS_S, poses, "drive")


@pytest.mark.parametrize(
    ("stands", "span"),
    [(None, None), (slice(0, 40), (0.0, 39.0)), (slice(10, 25), (10.0, 24.0)), (slice(4, 8), None)],
)
def test_it_is_found_where_the_path_goes_on(
    stands: slice | None, span: tuple[float, float] | None
) -> None:
    assert frozen_span(drive(stands), drive()) == span


def test_a_robot_that_stands_has_no_frozen_odometry() -> None:
    stands = slice(10, 25)
    assert frozen_span(drive(stands), drive(stands)) is None


def course(seed: int = 0, scans: int = 600, length: float = 1.0, turn: float = 1.0) -> Trajectory:
    """Drive about 60 m round corners; lengths and turns may be those of wrong wheels."""
    rng = np.random.default_rng(seed)
    rate = np.repeat(rng.uniform(-0.15, 0.15, scans // 20), 20)
    steps = np.stack((np.full(scans, 0.1), np.zeros(scans), rate), axis=-1)
    steps = steps * (length, 1.0, turn) + rng.normal(0.0, (0.004, 0.004, 0.004), (scans, 3))
    poses = np.zeros((scans, 3), dtype=np.float64)
    for i in range(1, scans):
        poses[i] = compose_poses(poses[i - 1], steps[i])
    return Trajectory(0.1 * np.arange(scans, dtype=np.float64), poses)


def seen(path: Trajectory, *, yaw_deg: float = 0.0, is_mirrored: bool = False) -> Trajectory:
    """Return the path that a laser makes which is mounted otherwise than it says."""
    sign = -1.0 if is_mirrored else 1.0
    poses = path.poses * (1.0, sign, sign)
    mount = Pose2(0.0, 0.0, math.radians(yaw_deg))
    return Trajectory(path.stamps_s, compose_poses(poses, [mount.x, mount.y, mount.yaw_rad]))


def in_degrees(path: Trajectory) -> Trajectory:
    """Return the path as odometry that writes its yaw in degrees, -180 to 180."""
    yaws_deg = np.degrees(wrap_angles(path.poses[:, 2]))
    return Trajectory(path.stamps_s, np.column_stack((path.poses[:, :2], yaws_deg)))


PATH = course()


@pytest.mark.parametrize(
    ("odometry", "path", "words"),
    [
        (PATH, PATH, []),
        (course(length=1.06, turn=0.95), PATH, []),
        (PATH, seen(PATH, yaw_deg=3.0), []),
        (PATH, seen(PATH, is_mirrored=True), ["--laser mirrored"]),
        (PATH, seen(PATH, yaw_deg=180.0), ["--laser backward"]),
        (PATH, seen(PATH, yaw_deg=-8.0), ["turned by -8 degrees"]),
        (PATH, seen(PATH, yaw_deg=90.0), ["turned by +90 degrees"]),
        (PATH, seen(PATH, yaw_deg=20.0, is_mirrored=True), ["--laser mirrored", "20 degrees"]),
        (course(length=0.8), PATH, ["1.25 times as long"]),
        (course(turn=1.3), PATH, ["0.77 times as far"]),
        (course(length=0.8, turn=0.8), PATH, ["1.25 times as long"]),
        (course(length=0.8, turn=1.3), PATH, ["0.77 times as far", "1.25 times as long"]),
        (in_degrees(PATH), PATH, ["is in degrees"]),
        (course(seed=1), PATH, ["turns unlike"]),
        (PATH, course(turn=0.0), ["turns unlike"]),
        (PATH, replace(PATH, poses=PATH.poses * (1e3, 1e3, 1.0)), ["another unit than metres"]),
    ],
)
def test_what_contradicts_the_odometry(
    odometry: Trajectory, path: Trajectory, words: list[str]
) -> None:
    found = list(contradictions(odometry, path))
    assert len(found) == len(words), found
    for sentence, word in zip(found, words, strict=True):
        assert word in sentence


def test_too_little_motion_says_nothing() -> None:
    short = course(scans=40)
    assert list(contradictions(short, seen(short, is_mirrored=True))) == []
    stands = Trajectory(PATH.stamps_s, np.zeros_like(PATH.poses))
    fit = fit_odometry(stands, stands)
    assert fit.turn is None
    assert fit.length is None


def test_only_the_mounting_of_the_laser_is_its_fault() -> None:
    fault = laser_fault(PATH, seen(PATH, is_mirrored=True))
    assert "the map is mirrored" in fault
    assert laser_fault(PATH, PATH) is None
    assert laser_fault(course(length=0.8), PATH) is None
    assert laser_fault(None, PATH) is None
    # Yaws of the wrong sign alone: no laser makes such a path.
    turned = replace(PATH, poses=PATH.poses * (1.0, 1.0, -1.0))
    assert laser_fault(PATH, turned) is None
    assert "drives unlike the odometry" in "".join(contradictions(PATH, turned))
    assert laser_fault(in_degrees(course(seed=10)), course(seed=10)) is None


@pytest.mark.parametrize(("wrong", "words"), [(slice(0, 400), ""), (slice(450, 600), "mirrored")])
def test_the_newest_steps_decide(wrong: slice, words: str) -> None:
    """A fault that is repaired is not named any more, and one that comes late is."""
    steps = compose_poses(invert_poses(PATH.poses[:-1]), PATH.poses[1:])
    steps[wrong, 2] *= -1.0
    rows = [*itertools.accumulate(steps, compose_poses, initial=PATH.poses[0])]
    found = "; ".join(contradictions(Trajectory(PATH.stamps_s, np.array(rows)), PATH, newest=20))
    assert words in found
    assert bool(words) == bool(found)


def test_odometry_that_drives_on_for_as_many_steps_is_not_frozen_any_more() -> None:
    poses = PATH.poses.copy()
    poses[200:300] = poses[200]
    poses[300:, :2] += PATH.poses[200, :2] - PATH.poses[300, :2]
    odometry = Trajectory(PATH.stamps_s, poses)
    for last, named in ((380, True), (600, False)):
        until = Trajectory(PATH.stamps_s[:last], odometry.poses[:last])
        found = "".join(contradictions(until, PATH, newest=20))
        assert ("stands still from 20 s" in found) == named
