"""The proposal is the integral that [G07] asks for, and resampling is fair."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from slamfusion.compute import ComputeDevice
from slamfusion.config import GmappingConfig
from slamfusion.geometry import Pose2
from slamfusion.slam.gmapping.beams import beams_of
from slamfusion.slam.gmapping.particles import normalised_weights
from slamfusion.slam.gmapping.proposal import (
    effective_particles,
    local_grid,
    propose,
    resample_systematic,
)
from slamfusion.slam.gmapping.slam import Gmapping
from tests.slam.drives import scan_at, true_poses
from tests.support.examples import examples

F64 = npt.NDArray[np.float64]


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


def box_integral(
    log_density: Callable[[F64], F64], reach: F64, nodes: int = 60
) -> tuple[float, F64, F64]:
    """Return log of the integral over a box around 0, mean and covariance, by Gauss-Legendre."""
    places, weights = np.polynomial.legendre.leggauss(nodes)
    grid = np.stack(
        np.meshgrid(*(places * side for side in reach), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    volume = np.einsum("i,j,k->ijk", weights, weights, weights).ravel() * reach.prod()
    logs = log_density(grid)
    mass = volume * np.exp(logs - logs.max())
    total = mass.sum()
    mean = mass @ grid / total
    away = grid - mean
    return math.log(total) + logs.max(), mean, (mass[:, None] * away).T @ away / total


def two_hills(apart: float, height: float) -> Callable[[F64], F64]:
    """A likelihood with two hills along a diagonal and tails that no Gaussian has."""

    def log_density(poses: F64) -> F64:
        first = np.square((poses - (0.03, -0.02, 0.01)) / (0.025, 0.03, 0.02)).sum(axis=-1)
        second = np.square((poses - (0.03 - apart, apart, 0.0)) / (0.03, 0.02, 0.03)).sum(axis=-1)
        return np.asarray(height + np.log(1.0 / (1.0 + first) ** 2 + 0.7 * np.exp(-0.5 * second)))

    return log_density


def test_any_likelihood_has_its_integral():
    """Against Gauss-Legendre quadrature over the same box; tolerances as above."""
    reach = np.array([0.15, 0.15, 0.1])
    steps = np.array([0.01, 0.01, 0.01])
    offsets = local_grid(0.145, 0.01, 0.095, 0.01)
    offsets = offsets[(np.abs(offsets) < reach).all(axis=1)]
    sigmas = np.array([0.05, 0.05, 0.03])
    centres = np.array([(0.0, 0.0, 0.0), (0.02, 0.0, -0.01), (-0.03, 0.03, 0.01)])
    hills = [two_hills(0.0, 0.0), two_hills(0.06, -300.0), two_hills(0.1, 40.0)]

    def prior(poses: F64, centre: F64) -> F64:
        return np.asarray(-0.5 * np.square((poses - centre) / sigmas).sum(axis=-1))

    found = propose(
        offsets,
        np.array([hill(offsets) for hill in hills]),
        np.array([prior(offsets, centre) for centre in centres]),
        steps,
    )
    # The samples stand for boxes around them, so together for half a step more than they reach.
    box = np.abs(offsets).max(axis=0) + 0.5 * steps
    for index, (hill, centre) in enumerate(zip(hills, centres, strict=True)):
        evidence, mean, covariance = box_integral(
            lambda poses, h=hill, c=centre: h(poses) + prior(poses, c), box
        )
        assert found.log_evidence[index] == pytest.approx(evidence, abs=2e-3)
        np.testing.assert_allclose(found.means[index], mean, rtol=0.0, atol=1e-4)
        np.testing.assert_allclose(
            found.covariances[index] - np.diag(steps**2 / 12.0),
            covariance,
            rtol=0.0,
            atol=0.01 * covariance.max(),
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


# -- a real map ------------------------------------------------------------------------------------

CELL, SIGMA, LSIGMA = 0.05, 0.05, 2.0
POSE = true_poses(1)[0]
# One metre straight ahead makes the motion model as wide as this.
SIGMAS = np.array([0.06, 0.06, 0.04])
AHEAD = Pose2(1.0, 0.0, 0.0)


def mapped(device: ComputeDevice, count: int, **samples: float) -> Gmapping:
    """Return a filter whose particles have one scan on their maps."""
    config = GmappingConfig(
        particles=count,
        delta=CELL,
        sigma=SIGMA,
        kernelSize=1,
        lsigma=LSIGMA,
        lskip=0,
        climb_loss=0.0,
        srr=SIGMAS[0],
        srt=SIGMAS[2],
        str=0.0,
        stt=0.0,
        **{"minimumScore": 0.0, **samples},
    )
    slam = Gmapping(config, device)
    slam.feed(scan_at(POSE, 0.0), POSE)
    return slam


def move(slam: Gmapping, points: F64, expected: F64, drawn: F64) -> int:
    """Sample the particles' poses after the step ahead; return how many matches are rejected."""
    sigmas = slam._motion.sigmas(AHEAD)
    sampled = slam._sampler.sample(points, expected, drawn, sigmas, slam._rng)
    slam._particles.move(sampled.poses, sampled.log_evidence)
    return sampled.rejected


def log_likelihoods(slam: Gmapping, index: int, points: F64, poses: F64) -> F64:
    """Return (K,) log-likelihoods in floating point, from what the score field means.

    The field f between cells is bilinear; a hit there is sqrt(-sigma ln f) from a wall, no more
    than sqrt(0.5) m, and its log-likelihood is minus that squared over lsigma.
    """
    field, first = slam._maps.tiles.cells("field", index)
    field = np.pad(field.astype(np.float64), 1, mode="constant") / 255.0
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = poses[:, :1] + cos * points[:, 0] - sin * points[:, 1]
    y = poses[:, 1:2] + sin * points[:, 0] + cos * points[:, 1]
    col = np.clip((x - slam._maps.anchor[0]) / CELL - first[0] + 0.5, 0.0, field.shape[1] - 1.001)
    row = np.clip((y - slam._maps.anchor[1]) / CELL - first[1] + 0.5, 0.0, field.shape[0] - 1.001)
    c, r = col.astype(int), row.astype(int)
    right, up = col - c, row - r
    low = field[r, c] * (1.0 - right) + field[r, c + 1] * right
    high = field[r + 1, c] * (1.0 - right) + field[r + 1, c + 1] * right
    found = low * (1.0 - up) + high * up
    squared = np.minimum(-SIGMA * np.log(np.maximum(found, 1e-300)), 0.5)
    return np.asarray(-squared.sum(axis=1) / LSIGMA)


def dense_integral(
    slam: Gmapping, index: int, points: F64, expected: F64
) -> tuple[float, F64, F64]:
    """Return log of the integral of likelihood times prior over poses, its mean and deviations.

    A Riemann sum of boxes of 2 cm by 2 cm by 0.01 rad, up to five deviations of the prior away.
    """
    axes = [np.arange(0.5 * h - 5.0 * s, 5.0 * s, h) for s, h in zip(SIGMAS, BOX, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    logs = np.concatenate(
        [log_likelihoods(slam, index, points, expected + part) for part in np.array_split(grid, 40)]
    )
    logs -= 0.5 * np.square(grid / SIGMAS).sum(axis=1)
    logs -= np.log(SIGMAS).sum() + 1.5 * math.log(math.tau)
    mass = np.exp(logs - logs.max())
    mean = mass @ grid / mass.sum()
    deviations = np.sqrt(mass @ np.square(grid - mean) / mass.sum())
    return math.log(mass.sum() * np.prod(BOX)) + logs.max(), expected + mean, deviations


BOX = np.array([0.02, 0.02, 0.01])


def test_weights_are_the_integral_of_likelihood_and_prior_on_each_particle_s_map(
    device: ComputeDevice,
):
    """Every particle has a map, an expectation and a drawn pose of its own.

    Tolerance 0.05 in the logarithm: the score field counts in sixteenths of a cell.
    """
    slam = mapped(
        device, 4, llsamplerange=0.2, llsamplestep=0.02, lasamplerange=0.12, lasamplestep=0.01
    )
    own = np.array([POSE.x, POSE.y, POSE.yaw_rad])
    around = [(0.05, 0.0, 0.0), (-0.06, 0.1, 0.05), (0.0, -0.2, -0.2), (1.0, 0.5, 1.0)]
    slam._particles.poses = own + np.array(around)
    for shift in (0.02, 0.05):
        seen = scan_at(POSE.compose(Pose2(shift, shift, shift)), 0.1)
        slam._maps.integrate(beams_of(seen, slam._config), slam._particles.poses, np.arange(4))
    points = scan_at(POSE, 0.0).points()[::3]
    away = [(0.0, 0.0, 0.0), (0.03, -0.02, 0.01), (-0.02, 0.03, -0.02), (0.05, 0.05, 0.0)]
    expected = own + np.array(away)
    move(slam, points, expected, expected + np.array([0.01, 0.01, 0.005]))
    wanted = [dense_integral(slam, i, points, expected[i])[0] for i in range(4)]
    assert np.ptp(wanted) > 0.5
    np.testing.assert_allclose(slam._particles.log_weights, wanted, rtol=0.0, atol=0.05)
    np.testing.assert_array_equal(slam._particles.path_weights, slam._particles.log_weights)


def test_poses_are_drawn_from_likelihood_times_prior(device: ComputeDevice):
    """600 particles of one map: their mean to 4 standard errors and 2 mm, deviations to 15 %."""
    count = 600
    slam = mapped(
        device,
        count,
        llsamplerange=0.15,
        llsamplestep=0.05,
        lasamplerange=0.09,
        lasamplestep=0.03,
    )
    points = scan_at(POSE, 0.0).points()[::6]
    expected = np.array([POSE.x + 0.05, POSE.y - 0.03, POSE.yaw_rad + 0.02])
    everyone = np.tile(expected, (count, 1))
    move(slam, points, everyone, everyone)
    _, mean, deviations = dense_integral(slam, 0, points, expected)
    assert (deviations < 0.9 * SIGMAS).all()  # the scan tells something
    off = np.abs(slam._particles.poses.mean(axis=0) - mean)
    assert (off < 4.0 * deviations / math.sqrt(count) + 0.002).all()
    np.testing.assert_allclose(slam._particles.poses.std(axis=0), deviations, rtol=0.15)


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
