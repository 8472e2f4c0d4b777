"""Claims about reading trajectories from whatever file holds them, and writing TUM files."""

from __future__ import annotations

import gzip
import logging
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, TrajectoryError
from slamfusion.geometry import wrap_angles
from slamfusion.io import read_trajectory, write_tum
from slamfusion.trajectory import Trajectory
from tests.io.logs import flaser, robotlaser, write_lines
from tests.support.datasets import DATASETS

TURN = f"0 0 {math.sin(0.25)} {math.cos(0.25)}"  # yaw 0.5


def read(folder: Path, name: str, *lines: str) -> list[list[float]]:
    """Write a file, read it, and return its rows: time, x, y, yaw."""
    found = read_trajectory(write_lines(folder / name, *lines))
    return np.column_stack((found.stamps_s, found.poses)).tolist()


@pytest.mark.parametrize("name", ["a.tum", "a.txt", "anything"])
def test_eight_columns_are_a_tum_file(tmp_path: Path, name: str) -> None:
    rows = read(tmp_path, name, "# heading", "", f"1.5 1 2 9 {TURN}", f"2.5 3 4 9 {TURN}")
    assert rows == [pytest.approx([1.5, 1, 2, 0.5]), pytest.approx([2.5, 3, 4, 0.5])]


def test_packed_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.b.tum.gz"
    path.write_bytes(gzip.compress(f"1.5 1 2 9 {TURN}\n".encode()))
    found = read_trajectory(path)
    assert found.name == "a.b"
    assert found.poses[0] == pytest.approx([1.0, 2.0, 0.5])


@pytest.mark.parametrize("name", ["a.tum", "a.log", "a.log.gz"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
def test_a_text_may_come_from_any_editor(
    tmp_path: Path, name: str, end: str, encoding: str
) -> None:
    lines = [flaser(k, robot=(k, 2, 0.5)) for k in (1.5, 2.5)]
    if name == "a.tum":
        lines = ["# time x y z ...", *(f"{k} {k} 2 9 {TURN}" for k in (1.5, 2.5))]
    text = ("\ufeff" if encoding == "utf-16-be" else "") + "".join(line + end for line in lines)
    data = text.encode(encoding)
    (tmp_path / name).write_bytes(gzip.compress(data) if name.endswith("gz") else data)
    found = read_trajectory(tmp_path / name)
    assert found.poses == pytest.approx(np.array([[1.5, 2.0, 0.5], [2.5, 2.0, 0.5]]))


@pytest.mark.parametrize("digits", [0, 3, 6, 9])
def test_the_unit_of_a_time_is_that_of_its_magnitude(tmp_path: Path, digits: int) -> None:
    first, last = (f"{10**digits * 1134864629.895182:.6f}", f"{10**digits * 1134864630}")
    (row, _) = read(tmp_path, "a.txt", f"{first} 1 2 0.5", f"{last} 3 4 0.5")
    assert row == pytest.approx([1134864629.895182, 1.0, 2.0, 0.5], abs=1e-6)


def test_csv_with_its_heading(tmp_path: Path) -> None:
    rows = read(tmp_path, "a.csv", "ipc_timestamp,x,y,theta", "1.5,1,2,0.5", "2.5,3,4,0.25")
    assert rows == [[1.5, 1.0, 2.0, 0.5], [2.5, 3.0, 4.0, 0.25]]


def test_recorded_odometry_out_of_order_is_sorted_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="slamfusion"):
        rows = read(tmp_path, "a.txt", "1 1 0 0", "3 3 0 0", "2 2 0 0", "3 4 0 0")
    assert [row[:2] for row in rows] == [[1, 1], [2, 2], [3, 3], [3, 4]]
    assert "1 rows are earlier" in caplog.text


def test_a_log_gives_the_odometry_of_its_scans(tmp_path: Path) -> None:
    lines = [
        flaser(1.5, robot=(1, 2, 0.5), laser=(9, 9, 9)),
        "FLASER 3",
        flaser(2, robot=(3, 4, 0)),
    ]
    assert read(tmp_path, "a.log", *lines) == [[1.5, 1, 2, 0.5], [2, 3, 4, 0]]


def test_a_log_without_time_says_that_its_times_are_made_up(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_lines(tmp_path / "a.log", flaser(0), flaser(0))
    found = read_trajectory(path, LogConfig(index_period_s=0.5))
    assert found.stamps_s.tolist() == [0.0, 0.5]
    assert "times are made from indices" in caplog.text


def test_a_graph_gives_its_vertices_at_the_times_of_their_scans(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = [
        "VERTEX2 0 1 2 0.5",
        robotlaser(7.5, robot=(1.3, 2, 0.5)),
        "VERTEX2 1 3 4 0.25",
        robotlaser(6.5),
        "VERTEX2 2 5 6 0.25",
        robotlaser(7.5),
        "VERTEX2 3 7 8 0",
        "EDGE2 0 1 1 1 0 1 0 1 1 0 0",
    ]
    assert read(tmp_path, "a.log", *lines) == [[6.5, 3, 4, 0.25], [7.5, 1, 2, 0.5]]
    assert "1 vertices have the stamp of an earlier one" in caplog.text
    assert "1 vertices have no scan" in caplog.text


def test_a_vertex_of_three_digits_takes_the_pose_of_its_scan(tmp_path: Path) -> None:
    line = robotlaser(7.5, robot=(576.536523, 0.106594, -2.255213))
    assert read(tmp_path, "a.log", "VERTEX2 0 577 0.107 -2.26", line) == [
        [7.5, 576.536523, 0.106594, -2.255213]
    ]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "found no pose at all"),
        (["# only a comment"], "found no pose at all"),
        (["1 2 3"], "found 3 columns: '1 2 3'"),
        (
            ["0,5 1,0 2,0 0,1"],
            "found 5 columns, with decimal commas where points are wanted: '0,5 1",
        ),
        (["0,5;1,0;2,0;0,1"], "with decimal commas where points are wanted: '0,5;1,0;2,0;0,1'"),
        (["hello world, this is text"], "found 2 columns: 'hello"),
        (["VERTEX_SE2 0 0 0 0"], "found 5 columns: 'VERTEX_SE2"),
        (["a b c d"], "found 4 columns, the first of them no time: 'a b c d'"),
        (["1 0 0 0", "2 0 0"], "line 2: wanted 4 columns as in the lines before, found 3"),
        (["1 0 0 0", "2 0 x 0"], "line 2, column 3 of 4: wanted a finite number, found 'x'"),
        (["1 0 0 0", "2 0 nan 0"], "line 2, column 3 of 4: wanted a finite number"),
        ([f"1 0 0 0 {TURN}", f"inf 0 0 0 {TURN}"], "line 2, column 1 of 8: wanted a finite number"),
        ([f"1 0 0 0 {TURN}", "2 0 0 0 0 0 0 0"], "line 2: the quaternion has length 0, wanted 1"),
        (["t,note,x,y,yaw", "1,a,0,0,0", "2,b,0,x,0"], "line 3, column 4 of 5: wanted a finite"),
        ([f"2 0 0 0 {TURN}", f"1 0 0 0 {TURN}"], "line 2: time goes back from 2.000000 to 1"),
        (["1 2 0.5 0.1 0 0 0 0.2"], "line 1: the quaternion has length 0.2"),
        (["VERTEX2 0 1 2 0.5", "EDGE2 0 1 1 1 0 1 0 1 1 0 0"], "no ROBOTLASER1 line"),
        (["VERTEX2 0 1 2"], "line 1: wanted 'VERTEX2 id x y theta'"),
        (["VERTEX2 0 1 2 0.5", "ROBOTLASER1 0 1"], "line 2: pose or time not finite"),
    ],
)
def test_what_is_no_trajectory_is_one_clear_line(
    tmp_path: Path, lines: list[str], words: str
) -> None:
    path = write_lines(tmp_path / "a.txt", *lines)
    with pytest.raises(TrajectoryError) as caught:
        read_trajectory(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.5, 0.0002])
def test_a_cut_off_packed_file_is_an_error(tmp_path: Path, share: float) -> None:
    rng = np.random.default_rng(2)
    text = "".join(f"{k} {rng.random()} 0 0\n" for k in range(9000))
    packed = gzip.compress(text.encode())
    path = tmp_path / "a.txt.gz"
    path.write_bytes(packed[: int(len(packed) * share)])
    with pytest.raises(TrajectoryError, match=r"line \d+: the packed file ends early"):
        read_trajectory(path)


def test_a_log_without_a_laser_is_a_log_error(tmp_path: Path) -> None:
    path = write_lines(tmp_path / "a.log", "ODOM 0 0 0 0 0 0 1 h 0")
    with pytest.raises(LogError, match="no laser in it"):
        read_trajectory(path)


def test_a_missing_file_is_the_systems_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_trajectory(tmp_path / "none.tum")


@pytest.mark.parametrize("name", ["truth.yaml", "truth.pgm.gz"])
def test_a_map_is_named_with_what_reads_it(tmp_path: Path, name: str) -> None:
    with pytest.raises(TrajectoryError, match="found a map; `slamfusion fuse` and `evaluate`"):
        read_trajectory(write_lines(tmp_path / name, "image: truth.pgm"))


@pytest.mark.datasets
@pytest.mark.parametrize(
    ("name", "poses", "path_m"),
    [
        ("mit-csail/mit-csail.clf.gz", 1988, 373.6),
        ("mit-csail/mit-csail-reference-graph.log.gz", 1051, 382.9),
        ("mit-csail/mit-csail-estimate-1592.txt.gz", 1592, None),
        ("mit-csail/csail-406-corrected.poses.csv.gz", 406, 379.6),
        ("intel/intel-reference-graph.log.gz", 2672, 393.6),
        ("intel/intel-estimate-11439.txt.gz", 11439, None),
        ("intel/intel-odometry-13631.txt.gz", 13631, None),
        ("intel/intel-910-corrected.poses.csv.gz", 910, 499.6),
        ("maps/multi-slam/mit-csail/karto.tum", 1468, None),
    ],
)
def test_recorded_trajectories(
    name: str, poses: int, path_m: float | None, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    found = read_trajectory(DATASETS / name)
    assert len(found) == poses
    if path_m is not None:
        assert found.path_length_m() == pytest.approx(path_m, abs=0.06)
    assert found.stamps_s[0] > 9e8


# --- TUM files, with evo as the judge -------------------------------------------------------------

TWO = Trajectory([1.5, 2.0], [(1.0, -2.0, math.pi / 2.0), (3.0, 4.0, -math.pi / 3.0)])


def test_the_file_is_what_the_format_says(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    write_tum(path, TWO)
    heading, first, _ = path.read_text().splitlines()
    assert heading == "# timestamp tx ty tz qx qy qz qw"
    half = math.sqrt(0.5)
    expected = [1.5, 1.0, -2.0, 0.0, 0.0, 0.0, half, half]
    assert [float(item) for item in first.split()] == pytest.approx(expected, abs=1e-11)


def test_evo_reads_what_we_write(tmp_path: Path) -> None:
    file_interface = pytest.importorskip(
        "evo.tools.file_interface", reason="evo is a test oracle that is not installed"
    )
    rng = np.random.default_rng(5)
    poses = np.column_stack((rng.normal(size=(50, 2)) * 500.0, rng.uniform(-9.0, 9.0, 50)))
    ours = Trajectory(1.2e9 + np.arange(50) * 0.1, poses)
    path = tmp_path / "a.tum"
    write_tum(path, ours)
    theirs = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_allclose(theirs.timestamps, ours.stamps_s, atol=1e-6, rtol=0)
    np.testing.assert_allclose(theirs.positions_xyz[:, :2], poses[:, :2], atol=1e-8)
    yaws = theirs.get_orientations_euler()[:, 2]
    np.testing.assert_allclose(wrap_angles(yaws - poses[:, 2]), 0.0, atol=1e-9)
    assert theirs.check()[0]


@settings(deadline=None)
@given(
    rows=st.lists(
        st.tuples(
            st.integers(0, 10**12), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-10, 10)
        ),
        min_size=1,
        max_size=6,
    ),
    packed=st.booleans(),
)
def test_what_is_written_reads_back(
    rows: list[tuple[int, float, float, float]],
    packed: bool,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    table = np.array(sorted(rows), dtype=np.float64)
    ours = Trajectory(table[:, 0] * 1e-3, table[:, 1:])
    path = tmp_path_factory.mktemp("tum") / ("a.tum.gz" if packed else "a.txt")
    write_tum(path, ours)
    back = read_trajectory(path)
    assert back.name == "a"
    np.testing.assert_allclose(back.stamps_s, ours.stamps_s, atol=1e-6, rtol=0)
    np.testing.assert_allclose(back.poses[:, :2], ours.poses[:, :2], atol=1e-8)
    np.testing.assert_allclose(wrap_angles(back.poses[:, 2] - ours.poses[:, 2]), 0, atol=1e-9)
