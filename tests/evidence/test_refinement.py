"""The refined path is taken where the scans do not speak against it, and scored as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import JudgedScans, refine_borne_out, refinement, score_paths, with_path
from slamfusion.geometry import compose_poses, invert_poses
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
    found = refine_borne_out(evidence, given, device)
    assert found.taken
    assert found.verdict == "better"
    assert found.path.name == "fused"
    assert not np.array_equal(found.path.poses, given.poses)
    assert tuple(found.evidence.scores) == ("truth", "fused")
    again = with_path(evidence, "fused", found.path, device).scores["fused"]
    assert found.evidence.scores["fused"].consistency == again.consistency
    assert found.evidence.scores["fused"].name == "fused"
    assert plain(found)["taken"]


def test_a_path_that_the_scans_speak_against_is_not_taken(
    device: ComputeDevice, scans: JudgedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = circuit()
    given = Trajectory(truth.stamps_s, truth.poses, "fused")
    evidence = score_paths(replace(scans, odometry=None), {"other": wavy(truth)}, device)
    # What a refinement that pulls two walls together would do.
    monkeypatch.setattr(
        refinement, "refine_path", lambda _, path: moved(path, (0.4, 0.0, 0.0), len(path) // 2)
    )
    found = refine_borne_out(evidence, given, device)
    assert not found.taken
    assert found.verdict == "worse"
    assert found.path is given
    before = with_path(evidence, "fused", given, device).scores["fused"]
    assert found.evidence.scores["fused"].consistency == before.consistency
    assert tuple(found.evidence.scores) == ("other", "fused")
    # What comes by chance more often than once in a hundred times speaks against neither.
    monkeypatch.setattr(refinement, "SURE", found.p_value)
    assert refine_borne_out(evidence, given, device).taken
    assert plain(found) == {
        "taken": False,
        "start": "paths",
        "verdict": "worse",
        "difference": found.difference,
        "difference_95": [*found.difference_95],
        "p_value": found.p_value,
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
    assert scans.odometry is not None
    elsewhere = replace(scans, odometry=compose_poses((30.0, -4.0, 2.0), scans.odometry))
    found = refine_borne_out(replace(evidence, scans=elsewhere), given, device)
    assert (found.taken, found.start) == (True, "odometry")
    assert plain(found)["start"] == "odometry"
    assert found.verdict == "better"
    assert worst_m(given, truth) > 0.5
    assert worst_m(found.path, truth) < 0.05
    # It has the name, the stamps and the frame of the path that was given.
    assert found.path.name == "fused"
    assert np.array_equal(found.path.stamps_s, given.stamps_s)
    off_m = np.linalg.norm(found.path.poses[:, :2] - given.poses[:, :2], axis=1)
    assert np.median(off_m) < 0.6
    again = with_path(evidence, "fused", found.path, device).scores["fused"]
    assert found.evidence.scores["fused"].consistency == pytest.approx(again.consistency, abs=2e-3)


def test_odometry_that_is_absent_or_far_off_is_no_start(
    device: ComputeDevice, scans: JudgedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = far_off()
    evidence = score_paths(scans, {"given": given}, device)
    assert scans.odometry is not None
    for odometry in (None, scans.odometry * (1.0, 1.0, 0.0)):
        other = replace(evidence, scans=replace(scans, odometry=odometry))
        assert refine_borne_out(other, given, device).start == "paths"
    assert refine_borne_out(evidence, given, device).start == "odometry"
    monkeypatch.setattr(refinement, "NEAR", -10.0)
    assert refine_borne_out(evidence, given, device).start == "paths"


def test_where_the_scans_cannot_tell_the_odometry_counts_unless_it_lies_far_off(
    device: ComputeDevice, scans: JudgedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = replace(wavy(circuit()), name="fused"), far_off()
    evidence = score_paths(scans, {"near": near, "far": far}, device)
    assert refine_borne_out(evidence, near, device).start == "odometry"
    # Two fits of one place say the same; one that is likelier by as much as this wins.
    monkeypatch.setattr(refinement, "GAIN", -0.05)
    assert refine_borne_out(evidence, near, device).start == "paths"
    monkeypatch.undo()
    # What lies elsewhere must be likelier by far.
    monkeypatch.setattr(refinement, "FAR_M", 0.0)
    assert refine_borne_out(evidence, near, device).start == "paths"
    assert refine_borne_out(evidence, far, device).start == "paths"
    monkeypatch.setattr(refinement, "FAR_GAIN", 0.01)
    assert refine_borne_out(evidence, near, device).start == "paths"
    assert refine_borne_out(evidence, far, device).start == "odometry"


def test_scans_are_laid_on_each_other_again_while_that_gains(
    device: ComputeDevice, scans: JudgedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, given = circuit(), wavy(circuit())
    evidence = score_paths(replace(scans, odometry=None), {"given": given}, device)
    rounds = []

    def halve(_: JudgedScans, path: Trajectory) -> Trajectory:
        rounds.append(path)
        return Trajectory(path.stamps_s, 0.5 * (path.poses + truth.poses), path.name)

    monkeypatch.setattr(refinement, "refine_path", halve)
    monkeypatch.setattr(refinement, "ROUND_GAIN", 0.002)
    found = refine_borne_out(evidence, replace(given, name="fused"), device)
    assert found.taken
    assert 1 < len(rounds) <= refinement.MOST_ROUNDS
    assert worst_m(found.path, truth) < 0.5 * worst_m(given, truth)
    # The last round gained little, and no more than that was tried.
    monkeypatch.setattr(refinement, "ROUND_GAIN", 10.0)
    rounds.clear()
    refine_borne_out(evidence, replace(given, name="fused"), device)
    assert len(rounds) == 1
