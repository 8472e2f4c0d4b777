"""Motions between scans: odometry with its calibration, and the path where odometry errs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.evidence.beams import JudgedScans, judged_scans
from slamfusion.evidence.known_motions import KnownMotions, turned
from slamfusion.evidence.refined_path import refine_path
from slamfusion.geometry import F64, compose_poses, invert_poses
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import box, by_steps, circuit, off_m, recorded

# A corridor whose ends are out of sight of its middle half, with a door frame near either end.
CORRIDOR_M = 40.0
CORRIDOR = np.array(
    box(0.0, 0.0, CORRIDOR_M, 2.0)
    + box(4.0, 0.0, 0.3, 0.4)
    + box(9.0, 1.6, 0.3, 0.4)
    + box(32.0, 0.0, 0.3, 0.4)
    + box(37.0, 1.6, 0.3, 0.4)
)
LONG_M = CORRIDOR_M - 4.0


def along_corridor(count: int = 120) -> Trajectory:
    """Return a drive from one end of the corridor to the other."""
    x = np.linspace(2.0, 2.0 + LONG_M, count)
    poses = np.stack((x, np.ones(count), np.zeros(count)), axis=1)
    return Trajectory(0.25 * np.arange(count, dtype=np.float64), poses, "truth")


def wheels_of(path: F64, scale: float = 1.0, turn_rad: float = 0.0) -> F64:
    """Return odometry of a path that reads ways too long, askew, and drifts in heading."""
    steps = compose_poses(invert_poses(path[:-1]), path[1:])
    cos_sin = np.array((math.cos(turn_rad), math.sin(turn_rad)))
    steps[:, :2] = turned(steps[:, :2], scale * cos_sin)
    steps[:, 2] += 5e-4
    return by_steps(steps)


def with_odometry(scans: JudgedScans, odometry: F64 | None) -> JudgedScans:
    """Return scans with another odometry."""
    driven = None if odometry is None else Trajectory(scans.stamps_s, odometry)
    return replace(scans, driven=driven)


@pytest.fixture(scope="module")
def corridor() -> JudgedScans:
    return judged_scans(recorded(along_corridor(), walls=CORRIDOR))


def pulled(truth: Trajectory, share: float = 0.06) -> Trajectory:
    """Return a path that is too short where no end of the corridor is seen, as by a matcher."""
    steps = compose_poses(invert_poses(truth.poses[:-1]), truth.poses[1:])
    is_bare = np.abs(truth.poses[:-1, 0] - 0.5 * CORRIDOR_M) < 0.15 * CORRIDOR_M
    steps[is_bare, 0] *= 1.0 - share
    return Trajectory(truth.stamps_s, by_steps(steps), "pulled")


def length_m(path: Trajectory) -> float:
    return float(np.hypot(*(path.poses[-1] - path.poses[0])[:2]))


@pytest.mark.parametrize("scale", [1.0, 1.03, 0.85])
def test_what_the_walls_leave_open_odometry_decides_by_their_calibration(
    corridor: JudgedScans, scale: float
) -> None:
    truth = along_corridor()
    path = pulled(truth)
    lost_m = LONG_M - length_m(path)
    assert lost_m > 0.7
    scans = with_odometry(corridor, wheels_of(truth.poses, scale, 0.02))
    # The places of the path hold it, too.
    assert 0.0 < LONG_M - length_m(refine_path(scans, path)) < 0.55 * lost_m
    blind = refine_path(with_odometry(corridor, None), path)
    assert LONG_M - length_m(blind) == pytest.approx(lost_m, abs=0.03)


def test_a_jump_that_nothing_but_the_path_tells_is_taken_back(corridor: JudgedScans) -> None:
    truth = along_corridor()
    poses = truth.poses.copy()
    poses[len(poses) // 2 :, 0] += 0.15
    jumped = Trajectory(truth.stamps_s, poses, "jumped")
    refined = refine_path(with_odometry(corridor, wheels_of(truth.poses)), jumped)
    assert length_m(refined) - LONG_M < 0.07
    blind = refine_path(with_odometry(corridor, None), jumped)
    assert length_m(blind) - LONG_M > 0.12
    # Spread over the way there, not left in one step.
    steps_m = np.hypot(*np.diff(refined.poses[:, :2], axis=0).T)
    assert steps_m.max() < LONG_M / (len(poses) - 1) + 0.05


def test_odometry_that_the_walls_contradict_harms_nothing() -> None:
    """In a room everything is seen: wheels that slip here and there change nothing."""
    truth = circuit()
    scans = judged_scans(recorded(truth))
    steps = compose_poses(invert_poses(truth.poses[:-1]), truth.poses[1:])
    steps[::12, :2] *= 0.7
    steps[5::36, 0] += 0.08
    slipping = with_odometry(scans, by_steps(steps))
    assert off_m(refine_path(slipping, truth), truth) < 0.02


@pytest.mark.parametrize("scale", [0.3, 3.28])
def test_odometry_of_another_unit_is_none(corridor: JudgedScans, scale: float) -> None:
    truth = along_corridor()
    odometry = wheels_of(truth.poses, scale)
    assert not KnownMotions.of(truth.poses, odometry).is_sound.any()
    path = pulled(truth)
    without = refine_path(with_odometry(corridor, None), path)
    assert (
        refine_path(with_odometry(corridor, odometry), path).poses.tobytes()
        == without.poses.tobytes()
    )


@settings(max_examples=25, deadline=None)
@given(scale=st.floats(0.6, 1.6), turn_rad=st.floats(-0.3, 0.3), seed=st.integers(0, 2**16))
def test_the_usual_calibration_is_found_whatever_a_part_does(
    scale: float, turn_rad: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    steps = np.column_stack(
        (rng.uniform(0.1, 0.3, 120), rng.normal(0.0, 0.01, 120), rng.normal(0.0, 0.1, 120))
    )
    path = by_steps(steps)
    odometry = wheels_of(path, scale, turn_rad)
    driven = compose_poses(invert_poses(odometry[:-1]), odometry[1:])
    driven[60:80] = 0.0
    motions = KnownMotions.of(path, by_steps(driven))
    wanted = np.array((math.cos(turn_rad), -math.sin(turn_rad))) / scale
    assert motions.calibration == pytest.approx(wanted, abs=0.03)
    assert not motions.is_sound[60:80].any()
    assert motions.is_sound[:50].all()
