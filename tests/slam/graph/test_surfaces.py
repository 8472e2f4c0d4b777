"""Between hits on one wall there is a wall; over corners, doors and edges there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.geometry import F64
from slamfusion.slam.graph.submap import MOST_GAP_M, fill_walls
from tests.support.examples import examples

NO_LASER = np.zeros(2)
STEP_M = 0.05


def beams_at(*degrees: float) -> F64:
    """Return (N, 2) directions of beams."""
    angles = np.radians(np.array(degrees))
    return np.column_stack((np.cos(angles), np.sin(angles)))


def on_line(directions: F64, normal: tuple[float, float], away_m: float) -> F64:
    """Return (N, 2) where beams from the origin meet a straight wall."""
    return np.asarray(directions * (away_m / (directions @ np.array(normal)))[:, None])


def wall_ahead(count: int = 9, away_m: float = 2.0, degrees: float = 4.0) -> F64:
    """Return (N, 2) hits on a wall that the robot looks at, at x of so many metres."""
    spread = degrees * (np.arange(count) - 0.5 * (count - 1))
    return on_line(beams_at(*spread), (1.0, 0.0), away_m)


def added(points: F64, laser: F64 = NO_LASER, step_m: float = STEP_M) -> F64:
    """Return the hits that are put in; the bare ones must come first, to the bit."""
    filled = fill_walls(points, laser, step_m)
    assert filled[: len(points)].tobytes() == points.tobytes()
    return filled[len(points) :]


def is_between(places: F64, one: F64, other: F64) -> bool:
    """Return whether a place lies between two points, up to rounding."""
    if len(places) == 0:
        return False
    along = other - one
    share = (places - one) @ along / (along @ along)
    beside = np.abs((places - one) @ np.array([-along[1], along[0]])) / np.hypot(*along)
    return bool(((share > 1e-9) & (share < 1.0 - 1e-9) & (beside < 1e-9)).any())


# -- what is filled --------------------------------------------------------------------------------


def test_between_hits_on_one_wall_hits_are_put_evenly():
    """Hits at y of -0.3, -0.1, 0.1, 0.3: only the middle two have a hit on both sides."""
    points = np.array([(2.0, -0.3), (2.0, -0.1), (2.0, 0.1), (2.0, 0.3)])
    wanted = [(2.0, -0.05), (2.0, 0.0), (2.0, 0.05)]
    np.testing.assert_allclose(added(points), wanted, atol=1e-12)


# -- what is not -----------------------------------------------------------------------------------


def test_a_corner_is_not_cut():
    """Walls at x = 2 and y = 2 meet at 45 degrees, between two beams."""
    ahead, left = beams_at(28, 32, 36, 40, 44), beams_at(48, 52, 56, 60, 64)
    points = np.concatenate((on_line(ahead, (1.0, 0.0), 2.0), on_line(left, (0.0, 1.0), 2.0)))
    new = added(points)
    assert not is_between(new, points[4], points[5])
    # Nor a gap that has the corner beside it: it is not known which of the two walls goes on.
    assert not is_between(new, points[3], points[4])
    assert not is_between(new, points[5], points[6])
    assert is_between(new, points[2], points[3])
    assert is_between(new, points[6], points[7])
    on_walls = np.minimum(np.abs(new[:, 0] - 2.0), np.abs(new[:, 1] - 2.0))
    assert on_walls.max() < 1e-12


def test_a_door_with_a_wall_behind_is_not_bridged():
    """Three beams go through a door of a wall at x = 2 to one at x = 5."""
    points = wall_ahead(13)
    points[5:8] *= 2.5
    new = added(points)
    for index in (3, 4, 5, 6, 7, 8):
        assert not is_between(new, points[index], points[index + 1]), index
    assert is_between(new, points[2], points[3])
    assert is_between(new, points[9], points[10])


@pytest.mark.parametrize("missing", [1, 2, 3])
def test_beams_that_are_missing_are_not_bridged(missing: int):
    """An open door, glass or a reading that failed: the gap is wider than from beam to beam."""
    points = wall_ahead(13)
    points = np.delete(points, range(6, 6 + missing), axis=0)
    new = added(points)
    assert not is_between(new, points[5], points[6])
    # Its neighbours have lost a witness.
    assert not is_between(new, points[4], points[5])
    assert not is_between(new, points[6], points[7])
    assert is_between(new, points[3], points[4])
    assert is_between(new, points[7], points[8])


# -- odd scans -------------------------------------------------------------------------------------


SCANS = st.builds(
    lambda seed, count, clockwise, wild: made_scan(seed, count, clockwise=clockwise, wild=wild),
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 80),
    clockwise=st.booleans(),
    wild=st.floats(0.0, 1.0),
)


def made_scan(seed: int, count: int, *, clockwise: bool, wild: float) -> tuple[F64, F64]:
    """Return hits on a room's walls, a share of them anywhere or twice, and the laser's place."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(-2.3, 2.3, count) + rng.uniform(-3.0, 3.0)
    if clockwise:
        angles = angles[::-1]
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    ranges = rng.uniform(0.5, 8.0) / np.maximum(np.abs(directions).max(axis=1), 1e-9)
    is_wild = rng.random(count) < wild * rng.random()
    ranges = np.where(is_wild, rng.uniform(0.0, 30.0, count), ranges)
    keep = np.sort(rng.choice(count, size=max(0, count - rng.integers(0, 5)), replace=False))
    again = np.sort(np.concatenate((keep, keep[: rng.integers(0, 3)])))
    laser = rng.normal(0.0, 10.0, 2)
    return laser + (directions * ranges[:, None])[again], laser


@given(scan=SCANS, step_m=st.sampled_from((0.02, 0.05, 0.3)))
@settings(max_examples=examples(200), deadline=None)
def test_every_new_hit_lies_between_two_neighbours(scan: tuple[F64, F64], step_m: float):
    points, laser = scan
    new = added(points, laser, step_m)
    assert np.isfinite(new).all()
    if len(points) < 4:
        assert len(new) == 0
        return
    one, along = points[:-1], np.diff(points, axis=0)
    length = np.hypot(*along.T)
    for place in new:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.einsum("ij,ij->i", place - one, along) / length**2
        share = np.clip(np.nan_to_num(share), 0.0, 1.0)
        nearest = np.hypot(*(one + share[:, None] * along - place).T)
        assert nearest[(length > step_m) & (length <= MOST_GAP_M)].min() < 1e-9
