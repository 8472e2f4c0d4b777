"""Poses between scans: composed with raw odometry, whose rows are found by pose, not by stamp."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.errors import TrajectoryError
from slamfusion.evaluation.odometry import match_odometry, poses_by_odometry, rows_by_stamp
from slamfusion.evaluation.relations import Relations, read_relations, relation_errors
from slamfusion.geometry import compose_poses
from slamfusion.io.trajectories import read_trajectory
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evaluation.test_relations import random_pairs, relations_of
from tests.evidence.rooms import by_steps
from tests.support.datasets import ABSENT, DATASETS
from tests.support.examples import examples

INTEL = DATASETS / "intel"
TOLERANCE_S = 0.01
START_S = 1000.0


def run(count: int = 400, seed: int = 3) -> tuple[Trajectory, Trajectory]:
    """The truth of a run, and its odometry: drifting, at rest for a while, five rows a second."""
    rng = np.random.default_rng(seed)
    steps = rng.normal((0.1, 0.0, 0.02), (0.03, 0.0, 0.1), (count - 1, 3))
    steps[100:130] = 0.0
    slip = 1.0 + rng.normal(0.0, 0.05, steps.shape) + (0.0, 0.0, 0.1)
    stamps = START_S + 0.2 * np.arange(count)
    truth = Trajectory(stamps, by_steps(steps), "truth")
    return truth, Trajectory(stamps, by_steps(steps * slip), "odometry")


def part(path: Trajectory, rows: npt.NDArray[np.int64], late_s: npt.ArrayLike = 0.0) -> Trajectory:
    """Some poses of a path, with other stamps."""
    stamps = np.maximum.accumulate(path.stamps_s[rows] + np.asarray(late_s))
    return Trajectory(stamps, path.poses[rows], f"part of {path.name}")


def test_at_every_row_the_estimate_is_kept() -> None:
    truth, odometry = run()
    relations = relations_of(truth, random_pairs(300, 400))
    for scans in (None, odometry):
        dense = poses_by_odometry(truth, scans, odometry, tolerance_s=TOLERANCE_S)
        found = relation_errors(dense.trajectory, relations, TOLERANCE_S)
        assert found.relations_used == 300
        assert found.translation.mean < 0.002
        # Where the robot stands, any of the equal rows may be taken for a scan's.
        np.testing.assert_allclose(dense.trajectory.poses, truth.poses, atol=1e-12)


def test_between_scans_the_wheels_carry_the_pose_on() -> None:
    truth, odometry = run()
    every_tenth = np.arange(0, 400, 10)
    estimate = part(truth, every_tenth)
    dense = poses_by_odometry(estimate, None, odometry, tolerance_s=TOLERANCE_S)
    # Row 13 belongs to scan 10, row 17 to scan 20, row 15 to the earlier of the two.
    for row, scan in ((13, 10), (17, 20), (15, 10)):
        step = odometry.pose(scan).inverse().compose(odometry.pose(row))
        wanted = truth.pose(scan).compose(step)
        found = dense.trajectory.pose(row)
        assert (found.x, found.y) == pytest.approx((wanted.x, wanted.y), abs=1e-12)
    assert plain(dense) == {
        "rows": 400,
        "rows_found_by": "stamp",
        "poses_used": 40,
        "poses_without_row": 0,
    }
    relations = relations_of(truth, random_pairs(300, 400))
    carried = relation_errors(dense.trajectory, relations, TOLERANCE_S)
    assert carried.relations_used == 300
    drifted = relation_errors(odometry, relations, TOLERANCE_S)
    assert carried.translation.mean < 0.1 * drifted.translation.mean


@settings(max_examples=examples(25))
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3), st.integers(0, 1000))
def test_rows_are_found_in_another_frame_and_with_wrong_stamps(
    x: float, y: float, yaw_rad: float, seed: int
) -> None:
    _, odometry = run()
    rows = np.sort(np.random.default_rng(seed).choice(400, 150, replace=False))
    late = np.random.default_rng(seed).uniform(-3.0, 3.0, 150)
    exact = part(odometry, rows, late)
    poses = compose_poses((x, y, yaw_rad), exact.poses)
    matched = match_odometry(Trajectory(exact.stamps_s, poses), odometry)
    assert np.count_nonzero(matched >= 0) == 150
    found = odometry.poses[matched]
    np.testing.assert_allclose(found, odometry.poses[rows], atol=1e-9)


def test_stamps_that_are_off_do_no_harm_where_the_log_is_known() -> None:
    truth, odometry = run()
    rows = np.arange(0, 400, 4)
    # Each scan has the stamp of a row, as a rule of a wrong one.
    stamps = truth.stamps_s[np.sort(np.random.default_rng(8).choice(400, 100, replace=False))]
    estimate, scans = (
        Trajectory(stamps, path.poses[rows], path.name) for path in (truth, odometry)
    )
    relations = relations_of(truth, random_pairs(300, 400))
    means = {}
    for known in (scans, None):
        dense = poses_by_odometry(estimate, known, odometry, tolerance_s=TOLERANCE_S)
        found = relation_errors(dense.trajectory, relations, TOLERANCE_S)
        means[dense.rows_found_by] = found.translation.mean
    assert means["odometry"] < 0.05
    assert means["stamp"] > 10.0 * means["odometry"]


def test_a_place_that_is_met_again_minutes_later_is_another_row() -> None:
    # Twice round one closed curve without drift: every pose comes twice, 100 s apart.
    turn = np.linspace(0.0, 4.0 * np.pi, 1001)[:-1]
    radius = 5.0 + np.sin(turn) + 0.5 * np.cos(3.0 * turn)
    poses = np.column_stack((radius * np.cos(turn), radius * np.sin(turn), turn))
    odometry = Trajectory(0.2 * np.arange(1000), poses, "laps")
    rows = np.arange(0, 1000, 7)
    matched = match_odometry(part(odometry, rows, 0.3), odometry)
    assert matched.tolist() == rows.tolist()


def test_scans_without_a_row_are_counted_and_left_out() -> None:
    truth, odometry = run()
    rows = np.arange(0, 400, 10)
    scans = part(odometry, rows)
    wrong = scans.poses.copy()
    wrong[7] += (0.02, 0.0, 0.0)
    scans = Trajectory(scans.stamps_s, wrong, "scans")
    assert match_odometry(scans, odometry)[7] == -1
    dense = poses_by_odometry(part(truth, rows), scans, odometry, tolerance_s=TOLERANCE_S)
    assert dense.poses_without_row == 1
    assert dense.rows_found_by == "odometry"


def test_odometry_of_another_run_is_refused() -> None:
    truth, odometry = run()
    _, other = run(seed=4)
    late = Trajectory(other.stamps_s + 5000.0, other.poses, "other")
    with pytest.raises(TrajectoryError, match=r"other: no row equals the odometry of a scan"):
        match_odometry(odometry, late)
    with pytest.raises(TrajectoryError, match=r"truth: no pose .* 1000\.000 .* 6000\.000"):
        poses_by_odometry(truth, None, late, tolerance_s=0.01)
    with pytest.raises(TrajectoryError, match=r"truth: no pose .* of other .* 6000\.000"):
        poses_by_odometry(truth, late, odometry, tolerance_s=0.01)


def least_cost(poses_s: list[float], rows_s: list[float], tolerance_s: float) -> float:
    """The least cost of giving poses rows in order, by trying all; left out costs the tolerance."""
    best = tolerance_s * len(poses_s)
    for count in range(1, min(len(poses_s), len(rows_s)) + 1):
        for poses in itertools.combinations(poses_s, count):
            for rows in itertools.combinations(rows_s, count):
                apart = [abs(a - b) for a, b in zip(poses, rows, strict=True)]
                if max(apart) <= tolerance_s:
                    cost = sum(apart) + tolerance_s * (len(poses_s) - count)
                    best = min(best, cost)
    return best


@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=5),
    st.lists(st.integers(0, 6), min_size=1, max_size=6),
    st.sampled_from([0.4, 1.0, 2.5]),
)
def test_rows_by_stamp_are_the_best_in_order(
    tenths: list[int], whole: list[int], tolerance_s: float
) -> None:
    poses_s, rows_s = sorted(value / 10.0 for value in tenths), sorted(float(v) for v in whole)
    paths = [Trajectory(np.array(s), np.zeros((len(s), 3))) for s in (poses_s, rows_s)]
    used, rows = rows_by_stamp(*paths, tolerance_s)
    assert (np.diff(used) > 0).all()
    assert (np.diff(rows) > 0).all()
    apart = np.abs(np.array(poses_s)[used] - np.array(rows_s)[rows])
    assert (apart <= tolerance_s + 1e-9).all()
    cost = float(apart.sum()) + tolerance_s * (len(poses_s) - len(used))
    assert cost == pytest.approx(least_cost(poses_s, rows_s, tolerance_s), abs=1e-6)


# --- the Intel run -------------------------------------------------------------------------------


def intel(log: str) -> tuple[Trajectory, Trajectory, Relations]:
    """The odometry of a log's scans, of the whole run, and the relations."""
    return (
        read_trajectory(INTEL / f"intel-{log}-raw.log.gz"),
        read_trajectory(INTEL / "intel-odometry-13631.txt.gz"),
        read_relations(INTEL / "intel.relations"),
    )


def score(
    estimate: Trajectory, scans: Trajectory | None, odometry: Trajectory, relations: Relations
) -> tuple[float, float]:
    """Mean and deviation of the translation error; all relations must count."""
    dense = poses_by_odometry(estimate, scans, odometry, tolerance_s=TOLERANCE_S)
    found = relation_errors(dense.trajectory, relations, TOLERANCE_S)
    assert found.relations_used == len(relations)
    return found.translation.mean, found.translation.std


@pytest.mark.datasets
@pytest.mark.skipif(not INTEL.is_dir(), reason=ABSENT)
@pytest.mark.parametrize(("log", "scans_in_it"), [("910", 910), ("2726", 2726)])
def test_every_scan_of_intel_has_its_row_and_paths_their_known_errors(
    log: str, scans_in_it: int
) -> None:
    scans, odometry, relations = intel(log)
    matched = match_odometry(scans, odometry)
    assert np.count_nonzero(matched >= 0) == scans_in_it
    assert len(relations) == 2984
    assert score(scans, scans, odometry, relations)[0] == pytest.approx(7.39, abs=0.02)
    if log == "910":
        gmapping = read_trajectory(INTEL / "intel-910-corrected.poses.csv.gz")
        found = score(gmapping, scans, odometry, relations)
        assert found == pytest.approx((0.0507, 0.047), abs=5e-4)
