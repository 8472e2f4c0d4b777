"""The fused path on drawn drives: what single paths do wrong must not be in it."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.errors import TrajectoryError
from slamfusion.evidence.fused_path import fuse_paths
from slamfusion.evidence.path_frames import find_modes, fit_frame, lay_paths
from slamfusion.geometry import Pose2, compose_poses, fit_motion, invert_poses, wrap_angles
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import by_steps

Poses = np.ndarray
SCANS = 240


def two_rounds(count: int = SCANS) -> Poses:
    """Two rounds through a place of 10 x 6 m, heading along the way."""
    turn = np.linspace(0.0, 4.0 * np.pi, count)
    x, y = 5.0 * np.cos(turn), 3.0 * np.sin(turn)
    yaw = np.arctan2(3.0 * np.cos(turn), -5.0 * np.sin(turn))
    return np.stack((x, y, wrap_angles(yaw)), axis=1)


def path(poses: Poses, name: str = "path") -> Trajectory:
    return Trajectory(0.1 * np.arange(len(poses)), poses, name)


def noisy(truth: Poses, seed: int, m: float = 0.02, rad: float = 0.005) -> Poses:
    """Poses off by white noise, as scan matching leaves it."""
    rng = np.random.default_rng(seed)
    return truth + rng.normal(size=truth.shape) * (m, m, rad)


def drifting(truth: Poses, share: float) -> Poses:
    """The same drive with each step longer by a share."""
    steps = compose_poses(invert_poses(truth[:-1]), truth[1:])
    steps[:, :2] *= 1.0 + share
    return compose_poses(truth[0], by_steps(steps))


def turning(truth: Poses, rad: float) -> Poses:
    """The same drive with each step turned by a little more."""
    steps = compose_poses(invert_poses(truth[:-1]), truth[1:])
    steps[:, 2] += rad
    return compose_poses(truth[0], by_steps(steps))


def broken_away(truth: Poses, first: int, motion: tuple[float, float, float]) -> Poses:
    """The same drive, turned and shifted from one scan on about the pose there."""
    poses = truth.copy()
    at = truth[first]
    bent = compose_poses(at, motion)
    poses[first:] = compose_poses(bent, compose_poses(invert_poses(at), truth[first:]))
    return poses


def ate(estimate: Trajectory, truth: Poses) -> float:
    motion = fit_motion(estimate.poses, truth)
    laid = motion.transform(estimate.poses[:, :2])
    return float(np.sqrt(((laid - truth[:, :2]) ** 2).sum(axis=1).mean()))


def fuse(*poses: Poses, **options: object) -> Trajectory:
    paths = {f"slam{index}": path(own) for index, own in enumerate(poses)}
    return fuse_paths(paths, **options)


# --- the common frame -------------------------------------------------------------------------


def test_a_frame_is_fitted_to_the_greater_part_of_a_path() -> None:
    truth = two_rounds()
    moved = compose_poses((3.0, -2.0, 0.8), broken_away(truth, 150, (1.0, 2.0, 0.5)))
    motion = fit_frame(moved, truth)
    laid = compose_poses((motion.x, motion.y, motion.yaw_rad), moved)
    assert np.abs(laid[:150] - truth[:150])[:, :2].max() < 0.01
    # Least squares alone would be drawn along.
    plain = fit_motion(moved, truth)
    assert np.abs(plain.transform(moved[:150, :2]) - truth[:150, :2]).max() > 0.5


def test_paths_in_frames_of_their_own_are_laid_into_one() -> None:
    truth = two_rounds()
    paths = {
        "a": path(truth),
        "b": path(compose_poses((30.0, -7.0, 2.0), truth)),
        "c": path(compose_poses((-3.0, 1.0, -3.0), truth)),
    }
    _, laid, _ = lay_paths(paths)
    assert np.abs(laid - laid[0])[..., :2].max() < 1e-6


def test_what_cannot_be_laid_is_said() -> None:
    truth = two_rounds()
    late = Trajectory(5000.0 + np.arange(SCANS), truth, "late")
    with pytest.raises(TrajectoryError, match="late: no pose at the time of one of path"):
        lay_paths({"path": path(truth), "late": late})
    with pytest.raises(TrajectoryError, match="no path"):
        lay_paths({})
    with pytest.raises(TrajectoryError, match="has no pose"):
        lay_paths({"path": path(truth), "empty": Trajectory(np.zeros(0), np.zeros((0, 3)))})


# --- the consensus ----------------------------------------------------------------------------


def test_a_path_that_lies_elsewhere_has_no_say() -> None:
    truth = two_rounds()
    far = truth + np.array((5.0, 0.0, 0.0))
    broken = broken_away(truth, 120, (0, 0, 1.0))
    _, laid, weights = lay_paths({"a": path(truth), "b": path(broken)})
    assert np.abs(find_modes(laid, weights)[120:] - laid[0, 120:]).max() < 1e-6
    _, laid, weights = lay_paths(
        {"a": path(truth), "b": path(truth + np.array((0.02, 0.0, 0.0))), "c": path(truth)}
    )
    laid[2] = far
    assert np.abs(find_modes(laid, weights)[:, :2] - truth[:, :2]).max() < 0.03


# --- the fused path ---------------------------------------------------------------------------


def test_one_path_alone_stays_as_it_is() -> None:
    truth = two_rounds()
    assert np.abs(fuse(truth).poses - truth).max() < 1e-12
    assert len(fuse(truth[:1], truth[:1])) == 1


def test_noise_averages_out_below_the_best_input() -> None:
    truth = two_rounds()
    inputs = [noisy(truth, seed) for seed in range(3)]
    best = min(ate(path(own), truth) for own in inputs)
    # Of three equally good ones at most 1 / sqrt(3) is left.
    assert ate(fuse(*inputs), truth) < 0.65 * best


@pytest.mark.parametrize(
    ("which", "motion"), [(0, (0.0, 0.0, 0.5)), (1, (2.0, -1.0, 0.0)), (2, (0.3, 0.0, 0.05))]
)
def test_a_path_that_broke_away_does_not_drag_the_others(
    which: int, motion: tuple[float, float, float]
) -> None:
    truth = two_rounds()
    inputs = [noisy(truth, seed) for seed in range(3)]
    inputs[which] = broken_away(inputs[which], 130, motion)
    found = fuse(*inputs)
    assert ate(found, truth) < 0.03


def test_there_is_no_jump_where_another_path_takes_over() -> None:
    truth = two_rounds()
    # Each path slips once, at another time: the majority changes twice.
    inputs = [
        broken_away(noisy(truth, index, 0.002, 0.0005), 60 * (index + 1), (0.6, 0.4, 0.0))
        for index in range(3)
    ]
    found = fuse(*inputs).poses
    told = compose_poses(invert_poses(found[:-1]), found[1:])
    true = compose_poses(invert_poses(truth[:-1]), truth[1:])
    apart = np.hypot(*(told - true)[:, :2].T)
    assert apart.max() < 0.05
    # The consensus of each scan on its own does jump.
    _, laid, weights = lay_paths({str(index): path(own) for index, own in enumerate(inputs)})
    jumpy = find_modes(laid, weights)
    told = compose_poses(invert_poses(jumpy[:-1]), jumpy[1:])
    assert np.hypot(*(told - true)[:, :2].T).max() > 0.3


def test_two_that_share_a_fault_outvote_the_third_unless_the_scans_say_otherwise() -> None:
    truth = two_rounds()
    drifted = [noisy(drifting(truth, 0.08), seed, 0.005, 0.001) for seed in (1, 2)]
    right = noisy(truth, 3, 0.005, 0.001)
    fooled = ate(fuse(right, *drifted), truth)
    weighted = fuse(right, *drifted, weights={"slam1": 0.02, "slam2": 0.02})
    assert fooled > 0.1
    assert ate(weighted, truth) < 0.03


def test_two_that_share_a_fault_count_once_over_long_spans() -> None:
    truth = two_rounds()
    # A heading that drifts by no more than its noise in a step, and by 41 degrees in the end.
    drifted = [noisy(turning(truth, 0.003), seed, 0.005, 0.003) for seed in (1, 2)]
    right = noisy(truth, 3, 0.005, 0.003)
    # Hardly less than the third by the scans: that alone is not enough.
    told = {"slam1": 0.9, "slam2": 0.9}
    twice = fuse(right, *drifted, weights=told)
    once = fuse(right, *drifted, weights=told, sharing_fault=("slam1", "slam2"))
    assert ate(twice, truth) > 0.5
    assert ate(once, truth) < 0.05
    # One alone shares its fault with nobody.
    alone = fuse(right, *drifted, weights=told, sharing_fault=("slam1",))
    assert alone.poses.tobytes() == twice.poses.tobytes()


def test_a_path_without_weight_adds_nothing() -> None:
    truth = two_rounds()
    bad = broken_away(noisy(truth, 5), 10, (0.0, 0.0, 2.0))
    found = fuse(noisy(truth, 1), bad, weights={"slam1": 0.0})
    assert ate(found, truth) < 0.03


def test_a_gap_in_one_path_is_filled_by_the_others() -> None:
    truth = two_rounds()
    kept = np.r_[0:80, 160:SCANS]
    gappy = Trajectory(0.1 * kept, noisy(truth, 1)[kept], "gappy")
    whole = path(noisy(truth, 2), "whole")
    found = fuse_paths({"gappy": gappy, "whole": whole})
    assert len(found) == SCANS
    assert ate(found, truth) < 0.03


def test_the_order_and_the_frames_of_the_inputs_do_not_matter() -> None:
    truth = two_rounds()
    inputs = {f"slam{seed}": path(noisy(truth, seed)) for seed in range(3)}
    found = fuse_paths(inputs)
    turned = fuse_paths(dict(reversed(list(inputs.items()))))
    motion = Pose2(40.0, -9.0, 2.5)
    moved = {
        name: path(compose_poses((motion.x, motion.y, motion.yaw_rad), own.poses))
        for name, own in inputs.items()
    }
    for other in (turned, fuse_paths(moved)):
        back = fit_motion(other.poses, found.poses)
        laid = back.transform(other.poses[:, :2])
        assert np.abs(laid - found.poses[:, :2]).max() < 0.005
