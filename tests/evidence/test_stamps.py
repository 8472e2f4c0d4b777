"""Sparse paths have a pose at every scan that odometry reaches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.beams import JudgedScans, cover_stamps, judged_scans
from slamfusion.evidence.predictive import score_paths
from slamfusion.geometry import wrap_angles
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, moved, recorded
from tests.support.examples import examples

TRUTH = circuit()


def sparse(path: Trajectory, step: int, first: int = 0) -> Trajectory:
    return Trajectory(path.stamps_s[first::step], path.poses[first::step], "sparse")


def test_a_full_path_is_taken_as_it_is(scans: JudgedScans):
    poses, is_own = cover_stamps(TRUTH, scans)
    assert is_own.all()
    assert np.array_equal(poses, TRUTH.poses)


@settings(max_examples=examples(20), deadline=None)
@given(step=st.integers(2, 30), x=st.floats(-50, 50), yaw_rad=st.floats(-3.0, 3.0))
def test_keyframes_are_filled_by_odometry(scans: JudgedScans, step: int, x: float, yaw_rad: float):
    path = moved(TRUTH, (x, 1.0, yaw_rad))
    poses, is_own = cover_stamps(sparse(path, step), scans)
    assert np.count_nonzero(is_own) == -(-len(TRUTH) // step)
    covered = np.isfinite(poses[:, 0])
    assert covered[: (len(TRUTH) - 1) // step * step + 1].all()
    apart = poses[covered] - path.poses[covered]
    assert np.hypot(apart[:, 0], apart[:, 1]).max() < 0.05
    assert np.abs(wrap_angles(apart[:, 2])).max() < 0.02


def test_a_gap_ends_at_the_next_pose_of_the_path(scans: JudgedScans):
    # The path jumps by 1 m within the gap: what is filled in goes over to it without a step.
    path = moved(TRUTH, (1.0, 0.0, 0.0), 60)
    kept = np.r_[0:50, 70:144]
    poses, _ = cover_stamps(Trajectory(path.stamps_s[kept], path.poses[kept]), scans)
    off = poses[50:70, 0] - TRUTH.poses[50:70, 0]
    assert off[0] == pytest.approx(1.0 / 21.0, abs=0.03)
    assert (np.diff(off) > 0.0).all()
    assert off[-1] == pytest.approx(20.0 / 21.0, abs=0.03)


def test_odometry_carries_a_path_a_short_way_beyond_its_ends(scans: JudgedScans):
    poses, _ = cover_stamps(Trajectory(TRUTH.stamps_s[40:100], TRUTH.poses[40:100]), scans)
    covered = np.flatnonzero(np.isfinite(poses[:, 0]))
    assert 30 < covered[0] < 40
    assert 100 <= covered[-1] < 112
    assert np.array_equal(covered, np.arange(covered[0], covered[-1] + 1))


def test_without_odometry_only_short_gaps_are_filled():
    scans = judged_scans(recorded(TRUTH, odometry=False))
    assert scans.driven is None
    # Scans are 0.25 s apart: 3 missing make a gap of 1 s, 7 one of 2 s.
    poses, _ = cover_stamps(sparse(TRUTH, 4), scans)
    assert np.isfinite(poses[:, 0]).mean() > 0.97
    apart = poses[:140] - TRUTH.poses[:140]
    poses, is_own = cover_stamps(sparse(TRUTH, 8), scans)
    assert np.array_equal(np.isfinite(poses[:, 0]), is_own)
    assert np.hypot(apart[:, 0], apart[:, 1]).max() < 0.08


def test_stamps_rounded_to_milliseconds_are_the_scans_own(scans: JudgedScans):
    rounded = Trajectory(TRUTH.stamps_s + 4e-4, TRUTH.poses)
    assert cover_stamps(rounded, scans)[1].all()


def test_beyond_its_ends_a_path_is_not_judged(device: ComputeDevice, scans: JudgedScans):
    paths = {"full": TRUTH, "part": Trajectory(TRUTH.stamps_s[40:100], TRUTH.poses[40:100])}
    evidence = score_paths(scans, paths, device)
    assert np.flatnonzero(evidence.is_judged).tolist() == [*range(40, 100)]
    found = evidence.compare("full", "part")
    assert (found.verdict, found.difference) == ("cannot tell", 0.0)


def test_a_sparse_path_is_judged_with_the_full_one(device: ComputeDevice, scans: JudgedScans):
    paths = {"full": TRUTH, "sparse": sparse(TRUTH, 6)}
    evidence = score_paths(scans, paths, device)
    full, few = evidence.scores["full"], evidence.scores["sparse"]
    assert few.is_own.mean() == pytest.approx(1.0 / 6.0)
    assert np.array_equal(full.beams, few.beams)
    assert evidence.is_judged.mean() > 0.95
    assert few.consistency > full.consistency - 0.1
