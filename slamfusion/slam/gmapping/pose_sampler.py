"""``PoseSampler``: the improved proposal of [G07] for all particles at once.

Every particle's drawn pose is moved to where the scan fits its own map, by hill climbing.
Likelihood times prior is sampled around there, and the pose is drawn from the Gaussian of these
samples; their sum multiplies the particle's weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.compute.scan_match import upload_hits
from slamfusion.geometry import F32, F64, Pose2, compose_poses, invert_poses, row_of, wrap_angles
from slamfusion.slam.common.matcher import pose_table
from slamfusion.slam.gmapping.particles import ParticleMaps

# Least standard deviations of x, y and yaw, metres and radians: a prior of no width would outweigh
# the scan.
LEAST_SIGMAS = (0.005, 0.005, 0.002)
# Distance, metres, below which a bicycle stands: its steering angle is undefined.
LEAST_DISTANCE_M = 1e-6
# Greatest steering angle, radians: at a right angle a bicycle cannot drive.
MOST_STEERING_RAD = 1.4
# Turn, radians, below which an arc is straight: its radius would overflow.
LEAST_TURN_RAD = 1e-9


class DifferentialModel:
    """Errors grow with the distance and with the turn, alike in every direction."""

    def __init__(self, srr: float, srt: float, translation_per_turn: float, stt: float) -> None:
        self._srr, self._srt, self._str, self._stt = srr, srt, translation_per_turn, stt

    def draw(self, step: Pose2, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) steps that the robot may have made; metres, radians, its own frame."""
        errors = rng.standard_normal((count, 3)) * self._spread(step)
        return row_of(step) + errors

    def sigmas(self, step: Pose2) -> F64:
        """Return (3,) standard deviations of x, y and yaw around the step."""
        return np.maximum(self._spread(step), LEAST_SIGMAS)

    def _spread(self, step: Pose2) -> F64:
        distance, turn = math.hypot(step.x, step.y), abs(step.yaw_rad)
        across = self._srr * distance + self._str * turn
        return np.array([across, across, self._srt * distance + self._stt * turn])


class BicycleModel:
    """A steered front wheel: the robot goes along arcs, and its errors are those of an arc [B16].

    Speed and steering follow from the step: a distance s along the arc, and the steering angle
    atan(L * turn / s).
    """

    def __init__(self, srr: float, steering_sigma: float, wheel_base: float) -> None:
        self._srr, self._steering, self._base = srr, steering_sigma, wheel_base

    def draw(self, step: Pose2, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) steps; see ``DifferentialModel``."""
        distance, steering = self._controls(step)
        errors = rng.standard_normal((count, 2))
        distances = distance + self._srr * abs(distance) * errors[:, 0]
        angles = np.clip(
            steering + self._steering * errors[:, 1], -MOST_STEERING_RAD, MOST_STEERING_RAD
        )
        meant = _arcs(np.array([distance]), np.array([distance * math.tan(steering) / self._base]))
        drawn = _arcs(distances, distances * np.tan(angles) / self._base)
        # The step may consist of several arcs; the change by the errors is appended.
        changed = compose_poses(invert_poses(meant), drawn)
        return np.asarray(compose_poses(row_of(step)[None], changed))

    def sigmas(self, step: Pose2) -> F64:
        """Return (3,) standard deviations; see ``DifferentialModel``."""
        distance, steering = self._controls(step)
        turn = abs(distance) * self._steering / (self._base * math.cos(steering) ** 2)
        along, across = self._srr * abs(distance), 0.5 * abs(distance) * turn
        return np.maximum(
            [math.hypot(along, across), math.hypot(along, across), turn], LEAST_SIGMAS
        )

    def _controls(self, step: Pose2) -> tuple[float, float]:
        """Return distance (m, negative backwards) and steering angle (rad) of a step."""
        chord = math.hypot(step.x, step.y)
        if chord < LEAST_DISTANCE_M:
            return 0.0, 0.0
        half = 0.5 * step.yaw_rad
        distance = chord * (half / math.sin(half) if abs(half) > LEAST_TURN_RAD else 1.0)
        forward = math.cos(half) * step.x + math.sin(half) * step.y
        distance = math.copysign(distance, forward)
        steering = math.atan(self._base * step.yaw_rad / distance)
        return distance, max(-MOST_STEERING_RAD, min(MOST_STEERING_RAD, steering))


def make_motion_model(config: Any) -> DifferentialModel | BicycleModel:
    """Return the motion model of a complete configuration."""
    if config.motion_model == "bicycle":
        return BicycleModel(config.srr, config.steering_sigma, config.wheel_base)
    return DifferentialModel(config.srr, config.srt, config.str, config.stt)


def _arcs(distances: F64, turns: F64) -> F64:
    """Return (N, 3) steps along arcs of distances, metres, and turns, radians, (N,)."""
    safe = np.where(np.abs(turns) < LEAST_TURN_RAD, 1.0, turns)
    straight = np.abs(turns) < LEAST_TURN_RAD
    ahead = np.where(straight, 1.0, np.sin(turns) / safe)
    aside = np.where(straight, 0.0, (1.0 - np.cos(turns)) / safe)
    return np.column_stack((distances * ahead, distances * aside, turns))


class Proposal(NamedTuple):
    """Gaussians of N particles, and the logarithm of each particle's weight factor.

    Attributes:
        means: (N, 3) x, y in metres and yaw in radians, relative to the centre of the samples.
        covariances: (N, 3, 3).
        log_evidence: (N,) logarithm of the integral of likelihood times prior over the samples.
    """

    means: F64
    covariances: F64
    log_evidence: F64


def local_grid(range_m: float, step_m: float, range_rad: float, step_rad: float) -> F64:
    """Return (K, 3) offsets of x, y and yaw around a pose, the pose itself among them."""
    along = _symmetric(range_m, step_m)
    around = _symmetric(range_rad, step_rad)
    grid = np.meshgrid(along, along, around, indexing="ij")
    return np.stack([axis.ravel() for axis in grid], axis=-1)


def propose(offsets: F64, log_likelihoods: F64, log_priors: F64, steps: F64) -> Proposal:
    """Fit a Gaussian to likelihood times prior on samples of the pose.

    Args:
        offsets: (K, 3) the samples, relative to each particle's own centre.
        log_likelihoods: (N, K) of the scan at each sample.
        log_priors: (N, K) log density of the motion model there.
        steps: (3,) distance between samples along x, y, yaw. The variance within a sample's
            volume is included, so that a single sharp sample still has a width.
    """
    joint = log_likelihoods + log_priors
    top = joint.max(axis=1, keepdims=True)
    shares = np.exp(joint - top)
    total = shares.sum(axis=1, keepdims=True)
    log_evidence = (top + np.log(total))[:, 0] + float(np.log(steps).sum())
    shares /= total
    means = shares @ offsets
    away = offsets[None] - means[:, None]
    covariances = np.einsum("nk,nki,nkj->nij", shares, away, away)
    covariances += np.diag(steps**2 / 12.0)
    return Proposal(means, covariances, log_evidence)


def _symmetric(reach: float, step: float) -> F64:
    """Return multiples of a step from -reach to reach."""
    most = int(reach / step + 1e-9)
    return np.asarray(step * np.arange(-most, most + 1, dtype=np.float64))


# Squared distance of a hit far from every wall, m^2: as 0.7 m away; one outlier decides little.
NO_HIT_M2 = 0.5
# Log-likelihoods are integers in this part of 1.
LOG_ONE = 1024
# Most steps of a hill climb: a bound on its time; it ends far earlier.
MOST_TRIES = 40


@dataclass(frozen=True, eq=False)
class Sampled:
    """The sampled poses (N, 3), metres and radians, of N particles.

    Attributes:
        log_evidence: (N,) logarithm of each weight's factor.
        scores: (N,) sums of the hits' scores, each 0 to 1, where hill climbing ended.
        rejected: number of particles whose match was rejected.
    """

    poses: F64
    log_evidence: F64
    scores: F64
    rejected: int


class PoseSampler:
    """Samples the particles' poses."""

    def __init__(self, config: Any, device: ComputeDevice, maps: ParticleMaps) -> None:
        self._config = config
        self._device = device
        self._maps = maps
        # (256,) int32 log-likelihood, in 1/LOG_ONE, of a hit by the field under it.
        squared_m2 = np.full(256, NO_HIT_M2)
        squared_m2[1:] = np.minimum(-config.sigma * np.log(np.arange(1, 256) / 255.0), NO_HIT_M2)
        likelihoods = np.rint(-LOG_ONE * squared_m2 / config.lsigma)
        self._likelihood_table = likelihoods.astype(np.int32)
        # (S, 4) float32 steps of hill climbing, each half of the one before.
        halves = 0.5 ** np.arange(config.iterations + 1)
        turns = config.astep * halves
        steps = (config.lstep / config.delta * halves, turns, np.cos(turns), np.sin(turns))
        self._climb_sizes = np.column_stack(steps).astype(np.float32)
        self._samples = local_grid(
            config.llsamplerange, config.llsamplestep, config.lasamplerange, config.lasamplestep
        )

    def sample(
        self, points: F64, expected: F64, drawn: F64, sigmas: F64, rng: np.random.Generator
    ) -> Sampled:
        """Return the particles' poses and weights after a step.

        Args:
            points: (P, 2) hits, metres in the robot's frame.
            expected: (N, 3) poses expected by the motion model.
            drawn: (N, 3) poses drawn from it.
            sigmas: (3,) its standard deviations.
        """
        config, cell = self._config, self._config.delta
        hits = (points / cell).astype(np.float32)
        every = -(-len(points) // config.matcher.beams)
        # Match each particle on its own map.
        matched, score = self._hill_climb(hits[::every], expected, drawn, sigmas)
        scores = np.asarray(score * len(points))
        is_believed = scores > config.minimumScore
        centres = np.where(is_believed[:, None], matched, drawn)
        # Sample the likelihood around each match, times the motion model's prior.
        samples = centres[:, None, :] + self._samples
        looked_at = hits[:: max(every, config.lskip + 1)]
        table = pose_table(samples, cell, self._maps.corner)
        sums = self._device.score_maps(
            self._maps.tiles.pools["field"],
            self._maps.tiles.page_tables,
            upload_hits(looked_at, self._device),
            table,
            self._likelihood_table,
        )
        log_likelihoods = np.asarray(sums / LOG_ONE)
        away = (samples - expected[:, None, :]) / sigmas
        away[..., 2] = wrap_angles(samples[..., 2] - expected[:, None, 2]) / sigmas[2]
        log_priors = -0.5 * np.square(away).sum(axis=-1) - float(
            np.log(sigmas).sum() + 1.5 * math.log(math.tau)
        )
        # Draw from the Gaussian of the samples.
        steps = np.array([config.llsamplestep, config.llsamplestep, config.lasamplestep])
        proposal = propose(self._samples, log_likelihoods, log_priors, steps)
        noise = rng.standard_normal((len(drawn), 3))
        spread = np.linalg.cholesky(proposal.covariances)
        poses = centres + proposal.means + np.einsum("nij,nj->ni", spread, noise)
        poses = np.where(is_believed[:, None], poses, drawn)
        poses[:, 2] = wrap_angles(poses[:, 2])
        return Sampled(poses, proposal.log_evidence, scores, int((~is_believed).sum()))

    def _hill_climb(self, hits: F32, expected: F64, drawn: F64, sigmas: F64) -> tuple[F64, F64]:
        """Return (N, 3) where hill climbing from the drawn poses ends, and (N,) mean scores."""
        config, cell, corner = self._config, self._config.delta, self._maps.corner
        looked_at = upload_hits(hits, self._device)

        def rows(poses: F64) -> F64:
            """Convert to cells of the window, headings near 0, within float32's precision."""
            yaw = wrap_angles(poses[..., 2] - expected[..., 2])
            return np.concatenate((poses[..., :2] / cell - corner, yaw[..., None]), axis=-1)

        turned = np.column_stack((np.cos(drawn[:, 2]), np.sin(drawn[:, 2])))
        losses = np.zeros((len(drawn), 7), dtype=np.float32)
        losses[:, :3] = rows(expected)
        losses[:, 3:6] = config.climb_loss * (np.array([cell, cell, 1.0]) / sigmas) ** 2
        found = self._device.climb_maps(
            self._maps.tiles.pools["field"],
            self._maps.tiles.page_tables,
            looked_at,
            losses,
            np.column_stack((rows(drawn), turned)).astype(np.float32),
            self._climb_sizes,
            tries=MOST_TRIES,
            scale=1.0 / (255.0 * looked_at.shape[0]),
        ).astype(np.float64)
        matched = np.column_stack(
            ((found[:, :2] + corner) * cell, wrap_angles(found[:, 2] + expected[:, 2]))
        )
        loss = (losses[:, 3:6] * (found[:, :3] - losses[:, :3]) ** 2).sum(axis=1)
        return matched, np.asarray(found[:, 5] + loss)
