"""Simulated drives: the truth is true, the laser sees it, same seed, same bytes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import ActionConfig, DriveConfig, SimulateConfig
from slamfusion.errors import MapFileError, SimulationError
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED
from slamfusion.io import load_map, open_log, save_map
from slamfusion.sim import Course, Recording, load_course, named_course, simulate, with_overrides
from slamfusion.sim import write_recording as write
from slamfusion.sim.world import tilt_of
from tests.sim.places import clearance_m, room

WORLDS = ("office", "corridor", "atrium", "yard", "rooms")
EACH_WORLD = [
    pytest.param(name, marks=() if name in {"atrium", "yard"} else pytest.mark.full)
    for name in WORLDS
]


@cache
def device() -> ComputeDevice:
    return open_device("auto")


def short(name: str, seed: int = 1) -> Course:
    """A named course with few beams, for tests that look at the drive."""
    course = named_course(name, seed)
    return replace(course, lidar=replace(course.lidar, beams=31))


@cache
def recorded(name: str) -> Recording:
    return simulate(short(name), device())


def bare(grid_folder: Path, *waypoints: tuple[float, float], name: str = "drive") -> Course:
    """A course with waypoints in an empty room of 8 m x 6 m."""
    save_map(room(8.0, 6.0), grid_folder / "room")
    text = "world: room.yaml\nstart: [-3, 0, 0]\nlidar: {model: hokuyo, beams: 31, rate_hz: 5}\n"
    path = grid_folder / f"{name}.yaml"
    path.write_text(text + f"waypoints: {[list(p) for p in waypoints]}\n", encoding="utf-8")
    return load_course(path)


def wall_distances(recording: Recording, indices: Iterable[int]) -> np.ndarray:
    """Distances in metres from some scans' points, at the true poses, to true walls; 9 off the map.

    Args:
        indices: of the scans.
    """
    grid = recording.world.grid
    points = np.concatenate(
        [
            recording.truth.pose(index).transform(recording.scans[index].scan.points())
            for index in indices
        ]
    )
    away = ndimage.distance_transform_edt(grid.cells != OCCUPIED) * grid.resolution
    rows, cols = grid.cell_indices(points)
    inside = (rows >= 0) & (cols >= 0) & (rows < grid.height) & (cols < grid.width)
    found = away[rows.clip(0, grid.height - 1), cols.clip(0, grid.width - 1)]
    return np.where(inside, found, 9.0)


@pytest.mark.parametrize("name", EACH_WORLD)
def test_the_robot_keeps_its_radius_from_every_wall(name: str) -> None:
    recording = recorded(name)
    assert clearance_m(recording.world.grid, recording.truth.poses[:, :2]) >= 0.2 - 1e-9


@pytest.mark.parametrize("name", EACH_WORLD)
def test_a_drive_takes_minutes_and_reaches_its_stops(name: str) -> None:
    recording = recorded(name)
    assert 60.0 < recording.duration_s() < 480.0
    for stop in recording.course.waypoints:
        away = np.hypot(*(recording.truth.poses[:, :2] - stop).T)
        assert away.min() < 0.4


@pytest.mark.parametrize("name", [*EACH_WORLD, "f16"])
def test_odometry_starts_at_the_truth_and_drifts_by_a_few_percent(name: str) -> None:
    recording = recorded(name)
    odometry, truth = recording.odometry(), recording.truth
    assert odometry.poses[0].tolist() == truth.poses[0].tolist()
    away = np.hypot(*(odometry.poses - truth.poses)[:, :2].T).max()
    assert 0.002 < away / truth.path_length_m() < 0.12


@pytest.mark.parametrize("name", ["atrium", "yard"])
def test_scans_at_true_poses_lie_on_true_walls(name: str) -> None:
    course = short(name)
    clean = replace(course.lidar, outlier_share=0.0, mixed_share=0.0)
    clear = replace(course.world, glass_share=0.0)
    script = (ActionConfig(turn_deg=360.0), ActionConfig(forward_m=0.5))
    course = replace(course, people=0, world=clear, lidar=clean, drive=DriveConfig())
    recording = simulate(replace(course, script=script), device())
    away = wall_distances(recording, range(0, len(recording.scans), 4))
    assert np.mean(away < 0.15) > 0.98


@pytest.mark.once
def test_people_stand_in_the_way_of_beams() -> None:
    course = replace(named_course("hall", 1), people=2)
    lidar = replace(course.lidar, beams=181, outlier_share=0.0, mixed_share=0.0)
    with_people, without = (
        simulate(replace(course, lidar=lidar, people=count), device()) for count in (2, 0)
    )
    nearer = [
        np.count_nonzero(a.scan.is_hit() & (a.scan.ranges < b.scan.ranges - 0.3))
        for a, b in zip(with_people.scans, without.scans, strict=True)
    ]
    assert sum(nearer) > 1000


@pytest.mark.once
def test_a_track_that_slips_turns_the_robot_unseen_by_its_odometry() -> None:
    recording = recorded("yard-tracks")
    drive = recording.course.drive
    turned, read = (
        np.unwrap(some.poses[:, 2])[-1] - some.poses[0, 2]
        for some in (recording.truth, recording.odometry())
    )
    right_m = recording.odometry().path_length_m() + read * drive.track_m / 2.0
    wanted = drive.slip_right * right_m / drive.track_m
    assert wanted > 10.0, "radians"
    assert read - turned == pytest.approx(wanted, rel=0.1)
    assert clearance_m(recording.world.grid, recording.truth.poses[:, :2]) >= 0.2 - 1e-9


def test_f16_turns_drives_over_the_obstacle_and_turns() -> None:
    recording = recorded("f16")
    assert recording.duration_s() == pytest.approx(18.0, abs=0.11)
    (cable,) = recording.world.obstacles
    poses = recording.truth.poses
    assert np.abs(poses[:40, :2]).max() < 1e-9
    assert np.abs(poses[-40:, :2] - poses[-1, :2]).max() < 1e-9
    assert poses[-1, 0] > cable.x_m + 1.0
    tilt = np.abs(tilt_of(recording.world, poses)).max(axis=1)
    assert tilt.max() > 0.07
    # The wheels made 5 m, of which the cable took its share.
    lost = cable.across_m * (1.0 / (1.0 - cable.slip_share) - 1.0)
    assert recording.truth.path_length_m() == pytest.approx(5.0 - lost, abs=0.05)


def test_without_the_obstacle_f16_drives_its_five_metres() -> None:
    course = with_overrides(short("f16"), SimulateConfig(obstacle=False))
    recording = simulate(course, device())
    assert recording.world.obstacles == ()
    assert recording.truth.poses[-1] == pytest.approx([5.0, 0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("name", ["f16", "atrium"])
def test_the_written_course_gives_the_same_files_again(tmp_path: Path, name: str) -> None:
    course = with_overrides(short(name), SimulateConfig(people=1, glass_share=0.1))
    files = write(simulate(course, device()), tmp_path / "first")
    again = simulate(load_course(tmp_path / "first" / "course.yaml"), device())
    for path, other in zip(files, write(again, tmp_path / "second"), strict=True):
        assert path.read_bytes() == other.read_bytes(), path.name


def test_a_map_course_travels_with_its_map(tmp_path: Path) -> None:
    course = bare(tmp_path, (2.0, 2.0), (2.0, -2.0))
    files = write(simulate(course, device()), tmp_path / "first")
    (tmp_path / "room.yaml").unlink()
    again = simulate(load_course(tmp_path / "first" / "course.yaml"), device())
    for path, other in zip(files, write(again, tmp_path / "second"), strict=True):
        assert path.read_bytes() == other.read_bytes(), path.name
    truth = load_map(tmp_path / "first" / "truth.yaml")
    assert truth.cells.tobytes() == room(8.0, 6.0).cells.tobytes()


def test_a_map_without_waypoints_is_toured_from_a_place_of_the_seed(tmp_path: Path) -> None:
    course = replace(bare(tmp_path), waypoints=None, start=None)
    recording = simulate(course, device())
    assert len(recording.course.waypoints) > 3
    assert clearance_m(recording.world.grid, recording.truth.poses[:, :2]) >= 0.2
    other = simulate(replace(course, seed=5), device())
    assert other.course.start != recording.course.start


def test_the_log_reads_back_as_what_was_simulated(tmp_path: Path) -> None:
    recording = simulate(short("yard"), device())
    log, *_ = write(recording, tmp_path)
    found = list(open_log(log))
    assert len(found) == len(recording.scans)
    lidar = recording.course.lidar
    for own, read in zip(recording.scans[::50], found[::50], strict=True):
        assert read.scan.stamp_s == pytest.approx(own.scan.stamp_s, abs=1e-6)
        assert read.scan.angle_increment_rad == pytest.approx(own.scan.angle_increment_rad)
        assert read.scan.range_max_m == pytest.approx(lidar.range_max_m)
        assert (read.scan.is_clear() == own.scan.is_clear()).all()
        hit = own.scan.is_hit()
        assert read.scan.ranges[hit] == pytest.approx(own.scan.ranges[hit], abs=2e-3)
        assert read.odometry.x == pytest.approx(own.odometry.x, abs=1e-5)


def test_nothing_to_drive_is_one_scan(tmp_path: Path) -> None:
    recording = simulate(bare(tmp_path), device())
    assert len(recording.scans) == 1
    assert recording.truth.pose(0) == Pose2(-3.0, 0.0, 0.0)


def test_an_obstacle_on_no_way_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="no obstacle lies on its way"):
        simulate(replace(bare(tmp_path), obstacles=True), device())


def test_a_waypoint_in_a_wall_is_refused_by_number(tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="waypoint 2 at"):
        simulate(bare(tmp_path, (1.0, 1.0), (4.0, 0.0)), device())


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    recording = simulate(bare(tmp_path, (1.0, 1.0)), device())
    folder = tmp_path / "out"
    (folder / "truth.tum").mkdir(parents=True)
    with pytest.raises(MapFileError, match=r"truth\.tum: cannot write"):
        write(recording, folder)
    assert [path.name for path in folder.iterdir()] == ["truth.tum"]
