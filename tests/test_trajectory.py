"""Stamped poses: order, finding by time, and length."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.errors import TrajectoryError
from slamfusion.geometry import Pose2
from slamfusion.trajectory import Trajectory


def line(*stamps: float) -> Trajectory:
    return Trajectory(np.array(stamps), np.array([(s, 0.0, 0.1) for s in stamps]).reshape(-1, 3))


def test_nearest_in_time_takes_the_earlier_on_a_tie():
    path = line(0.0, 1.0, 2.0, 4.0)
    assert path.nearest([-5.0, 0.4, 0.5, 0.6, 3.0, 3.1, 99.0]).tolist() == [0, 0, 0, 1, 2, 3, 3]
    assert line(3.0).nearest([1.0, 9.0]).tolist() == [0, 0]


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20).map(sorted),
    st.lists(st.floats(-2e3, 2e3), min_size=1, max_size=10),
)
def test_nearest_is_nearest(stamps: list[float], wanted: list[float]):
    found = line(*stamps).nearest(wanted)
    for time, index in zip(wanted, found, strict=True):
        assert abs(stamps[index] - time) == min(abs(stamp - time) for stamp in stamps)


def test_poses_match_times_within_a_limit():
    path = line(0.0, 1.0, 2.0)
    near, is_matched = path.matches([[-1.0, 0.0009], [1.0011, 1.75]])
    assert near.tolist() == [[0, 0], [1, 2]]
    assert is_matched.tolist() == [[False, True], [False, False]]
    assert path.matches([1.75, 2.5], 0.25)[1].tolist() == [True, False]


def test_length_and_poses():
    path = Trajectory(np.arange(3.0), np.array([(0, 0, 0), (3, 4, 1), (3, 5, 2)]))
    assert path.path_length_m() == pytest.approx(6.0)
    assert path.pose(1) == Pose2(3.0, 4.0, 1.0)
    assert len(path) == 3
    assert line().path_length_m() == 0.0


def test_values_are_frozen_and_the_trajectory_s_own():
    stamps = np.arange(2.0)
    path = Trajectory(stamps, np.zeros((2, 3)))
    stamps[0] = 9.0
    assert path.stamps_s[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        path.poses[0, 0] = 1.0


@pytest.mark.parametrize(
    ("stamps", "poses", "words"),
    [
        ([0.0, 1.0], np.zeros((1, 3)), "do not fit"),
        ([0.0, math.nan], np.zeros((2, 3)), "finite"),
        ([0.0, 1.0], np.full((2, 3), math.inf), "finite"),
        ([1.0, 0.5, 2.0], np.zeros((3, 3)), "time goes back at pose 1"),
    ],
)
def test_what_is_no_trajectory(stamps: list[float], poses: np.ndarray, words: str):
    with pytest.raises(TrajectoryError, match=words):
        Trajectory(np.array(stamps), poses)


def test_nothing_is_nearest_to_no_pose():
    with pytest.raises(TrajectoryError, match="has no pose"):
        line().nearest([0.0])
    with pytest.raises(TrajectoryError, match="has no pose"):
        line().matches([0.0])
