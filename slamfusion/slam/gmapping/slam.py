"""gmapping [G07]: a particle filter over paths, each particle with a map of its own.

Between two filter steps the robot is followed by matching every scan against the best particle's
map. When it has gone far enough, every particle draws a pose from the motion model, climbs on its
own map to where the scan fits, samples likelihood and prior around there, and draws its pose from
the Gaussian of these samples; their sum is its weight. Particles whose weights have become uneven
are resampled, and the scan is written into every map.

Sources: Grisetti, Stachniss and Burgard, T-RO 2007 [G07]; the parameters that were published with
gmapping; Balasuriya et al. 2016 [B16] (no odometry, bicycle model); Stachniss, Grisetti and
Burgard, RSS 2005 (entropy of the path as the mean of the poses' entropies).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from slamfusion.compute.backend import Backend
from slamfusion.compute.hit_map_reference import (
    MOST_BEAMS,
    BeamScan,
    FieldRule,
)
from slamfusion.config import GmappingConfig, to_mapping
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2, compose_poses, wrap_angle, wrap_angles
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.slam.common.hit_cells import halve_counts, percent_of_counts
from slamfusion.slam.common.mapper import Health, Series, Step
from slamfusion.slam.common.matcher import FieldMap, PoseHypothesis, pose_table
from slamfusion.slam.common.shared_tiles import SharedTileMaps
from slamfusion.slam.common.state import (
    health_record,
    pose_record,
    read_state,
    recorded_pose,
    restore_health,
    restore_tracker,
    tracker_record,
    write_state,
)
from slamfusion.slam.common.tracking import Tracker
from slamfusion.slam.gmapping.motion_model import make_motion_model
from slamfusion.slam.gmapping.particle_path import ParticlePaths
from slamfusion.slam.gmapping.proposal import (
    effective_particles,
    local_grid,
    propose,
    resample_systematic,
)
from slamfusion.trajectory import Trajectory

__all__ = ["FilterHealth", "Gmapping"]

F64 = npt.NDArray[np.float64]
NAME = "gmapping"

# The matcher takes a cell for a wall when more than this share of its beams ended in it; the
# published map asks for ``occ_thresh``.
MATCHER_SHARE = 0.1
# Log-likelihood of a hit beside every wall, in units of 1 / lsigma (m^2): as 0.7 m away.
NO_HIT_M2 = 0.5
# Log-likelihoods count in 1/1024.
LOG_ONE = 1024
# The score field is looked up in a table by squared distance.
TABLE_STEPS = 256
# A climb tries at most so many steps in all.
MOST_TRIES = 40
# Of beams that are more than a cell can count at once, every second (third, ...) is mapped.
MOST_MAPPED = MOST_BEAMS
DEFAULT_USABLE_M = 80.0
USABLE_SHARE = 0.98
# Particles are drawn anew when their maps hold this share of the budget.
BUDGET_SHARE = 0.8
STATE_FORMAT = 3


@dataclass
class FilterHealth(Health):
    """How well the particle filter is doing.

    Attributes:
        best_score: of the best particle at the last filter step: sum over its hits, each 0 to 1.
        filter_steps: times that the particles were weighed and mapped.
        resamplings: times that they were drawn anew.
        resamplings_for_memory: of these, the ones that ``memory_budget`` asked for.
        rejected: matches of single particles below ``minimumScore``.
        path_entropy: mean over the path of the entropy of the particles' pose, nats.
        tiles_owned: tiles of the maps that one particle uses alone.
        tiles_shared: tiles that several use.
    """

    best_score: float | None = None
    filter_steps: int = 0
    resamplings: int = 0
    resamplings_for_memory: int = 0
    rejected: int = 0
    path_entropy: float | None = None
    tiles_owned: int = 0
    tiles_shared: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return the record for a JSON document."""
        names = (
            "best_score",
            "filter_steps",
            "resamplings",
            "resamplings_for_memory",
            "rejected",
            "path_entropy",
            "tiles_owned",
            "tiles_shared",
        )
        return {**super().to_json(), "filter": {name: getattr(self, name) for name in names}}


class Gmapping:
    """The filter behind the ``Mapper`` protocol.

    Attributes:
        name: ``gmapping``.
        health: the record so far.
        last_stamp_s: time of the last scan; None before the first.
    """

    name = NAME

    def __init__(self, config: GmappingConfig, backend: Backend, seed: int = 0) -> None:
        """Start with empty maps.

        Args:
            config: see ``GmappingConfig``.
            backend: where the maps live.
            seed: of every draw.
        """
        self.health: FilterHealth = FilterHealth()
        self.last_stamp_s: float | None = None
        self._given = config
        # No field of it is open, which its type cannot say.
        self._config = cast("Any", config.chosen())
        self._backend = backend
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._tracker = Tracker(
            config.matcher,
            backend,
            self._rng,
            self.health,
            expects_standstill=config.expectation == "pose",
        )
        count = self._config.particles
        self._maps = SharedTileMaps(
            backend,
            count,
            {"counts": np.uint32, "sums": np.uint32, "field": np.uint8},
        )
        self._motion = make_motion_model(self._config)
        self._field_rule = self._make_field_rule()
        self._likelihood_table = self._make_likelihood_table()
        self._climb_sizes = self._make_climb_sizes()
        self._samples = local_grid(
            self._config.llsamplerange,
            self._config.llsamplestep,
            self._config.lasamplerange,
            self._config.lasamplestep,
        )
        self._anchor = np.zeros(2)
        self._poses = np.zeros((count, 3))
        self._log_weights = np.zeros(count)
        # Log-weights of whole paths: never set back by resampling.
        self._path_weights = np.zeros(count)
        self._best = 0
        # What the robot has done since the last filter step, and when that was.
        self._moved = IDENTITY
        self._filtered_s = 0.0
        self._paths = ParticlePaths(count)
        self._n_eff: list[tuple[float, float]] = []
        self._is_mapped = False

    # -- the protocol --------------------------------------------------------------------------

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Follow the robot to a scan, and filter where it has gone far enough."""
        self.health.scans += 1
        known = None if self._config.odometry == "none" else odometry
        hypotheses = self._tracker.hypotheses(scan.stamp_s, known)
        if self._tracker.pose is None:
            cell = self._config.delta
            self._anchor = np.floor(hypotheses[0].pose[:2] / cell) * cell
        if not self._is_mapped:
            self._poses[:] = hypotheses[0].pose
        ends, is_hit = self._beams(scan)
        if not is_hit.any():
            step = self._skip("no reading within the usable range", hypotheses[0])
        elif not self._is_mapped:
            step = self._begin(scan, ends, is_hit)
        else:
            step = self._follow(scan, ends, is_hit, hypotheses)
        self._tracker.advance(step.pose_map_base, known, scan.stamp_s)
        if self._is_mapped and self._moved == IDENTITY:  # the filter has chosen another best
            self._tracker.pose = _pose(self._poses[self._best])
        self.last_stamp_s = scan.stamp_s
        pose = self._tracker.pose or step.pose_map_base
        self._paths.add_scan(scan.stamp_s, self._moved)
        return dataclasses.replace(step, pose_map_base=pose)

    def trajectory(self) -> Trajectory:
        """Return the best particle's path."""
        return self._paths.path(self._best, self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return the paths of the other particles, best first."""
        order = np.argsort(-self._path_weights, kind="stable")
        others = [int(index) for index in order if index != self._best]
        return tuple(self._paths.path(index, f"particle {index}") for index in others)

    def series(self) -> tuple[Series, ...]:
        """Return how the effective number of particles went."""
        if not self._n_eff:
            return ()
        stamps_s, values = np.array(self._n_eff).T
        limit = self._config.resampleThreshold * self._config.particles
        return (Series("effective particles", "", stamps_s, values, limit),)

    def grid(self) -> OccupancyGrid:
        """Return the best particle's map; see ``Mapper.grid``."""
        if not self._is_mapped:
            message = f"{self.name}: no scan could be used, so there is no map"
            raise SlamFusionError(message)
        counts, first = self._maps.cells("counts", self._best)
        cell = self._config.delta
        corner = self._anchor + first * cell
        origin = Pose2(float(corner[0]), float(corner[1]))
        percent = percent_of_counts(counts.astype(np.uint32), self._config.occ_thresh)
        grid = OccupancyGrid(percent, cell, origin, self.name)
        box = grid.known_box()
        return grid if box is None else grid.crop(box)

    def memory_bytes(self) -> int:
        """Return the bytes of all maps, with what their pools hold in reserve, and of the paths."""
        return self._maps.memory_bytes + self._paths.memory_bytes

    # -- one scan ------------------------------------------------------------------------------

    def _beams(self, scan: LaserScan) -> tuple[F64, npt.NDArray[np.uint8]]:
        """Return the beams that count.

        Returns:
            (B, 2) their ends, metres in the robot's frame, and (B,) 1 for those that hit something
            there; the others are free up to their end.
        """
        config = self._config
        most = config.maxRange or scan.range_max_m
        usable = config.maxUrange or min(DEFAULT_USABLE_M, USABLE_SHARE * scan.range_max_m)
        usable = min(usable, most)
        hit = scan.is_hit(usable)
        free = scan.is_hit(most) & ~hit
        if most > scan.range_max_m:  # [G07]'s way to say that no return means free space
            free |= scan.is_clear()
        chosen = hit | free
        ranges = np.where(hit, scan.ranges, usable)[chosen].astype(np.float64)
        angles = scan.angles()[chosen] + scan.mount.yaw_rad
        ends = np.stack((ranges * np.cos(angles), ranges * np.sin(angles)), axis=-1)
        ends += np.array([scan.mount.x, scan.mount.y])
        return ends, hit[chosen].astype(np.uint8)

    def _skip(self, reason: str, hypothesis: PoseHypothesis) -> Step:
        self.health.skips.add(reason, self.health.scans)
        pose = _pose(hypothesis.pose)
        if self._is_mapped:
            self._moved = _pose(self._poses[self._best]).inverse().compose(pose)
        else:
            self._moved = pose
        return Step(pose, used=False, match_score=None, reason=reason)

    def _begin(self, scan: LaserScan, ends: F64, is_hit: npt.NDArray[np.uint8]) -> Step:
        """Write the first scan into every map."""
        pose = _pose(self._poses[0])
        # All particles are alike still: they share one map.
        self._write(scan, ends, is_hit, np.zeros(1, dtype=np.int64))
        self._maps.take_over(np.zeros(len(self._poses), dtype=np.int64))
        self._is_mapped = True
        self._paths.add_node(self._poses, None)
        self._moved, self._filtered_s = IDENTITY, scan.stamp_s
        self.health.scans_used += 1
        return Step(pose, used=True, match_score=None)

    def _follow(
        self,
        scan: LaserScan,
        ends: F64,
        is_hit: npt.NDArray[np.uint8],
        hypotheses: list[PoseHypothesis],
    ) -> Step:
        """Match a scan on the best map; filter when the robot has gone far enough."""
        points = ends[is_hit == 1]
        start = _pose(self._poses[self._best])
        score: float | None = None
        pose = _pose(hypotheses[0].pose)
        # Without odometry nothing but the match moves the robot.
        is_matched = self._config.match_every_scan or self._tracker.odometry is None
        if is_matched:
            match = self._tracker.match(self._walls(), points, hypotheses)
            score = match.score
            if score * len(points) > self._config.minimumScore:
                pose = _pose(match.pose)
        self._moved = start.inverse().compose(pose)
        is_due = self._is_due(scan.stamp_s)
        if is_due:
            best_score = self._filter(scan, ends, is_hit)
            score = best_score if score is None else score
            self.health.scans_used += 1
        elif is_matched:
            self.health.scans_used += 1
        is_used = is_due or is_matched
        reason = "" if is_used else "the robot has not gone far enough since the last one"
        return Step(pose, is_used, score, reason)

    def _walls(self) -> FieldMap:
        """Return the best particle's map as the matcher sees it."""
        maps, cell = self._maps, self._config.delta
        corner = self._anchor / cell + maps.origin
        return FieldMap(maps.pools["field"], maps.page_table(self._best), corner, cell)

    def _is_due(self, stamp_s: float) -> bool:
        """Return whether the robot has gone, turned or waited enough for a filter step."""
        config, moved = self._config, self._moved
        return bool(
            math.hypot(moved.x, moved.y) >= config.linearUpdate
            or abs(wrap_angle(moved.yaw_rad)) >= config.angularUpdate
            or 0.0 <= config.temporalUpdate <= stamp_s - self._filtered_s
        )

    # -- the filter ----------------------------------------------------------------------------

    def _filter(self, scan: LaserScan, ends: F64, is_hit: npt.NDArray[np.uint8]) -> float:
        """Move, weigh, resample and map; return the mean score of a hit for the best particle."""
        health, config = self.health, self._config
        before = self._poses
        drawn = compose_poses(before, self._motion.draw(self._moved, len(before), self._rng))
        expected = compose_poses(before, _vector(self._moved))
        points = ends[is_hit == 1]
        scores = self._move(points, expected, drawn)
        shares = _normalised(self._log_weights, config.ogain)
        n_eff = effective_particles(shares)
        health.n_eff = n_eff
        self._n_eff.append((scan.stamp_s, n_eff))
        parents: npt.NDArray[np.int64] | None = None
        if 0.0 < BUDGET_SHARE * config.memory_budget * 1e6 < self._maps.used_bytes:
            # Their weights are too even to leave fewer maps by chance: the better half goes on.
            parents = _better_half(self._log_weights)
            health.resamplings_for_memory += 1
        elif n_eff < config.resampleThreshold * len(before):
            parents = resample_systematic(shares, float(self._rng.random()))
        health.resamplings += parents is not None
        alive = np.arange(len(before)) if parents is None else np.unique(parents)
        self._write(scan, ends, is_hit, alive)
        if parents is not None:
            # Those that descend from one particle would map the scan alike: they share its map.
            self._maps.take_over(parents)
            self._poses = self._poses[parents]
            self._path_weights = self._path_weights[parents]
            scores = scores[parents]
            self._log_weights = np.zeros(len(before))
        self._best = int(np.argmax(self._path_weights))
        self._paths.add_node(self._poses, parents)
        self._moved, self._filtered_s = IDENTITY, scan.stamp_s
        health.filter_steps += 1
        health.best_score = float(scores[self._best])
        health.path_entropy = self._paths.entropy()
        health.tiles_owned, health.tiles_shared = self._maps.tiles_owned, self._maps.tiles_shared
        return health.best_score / len(points)

    def _move(self, points: F64, expected: F64, drawn: F64) -> F64:
        """Give every particle its pose and weight; return (N,) sums of the hits' scores.

        Args:
            points: (P, 2) hits, metres in the robot's frame.
            expected: (N, 3) where the motion model expects each particle.
            drawn: (N, 3) where it has drawn it.
        """
        config = self._config
        cell = config.delta
        corner = self._anchor / cell + self._maps.origin
        field, pages = self._maps.pools["field"], self._maps.page_tables
        hits = (points / cell).astype(np.float32)
        every = -(-len(points) // config.matcher.beams)
        looked_at = self._backend.upload(hits[::every])
        sigmas = self._motion.sigmas(self._moved)

        def rows(poses: F64) -> F64:
            """In cells of the window, headings near 0: float32 is to carry them."""
            yaw = wrap_angles(poses[..., 2] - expected[..., 2])
            return np.concatenate((poses[..., :2] / cell - corner, yaw[..., None]), axis=-1)

        starts = rows(drawn)
        turned = np.column_stack((np.cos(drawn[:, 2]), np.sin(drawn[:, 2])))
        losses = np.zeros((len(drawn), 7), dtype=np.float32)
        losses[:, :3] = rows(expected)
        losses[:, 3:6] = config.climb_loss * (np.array([cell, cell, 1.0]) / sigmas) ** 2
        found = self._backend.climb_maps(
            field,
            pages,
            looked_at,
            losses,
            np.column_stack((starts, turned)).astype(np.float32),
            self._climb_sizes,
            tries=MOST_TRIES,
            scale=1.0 / (255.0 * looked_at.shape[0]),
        ).astype(np.float64)
        matched = np.column_stack(
            ((found[:, :2] + corner) * cell, wrap_angles(found[:, 2] + expected[:, 2]))
        )
        score = found[:, 5] + (losses[:, 3:6] * (found[:, :3] - losses[:, :3]) ** 2).sum(axis=1)
        scores = np.asarray(score * len(points))
        is_believed = scores > config.minimumScore
        self.health.rejected += int((~is_believed).sum())
        centres = np.where(is_believed[:, None], matched, drawn)
        # The likelihood around each centre, times the motion model's prior.
        samples = centres[:, None, :] + self._samples
        table = pose_table(samples, cell, corner)
        if config.lskip + 1 > every:
            looked_at = self._backend.upload(hits[:: config.lskip + 1])
        sums = self._backend.score_maps(field, pages, looked_at, table, self._likelihood_table)
        log_likelihoods = sums / LOG_ONE
        away = (samples - expected[:, None, :]) / sigmas
        away[..., 2] = wrap_angles(samples[..., 2] - expected[:, None, 2]) / sigmas[2]
        log_priors = -0.5 * np.square(away).sum(axis=-1) - float(
            np.log(sigmas).sum() + 1.5 * math.log(math.tau)
        )
        steps = np.array([config.llsamplestep, config.llsamplestep, config.lasamplestep])
        proposal = propose(self._samples, log_likelihoods, log_priors, steps)
        noise = self._rng.standard_normal((len(drawn), 3))
        spread = np.linalg.cholesky(proposal.covariances)
        poses = centres + proposal.means + np.einsum("nij,nj->ni", spread, noise)
        poses = np.where(is_believed[:, None], poses, drawn)
        poses[:, 2] = wrap_angles(poses[:, 2])
        self._poses = poses
        self._log_weights = self._log_weights + proposal.log_evidence
        self._path_weights = self._path_weights + proposal.log_evidence
        return scores

    # -- the maps ------------------------------------------------------------------------------

    def _write(
        self,
        scan: LaserScan,
        ends: F64,
        is_hit: npt.NDArray[np.uint8],
        alive: npt.NDArray[np.int64],
    ) -> None:
        """Write a scan into the maps of some particles.

        Args:
            scan: where the laser is.
            ends: (B, 2) metres in the robot's frame.
            is_hit: (B,) 1 where something was hit.
            alive: indices of the particles.
        """
        config, maps, backend = self._config, self._maps, self._backend
        cell = config.delta
        every = -(-len(ends) // MOST_MAPPED)
        ends, is_hit = ends[::every], is_hit[::every]
        laser = np.array([scan.mount.x, scan.mount.y])
        reach = float(np.hypot(*np.vstack((ends, laser)).T).max()) / cell + config.kernelSize + 1.0
        at = (self._poses - (*self._anchor, 0.0))[alive] / (cell, cell, 1.0)
        maps.cover(at[:, :2].min(axis=0) - reach, at[:, :2].max(axis=0) + reach)
        table = pose_table(at, 1.0, maps.origin)
        beams = BeamScan(
            (ends / cell).astype(np.float32), is_hit, (laser / cell).astype(np.float32), table
        )
        pages = maps.page_tables_of(alive)
        written = np.zeros(maps.pages.shape, dtype=np.bool_)
        written[alive] = backend.touch_pages(pages, beams, config.kernelSize)
        maps.make_writable(written)
        pages, pools = maps.page_tables_of(alive), maps.pools
        if backend.count_beams(pools["counts"], pools["sums"], pages, beams):
            halve_counts(backend, pools)
        backend.settle_field(
            pools["counts"], pools["sums"], pools["field"], pages, beams, self._field_rule
        )

    # -- tables --------------------------------------------------------------------------------

    def _make_field_rule(self) -> FieldRule:
        """Return how the score field follows from the counts."""
        config = self._config
        # No occupied cell within reach is farther than this, in (1/256 cell)^2.
        farthest = 2.0 * ((config.kernelSize + 0.5) * 256.0) ** 2
        shift = max(0, math.ceil(math.log2(farthest / TABLE_STEPS)))
        squared_m2 = np.arange(TABLE_STEPS) * 2.0**shift / 65536.0 * config.delta**2
        return FieldRule(
            table=np.rint(255.0 * np.exp(-squared_m2 / config.sigma)).astype(np.uint8),
            shift=shift,
            reach=config.kernelSize,
            occupied=round(MATCHER_SHARE * 65536),
            least_hits=1,
        )

    def _make_likelihood_table(self) -> npt.NDArray[np.int32]:
        """Return (256,) int32 log-likelihood, in 1/LOG_ONE, of a hit by the field under it."""
        config = self._config
        field = np.arange(256) / 255.0
        squared_m2 = np.full(256, NO_HIT_M2)
        squared_m2[1:] = np.minimum(-config.sigma * np.log(field[1:]), NO_HIT_M2)
        return np.asarray(np.rint(-LOG_ONE * squared_m2 / config.lsigma).astype(np.int32))

    def _make_climb_sizes(self) -> npt.NDArray[np.float32]:
        """Return (S, 4) float32 steps of the climb, each half of the one before."""
        config = self._config
        halves = 0.5 ** np.arange(config.iterations + 1)
        turns = config.astep * halves
        steps = (config.lstep / config.delta * halves, turns, np.cos(turns), np.sin(turns))
        return np.column_stack(steps).astype(np.float32)

    # -- state ---------------------------------------------------------------------------------

    def save_state(self, path: Path) -> None:
        """Write everything that decides how the filter goes on; whole or not at all."""
        record = {
            "health": health_record(self.health),
            "tracker": tracker_record(self._tracker),
            "last_stamp_s": self.last_stamp_s,
            "moved": pose_record(self._moved),
            "filtered_s": self._filtered_s,
            "best": self._best,
            "is_mapped": self._is_mapped,
            # Settings that are left open mean what they meant.
            "chosen": to_mapping(self._config),
        }
        arrays = {
            "anchor": self._anchor,
            "poses": self._poses,
            "log_weights": self._log_weights,
            "path_weights": self._path_weights,
            "n_eff": np.array(self._n_eff).reshape(-1, 2),
            **self._maps.to_arrays(),
            **self._paths.to_arrays(),
        }
        write_state(
            path,
            name=self.name,
            version=STATE_FORMAT,
            config=self._given,
            seed=self._seed,
            record=record,
            arrays=arrays,
        )

    @classmethod
    def load_state(
        cls, path: Path, config: GmappingConfig, backend: Backend, seed: int = 0
    ) -> Gmapping:
        """Return the filter that ``save_state`` has written.

        Args:
            path: the file.
            config: must be what the state was made with.
            backend: where the maps are to live.
            seed: likewise.

        Raises:
            SlamFusionError: no state of ours, or one made with other settings.
        """
        record, arrays = read_state(
            path, name=cls.name, version=STATE_FORMAT, config=config, seed=seed
        )
        if record.get("chosen") != to_mapping(config.chosen()):
            message = f"{path}: was made with other defaults of its profile; make it anew"
            raise SlamFusionError(message)
        made = cls(config, backend, seed)
        try:
            made._restore(record, arrays)
        except KeyError as error:
            message = f"{path}: not a whole state, {error} is missing"
            raise SlamFusionError(message) from None
        return made

    def _restore(self, record: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Take over a saved state."""
        restore_health(self.health, record["health"])
        restore_tracker(self._tracker, record["tracker"])
        self.last_stamp_s = record["last_stamp_s"]
        self._moved = recorded_pose(record["moved"]) or IDENTITY
        self._filtered_s, self._best = record["filtered_s"], record["best"]
        self._is_mapped = record["is_mapped"]
        self._anchor, self._poses = arrays["anchor"], arrays["poses"]
        self._log_weights, self._path_weights = arrays["log_weights"], arrays["path_weights"]
        self._n_eff = [(stamp, value) for stamp, value in arrays["n_eff"].tolist()]
        self._maps.restore(arrays)
        self._paths.restore(arrays)


def _pose(row: F64) -> Pose2:
    x, y, yaw = (float(value) for value in row)
    return Pose2(x, y, wrap_angle(yaw))


def _vector(pose: Pose2) -> F64:
    return np.array([pose.x, pose.y, pose.yaw_rad])


def _better_half(log_weights: F64) -> npt.NDArray[np.int64]:
    """Return (N,) parents: each of the better half of the particles, and each again."""
    better = np.argsort(-log_weights, kind="stable")[: -(-len(log_weights) // 2)]
    return np.resize(better, len(log_weights))


def _normalised(log_weights: F64, gain: float) -> F64:
    """Return weights that sum to 1, evened out by gmapping's ``ogain`` times the particles."""
    away = log_weights - log_weights.max()
    weights = np.exp(away / (gain * len(log_weights)))
    return np.asarray(weights / weights.sum())
