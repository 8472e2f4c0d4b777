"""What a robot suffers is named by the scans and the odometry of its drive, and nothing else is."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.beams import judged_scans
from slamfusion.evidence.conditions import Condition, drive_conditions
from slamfusion.evidence.predictive import score_paths
from slamfusion.geometry import Pose2, compose_poses, invert_poses
from slamfusion.io import LogScan
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, box, circuit, recorded

# Another floor: the walls of a room that is as large, with other things in it.
UPSTAIRS = np.array(box(0.0, 0.0, 9.0, 6.0) + box(1.2, 1.0, 1.0, 4.0) + box(6.3, 1.8, 0.8, 3.0))
CHANGED = 96


def conditions(
    scans: Sequence[LogScan], path: Trajectory, device: ComputeDevice
) -> Mapping[Condition, str]:
    return drive_conditions(score_paths(judged_scans(scans), {"path": path}, device), "path")


def with_odometry(scans: Sequence[LogScan], poses: Sequence[Sequence[float]]) -> list[LogScan]:
    return [
        replace(item, odometry=Pose2(*(float(value) for value in pose)))
        for item, pose in zip(scans, poses, strict=True)
    ]


@pytest.fixture(scope="module")
def drive() -> tuple[list[LogScan], Trajectory]:
    path = circuit()
    return with_odometry(recorded(path), path.poses.tolist()), path


def test_a_drive_that_is_right_has_none(
    drive: tuple[list[LogScan], Trajectory], device: ComputeDevice
) -> None:
    assert not conditions(*drive, device)
    # Nor has one whose robot stands for a while, with its odometry.
    path = circuit()
    stands = Trajectory(path.stamps_s, path.poses[np.minimum(np.arange(144), 90)])
    scans = with_odometry(recorded(stands), stands.poses.tolist())
    assert not conditions(scans, stands, device)


def test_frozen_odometry(drive: tuple[list[LogScan], Trajectory], device: ComputeDevice) -> None:
    scans, path = drive
    frozen = path.poses[np.minimum(np.arange(144), CHANGED)]
    found = conditions(with_odometry(scans, frozen.tolist()), path, device)
    assert found.keys() == {"odometry"}
    assert "the odometry stands still from 24 s to 36 s" in found["odometry"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ((1.0, -1.0, -1.0), "--laser mirrored"),
        ((-1.0, -1.0, 1.0), "--laser backward"),
        ((1.0, 1.0, 1.25), "turns 0.80 times as far as the odometry"),
    ],
)
def test_odometry_that_contradicts_the_scans(
    device: ComputeDevice, change: tuple[float, float, float], words: str
) -> None:
    """Also long after the robot has stopped."""
    turn = np.append(np.linspace(0.0, 12.0 * np.pi, 144), np.full(160, 12.0 * np.pi))
    poses = (1.8 + 0.8 * np.cos(turn), 3.0 + 0.8 * np.sin(turn), turn + np.pi / 2)
    path = Trajectory(np.arange(0.0, 76.0, 0.25), np.array(poses, dtype=np.float64).T)
    scans = recorded(path)
    steps = compose_poses(invert_poses(path.poses[:-1]), path.poses[1:]) * change
    wheels = [*itertools.accumulate(steps, compose_poses, initial=path.poses[0])]
    found = conditions(with_odometry(scans, np.array(wheels).tolist()), path, device)
    assert found.keys() == {"odometry"}
    assert words in found["odometry"]


@pytest.mark.parametrize("where", ["carried away", "upstairs"])
def test_another_place(device: ComputeDevice, where: str) -> None:
    """The odometry, and so the path, know nothing of it."""
    told = circuit()
    if where == "upstairs":
        later = recorded(told, walls=UPSTAIRS)[CHANGED:]
    else:
        # A part of a turn around the middle of the room.
        away = compose_poses((4.5, 3.0, 1.2), compose_poses((-4.5, -3.0, 0.0), told.poses))
        later = recorded(Trajectory(told.stamps_s, away))[CHANGED:]
    scans = with_odometry([*recorded(told)[:CHANGED], *later], told.poses.tolist())
    found = conditions(scans, told, device)
    assert found.keys() == {"new place"}
    assert "since stamp 24 s" in found["new place"]


@pytest.mark.parametrize("last", [92, 144])
def test_a_map_that_shows_its_walls_twice(
    drive: tuple[list[LogScan], Trajectory], device: ComputeDevice, last: int
) -> None:
    """As soon as most of what the robot sees was free space before; of another floor it is true."""
    scans, path = drive
    twice = bent(path, 0.12, 70)
    found = conditions(with_odometry(scans, twice.poses.tolist())[:last], twice, device)
    assert found.keys() == {"doubled walls"}
    assert "every input has drifted, or the robot is on another floor" in found["doubled walls"]


def test_it_is_no_other_place_while_one_path_fits(
    drive: tuple[list[LogScan], Trajectory], device: ComputeDevice
) -> None:
    scans, path = drive
    away = bent(path, 1.5, 70)
    paths = {"path": away, "right": path}
    evidence = score_paths(judged_scans(scans), paths, device)
    assert not drive_conditions(evidence.of_paths(["right"]), "right")
    assert "new place" in drive_conditions(evidence.of_paths(["path"]), "path")
    assert "new place" not in drive_conditions(evidence, "path")


@pytest.mark.parametrize(("first", "last"), [(60, 84), (120, 144)])
def test_inputs_that_have_parted_where_no_scan_shows_which_is_right(
    device: ComputeDevice, first: int, last: int
) -> None:
    """Off through a place that is seen once, each its own way; and back, or not."""
    path = circuit(144, 3.0)
    poses = path.poses.copy()
    poses[first:last, 0] += 20.0 * np.arange(1, last - first + 1)
    other = poses.copy()
    other[first:last, 1] += 2.0
    paths = {"path": Trajectory(path.stamps_s, poses), "b": Trajectory(path.stamps_s, other)}
    evidence = score_paths(judged_scans(recorded(path, odometry=False)), paths, device)
    words = drive_conditions(evidence, "path").get("undecided", "")
    assert words.startswith("since stamp 30 s b is up to 2.0 m" if last == 144 else "")
    assert bool(words) == (last == 144)
