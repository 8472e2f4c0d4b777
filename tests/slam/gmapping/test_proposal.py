"""The proposal is the integral that [G07] asks for, and resampling is fair."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from slamfusion.geometry import F64
from slamfusion.slam.gmapping.particles import (
    effective_particles,
    normalised_weights,
    resample_systematic,
)
from slamfusion.slam.gmapping.pose_sampler import local_grid, propose
from tests.support.examples import examples

seeds = st.integers(0, 2**32 - 1)


# -- the samples -----------------------------------------------------------------------------------


def test_the_published_samples_are_27_around_the_pose():
    grid = local_grid(0.01, 0.01, 0.005, 0.005)
    assert grid.shape == (27, 3)
    wanted = {(x, y, yaw) for x in (-1, 0, 1) for y in (-1, 0, 1) for yaw in (-1, 0, 1)}
    found = np.rint(grid / (0.01, 0.01, 0.005)).astype(int)
    assert set(map(tuple, found.tolist())) == wanted
    np.testing.assert_allclose(grid, found * (0.01, 0.01, 0.005), rtol=0.0, atol=1e-15)


# -- analytic likelihoods --------------------------------------------------------------------------


def gaussian_particles(seed: int, count: int) -> list[tuple[F64, F64, F64, F64, float]]:
    """Mean and covariance of likelihoods and of priors, and the likelihood's height, its log."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        widths = np.diag(rng.uniform(0.02, 0.04, 3) ** 2)
        prior = np.diag(rng.uniform(0.03, 0.05, 3) ** 2)
        away = rng.uniform(-0.02, 0.02, (2, 3))
        made.append((away[0], turn @ widths @ turn.T, away[1], prior, rng.uniform(-800.0, 5.0)))
    return made


def test_gaussians_have_their_evidence_mean_and_covariance():
    """Closed form: a product of Gaussians is one, and its integral is a Gaussian of the means.

    Tolerances: 0.001 in the logarithm, 0.1 mm and 0.1 mrad in the mean, 1 % in the covariance.
    """
    offsets, steps = local_grid(0.2, 0.01, 0.2, 0.01), np.full(3, 0.01)
    particles = gaussian_particles(1, 4)
    log_likelihoods = np.array(
        [h + multivariate_normal(m, c).logpdf(offsets) for m, c, _, _, h in particles]
    )
    log_priors = np.array([multivariate_normal(m, c).logpdf(offsets) for *_, m, c, _ in particles])
    found = propose(offsets, log_likelihoods, log_priors, steps)
    for index, (mean, cov, prior_mean, prior_cov, height) in enumerate(particles):
        evidence = height + multivariate_normal(prior_mean, cov + prior_cov).logpdf(mean)
        wanted_cov = np.linalg.inv(np.linalg.inv(cov) + np.linalg.inv(prior_cov))
        wanted_mean = wanted_cov @ (
            np.linalg.solve(cov, mean) + np.linalg.solve(prior_cov, prior_mean)
        )
        assert found.log_evidence[index] == pytest.approx(evidence, abs=1e-3)
        np.testing.assert_allclose(found.means[index], wanted_mean, rtol=0.0, atol=1e-4)
        within = np.diag(steps**2 / 12.0)  # what propose adds on purpose
        scale = np.abs(wanted_cov).max()
        np.testing.assert_allclose(
            found.covariances[index] - within, wanted_cov, rtol=0.0, atol=0.01 * scale
        )


@settings(max_examples=examples(40), deadline=None)
@given(seed=seeds, constant=st.floats(-1e5, 1e5))
def test_a_factor_of_the_likelihood_moves_the_evidence_alone(seed: int, constant: float):
    rng = np.random.default_rng(seed)
    offsets, steps = local_grid(0.02, 0.01, 0.005, 0.005), np.array([0.01, 0.01, 0.005])
    logs = rng.uniform(-2000.0, 0.0, (2, 3, len(offsets)))
    plain = propose(offsets, *logs, steps)
    more = propose(offsets, logs[0] + constant, logs[1], steps)
    np.testing.assert_allclose(more.log_evidence, plain.log_evidence + constant, atol=1e-7)
    np.testing.assert_allclose(more.means, plain.means, atol=1e-7)
    np.testing.assert_allclose(more.covariances, plain.covariances, atol=1e-9)
    # However sharp, a draw has a width: its covariance has a root.
    np.testing.assert_allclose(
        plain.covariances, plain.covariances.transpose(0, 2, 1), rtol=0.0, atol=1e-18
    )
    assert (np.linalg.eigvalsh(plain.covariances) >= (steps**2).min() / 12.0 - 1e-15).all()


# -- weights and resampling ------------------------------------------------------------------------


@settings(max_examples=examples(100), deadline=None)
@given(seed=seeds, count=st.integers(1, 200), spread=st.floats(0.0, 50.0))
def test_effective_particles_lie_between_one_and_all(seed: int, count: int, spread: float):
    weights = np.exp(spread * np.random.default_rng(seed).standard_normal(count))
    weights /= weights.sum()
    assert 1.0 - 1e-9 <= effective_particles(weights) <= count * (1.0 + 1e-9)


def test_weights_are_evened_out_by_gain_and_number():
    logs = np.array([-1e6, -1e6 - 12.0, -1e6 - 24.0, -3e6])
    weights = normalised_weights(logs, 3.0)
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(np.log(weights[1:3] / weights[0]), [-1.0, -2.0])
    assert weights[3] == 0.0
    np.testing.assert_allclose(normalised_weights(np.full(5, -1e9), 3.0), 0.2)


def random_weights(seed: int, count: int) -> F64:
    """Uneven weights, some of them 0."""
    rng = np.random.default_rng(seed)
    weights = rng.gamma(0.4, size=count) * (rng.random(count) < 0.9)
    weights[0] += 1e-3
    return np.asarray(weights / weights.sum())


@settings(max_examples=examples(200), deadline=None)
@given(seed=seeds, count=st.integers(1, 60), start=st.floats(0.0, 1.0, exclude_max=True))
def test_every_particle_has_its_share_of_offspring_to_the_nearest_whole(
    seed: int, count: int, start: float
):
    weights = random_weights(seed, count)
    parents = resample_systematic(weights, start)
    assert parents.shape == (count,)
    assert (np.diff(parents) >= 0).all()
    offspring = np.bincount(parents, minlength=count)
    share = count * weights
    assert (offspring >= np.floor(share - 1e-9)).all()
    assert (offspring <= np.ceil(share + 1e-9)).all()


def test_a_certain_particle_has_all_offspring_and_equal_ones_each_their_own():
    for start in (0.0, 0.4, 1.0 - 2.0**-53):  # the last one leads to a place of 1.0
        assert resample_systematic(np.eye(7)[3], start).tolist() == [3] * 7
        assert resample_systematic(np.ones(1), start).tolist() == [0]
    for start in (0.0, 0.4, 0.999):
        assert resample_systematic(np.full(8, 0.125), start).tolist() == list(range(8))
