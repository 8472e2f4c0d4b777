"""Steps are drawn as the models' formulas say: how wide, and where to."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.geometry import F64, Pose2, wrap_angles
from slamfusion.slam.gmapping.pose_sampler import LEAST_SIGMAS, BicycleModel, DifferentialModel

DRAWS = 20_000
# Standard errors that means and deviations of so many draws may be off; the seeds are fixed.
FAR = 4.5


def draws(model: DifferentialModel | BicycleModel, step: Pose2, seed: int = 0) -> F64:
    found = model.draw(step, DRAWS, np.random.default_rng(seed))
    assert found.shape == (DRAWS, 3)
    return np.asarray(found)


def arc(way: float, turn: float) -> Pose2:
    """Return the step along an arc, metres and radians."""
    if abs(turn) < 1e-12:
        return Pose2(way, 0.0, 0.0)
    radius = way / turn
    return Pose2(radius * math.sin(turn), radius * (1.0 - math.cos(turn)), turn)


# -- differential ----------------------------------------------------------------------------------

SRR, SRT, STR, STT = 0.11, 0.23, 0.13, 0.29
STEPS = [
    Pose2(1.0, 0.0, 0.0),
    Pose2(0.0, 0.0, 0.7),
    Pose2(0.0, 0.0, -0.7),
    Pose2(0.3, -0.4, 0.2),
    Pose2(-0.6, 0.1, -0.3),
]


@pytest.mark.parametrize("step", STEPS)
def test_differential_errors_grow_with_way_and_turn(step: Pose2):
    """Across srr s + str |a|, in the heading srt s + stt |a|, around the step itself."""
    model = DifferentialModel(SRR, SRT, STR, STT)
    way, turn = math.hypot(step.x, step.y), abs(step.yaw_rad)
    across, around = SRR * way + STR * turn, SRT * way + STT * turn
    wanted = np.array([across, across, around])
    found = draws(model, step)
    off = np.abs(found.mean(axis=0) - (step.x, step.y, step.yaw_rad))
    assert (off < FAR * wanted / math.sqrt(DRAWS)).all()
    np.testing.assert_allclose(found.std(axis=0), wanted, rtol=FAR / math.sqrt(2 * DRAWS))
    correlations = np.corrcoef(found.T) - np.eye(3)
    assert np.abs(correlations).max() < FAR / math.sqrt(DRAWS)
    np.testing.assert_allclose(model.sigmas(step), wanted)


# -- bicycle ---------------------------------------------------------------------------------------

BASE = 0.4
ARCS = [(1.0, 0.0), (0.8, 0.5), (0.8, -0.5), (2.0, 1.5), (-0.7, 0.4), (-0.7, 0.0), (0.3, 1e-10)]


@pytest.mark.parametrize(("way", "turn"), ARCS)
def test_a_bicycle_does_not_slip_sideways(way: float, turn: float):
    """Every drawn step lies on an arc that begins along the robot: y = x tan(turn / 2)."""
    found = draws(BicycleModel(0.1, 0.2, BASE), arc(way, turn))
    half = 0.5 * found[:, 2]
    aside = -np.sin(half) * found[:, 0] + np.cos(half) * found[:, 1]
    assert np.abs(aside).max() < 1e-9
    assert np.ptp(found[:, 2]) > 0.1 * abs(way)


@pytest.mark.parametrize(("way", "turn"), ARCS)
def test_way_and_steering_err_as_asked(way: float, turn: float):
    """The way by srr a metre, the steering angle atan(L turn / way) by its own deviation."""
    srr, steering_sigma = 0.05, 0.03
    found = draws(BicycleModel(srr, steering_sigma, BASE), arc(way, turn))
    half = 0.5 * found[:, 2]
    chords = np.cos(half) * found[:, 0] + np.sin(half) * found[:, 1]  # negative backwards
    ways = chords / np.sinc(half / math.pi)
    angles = np.arctan(BASE * found[:, 2] / ways)
    for values, wanted, sigma in (
        (ways, way, srr * abs(way)),
        (angles, math.atan(BASE * turn / way), steering_sigma),
    ):
        assert abs(values.mean() - wanted) < FAR * sigma / math.sqrt(DRAWS)
        assert values.std() == pytest.approx(sigma, rel=FAR / math.sqrt(2 * DRAWS))


def test_without_errors_a_step_is_itself():
    """Also one that is no arc: around two corners, or sideways."""
    for step in (*STEPS, Pose2(0.0, 0.5, 0.0), Pose2(0.2, 0.3, -3.1), arc(1.0, 6.0)):
        for model in (BicycleModel(0.0, 0.0, BASE), DifferentialModel(0.0, 0.0, 0.0, 0.0)):
            found = model.draw(step, 3, np.random.default_rng(0))
            found[:, 2] = wrap_angles(found[:, 2] - step.yaw_rad)
            np.testing.assert_allclose(found, [[step.x, step.y, 0.0]] * 3, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(model.sigmas(step), LEAST_SIGMAS)
