"""Deskewing: the beams of a turning lidar on a moving robot, moved to the stamp of the scan."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import LogConfig, RunConfig
from slamfusion.deskew import Deskewer
from slamfusion.geometry import F64, Pose2, compose_poses, transform_points
from slamfusion.io import open_log
from slamfusion.io.log import LogScan, deskewed_scans
from slamfusion.scan import LaserScan
from slamfusion.sim import named_course, simulate, write_recording
from slamfusion.sim.world import LIDARS
from slamfusion.slam.session import ProducerSession, QueuedScan
from tests.io.bags import Bag

# Walls of a room with a screen and a box, metres: x and y of both ends.
WALLS = np.array(
    [
        (-4.0, -3.0, 4.0, -3.0),
        (4.0, -3.0, 4.0, 3.0),
        (4.0, 3.0, -4.0, 3.0),
        (-4.0, 3.0, -4.0, -3.0),
        (1.5, 3.0, 1.5, 1.2),
        (-2.5, -1.5, -1.5, -1.5),
        (-1.5, -1.5, -1.5, -2.5),
    ]
)
BEAMS, PERIOD_S = 360, 0.2
AUTO = LogConfig()


def path_at(times_s: F64) -> F64:
    """Return the robot's true poses (N, 3): it stands, then drives in bends."""
    since = np.maximum(times_s - 0.5, 0.0)
    yaw = 0.9 * np.sin(1.6 * since)
    return np.stack((0.8 * np.sin(0.5 * since), 0.3 * np.sin(0.9 * since), yaw), axis=1)


def still(times_s: F64) -> F64:
    return np.zeros((len(times_s), 3))


def cast(lasers: F64, angles: F64) -> F64:
    """Return how far beams (N,) at poses (N, 3) go to the nearest wall."""
    facing = lasers[:, 2] + angles
    dx, dy = np.cos(facing)[:, None], np.sin(facing)[:, None]
    ex, ey = WALLS[:, 2] - WALLS[:, 0], WALLS[:, 3] - WALLS[:, 1]
    px, py = WALLS[:, 0] - lasers[:, :1], WALLS[:, 1] - lasers[:, 1:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (px * ey - py * ex) / (dx * ey - dy * ex)
        across = (px * dy - py * dx) / (dx * ey - dy * ex)
    meets = (along > 0.0) & (across >= 0.0) & (across <= 1.0)
    return np.asarray(np.where(meets, along, np.inf).min(axis=1))


def swept(
    stamp_s: float,
    *,
    step_rad: float = math.tau / BEAMS,
    mount: Pose2 | None = None,
    sweep_s: float = PERIOD_S,
) -> LaserScan:
    """Return a sweep, each beam measured at its own time."""
    mount = Pose2(0.1, 0.0, 0.0) if mount is None else mount
    increment_s = sweep_s / BEAMS
    beams = np.arange(BEAMS, dtype=np.float64)
    poses = path_at(np.asarray(stamp_s + increment_s * beams))
    lasers = compose_poses(poses, (mount.x, mount.y, mount.yaw_rad))
    ranges = cast(lasers, np.asarray(-math.pi + step_rad * beams)).astype(np.float32)
    return LaserScan(
        stamp_s, ranges, -math.pi, step_rad, 0.1, 12.0, mount, time_increment_s=increment_s
    )


def off_walls(scan: LaserScan) -> float:
    """Return the mean distance of hits from the nearest wall, metres, seen from the stamp."""
    pose = path_at(np.array([scan.stamp_s]))
    ends = scan.points()
    at = transform_points(np.repeat(pose, len(ends), axis=0), ends)
    start, along = WALLS[:, :2], WALLS[:, 2:] - WALLS[:, :2]
    share = ((at[:, None] - start) * along).sum(axis=2) / np.square(along).sum(axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return float(np.hypot(*np.moveaxis(at[:, None] - nearest, -1, 0)).min(axis=1).mean())


def sweeps(count: int, *, sweep_s: float = PERIOD_S) -> list[LogScan]:
    """Return scans with their odometry, which is the truth."""
    stamps = np.asarray(PERIOD_S * np.arange(count, dtype=np.float64))
    poses = path_at(stamps).tolist()
    return [
        LogScan(swept(float(stamp), sweep_s=sweep_s), Pose2(*pose), number)
        for number, (stamp, pose) in enumerate(zip(stamps, poses, strict=True), 1)
    ]


def deskewed(scan: LaserScan, config: LogConfig = AUTO) -> LaserScan:
    """Return a scan of a laser whose period is known, deskewed by the true path."""
    deskewer = Deskewer(config)
    deskewer.note(scan.stamp_s - PERIOD_S)
    deskewer.note(scan.stamp_s)
    return deskewer.moved(scan, path_at(deskewer.times(scan)))


@pytest.mark.parametrize("step_rad", [math.tau / BEAMS, -math.tau / BEAMS])
@pytest.mark.parametrize("mount", [Pose2(0.1, 0.0, 0.0), Pose2(-0.2, 0.1, 2.0)])
def test_a_deskewed_scan_is_that_of_a_robot_that_stands(step_rad: float, mount: Pose2) -> None:
    skewed = swept(0.6, step_rad=step_rad, mount=mount)
    assert off_walls(skewed) > 0.05
    assert off_walls(deskewed(skewed)) < 0.002


def test_ranges_and_free_beams_stay_and_are_seen_from_where_the_laser_was() -> None:
    skewed = swept(0.6)
    moved = deskewed(skewed)
    assert np.array_equal(moved.ranges, skewed.ranges)
    everything = np.ones(BEAMS, dtype=np.bool_)
    ends = moved.points(everything, np.zeros(BEAMS, dtype=np.float32))
    last = path_at(np.array([0.6, 0.6 + PERIOD_S * (BEAMS - 1) / BEAMS]))
    there = Pose2(*last[0]).inverse().compose(Pose2(*last[1])).compose(skewed.mount)
    assert ends[-1] == pytest.approx((there.x, there.y), abs=1e-3)
    assert ends[0] == pytest.approx((0.1, 0.0))


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_an_increment_in_another_unit_is_found_by_the_period(unit: float) -> None:
    skewed = swept(0.6)
    other = replace(skewed, time_increment_s=unit * skewed.time_increment_s)
    assert off_walls(deskewed(other)) < 0.002


@pytest.mark.parametrize("increment_s", [0.0, 1e-12, 2e-3, math.nan, math.inf])
def test_an_increment_that_cannot_be_is_not_used_and_one_that_is_set_is(increment_s: float) -> None:
    odd = replace(swept(0.6), time_increment_s=increment_s)
    assert deskewed(odd) is odd
    assert off_walls(deskewed(odd, LogConfig(sweep_s=PERIOD_S * (BEAMS - 1) / BEAMS))) < 0.002


def test_a_scan_without_motion_that_matters_stays_as_it_is() -> None:
    deskewer = Deskewer(AUTO)
    for stamp_s in (0.0, PERIOD_S):
        deskewer.note(stamp_s)
        scan = swept(stamp_s)
        assert deskewer.moved(scan, still(deskewer.times(scan))) is scan
    assert deskewer.done.sentences() == []
    assert deskewed(swept(0.6), LogConfig(deskew="no")).motion is None


def written(folder: Path, increment_s: float | None, *, is_flipped: bool = False) -> Path:
    """Write a bag of a drive of 12 s with odometry at 50 Hz; upside down the laser turns back."""
    bag = Bag()
    mount = (0.1, 0.0, 0.2)
    turned = (1.0, 0.0, 0.0, 0.0) if is_flipped else (0.0, 0.0, 0.0, 1.0)
    bag.transform(0.0, "base_link", "laser", mount, turned, topic="/tf_static")
    for stamp_s in np.arange(1.0, 14.0, 0.02):
        x, y, yaw = path_at(np.array([stamp_s - 1.0]))[0]
        bag.odometry(float(stamp_s), (float(x), float(y), float(yaw)))
    step = -math.tau / BEAMS if is_flipped else math.tau / BEAMS
    for index in range(60):
        since_s = PERIOD_S * index
        # Seen from above the beams of an upside-down laser begin at the other side.
        scan = swept(since_s, step_rad=step)
        told = scan.time_increment_s if increment_s is None else increment_s
        bag.scan(
            1.0 + since_s, scan.ranges, angle_min=math.pi if is_flipped else -math.pi,
            angle_increment=abs(step), time_increment=told,
        )  # fmt: skip
    return bag.write(folder)


@pytest.mark.parametrize("is_flipped", [False, True])
def test_a_bag_is_deskewed_by_its_odometry_between_the_scans(
    tmp_path: Path, is_flipped: bool
) -> None:
    log = open_log(written(tmp_path, None, is_flipped=is_flipped))
    scans = [replace(item.scan, stamp_s=item.scan.stamp_s - 1.0) for item in log]
    assert len(scans) == 60
    assert max(off_walls(scan) for scan in scans[5:]) < 0.004
    (sentence,) = log.deskewing.sentences()
    assert "scans are deskewed: a sweep takes 0.199 s (time_increment)" in sentence
    raw = open_log(log.path, LogConfig(deskew="no"))
    assert max(off_walls(replace(one.scan, stamp_s=one.scan.stamp_s - 1.0)) for one in raw) > 0.1


def test_scans_that_say_no_increment_tell_by_their_turns(tmp_path: Path) -> None:
    log = open_log(written(tmp_path, 0.0))
    assert any("taken: a sweep lasts 0.199 s" in note for note in log.notes)
    scans = [replace(item.scan, stamp_s=item.scan.stamp_s - 1.0) for item in log]
    assert max(off_walls(scan) for scan in scans[5:]) < 0.004


@pytest.mark.parametrize("told_s", [0.0, PERIOD_S / BEAMS])
def test_scans_of_one_moment_are_not_deskewed_whatever_they_say(told_s: float) -> None:
    deskewer = Deskewer(AUTO)
    for item in sweeps(60, sweep_s=0.0):
        deskewer.note(item.scan.stamp_s)
        assert item.odometry is not None
        deskewer.learn(replace(item.scan, time_increment_s=told_s), item.odometry)
    assert deskewer.learned_s == (0.0 if told_s else None)
    assert deskewer.times(replace(swept(9.0), time_increment_s=told_s)) == pytest.approx([9.0])


def test_without_odometry_the_sweeps_are_matched() -> None:
    scans = [replace(item, odometry=None) for item in sweeps(60)]
    moved = list(deskewed_scans(scans))
    before = np.array([off_walls(item.scan) for item in scans])
    after = np.array([off_walls(item.scan) for item in moved])
    turns = before > 0.05
    assert np.count_nonzero(turns) > 20
    assert np.median(after[turns]) < 0.01
    assert after[5:].max() < 0.5 * before.max()


def test_odometry_of_the_scans_alone_brackets_the_sweep() -> None:
    moved = list(deskewed_scans(sweeps(60)))
    assert [item.line for item in moved] == list(range(1, 61))
    assert max(off_walls(item.scan) for item in moved[4:-1]) < 0.015


@pytest.mark.parametrize("model", ["rplidar", "lds01"])
def test_simulated_lidars_turn_and_their_logs_say_it(tmp_path: Path, model: str) -> None:
    course = replace(named_course("f16", 1), lidar=LIDARS[model])
    recording = simulate(course, open_device())
    log = open_log(
        next(path for path in write_recording(recording, tmp_path) if ".log" in path.name)
    )
    read = list(log)
    assert log.deskewing.sweep_s == pytest.approx(course.lidar.turn_s, rel=0.01)
    for one, other in zip(read, recording.scans, strict=True):
        pair = one.scan.motion, other.scan.motion
        assert (pair[0] is None) is (pair[1] is None)
        if pair[0] is not None and pair[1] is not None:
            assert np.allclose(pair[0], pair[1], atol=1e-6)
    assert sum(item.scan.motion is not None for item in read) > 30


def test_live_scans_are_deskewed_as_those_of_a_log() -> None:
    session = ProducerSession("tinyslam", RunConfig(), open_device, wants_odometry=True)
    for item in sweeps(12):
        queued = QueuedScan(item.scan.stamp_s, 0.0, 0, partial(replace, item.scan), path_at)
        assert session.feed(queued) is not None
    done = session.snapshot.deskewing
    assert (done.scans, done.without_motion) == (10, 0)
    short = QueuedScan(9.0, 0.0, 0, lambda: swept(9.0), lambda times: path_at(times[:1]))
    assert session.feed(short) is not None
    assert session.snapshot.deskewing.without_motion == 1
