"""ATE and RPE: by hand, in any frame, and the same as evo's to a millionth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.config import TrajectoryConfig
from slamfusion.errors import ConfigError, TrajectoryError
from slamfusion.evaluation.statistics import ErrorStatistics
from slamfusion.evaluation.trajectory_error import (
    associate,
    clock_offset_s,
    on_clock,
    trajectory_errors,
)
from slamfusion.geometry import Pose2, compose_poses, moved_poses
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import by_steps

CONFIG = TrajectoryConfig()
AS_IT_LIES = TrajectoryConfig(alignment="none")


def line(count: int = 11, step_m: float = 0.5) -> Trajectory:
    """Straight along x, a pose a second."""
    poses = np.zeros((count, 3))
    poses[:, 0] = step_m * np.arange(count)
    return Trajectory(np.arange(count, dtype=np.float64), poses, "line")


def drive(count: int = 200, seed: int = 1, noise: float = 0.0) -> Trajectory:
    """A path of random steps, ten poses a second; ``noise`` is added to each pose."""
    rng = np.random.default_rng(seed)
    steps = rng.normal((0.1, 0.0, 0.0), (0.05, 0.02, 0.2), (count - 1, 3))
    poses = compose_poses((3.0, -2.0, 0.4), by_steps(steps))
    wrong = np.random.default_rng(seed + 1000).normal(0.0, noise, (count, 3))
    return Trajectory(1e9 + 0.1 * np.arange(count), poses + wrong, f"drive-{seed}")


def rotations(errors: Any) -> tuple[float, float]:
    return float(errors.rotation_rad.max()), float(errors.relative_rotation_rad.max())


@given(st.floats(-900, 900), st.floats(-900, 900), st.floats(-4, 4))
def test_a_path_in_another_frame_has_no_error(x: float, y: float, yaw_rad: float) -> None:
    motion = Pose2(x, y, yaw_rad)
    found = trajectory_errors(drive().moved(motion), drive())
    assert found.translation_m.max() < 1e-8
    assert found.relative_translation_m.max() < 1e-8
    assert max(rotations(found)) < 1e-8
    back = found.alignment.transform.compose(motion)
    assert (back.x, back.y) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert math.remainder(back.yaw_rad, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_without_alignment_the_shift_is_the_error() -> None:
    found = trajectory_errors(line().moved(Pose2(3.0, 4.0, 0.0)), line(), AS_IT_LIES)
    assert found.translation_m == pytest.approx(np.full(11, 5.0))
    assert found.relative_translation_m.max() < 1e-12
    assert found.alignment.transform == Pose2()


def test_the_absolute_error_after_alignment_by_hand() -> None:
    # One of four places is 0.4 m off to the left; the best motion shifts by 0.1 m (the places lie
    # on top of the turn's centre by symmetry, so it turns by nothing).
    truth = Trajectory(
        np.arange(5.0), np.array([[-2.0, 0, 0], [-1.0, 0, 0], [0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    )
    wrong = truth.poses.copy()
    wrong[2, 1] = 0.5
    found = trajectory_errors(Trajectory(truth.stamps_s, wrong), truth)
    assert found.translation_m == pytest.approx([0.1, 0.1, 0.4, 0.1, 0.1])
    assert found.ate.rmse == pytest.approx(math.sqrt(0.2 / 5))


def test_scale_is_never_taken_off() -> None:
    longer = Trajectory(line().stamps_s, line().poses * (1.1, 1.0, 1.0))
    found = trajectory_errors(longer, line())
    assert found.translation_m.max() == pytest.approx(0.25)
    assert found.relative_translation_m == pytest.approx(np.full(10, 0.05))


@pytest.mark.parametrize(
    ("delta", "unit", "pairs", "error_m"),
    [(1.0, "frames", 10, 0.05), (3.0, "frames", 3, 0.15), (1.0, "m", 5, 0.1), (2.5, "s", 3, 0.15)],
)
def test_a_pair_spans_what_was_asked(delta: float, unit: str, pairs: int, error_m: float) -> None:
    longer = Trajectory(line().stamps_s, line().poses * (1.1, 1.0, 1.0))
    config = replace(CONFIG, rpe_delta=delta, rpe_unit=unit)
    found = trajectory_errors(longer, line(), config)
    assert found.relative_translation_m == pytest.approx(np.full(pairs, error_m))
    assert len(found.relative_travelled_m) == pairs


def test_a_jump_is_one_relative_error_and_turns_what_follows() -> None:
    truth = drive()
    wrong = truth.poses.copy()
    wrong[100:] = compose_poses((0.3, 0.0, 0.2), wrong[100:])
    found = trajectory_errors(Trajectory(truth.stamps_s, wrong), truth)
    assert np.flatnonzero(found.relative_rotation_rad > 1e-9).tolist() == [99]
    assert found.relative_rotation_rad[99] == pytest.approx(0.2)


def test_the_document_says_how_it_was_counted() -> None:
    truth = Trajectory(line().stamps_s[2:8], line().poses[2:8], "truth")
    document = plain(trajectory_errors(line().moved(Pose2(0.0, 1.0)), truth))
    assert set(document["ate"]) == {"rmse", "mean", "median", "std", "min", "max"}
    assert set(document["rpe"]) == set(document["ate"])
    assert (document["poses"], document["poses_matched"], document["rpe_pairs"]) == (11, 6, 5)
    assert document["alignment"]["kind"] == "se2"
    assert document["alignment"]["dy_m"] == pytest.approx(-1.0)


def test_poses_are_paired_once_by_the_nearest_time() -> None:
    dense = Trajectory(np.array([0.0, 0.09, 0.1, 0.11, 0.2, 0.5]), np.zeros((6, 3)))
    rare = Trajectory(np.array([0.001, 0.102, 0.3, 0.5]), np.zeros((4, 3)))
    first, second = associate(dense, rare, 0.01)
    assert first.tolist() == [0, 2, 5]
    assert second.tolist() == [0, 1, 3]
    second, first = associate(rare, dense, 0.01)
    assert first.tolist() == [0, 2, 5]
    assert second.tolist() == [0, 1, 3]
    # Halfway between two poses, the earlier is the pair.
    first, second = associate(line(), line().later(-0.5), 0.5)
    assert first.tolist() == second.tolist() == list(range(11))


@pytest.mark.parametrize("shift_s", [100.0, 9.995])
def test_paths_that_do_not_meet_name_both_ranges(shift_s: float) -> None:
    late = Trajectory(line().stamps_s + shift_s, line().poses, "late")
    with pytest.raises(TrajectoryError) as caught:
        trajectory_errors(late, line())
    message = str(caught.value)
    for word in ("at least two", "late", "line", "0.000 to 10.000", f"{shift_s:.3f} to"):
        assert word in message


def test_a_path_that_is_too_short_for_it_is_not_called_mirrored(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Of 60 pairs with noise alone in their yaws half turn against each other at first sight."""
    rng = np.random.default_rng(0)
    for count in [3] * 20 + [13] * 20 + [31] * 20:
        path, truth = (
            replace(own, poses=own.poses + rng.normal(0.0, 0.002, own.poses.shape))
            for own in [Trajectory(0.1 * np.arange(count), np.zeros((count, 3)), "path")] * 2
        )
        trajectory_errors(path, truth)
    assert "mirrored" not in caplog.text


@pytest.mark.parametrize(
    ("path", "factors", "what"),
    [
        (drive(), (1, -1, -1), "with y and yaw negated: is one of them mirrored?"),
        (drive(), (1, -1, 1), "with y negated: is one of them mirrored?"),
        (drive(), (1, 1, -1), "with yaw negated: is one of them mirrored?"),
        (drive(), (100, 100, 1), "multiplied by 0.01: is one of them in another unit than metres?"),
        (drive().later(1.5), (1, 1, 1), "about 1.6 s later: is one of them on another clock"),
        (drive(seed=2), (1, 1, 1), "by 3.288 m, which itself spreads by 2.517 m: are they of one"),
        (drive(noise=0.05), (1, 1, 1), ""),
    ],
)
def test_a_path_that_fits_the_truth_only_if_it_is_changed_is_named(
    path: Trajectory, factors: tuple[int, ...], what: str, caplog: pytest.LogCaptureFixture
) -> None:
    trajectory_errors(replace(path, poses=path.poses * factors), drive())
    assert len(caplog.messages) == bool(what)
    assert what in caplog.text


# --- evo as the judge ----------------------------------------------------------------------------


def evo_path(trajectory: Trajectory) -> Any:
    """Return a trajectory as evo has it."""
    core = pytest.importorskip("evo.core.trajectory", reason="evo comes with the test extra")
    half = trajectory.poses[:, 2] / 2.0
    zero = np.zeros(len(trajectory))
    return core.PoseTrajectory3D(
        positions_xyz=np.column_stack((trajectory.poses[:, :2], zero)),
        orientations_quat_wxyz=np.column_stack((np.cos(half), zero, zero, np.sin(half))),
        timestamps=trajectory.stamps_s,
    )


def evo_errors(
    estimate: Trajectory, truth: Trajectory, config: TrajectoryConfig
) -> dict[str, npt.NDArray[np.float64]]:
    """Return evo's errors of each pose and each pair: metres and radians."""
    from evo.core import metrics, sync  # noqa: PLC0415

    reference, found = sync.associate_trajectories(
        evo_path(truth), evo_path(estimate), max_diff=config.tolerance_s
    )
    if config.alignment == "se2":
        found.align(reference)
    unit = {"frames": metrics.Unit.frames, "m": metrics.Unit.meters}[config.rpe_unit]
    pairs = {"delta": config.rpe_delta, "delta_unit": unit, "pairs_from_reference": True}
    place, angle = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    wanted = {
        "ate": metrics.APE(place),
        "ate_rotation": metrics.APE(angle),
        "rpe": metrics.RPE(place, **pairs),
        "rpe_rotation": metrics.RPE(angle, **pairs),
    }
    for metric in wanted.values():
        metric.process_data((reference, found))
    return {name: np.asarray(metric.error) for name, metric in wanted.items()}


def assert_as_evo(estimate: Trajectory, truth: Trajectory, config: TrajectoryConfig) -> None:
    """Every single error is evo's, and so are the six figures of them."""
    judge = evo_errors(estimate, truth, config)
    found = trajectory_errors(estimate, truth, config)
    for name, ours in (
        ("ate", found.translation_m),
        ("ate_rotation", found.rotation_rad),
        ("rpe", found.relative_translation_m),
        ("rpe_rotation", found.relative_rotation_rad),
    ):
        assert len(ours) == len(judge[name]) > 0, name
        # evo has angles from 3 x 3 matrices: near 0 they keep half of the digits.
        np.testing.assert_allclose(ours, judge[name], rtol=0.0, atol=1e-6, err_msg=name)
        figures = plain(ErrorStatistics.of(ours))
        assert figures == pytest.approx(plain(ErrorStatistics.of(judge[name])), abs=1e-6)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("alignment", ["se2", "none"])
@pytest.mark.parametrize(("delta", "unit"), [(1.0, "frames"), (7.0, "frames"), (1.0, "m")])
def test_drawn_paths_have_evos_errors(seed: int, alignment: str, delta: float, unit: str) -> None:
    pytest.importorskip("evo", reason="evo comes with the test extra")
    truth = drive(seed=seed)
    noisy = drive(seed=seed, noise=0.05).moved(Pose2(4.0, -1.0, 2.5))
    config = TrajectoryConfig(alignment=alignment, rpe_delta=delta, rpe_unit=unit)
    assert_as_evo(noisy, truth, config)


# --- the offset of two clocks, found by the motion of two paths of one drive ----------------------


def long_drive(seconds: float = 90.0, step_s: float = 0.05, first_s: float = 0.0) -> Trajectory:
    """A robot that drives and turns as it pleases, from a second of the drive on."""
    times_s = np.arange(0.0, 120.0, 0.01)
    speed = 0.5 + 0.3 * np.sin(0.31 * times_s) * np.sin(0.07 * times_s + 1.0)
    yaw = 1.5 * np.sin(0.4 * times_s) + np.sin(0.23 * times_s + 0.5)
    x, y = (np.cumsum(0.01 * speed * turn) for turn in (np.cos(yaw), np.sin(yaw)))
    stamps_s = np.arange(first_s, first_s + seconds, step_s)
    rows = [np.interp(stamps_s, times_s, column) for column in (x, y, yaw)]
    return Trajectory(stamps_s, np.stack(rows, axis=1))


@pytest.mark.parametrize("offset_s", [0.0, 0.35, -3.2, 1_700_000_000.0])
@pytest.mark.parametrize("first_s", [0.0, 20.0])
def test_the_offset_of_another_clock_is_found(offset_s: float, first_s: float) -> None:
    path = long_drive(first_s=first_s, step_s=0.07)
    noise = np.random.default_rng(1).normal(0.0, [0.005, 0.005, 0.003], (len(path), 3))
    poses = moved_poses(Pose2(3.0, -2.0, 1.0), path.poses) + noise
    path = Trajectory(path.stamps_s - offset_s, poses)
    assert clock_offset_s(path, long_drive()) == pytest.approx(offset_s, abs=0.01)


def test_stamps_of_the_same_scans_meet_exactly() -> None:
    path = long_drive()
    relative = path.later(-path.stamps_s[0] - 12.345)
    assert clock_offset_s(relative, path) == pytest.approx(12.345, abs=1e-6)


def test_paths_of_two_drives_are_refused() -> None:
    other = long_drive(seconds=60.0)
    steps = np.random.default_rng(2).normal(0.0, [0.01, 0.01, 0.02], (len(other), 3))
    with pytest.raises(TrajectoryError, match="do not move alike"):
        clock_offset_s(Trajectory(other.stamps_s, np.cumsum(steps, axis=0)), long_drive())
    with pytest.raises(TrajectoryError, match="--time-offset in seconds"):
        on_clock(other, None, "auto")


@pytest.mark.parametrize("offset", ["1700000000", "auto"])
def test_a_truth_on_another_clock_is_measured_with_its_offset(offset: str) -> None:
    estimate = long_drive().later(1.7e9)
    with pytest.raises(TrajectoryError, match=r"1700000000\.000 s apart\? use --time-offset 17000"):
        trajectory_errors(estimate, long_drive())
    found = trajectory_errors(estimate, long_drive(), TrajectoryConfig(time_offset=offset))
    assert found.ate.rmse < 1e-3
    assert found.time_offset_s == pytest.approx(1.7e9)


@pytest.mark.parametrize("offset", ["soon", "nan", ""])
def test_an_offset_that_is_no_number_is_refused(offset: str) -> None:
    with pytest.raises(ConfigError, match="wanted seconds or auto"):
        TrajectoryConfig(time_offset=offset)
