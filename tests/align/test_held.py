"""By how many metres of wall a motion is held in the direction in which the fewest hold it."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.align.common_walls import disc_around, held_m, wall_normals, walls_around

SIZE, REACH = 0.05, 7


def lattice(walls: np.ndarray) -> np.ndarray:
    """Wall cells as lattice positions in half cells."""
    rows, cols = np.nonzero(walls)
    return np.stack((2 * cols + 1, 2 * rows + 1), axis=1).astype(np.int32)


def held(walls: np.ndarray) -> float:
    tensors = wall_normals(lattice(walls), walls, REACH)
    return held_m(SIZE * tensors.sum(axis=0))


def blank() -> np.ndarray:
    return np.zeros((160, 200), dtype=np.uint8)


@pytest.mark.parametrize("thick", [1, 2, 3])
def test_a_straight_wall_holds_nothing_along_it(thick: int) -> None:
    walls = blank()
    walls[80 : 80 + thick, 20:180] = 1
    assert held(walls) < 0.02
    # Nor does a second one beside it; two faces of one hold by their ends alone.
    walls[120, 20:180] = 1
    assert held(walls) < 0.02
    walls[83, 20:180] = 1
    assert held(walls) < 0.5


@given(turn=st.floats(0.0, math.pi), length=st.integers(20, 60))
def test_a_turned_wall_holds_nothing_along_it(turn: float, length: int) -> None:
    walls = blank()
    steps = np.arange(-length, length, 0.25)
    walls[
        np.rint(80 + steps * math.sin(turn)).astype(int),
        np.rint(100 + steps * math.cos(turn)).astype(int),
    ] = 1
    assert held(walls) < 0.03 * SIZE * np.count_nonzero(walls)


@given(seed=st.integers(0, 1000))
def test_more_walls_never_hold_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tensors = wall_normals(
        lattice(walls := (rng.random((40, 50)) < 0.02).astype(np.uint8)), walls, REACH
    )
    sums = np.cumsum(tensors, axis=0)
    found = [held_m(SIZE * part) for part in sums]
    assert all(b >= a - 1e-12 for a, b in itertools.pairwise(found))


def test_a_map_is_seen_from_off_it_as_if_nothing_stood_around_it() -> None:
    rng = np.random.default_rng(3)
    walls, edge = (rng.random((30, 41)) < 0.2).astype(np.uint8), 60
    rows, cols = rng.integers(-edge, 30 + edge, 3000), rng.integers(-edge, 41 + edge, 3000)
    disc = disc_around(4.5)
    wide = np.pad(walls, edge + 5)
    expected = wide[rows[:, None] + disc[1] + edge + 5, cols[:, None] + disc[0] + edge + 5] != 0
    np.testing.assert_array_equal(walls_around(rows, cols, walls, disc), expected)
