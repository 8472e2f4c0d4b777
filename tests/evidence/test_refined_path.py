"""Refined paths in a room of which everything is known: what all scans say together is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.evidence.beams import judged_scans
from slamfusion.evidence.refined_path import refine_path
from slamfusion.geometry import compose_poses, wrap_angles
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, off_m, recorded


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
