"""The refined path is taken where the scans do not speak against it, and scored as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import refined_path
from slamfusion.evidence.beams import JudgedScans
from slamfusion.evidence.predictive import score_paths, with_path
from slamfusion.evidence.refined_path import refine_borne_out
from slamfusion.geometry import Pose2, compose_poses, invert_poses
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, circuit, moved


def wavy(truth: Trajectory) -> Trajectory:
    """Return the true path with slow errors of some centimetres."""
    turn = 2.0 * np.pi * np.arange(len(truth)) / 40.0
    off = np.stack((0.05 * np.sin(turn), 0.05 * np.cos(turn), 0.01 * np.sin(turn)), axis=1)
    return Trajectory(truth.stamps_s, truth.poses + off, "fused")


def test_a_path_that_lays_walls_on_each_other_is_taken(
    device: ComputeDevice, scans: JudgedScans
) -> None:
    truth = circuit()
    evidence = score_paths(scans, {"truth": truth}, device)
    given = wavy(truth)
    path, with_refined, found = refine_borne_out(evidence, given)
    assert found.taken
    assert found.comparison.verdict == "better"
    assert path.name == "fused"
    assert not np.array_equal(path.poses, given.poses)
    assert tuple(with_refined.scores) == ("truth", "fused")
    again = with_path(evidence, "fused", path).scores["fused"]
    assert with_refined.scores["fused"].consistency == again.consistency
    assert plain(found)["taken"]


def test_a_path_that_the_scans_speak_against_is_not_taken(
    device: ComputeDevice, scans: JudgedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = circuit()
    given = Trajectory(truth.stamps_s, truth.poses, "fused")
    evidence = score_paths(replace(scans, driven=None), {"other": wavy(truth)}, device)
    # What a refinement that pulls two walls together would do.
    monkeypatch.setattr(
        refined_path, "refine_path", lambda _, path: moved(path, (0.4, 0.0, 0.0), len(path) // 2)
    )
    path, with_given, found = refine_borne_out(evidence, given)
    assert not found.taken
    assert found.comparison.verdict == "worse"
    assert path is given
    before = with_path(evidence, "fused", given).scores["fused"]
    assert with_given.scores["fused"].consistency == before.consistency
    assert tuple(with_given.scores) == ("other", "fused")
    assert plain(found) == {
        "taken": False,
        "start": "paths",
        "verdict": "worse",
        "difference": found.comparison.difference,
        "difference_95": [*found.comparison.difference_95],
        "p_value": found.comparison.p_value,
    }


def worst_m(path: Trajectory, truth: Trajectory) -> float:
    """Return how far a pose is from the true one at most, seen from the first pose, metres."""
    places = [compose_poses(invert_poses(poses[0]), poses) for poses in (path.poses, truth.poses)]
    return float(np.linalg.norm((places[0] - places[1])[:, :2], axis=1).max())


def far_off() -> Trajectory:
    """Return a path of the circuit whose second half draws each wall anew, half a metre off."""
    return replace(bent(circuit(), 0.25, 72), name="fused")


def test_where_the_odometry_is_nearer_the_path_is_sought_from_it(
    device: ComputeDevice, scans: JudgedScans
) -> None:
    truth, given = circuit(), far_off()
    evidence = score_paths(scans, {"given": given}, device)
    # Its frame is another one, and its places are those of a wheel that is a little too large.
    elsewhere = replace(scans, driven=scans.driven.moved(Pose2(30.0, -4.0, 2.0)))
    evidence = replace(evidence, scans=elsewhere)
    path, with_refined, found = refine_borne_out(evidence, given)
    assert (found.taken, found.start) == (True, "odometry")
    assert plain(found)["start"] == "odometry"
    assert found.comparison.verdict == "better"
    assert worst_m(given, truth) > 0.5
    assert worst_m(path, truth) < 0.05
    # It has the name, the stamps and the frame of the path that was given.
    assert path.name == "fused"
    assert np.array_equal(path.stamps_s, given.stamps_s)
    off_m = np.linalg.norm(path.poses[:, :2] - given.poses[:, :2], axis=1)
    assert np.median(off_m) < 0.6
    again = with_path(evidence, "fused", path).scores["fused"]
    assert with_refined.scores["fused"].consistency == pytest.approx(again.consistency, abs=2e-3)


def test_a_path_that_follows_a_wrong_slam_is_sought_from_another(
    device: ComputeDevice, scans: JudgedScans
) -> None:
    truth, given = circuit(), replace(bent(bent(circuit(), 0.5, 36), 0.5, 90), name="fused")
    paths = {"wrong": given, "right": moved(truth, (0.08, 0.0, 0.0), 72)}
    path, _, found = refine_borne_out(
        score_paths(replace(scans, driven=None), paths, device), given
    )
    assert (found.taken, found.start) == (True, "right")
    assert worst_m(given, truth) > 1.0
    assert worst_m(path, truth) < 0.02


def test_where_the_odometry_jumps_the_parts_of_the_drive_are_moved_together(
    device: ComputeDevice, scans: JudgedScans
) -> None:
    truth = circuit()
    # Wheels slip between the two rounds, by more than a hit is moved to a wall.
    given = replace(moved(truth, (0.4, -0.2, 0.0), len(truth) // 2), name="fused")
    slipped = replace(scans, driven=given)
    path, _, found = refine_borne_out(score_paths(slipped, {"given": given}, device), given)
    assert (found.taken, found.start) == (True, "odometry")
    assert worst_m(given, truth) > 0.4
    assert worst_m(path, truth) < 0.02
