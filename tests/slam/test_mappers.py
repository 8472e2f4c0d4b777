"""What all three SLAMs promise: accuracy, bad odometry, bad scans, equal bytes, saved states."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import BLIND
from slamfusion.slam.registry import (
    make_producer,
    open_producer_device,
    producer,
    resume_producer,
    with_settings,
)
from tests.slam.drives import ONE_JUMP, draw_flat, drive, jumped, stalled, true_poses
from tests.slam.places import errors, everything, feed, on_truth

pytestmark = pytest.mark.once

# Of gmapping few particles, and often a step at which they are resampled.
SETTINGS: dict[str, dict[str, Any]] = {
    "tinyslam": {},
    "gmapping": {"particles": 6, "linearUpdate": 0.15, "resampleThreshold": 1.0, "ogain": 0.2},
    "graph": {},
}
NAMES = tuple(SETTINGS)
RESUMABLE = tuple(name for name in NAMES if producer(name).load is not None)
# Greatest error of place, metres: particles are few.
NEAR_M = {"tinyslam": 0.1, "gmapping": 0.2, "graph": 0.1}


def config(name: str, seed: int = 0, **settings: Any) -> RunConfig:
    own = SETTINGS[name] | settings
    found = with_settings(RunConfig(), name, **own) if own else RunConfig()
    return replace(found, seed=seed)


def run(
    name: str,
    scans: Iterable[LogScan],
    seed: int = 0,
    device: ComputeDevice | None = None,
    **settings: Any,
) -> Any:
    own = config(name, seed, **settings)
    return feed(make_producer(name, own, device or open_producer_device(name, own)), scans)


def blind(stamp_s: float, value: float = np.inf) -> LaserScan:
    return LaserScan(stamp_s, np.full(7, value), 0.0, 0.1, 0.0, 8.0)


def without_odometry(scans: Iterable[LogScan]) -> list[LogScan]:
    return [replace(item, odometry=None) for item in scans]


# -- where the robot is ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "settings"),
    [*((name, {}) for name in NAMES), ("tinyslam", {"cell_model": "base"})],
    ids=str,
)
def test_odometry_that_drifts_is_corrected(name: str, settings: dict[str, Any]) -> None:
    scans, truth = drive(120, turn_bias=0.01)
    last = scans[-1].odometry
    assert math.hypot(last.x - truth[-1].x, last.y - truth[-1].y) > 1.0
    mapper = run(name, scans, **settings)
    metres, radians = errors(mapper, truth)
    assert metres < NEAR_M[name]
    assert radians < 0.06
    assert on_truth(mapper.grid(), draw_flat())[0] > 0.95
    assert mapper.health.scans_used == 120
    assert mapper.name == mapper.grid().name == mapper.trajectory().name == name


@pytest.mark.parametrize("name", NAMES)
def test_without_odometry_the_map_frame_begins_at_the_first_pose(name: str) -> None:
    scans, truth = drive(80)
    start = truth[0].inverse()
    mapper = run(name, without_odometry(scans))
    assert max(errors(mapper, [start.compose(pose) for pose in truth])) < NEAR_M[name]


@pytest.mark.parametrize("name", ["gmapping", "graph"])
def test_odometry_that_is_not_to_be_used_is_not_used(name: str) -> None:
    scans = drive(30, turn_bias=0.3)[0]
    asked, bare = run(name, scans, odometry="none"), run(name, without_odometry(scans))
    assert everything(asked) == everything(bare)


@pytest.mark.parametrize("name", NAMES)
def test_odometry_that_stalls_and_catches_up(name: str) -> None:
    scans, truth = drive(75)
    assert errors(run(name, stalled(scans)), truth)[0] < NEAR_M[name]


@pytest.mark.parametrize("name", NAMES)
def test_an_odometry_jump_is_named_and_ignored(name: str) -> None:
    scans, truth = drive(60)
    mapper = run(name, jumped(scans))
    assert errors(mapper, truth)[0] < NEAR_M[name]
    assert mapper.health.skips.to_json() == ONE_JUMP


@pytest.mark.parametrize("name", NAMES)
def test_a_start_far_from_zero_costs_nothing(name: str) -> None:
    far_start = Pose2(512_345.6, -98_765.4, 2.0)
    (near, truth), (far, far_truth) = drive(30), drive(30, start=far_start)
    mapper, away = run(name, near), run(name, far)
    assert away.memory_bytes() == pytest.approx(mapper.memory_bytes(), rel=0.5)
    assert errors(away, far_truth)[0] < 0.1
    assert errors(mapper, truth)[0] < 0.1
    moved = far_start.compose(true_poses(30)[0].inverse())
    assert on_truth(away.grid(), draw_flat(), moved)[0] > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_a_mounted_laser_draws_the_same_flat(name: str) -> None:
    mount = Pose2(0.3, -0.1, 0.7)
    scans, truth = drive(40, mount=mount, clockwise=True, turn_bias=0.005)
    mapper = run(name, scans)
    assert errors(mapper, truth)[0] < 0.1
    assert on_truth(mapper.grid(), draw_flat())[0] > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_scans_of_changing_beam_count(name: str) -> None:
    """Every second, every third, then all beams again; one scan has a single reading."""
    scans, truth = drive(60, turn_bias=0.01)
    changed = []
    for index, item in enumerate(scans):
        scan, every = item.scan, 1 + index % 3
        ranges = scan.ranges[::every]
        if index == 30:
            ranges = np.where(np.arange(len(ranges)) == 7, ranges, np.float32(np.nan))
        step = scan.angle_increment_rad * every
        changed.append(replace(item, scan=replace(scan, ranges=ranges, angle_increment_rad=step)))
    mapper = run(name, changed)
    assert errors(mapper, truth)[0] < 0.15
    assert mapper.health.scans_used == 60


@pytest.mark.parametrize("name", ["tinyslam", "gmapping"])
def test_a_scan_of_100_000_beams(name: str) -> None:
    ranges = 3.0 + 0.5 * np.sin(np.linspace(0.0, 40.0, 100_000))
    scans = [LaserScan(t, ranges, -math.pi, 2e-5 * math.pi, 0.0, 8.0) for t in (0.0, 0.1)]
    mapper = run(name, [LogScan(scan, Pose2(), 1) for scan in scans])
    assert mapper.health.scans_used == 2
    assert max(abs(value) for value in mapper.trajectory().poses[1]) < 0.03


# -- scans that are missing or show nothing --------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_without_odometry_is_found_where_it_went_while_scans_were_missing(
    name: str,
) -> None:
    """The robot drives on for a metre."""
    scans, truth = drive(64)
    mapper = run(name, [])
    for number, (item, pose) in enumerate(zip(scans, truth, strict=True)):
        if number not in range(40, 56):
            found = mapper.feed(item.scan, item.odometry if number < 30 else None).pose_map_base
            away = math.hypot(found.x - pose.x, found.y - pose.y)
            assert away < 0.3, f"scan {number}"


@pytest.mark.parametrize("name", NAMES)
def test_blind_scans_are_counted_and_their_poses_follow_the_odometry(name: str) -> None:
    """Also at the start, before there is a map."""
    scans, truth = drive(40)
    first, tenth = scans[0].odometry, scans[10].odometry
    log = [
        LogScan(blind(-0.2), first, 1),
        LogScan(blind(-0.1, np.nan), first, 2),
        *scans[:11],
        LogScan(blind(1.05, np.nan), tenth, 14),
        *scans[11:],
    ]
    mapper = run(name, [])
    steps = [mapper.feed(item.scan, item.odometry) for item in log]
    unused = {index: step.reason for index, step in enumerate(steps) if not step.used}
    assert unused == dict.fromkeys((0, 1, 13), BLIND)
    assert mapper.health.skips.counts == {BLIND: 3}
    assert (mapper.health.scans, mapper.health.scans_used) == (43, 40)
    whole = [truth[0], truth[0], *truth[:11], truth[10], *truth[11:]]
    assert errors(mapper, whole)[0] < NEAR_M[name]
    np.testing.assert_array_equal(mapper.trajectory().stamps_s, [item.scan.stamp_s for item in log])


@pytest.mark.parametrize("name", NAMES)
def test_no_usable_scan_has_no_map(name: str) -> None:
    mapper = run(name, [])
    with pytest.raises(SlamFusionError, match="no scan could be used, so there is no map"):
        mapper.grid()
    mapper.feed(blind(0.0), None)
    with pytest.raises(SlamFusionError, match="no map"):
        mapper.grid()


# -- equal bytes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_bytes_and_another_seed_agrees(name: str) -> None:
    scans, truth = drive(40, turn_bias=0.005)
    first, again, other = (run(name, scans, seed) for seed in (3, 3, 4))
    assert everything(first) == everything(again)
    assert other.trajectory().poses.tobytes() != first.trajectory().poses.tobytes()
    assert errors(other, truth)[0] < 0.1


@pytest.mark.parametrize("name", NAMES)
def test_the_numpy_twins_find_the_same_way(name: str) -> None:
    scans = drive(12, turn_bias=0.005)[0]
    settings = {"particles": 3} if name == "gmapping" else {}
    plain = run(name, scans, device=NumpyDevice(), **settings)
    assert everything(plain) == everything(run(name, scans, **settings))


# -- going on from a file --------------------------------------------------------------------------


def odd_drive() -> list[LogScan]:
    """Return a drive with blind scans first, odometry that jumps, and none at its end."""
    scans = drive(40, turn_bias=0.01)[0]
    far = [replace(item, odometry=Pose2(90.0, 0.0, 1.0)) for item in scans[20:22]]
    dark = [replace(item, scan=blind(item.scan.stamp_s)) for item in scans[:3]]
    return [*dark, *scans[3:20], *far, *scans[22:30], *without_odometry(scans[30:])]


@pytest.mark.parametrize("name", RESUMABLE)
def test_a_saved_state_goes_on_to_the_bit(name: str, tmp_path: Path) -> None:
    log, own = odd_drive(), config(name, 5)
    whole = everything(run(name, log, 5))
    for count in (2, 21, 35):
        run(name, log[:count], 5).save_state(tmp_path / "state")
        device = open_producer_device(name, own)
        resumed = feed(resume_producer(name, tmp_path / "state", own, device), log[count:])
        assert everything(resumed) == whole, count
