"""The relations metric: motions that are kept have no error, and a slip counts where it is."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.errors import TrajectoryError
from slamfusion.evaluation.relations import (
    RelationErrors,
    Relations,
    errors_at_scans,
    read_relations,
    relation_errors,
)
from slamfusion.evaluation.statistics import mean_interval
from slamfusion.geometry import compose_poses, invert_poses
from slamfusion.io.trajectories import read_trajectory
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import by_steps
from tests.support.datasets import ABSENT, DATASETS

CSAIL = DATASETS / "mit-csail"
# The table of the recordings counts "exact" stamps only.
EXACT_S = 2e-5


def drive(count: int = 60, seed: int = 1) -> Trajectory:
    """A path of random steps, ten poses a second."""
    rng = np.random.default_rng(seed)
    poses = by_steps(rng.normal((0.1, 0.0, 0.0), (0.05, 0.02, 0.2), (count - 1, 3)))
    return Trajectory(1000.0 + 0.1 * np.arange(count), poses, "drive")


def relations_of(trajectory: Trajectory, pairs: npt.NDArray[np.int64]) -> Relations:
    """The motions that a trajectory itself makes between pairs of its poses."""
    first, second = trajectory.poses[pairs[:, 0]], trajectory.poses[pairs[:, 1]]
    motions = compose_poses(invert_poses(first), second)
    return Relations(trajectory.stamps_s[pairs], motions, "own")


def random_pairs(count: int, of: int) -> npt.NDArray[np.int64]:
    return np.random.default_rng(2).integers(0, of, (count, 2))


@given(st.floats(-500, 500), st.floats(-500, 500), st.floats(-4, 4))
def test_kept_motions_have_no_error_in_any_frame(x: float, y: float, yaw_rad: float) -> None:
    path = drive()
    moved = Trajectory(path.stamps_s, compose_poses((x, y, yaw_rad), path.poses))
    found = relation_errors(moved, relations_of(path, random_pairs(40, 60)), 0.01)
    assert found.relations_used == found.relations_total == 40
    assert found.translation_m.max() < 1e-9
    assert found.rotation_rad.max() < 1e-9


def test_the_error_of_one_relation_by_hand() -> None:
    # The robot turned left by 90 degrees and should have gone 2 m along its nose; it went 2.5 m,
    # and turned 30 degrees too far.
    path = Trajectory(
        np.array([0.0, 1.0]),
        np.array([[5.0, 1.0, math.pi / 2], [5.0, 3.5, math.pi / 2 + math.radians(30)]]),
    )
    found = relation_errors(path, Relations([[0.0, 1.0]], [[2.0, 0.0, 0.0]]), 0.01)
    assert found.translation_m == pytest.approx([0.5])
    assert found.rotation_deg.mean == pytest.approx(30.0)


def test_rotations_wrap() -> None:
    path = Trajectory(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]]))
    found = relation_errors(path, Relations([[0.0, 1.0]], [[0.0, 0.0, 0.0]]), 0.01)
    assert found.rotation_rad == pytest.approx([2 * math.pi - 6.2])


def test_a_slip_counts_at_the_relations_across_it_only() -> None:
    path = drive()
    pairs = np.column_stack((np.arange(59), np.arange(1, 60)))
    slipped = path.poses.copy()
    slipped[30:] = compose_poses((7.0, -3.0, 1.0), slipped[30:])
    found = relation_errors(Trajectory(path.stamps_s, slipped), relations_of(path, pairs), 0.01)
    wrong = np.flatnonzero(found.translation_m > 1e-9)
    assert wrong.tolist() == [29]


def errors_of(
    stamps_s: npt.NDArray[np.float64], translation_m: npt.NDArray[np.float64], total: int
) -> RelationErrors:
    return RelationErrors(
        relations_total=total,
        tolerance_s=0.01,
        poses=9,
        name="a",
        relations="b",
        stamps_s=stamps_s,
        translation_m=translation_m,
        rotation_rad=np.zeros(len(translation_m)),
    )


def test_the_statistics_are_those_of_the_population() -> None:
    document = plain(errors_of(np.zeros((3, 2)), np.array([1.0, 2.0, 6.0]), 5))
    assert document["translation"]["mean"] == 3.0
    assert document["translation"]["std"] == pytest.approx(math.sqrt(14 / 3))
    assert document["translation"]["rmse"] == pytest.approx(math.sqrt(41 / 3))
    assert document["translation"]["max"] == 6.0
    assert (document["relations_used"], document["relations_total"]) == (3, 5)
    assert (document["tolerance_s"], document["poses"]) == (0.01, 9)


def test_relations_outside_the_tolerance_are_left_out_and_counted() -> None:
    path = drive()
    relations = relations_of(path, random_pairs(20, 60))
    shifted = relations.stamps_s.copy()
    shifted[:5, 1] += 0.03
    shifted[5:8, 0] = 5000.0
    late = Relations(shifted, relations.motions)
    assert relation_errors(path, late, 0.01).relations_used == 12
    assert relation_errors(path, late, 0.04).relations_used == 17
    assert relation_errors(path, late, 0.04).relations_total == 20


def test_revisits_are_relations_over_half_a_minute() -> None:
    stamps = np.array([[0.0, 29.0], [40.0, 0.0], [0.0, 31.0]])
    errors = errors_of(stamps, np.zeros(3), 3)
    assert errors.is_revisit().tolist() == [False, True, True]


def test_relations_at_scans_are_those_with_a_scan_at_both_ends() -> None:
    path = drive()
    relations = relations_of(path, random_pairs(20, 60))
    stamps, motions = relations.stamps_s.copy(), relations.motions.copy()
    stamps[:12, 0] += 0.005  # near enough to be used, but no scan's own time
    stamps[12] += 1e-6  # the digits of a file
    motions[13:, 0] += 0.3
    found = errors_at_scans(path, Relations(stamps, motions))
    assert (found.relations_used, found.relations_total) == (8, 20)
    assert found.translation_m == pytest.approx([0.0] + [0.3] * 7)
    document = plain(found)
    assert document["translation"]["mean"] == pytest.approx(2.1 / 8)
    assert document["translation_mean_95"] == list(mean_interval(found.translation_m))
    assert document["rotation_deg_mean_95"] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_no_relation_names_both_ranges_of_time() -> None:
    relations = Relations([[50.0, 60.5]], [[0.0, 0.0, 0.0]], "known")
    with pytest.raises(TrajectoryError) as caught:
        relation_errors(drive(), relations, 0.01)
    message = str(caught.value)
    for word in ("drive", "known", "1000.000", "1005.900", "50.000", "60.500", "--tolerance-s"):
        assert word in message
    assert "\n" not in message


TEXT = """# t1 t2 x y z roll pitch yaw
1134864645.90321 1134864646.32420 0.31293 0.02935 0.5  0.6 0.7 0.24198

  976052905.167303 976052911.885496 -0.056990 -0.128430 0 0 0 -1.682210
"""


@pytest.mark.parametrize("packed", [False, True])
def test_files_are_read_plain_and_packed(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / ("my.relations.gz" if packed else "my.relations")
    path.write_bytes(gzip.compress(TEXT.encode()) if packed else TEXT.encode())
    found = read_relations(path)
    assert found.name == "my"
    assert found.stamps_s.tolist() == [
        [1134864645.90321, 1134864646.32420],
        [976052905.167303, 976052911.885496],
    ]
    assert found.motions.tolist() == [[0.31293, 0.02935, 0.24198], [-0.05699, -0.12843, -1.68221]]
    assert not found.motions.flags.writeable
    assert found.span_s() == (976052905.167303, 1134864646.32420)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 2 3 4 5 6 7", "line 4: wanted 't1 t2 x y z roll pitch yaw', found 7 columns"),
        ("1 2 3 4 5 6 7 8 9", "line 4: wanted 't1 t2 x y z roll pitch yaw', found 9 columns"),
        ("1 2 3 4 5 6 7 x", "line 4, column 8 of 8: wanted a finite number, found 'x'"),
        ("1 2 nan 4 5 6 7 8", "line 4, column 3 of 8: wanted a finite number"),
        ("inf 2 3 4 5 6 7 8", "line 4, column 1 of 8: wanted a finite number"),
        ("\x00\xff\x01", "line 4: wanted 't1"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "bad.relations"
    path.write_bytes(b"# head\n1 2 3 4 5 6 7 8\n\n" + line.encode("latin-1") + b"\n")
    with pytest.raises(TrajectoryError) as caught:
        read_relations(path)
    assert f"{path}: {words}" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"\n\n", b"# nothing but words\n"])
def test_a_file_without_relations_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "none.relations"
    path.write_bytes(content)
    with pytest.raises(TrajectoryError, match="found none"):
        read_relations(path)


def test_a_path_is_not_taken_for_relations_although_it_has_as_many_columns(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum"
    path.write_text("1 0 0 0 0 0 0 1\n", encoding="ascii")
    with pytest.raises(TrajectoryError, match="wanted relations, found a path; "):
        read_relations(path)


@pytest.mark.datasets
@pytest.mark.skipif(not CSAIL.is_dir(), reason=ABSENT)
@pytest.mark.parametrize(
    ("run", "file", "used", "translation", "rotation"),
    [
        ("mit-csail", "mit-csail.clf.gz", 1172, (1.6815, 5.2922), (5.07, 8.24)),
        ("mit-csail", "mit-csail-reference-graph.log.gz", 1172, (0.0045, 0.0093), (0.046, 0.087)),
        ("mit-csail", "mit-csail-estimate-1592.txt.gz", 927, (0.0364, 0.1121), (0.33, 0.29)),
        ("intel", "intel-910-corrected.poses.csv.gz", 90, (0.0363, 0.0266), (0.42, 0.46)),
        ("intel", "intel-reference-graph.log.gz", 301, (0.0287, 0.0192), (0.39, 0.34)),
        ("intel", "intel-estimate-11439.txt.gz", 2518, (0.0224, 0.0410), (0.39, 0.56)),
    ],
)
def test_the_recordings_have_their_known_errors(
    run: str, file: str, used: int, translation: tuple[float, float], rotation: tuple[float, float]
) -> None:
    known = read_relations(DATASETS / run / f"{run}.relations")
    found = relation_errors(read_trajectory(DATASETS / run / file), known, EXACT_S)
    assert found.relations_used == used
    place, turn = found.translation, found.rotation_deg
    assert (place.mean, place.std) == pytest.approx(translation, abs=5.1e-5)
    assert (turn.mean, turn.std) == pytest.approx(rotation, abs=5.1e-3)
