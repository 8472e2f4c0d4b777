"""Walls that two maps share are one corner where two straight lines take them all."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.align.common_walls import BAND_M, beside_lines, beside_lines_m
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.fusion.drawings import features_of
from tests.support.examples import examples

F64 = npt.NDArray[np.float64]
STEP_M = 0.05


def wall(from_xy: tuple[float, float], to_xy: tuple[float, float]) -> F64:
    """Return the points (N, 2) of a straight wall, metres."""
    along = np.array(to_xy) - np.array(from_xy)
    steps = np.arange(0.0, float(np.hypot(*along)), STEP_M) / np.hypot(*along)
    return np.array(from_xy) + steps[:, None] * along


LONG, SHORT = wall((0.0, 0.0), (17.0, 0.0)), wall((0.0, 0.0), (0.0, 4.0))
STUB = wall((5.0, 1.0), (5.0, 2.0))


def moved(points: F64, turn: float, x: float, y: float) -> F64:
    """Return points turned and shifted."""
    cos, sin = math.cos(turn), math.sin(turn)
    return points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)


@settings(max_examples=examples(30), deadline=None)
@given(
    turn=st.floats(-math.pi, math.pi),
    x=st.floats(-50.0, 50.0),
    y=st.floats(-50.0, 50.0),
    noise_m=st.floats(0.0, 0.04),
)
def test_of_a_corner_nothing_is_left_at_any_turn(
    turn: float, x: float, y: float, noise_m: float
) -> None:
    noise = np.random.default_rng(3).uniform(-noise_m, noise_m, (len(LONG) + len(SHORT), 2))
    corner = np.concatenate((LONG, SHORT)) + noise
    assert beside_lines(moved(corner, turn, x, y), BAND_M) == 0
    # All of a third wall is left but where it lies in the band of another.
    third = np.concatenate((corner, STUB))
    assert beside_lines(moved(third, turn, x, y), BAND_M) == len(STUB)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_lie_on_two_lines(count: int) -> None:
    assert beside_lines(LONG[:count], BAND_M) == 0


def drawn(*walls: F64) -> OccupancyGrid:
    """Return a map with walls, 0.05 m a cell."""
    cells = np.full((160, 420), UNKNOWN, dtype=np.int8)
    cells[30:140, 30:400] = FREE
    for points in walls:
        cols, rows = np.floor((points + 1.5) / STEP_M + 0.5).astype(int).T
        cells[rows, cols] = OCCUPIED
    return OccupancyGrid(cells, STEP_M, name="drawn")


@pytest.mark.parametrize(("walls", "metres"), [((LONG, SHORT), 0.0), ((LONG, SHORT, STUB), 1.0)])
def test_metres_beside_the_corner_of_two_maps(
    device: ComputeDevice, walls: tuple[F64, ...], metres: float
) -> None:
    features = features_of(drawn(*walls), device)
    still = np.array([*features.centre, 0.0])
    assert beside_lines_m(Pair(features, features), still) == pytest.approx(metres, abs=0.11)


def test_maps_that_share_no_wall_have_none_beside(device: ComputeDevice) -> None:
    features = features_of(drawn(LONG, SHORT), device)
    away = np.array([features.centre[0] + 9000.0, features.centre[1], 0.0])
    assert beside_lines_m(Pair(features, features), away) == 0.0
