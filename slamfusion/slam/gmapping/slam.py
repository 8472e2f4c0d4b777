"""``Gmapping`` [G07]: a particle filter over paths, each particle with a map of its own.

Between two filter steps the robot is followed by matching every scan against the best particle's
map. When it has gone far enough, every particle draws a pose from the motion model, climbs on its
own map to the best fit of the scan, samples likelihood and prior around it, and draws its pose from
the Gaussian of these samples; their sum is its weight. Particles with uneven weights
are resampled, and the scan is written into every map.

Sources: Grisetti, Stachniss and Burgard, T-RO 2007 [G07]; the parameters that were published with
gmapping; Balasuriya et al. 2016 [B16] (no odometry, bicycle model); Stachniss, Grisetti and
Burgard, RSS 2005 (entropy of the path as the mean of the poses' entropies).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GmappingConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import I64, Pose2, compose_poses, pose_of, row_of, wrap_angle
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import BLIND, Health, Series, Step
from slamfusion.slam.common.matcher import PoseHypothesis
from slamfusion.slam.common.state import SavedMapper
from slamfusion.slam.common.tracking import Tracker
from slamfusion.slam.gmapping.particles import (
    Beams,
    ParticleMaps,
    ParticlePaths,
    Particles,
    beams_of,
    better_half,
    resample_systematic,
)
from slamfusion.slam.gmapping.pose_sampler import PoseSampler, make_motion_model
from slamfusion.trajectory import Trajectory


@dataclass
class FilterHealth(Health):
    """How well a particle filter is doing."""

    UNDER = "filter"

    best_score: float | None = None
    """Of the best particle at the last filter step: sum over its hits, each 0 to 1."""
    filter_steps: int = 0
    """Times that the particles were weighed and mapped."""
    resamplings: int = 0
    """Times that the particles were resampled."""
    resamplings_for_memory: int = 0
    """Of these, the ones that the memory budget asked for."""
    rejected: int = 0
    """Matches of single particles below minimumScore."""
    path_entropy: float | None = None
    """Mean over the path of the entropy of the particles' pose, nats."""
    tiles_owned: int = 0
    """Tiles of the maps that one particle uses alone."""
    tiles_shared: int = 0
    """Tiles that several particles use."""


class Gmapping(SavedMapper):
    """The filter behind the ``Mapper`` protocol."""

    name = "gmapping"
    STATE_FORMAT = 10
    STATE_KINDS = (FilterHealth, Particles)
    STATE = (
        "health",
        "last_stamp_s",
        "_tracker",
        "_particles",
        "_maps",
        "_paths",
        "_moved",
        "_filtered_s",
        "_is_mapped",
    )

    def __init__(self, config: GmappingConfig, device: ComputeDevice, seed: int = 0) -> None:
        self.health: FilterHealth = FilterHealth()
        self.last_stamp_s: float | None = None
        # Every field has a value, which its type cannot express.
        self._config = cast("Any", config.chosen())
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._tracker = Tracker(
            config.matcher,
            device,
            self._rng,
            self.health,
            expects_standstill=config.expectation == "pose",
        )
        count = self._config.particles
        self._particles = Particles.of(count)
        self._maps = ParticleMaps(self._config, device, count)
        self._motion = make_motion_model(self._config)
        self._sampler = PoseSampler(self._config, device, self._maps)
        self._paths = ParticlePaths(count)
        # Motion since the last filter step, and its stamp.
        self._moved = IDENTITY
        self._filtered_s = 0.0
        self._is_mapped = False

    # -- one scan ------------------------------------------------------------------------------

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Follow the robot to a scan; filter if it has moved far enough."""
        self.health.scans += 1
        known = None if self._config.odometry == "none" else odometry
        hypotheses = self._tracker.hypotheses(scan.stamp_s, known)
        if self._tracker.pose is None:
            self._maps.begin_at(hypotheses[0].pose[:2])
        if not self._is_mapped:
            self._particles.poses[:] = hypotheses[0].pose
        beams = beams_of(scan, self._config)
        if not beams.is_hit.any():
            step = self._skip(BLIND, hypotheses[0])
        elif not self._is_mapped:
            step = self._begin(scan.stamp_s, beams)
        else:
            step = self._follow(scan.stamp_s, beams, hypotheses)
        self._tracker.advance(step.pose_map_base, known, scan.stamp_s)
        if self._is_mapped and self._moved == IDENTITY:  # the filter may have chosen another best
            self._tracker.pose = self._particles.best_pose
        self.last_stamp_s = scan.stamp_s
        pose = self._tracker.pose or step.pose_map_base
        self._paths.add_scan(scan.stamp_s, self._moved)
        return dataclasses.replace(step, pose_map_base=pose)

    def _skip(self, reason: str, hypothesis: PoseHypothesis) -> Step:
        self.health.skips.add(reason, self.health.scans)
        pose = pose_of(hypothesis.pose)
        self._moved = self._particles.best_pose.inverse().compose(pose) if self._is_mapped else pose
        return Step(pose, used=False, match_score=None, reason=reason)

    def _begin(self, stamp_s: float, beams: Beams) -> Step:
        poses = self._particles.poses
        # All particles are still alike: they share one map.
        self._maps.integrate(beams, poses, np.zeros(1, dtype=np.int64))
        self._maps.tiles.take_over(np.zeros(len(poses), dtype=np.int64))
        self._is_mapped = True
        self._paths.add_node(poses, None)
        self._moved, self._filtered_s = IDENTITY, stamp_s
        self.health.scans_used += 1
        return Step(pose_of(poses[0]), used=True, match_score=None)

    def _follow(self, stamp_s: float, beams: Beams, hypotheses: list[PoseHypothesis]) -> Step:
        """Match a scan on the best map; filter if the robot has moved far enough."""
        points = beams.hits
        start = self._particles.best_pose
        score: float | None = None
        pose = pose_of(hypotheses[0].pose)
        # Without odometry only the match moves the robot.
        is_matched = self._config.match_every_scan or self._tracker.odometry is None
        if is_matched:
            match = self._tracker.match(self._maps.walls(self._particles.best), points, hypotheses)
            score = match.score
            if score * len(points) > self._config.minimumScore:
                pose = pose_of(match.pose)
        self._moved = start.inverse().compose(pose)
        is_due = _is_due(self._moved, stamp_s - self._filtered_s, self._config)
        if is_due:
            best_score = self._filter(stamp_s, beams)
            score = best_score if score is None else score
        is_used = is_due or is_matched
        self.health.scans_used += is_used
        reason = "" if is_used else "the robot has not gone far enough since the last one"
        return Step(pose, is_used, score, reason)

    # -- the filter ----------------------------------------------------------------------------

    def _filter(self, stamp_s: float, beams: Beams) -> float:
        """Move, weigh, resample and map; return the best particle's mean score of a hit."""
        health, particles, points = self.health, self._particles, beams.hits

        # Move every particle by the motion model and by the match on its own map.
        drawn = self._motion.draw(self._moved, len(particles), self._rng)
        sampled = self._sampler.sample(
            points,
            expected=compose_poses(particles.poses, row_of(self._moved)),
            drawn=compose_poses(particles.poses, drawn),
            sigmas=self._motion.sigmas(self._moved),
            rng=self._rng,
        )
        health.rejected += sampled.rejected

        # Weigh it by how well the scan fits there, and resample where weights are uneven.
        particles.move(sampled.poses, sampled.log_evidence)
        parents = self._parents(stamp_s)

        # Map the scan for the surviving particles; descendants of one particle share its map.
        alive = np.arange(len(particles)) if parents is None else np.unique(parents)
        self._maps.integrate(beams, particles.poses, alive)
        scores = sampled.scores
        if parents is not None:
            self._maps.tiles.take_over(parents)
            particles.resample(parents)
            scores = scores[parents]
            health.resamplings += 1

        # Choose the best path.
        particles.best = int(np.argmax(particles.path_weights))
        self._paths.add_node(particles.poses, parents)
        self._moved, self._filtered_s = IDENTITY, stamp_s
        health.filter_steps += 1
        health.best_score = float(scores[particles.best])
        health.path_entropy = self._paths.entropy()
        health.tiles_owned, health.tiles_shared = self._maps.tiles.owned_and_shared
        return health.best_score / len(points)

    def _parents(self, stamp_s: float) -> I64 | None:
        """Return the parents (N,) of the particles; None if all survive."""
        config, particles = self._config, self._particles
        shares, n_eff = particles.weigh(stamp_s, config.ogain)
        self.health.n_eff = n_eff
        if self._maps.is_over_budget:
            # The weights are too even to leave fewer maps by chance.
            self.health.resamplings_for_memory += 1
            return better_half(particles.log_weights)
        if n_eff < config.resampleThreshold * len(shares):
            return resample_systematic(shares, float(self._rng.random()))
        return None

    # -- what it has made ----------------------------------------------------------------------

    def trajectory(self) -> Trajectory:
        """Return the best particle's path."""
        return self._paths.path(self._particles.best, self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return the paths of the other particles, best first."""
        order = np.argsort(-self._particles.path_weights, kind="stable")
        others = [int(index) for index in order if index != self._particles.best]
        return tuple(self._paths.path(index, f"particle {index}") for index in others)

    def series(self) -> tuple[Series, ...]:
        """Return the effective number of particles over time."""
        return self._particles.series(limit_share=self._config.resampleThreshold)

    def grid(self) -> OccupancyGrid:
        """Return the best particle's map; see ``Mapper.grid``."""
        if not self._is_mapped:
            raise SlamFusionError(f"{self.name}: no scan could be used, so there is no map")
        return self._maps.grid(self._particles.best, self.name)

    def memory_bytes(self) -> int:
        """Return the bytes of the maps and of the paths."""
        return self._maps.tiles.memory_bytes + self._paths.memory_bytes


def _is_due(moved: Pose2, waited_s: float, config: Any) -> bool:
    """Return whether the robot has moved, turned or waited enough for a filter step."""
    return bool(
        math.hypot(moved.x, moved.y) >= config.linearUpdate
        or abs(wrap_angle(moved.yaw_rad)) >= config.angularUpdate
        or 0.0 <= config.temporalUpdate <= waited_s
    )
