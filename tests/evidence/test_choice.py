"""The SLAM whose path is taken is the one nearest to the fused path, where that is believed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import (
    JudgedScans,
    ProducerChoice,
    choose_producer,
    reach_verdict,
    score_paths,
)
from slamfusion.evidence.choice import distance_m
from slamfusion.geometry import compose_poses
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, circuit, moved

TRUTH = circuit()
# Both are off by centimetres, the second one by twice as many, on each fourth scan.
OFF = np.zeros((len(TRUTH), 3))
OFF[::4, 0] = 0.01
CLOSE = Trajectory(TRUTH.stamps_s, TRUTH.poses + OFF)
LESS = Trajectory(TRUTH.stamps_s, TRUTH.poses + 2.0 * OFF)
BENT = bent(TRUTH, math.radians(15.0), 60)
PATHS = {"bent": BENT, "less": LESS, "close": CLOSE, "fused": TRUTH}
SLAMS = ("bent", "less", "close", "absent")


def test_the_nearest_to_the_fused_path_is_taken(device: ComputeDevice, scans: JudgedScans):
    choice = choose_producer(score_paths(scans, PATHS, device), SLAMS, "fused")
    assert choice is not None
    assert choice.name == "close"
    assert list(choice.from_fused_m) == ["close", "less", "bent"]
    # A quarter of the poses moved by 0.02 m, but for their mean that is laid off.
    assert choice.from_fused_m["less"] == pytest.approx(0.02 * math.sqrt(3) / 4, rel=0.02)
    assert choice.from_fused_m["close"] == pytest.approx(0.01 * math.sqrt(3) / 4, rel=0.02)
    assert choice.from_fused_m["bent"] > 0.1


@pytest.mark.parametrize("fused", [None, "unknown"])
def test_without_a_fused_path_the_scans_alone_choose(
    device: ComputeDevice, scans: JudgedScans, fused: str | None
):
    evidence = score_paths(scans, {"bent": BENT, "close": CLOSE}, device)
    assert choose_producer(evidence, SLAMS, fused) == ProducerChoice("close")


def test_a_fused_path_that_the_scans_speak_against_chooses_nothing(
    device: ComputeDevice, scans: JudgedScans
):
    near_the_wrong = Trajectory(BENT.stamps_s, BENT.poses + np.array([0.01, 0.0, 0.0]))
    paths = {"bent": BENT, "right": TRUTH, "fused": near_the_wrong}
    evidence = score_paths(scans, paths, device)
    assert evidence.compare("right", "fused").verdict == "better"
    assert choose_producer(evidence, ("bent", "right"), "fused") == ProducerChoice("right")


def test_where_no_path_is_a_slams_own_none_is_taken(device: ComputeDevice, scans: JudgedScans):
    evidence = score_paths(scans, {"odometry": BENT, "fused": TRUTH}, device)
    assert choose_producer(evidence, ("graph",), "fused") is None
    assert reach_verdict(evidence, ("graph",), "fused").best_producer is None


def test_where_a_path_stands_in_its_frame_is_no_distance(device: ComputeDevice, scans: JudgedScans):
    elsewhere = Trajectory(TRUTH.stamps_s, compose_poses(np.array([7.0, -3.0, 2.0]), TRUTH.poses))
    late = moved(TRUTH, (0.9, 1.2, 0.0), 108)
    evidence = score_paths(scans, {"a": TRUTH, "b": elsewhere, "late": late}, device)
    assert distance_m(evidence, "a", "b") == pytest.approx(0.0, abs=1e-9)
    away_m = distance_m(evidence, "a", "late")
    assert distance_m(evidence, "b", "late") == pytest.approx(away_m)
    assert distance_m(evidence, "late", "b") == pytest.approx(away_m)
    assert 0.1 < away_m < 1.5


def test_the_verdict_says_which_is_nearest(device: ComputeDevice, scans: JudgedScans):
    verdict = reach_verdict(score_paths(scans, PATHS, device), SLAMS, "fused")
    assert verdict.best_producer == verdict.to_json()["best_producer"] == "close"
    words = "Of the SLAM paths close is nearest to the fused one, 0.004 m (less 0.009 m and bent "
    assert words in verdict.sentence
    found = {path["name"]: path["from_fused_m"] for path in verdict.paths_to_json()}
    assert found["fused"] is None
    assert found["less"] == verdict.from_fused_m("less")
    # Of one SLAM alone nothing is said, and its distance is there all the same.
    alone = reach_verdict(score_paths(scans, PATHS, device), ("bent",), "fused")
    assert "nearest" not in alone.sentence
    assert alone.from_fused_m("bent") == verdict.from_fused_m("bent")
