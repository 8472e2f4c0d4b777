"""Predictive consistency knows the true path from wrong ones, whatever its frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.errors import LogError, TrajectoryError
from slamfusion.evidence.beams import CHUNKS, JudgedScans, judged_scans
from slamfusion.evidence.predictive import score_paths, with_path
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, circuit, moved, recorded
from tests.support.examples import examples

TRUTH = circuit()
WRONG = {
    "torn in two": moved(TRUTH, (0.6, -0.4, 0.0), 72),
    "shifted at the end": moved(TRUTH, (2.0, 0.0, 0.0), 134),
    "turned half-way": bent(TRUTH, math.radians(10.0), 72),
    "drifted": Trajectory(TRUTH.stamps_s, TRUTH.poses * [1.05, 1.05, 1.0], "drifted"),
    "still": Trajectory(TRUTH.stamps_s, np.tile(TRUTH.poses[0], (len(TRUTH), 1)), "still"),
}


def test_true_path_is_better_than_each_wrong_one(device: ComputeDevice, scans: JudgedScans):
    evidence = score_paths(scans, {"truth": TRUTH, **WRONG}, device)
    assert evidence.ranking()[0] == "truth"
    for name in WRONG:
        assert evidence.compare("truth", name).verdict == "better"
        assert evidence.compare(name, "truth").verdict == "worse"


def test_all_paths_are_scored_on_the_same_hits(device: ComputeDevice, scans: JudgedScans):
    evidence = score_paths(scans, {"truth": TRUTH, **WRONG}, device)
    for score in evidence.scores.values():
        assert np.array_equal(score.beams, np.bincount(scans.hit_scans, minlength=len(scans)))
        assert score.consistency <= 0.0


@settings(max_examples=examples(15), deadline=None)
@given(x=st.floats(-1e5, 1e5), y=st.floats(-1e5, 1e5), yaw_rad=st.floats(-math.pi, math.pi))
def test_frame_of_a_path_does_not_count(
    device: ComputeDevice, scans: JudgedScans, x: float, y: float, yaw_rad: float
):
    paths = {"here": TRUTH, "there": moved(TRUTH, (x, y, yaw_rad))}
    evidence = score_paths(scans, paths, device)
    assert evidence.scores["here"].consistency == pytest.approx(
        evidence.scores["there"].consistency, abs=1e-4
    )


@settings(max_examples=examples(10), deadline=None)
@given(shift_m=st.floats(0.3, 3.0), first=st.integers(40, 130), towards=st.floats(0.0, 6.28))
def test_shifted_end_is_never_better(
    device: ComputeDevice, scans: JudgedScans, shift_m: float, first: int, towards: float
):
    motion = (shift_m * math.cos(towards), shift_m * math.sin(towards), 0.0)
    evidence = score_paths(scans, {"truth": TRUTH, "moved": moved(TRUTH, motion, first)}, device)
    assert evidence.compare("moved", "truth").verdict == "worse"


@pytest.mark.parametrize("kept", [slice(None), slice(30, 100)], ids=["everywhere", "in part"])
def test_path_added_later_is_scored_as_with_the_others(
    device: ComputeDevice, scans: JudgedScans, kept: slice
):
    others = {"truth": TRUTH, "drifted": WRONG["drifted"]}
    added = Trajectory(TRUTH.stamps_s[kept], WRONG["torn in two"].poses[kept])
    found = with_path(score_paths(scans, others, device), "added", added)
    wanted = score_paths(scans, {**others, "added": added}, device)
    assert list(found.scores) == list(wanted.scores)
    assert np.array_equal(found.is_judged, wanted.is_judged)
    assert found.is_judged.all() == (kept == slice(None))
    for name, score in wanted.scores.items():
        for array in ("sums", "beams", "seen"):
            assert np.array_equal(getattr(found.scores[name], array), getattr(score, array))
        poses = (found.scores[name].poses, score.poses)
        assert np.array_equal(*poses, equal_nan=True)


def test_path_added_later_must_meet_a_scan(device: ComputeDevice, scans: JudgedScans):
    evidence = score_paths(scans, {"truth": TRUTH}, device)
    late = Trajectory(TRUTH.stamps_s + 1e6, TRUTH.poses)
    with pytest.raises(TrajectoryError, match=r"late: its poses are of .*give a path of this log"):
        with_path(evidence, "late", late)


def test_too_few_scans_are_refused():
    with pytest.raises(LogError, match=rf"^9 scans hit something.*at least {CHUNKS}"):
        judged_scans(recorded(TRUTH)[:9])


def test_bad_paths_are_named(device: ComputeDevice, scans: JudgedScans):
    late = Trajectory(TRUTH.stamps_s + 1000.0, TRUTH.poses)
    with pytest.raises(TrajectoryError, match=r"^late: its poses are of 1000\.000 to .* this log"):
        score_paths(scans, {"late": late}, device)
    empty = Trajectory(np.empty(0), np.empty((0, 3)))
    with pytest.raises(TrajectoryError, match=r"^none: the path has no pose"):
        score_paths(scans, {"none": empty}, device)
    with pytest.raises(TrajectoryError, match="no path to score"):
        score_paths(scans, {}, device)
    wide = Trajectory(TRUTH.stamps_s, TRUTH.poses * [1e4, 1e4, 1.0])
    with pytest.raises(TrajectoryError, match=r"^wide: what it sees spreads over .* unit"):
        score_paths(scans, {"wide": wide}, device)


def test_paths_of_different_times_cannot_be_compared(device: ComputeDevice):
    scans = judged_scans(recorded(TRUTH, odometry=False))
    first = Trajectory(TRUTH.stamps_s[:60], TRUTH.poses[:60])
    last = Trajectory(TRUTH.stamps_s[80:], TRUTH.poses[80:])
    with pytest.raises(TrajectoryError, match=r"no scan has a pose in every path .*first 42%"):
        score_paths(scans, {"first": first, "last": last}, device)
