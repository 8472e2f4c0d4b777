"""Refined paths in a room of which everything is known, and whether they are taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import refined_path
from slamfusion.evidence.beams import JudgedScans, judged_scans
from slamfusion.evidence.predictive import score_paths, with_path
from slamfusion.evidence.refined_path import refine_borne_out, refine_path
from slamfusion.geometry import Pose2, compose_poses, invert_poses, wrap_angles
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, circuit, moved, off_m, recorded


def wavering(path: Trajectory, metres: float, radians: float, seed: int = 0) -> Trajectory:
    """A path that errs slowly, as one that is matched to what it drew before."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 1.0, len(path))[:, None] * (1.3, 1.9, 1.6) + rng.random(3)
    off = np.sin(2.0 * np.pi * phase) * (metres, metres, radians)
    off += rng.normal(0.0, 0.05, (len(path), 3)) * (metres, metres, radians)
    return Trajectory(path.stamps_s, compose_poses(path.poses, off), "wavering")


def test_all_scans_together_know_better_than_the_path() -> None:
    truth = circuit()
    scans = judged_scans(recorded(truth))
    given = wavering(truth, 0.08, 0.02)
    refined = refine_path(scans, given)
    assert off_m(given, truth) > 0.08
    assert off_m(refined, truth) < 0.02
    assert (refined.name, refined.stamps_s.tolist()) == ("wavering", given.stamps_s.tolist())
    # In the frame of the path that was given.
    assert np.hypot(*(refined.poses - given.poses)[:, :2].mean(axis=0)) < 0.04
    again = refine_path(scans, given)
    assert again.poses.tobytes() == refined.poses.tobytes()


def test_a_right_path_stays_what_it_is() -> None:
    truth = circuit()
    assert off_m(refine_path(judged_scans(recorded(truth)), truth), truth) < 0.01


def test_what_the_walls_leave_open_the_motions_decide() -> None:
    """Along a corridor without an end nothing is seen of the way."""
    walls = np.array([(-50.0, 0.0, 90.0, 0.0), (90.0, 2.0, -50.0, 2.0)])
    x = np.linspace(0.0, 20.0, 80)
    truth = Trajectory(0.25 * np.arange(80), np.stack((x, np.ones(80), 0.0 * x), axis=1), "truth")
    scans = judged_scans(recorded(truth, walls=walls, odometry=False))
    given = truth.poses.copy()
    given[:, 0] *= 1.05
    refined = refine_path(scans, Trajectory(truth.stamps_s, given, "long"))
    across = refined.poses[:, 1] - refined.poses[:, 1].mean()
    assert np.abs(across).max() < 0.1
    assert refined.poses[-1, 0] - refined.poses[0, 0] == pytest.approx(21.0, abs=0.05)


def test_hits_that_are_on_no_wall_have_no_say() -> None:
    truth = circuit()
    items = recorded(truth)
    rng = np.random.default_rng(1)
    for item in items:
        ranges = item.scan.ranges.copy()
        stray = rng.random(len(ranges)) < 0.1
        ranges[stray] *= rng.uniform(0.3, 1.0, stray.sum()).astype(np.float32)
        object.__setattr__(item.scan, "ranges", ranges)
    refined = refine_path(judged_scans(items), wavering(truth, 0.05, 0.01))
    assert off_m(refined, truth) < 0.02


def test_poses_between_scans_go_along_and_a_path_of_no_scan_stays() -> None:
    truth = circuit()
    scans = judged_scans(recorded(truth)[::2])
    given = wavering(truth, 0.05, 0.01)
    refined = refine_path(scans, given)
    assert len(refined) == len(truth)
    assert off_m(refined, truth) < 0.05
    # Between two scans the pose keeps its place beside one of them.
    moved = refined.poses - given.poses
    moved[:, 2] = wrap_angles(moved[:, 2])
    assert np.abs(moved[1::2] - moved[::2]).max() < 0.03
    late = Trajectory(truth.stamps_s + 1e4, truth.poses, "late")
    assert refine_path(scans, late) is late


def test_a_wall_that_is_drawn_far_apart_stays_two() -> None:
    """What is beyond reach is no error of a path that is nearly right: it is left alone."""
    truth = circuit()
    poses = truth.poses.copy()
    poses[72:, 0] += 0.6
    torn = Trajectory(truth.stamps_s, poses, "torn")
    refined = refine_path(judged_scans(recorded(truth)), torn)
    gap = refined.poses[72:, 0].mean() - refined.poses[:72, 0].mean()
    assert 0.3 < gap < 0.65


def test_where_a_wall_faces_its_hits_tell_and_not_their_scan() -> None:
    """Noise along the beams turns what a scan takes for the facing of a slant wall."""
    truth = circuit()
    scans = judged_scans(recorded(truth))
    turned = replace(scans, facings_rad=scans.facings_rad + 0.15)
    given = wavering(truth, 0.08, 0.02)
    assert off_m(refine_path(turned, given), truth) < 0.02


def test_scans_that_see_no_surface_leave_the_path_alone() -> None:
    truth = circuit()
    items = recorded(truth)
    for item in items:
        ranges = np.full_like(item.scan.ranges, np.inf)
        ranges[::30] = item.scan.ranges[::30]
        object.__setattr__(item.scan, "ranges", ranges)
    assert refine_path(judged_scans(items), truth) is truth


def test_far_hits_that_spread_weigh_less() -> None:
    """As if all were equally sure, the path would be 0.03 m off."""
    truth = circuit()
    items = recorded(truth)
    rng = np.random.default_rng(1)
    for item in items:
        ranges = item.scan.ranges.copy()
        far = ranges > 3.0
        ranges[far] += rng.normal(0.0, 0.1, far.sum()).astype(np.float32)
        object.__setattr__(item.scan, "ranges", ranges)
    assert off_m(refine_path(judged_scans(items), wavering(truth, 0.05, 0.01)), truth) < 0.02


def test_a_path_that_lays_walls_on_each_other_is_taken(
    device: ComputeDevice, scans: JudgedScans
) -> None:
    truth = circuit()
    evidence = score_paths(scans, {"truth": truth}, device)
    given = replace(wavering(truth, 0.05, 0.01), name="fused")
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
    evidence = score_paths(
        replace(scans, driven=None), {"other": wavering(truth, 0.05, 0.01)}, device
    )
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


@pytest.mark.parametrize("motion", [(2.0, -1.0, 0.3), (-3.0, 0.5, -0.6)])
def test_a_torn_path_is_joined(
    device: ComputeDevice, scans: JudgedScans, motion: tuple[float, float, float]
) -> None:
    truth = circuit()
    given = replace(moved(truth, motion, len(truth) // 2), name="fused")
    alone = replace(scans, driven=None)
    path, _, found = refine_borne_out(score_paths(alone, {"given": given}, device), given)
    assert found.taken
    assert worst_m(given, truth) > 0.7
    assert worst_m(path, truth) < 0.02
