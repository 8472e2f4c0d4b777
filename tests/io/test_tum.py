"""Claims about writing TUM files, with evo as the judge."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.geometry import quaternion_yaw_rad, wrap_angles
from slamfusion.io import read_trajectory, write_tum
from slamfusion.trajectory import Trajectory

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


@pytest.mark.parametrize("length", [1.0, 0.5, 20.0])
def test_the_heading_of_a_quaternion_does_not_depend_on_its_length(length: float) -> None:
    quaternion = np.array((0.0, 0.0, math.sin(0.4), math.cos(0.4))) * length
    assert quaternion_yaw_rad(*quaternion) == pytest.approx(0.8)


def test_roll_does_not_change_the_heading() -> None:
    # Yaw 0.8, then roll 0.3 about the turned x axis.
    yaw, roll = 0.4, 0.15
    quaternion = (
        math.cos(yaw) * math.sin(roll),
        math.sin(yaw) * math.sin(roll),
        math.sin(yaw) * math.cos(roll),
        math.cos(yaw) * math.cos(roll),
    )
    assert quaternion_yaw_rad(*quaternion) == pytest.approx(0.8)


def test_the_quaternion_0_has_no_heading() -> None:
    assert math.isnan(quaternion_yaw_rad(0.0, 0.0, 0.0, 0.0))
