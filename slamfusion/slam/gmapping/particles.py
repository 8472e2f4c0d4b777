"""``Particles``: poses and weights of the filter, and how they are resampled."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamfusion.compute import ComputeDevice
from slamfusion.compute.hit_counts import BeamScan, FieldRule, halve_counts, percent_of_counts
from slamfusion.compute.layout import MOST_BEAMS, PAIRS, TILE
from slamfusion.geometry import (
    F64,
    I8,
    I64,
    U8,
    U32,
    Pose2,
    compose_poses,
    corners,
    pose_of,
    wrap_angles,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.matcher import FieldMap, pose_table
from slamfusion.slam.common.state import Rows, Stateful
from slamfusion.slam.common.tile_map import SharedTileMaps, known_part
from slamfusion.trajectory import Trajectory

# Usable range if ``maxUrange`` is not set: metres, and share of the laser's range, near whose end
# readings are often false.
DEFAULT_USABLE_M, USABLE_SHARE = 80.0, 0.98


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams of a scan that count, in the robot's frame, metres.

    Attributes:
        ends: (B, 2) ends of the beams.
        is_hit: (B,) 1 for hits; the other beams are free up to their end.
        laser: (2,) position of the laser.
    """

    ends: F64
    is_hit: U8
    laser: F64

    @property
    def hits(self) -> F64:
        """(P, 2) the ends that hit something."""
        return np.asarray(self.ends[self.is_hit == 1])


def beams_of(scan: LaserScan, config: Any) -> Beams:
    """Return the beams of a scan that count."""
    most = config.maxRange or scan.range_max_m
    usable = config.maxUrange or min(DEFAULT_USABLE_M, USABLE_SHARE * scan.range_max_m)
    usable = min(usable, most)
    hit = scan.is_hit(usable)
    free = scan.is_hit(most) & ~hit
    if most > scan.range_max_m:  # [G07]'s way to say that no return means free space
        free |= scan.is_clear()
    chosen = hit | free
    ends = scan.points(chosen, np.where(hit, scan.ranges, usable))
    laser = np.array([scan.mount.x, scan.mount.y])
    return Beams(ends, hit[chosen].astype(np.uint8), laser)


def effective_particles(weights: F64) -> float:
    """Return N_eff of normalised weights, 1 to N."""
    return 1.0 / float(np.square(weights).sum())


def resample_systematic(weights: F64, start: float) -> I64:
    """Return (N,) parents by systematic resampling of normalised weights, ``start`` in [0, 1)."""
    count = len(weights)
    places = (np.arange(count) + start) / count
    sums = np.cumsum(weights)
    # Rounding may put the last place beyond the sum: it gets the last particle with any weight.
    last = np.searchsorted(sums, sums[-1])
    return np.asarray(np.minimum(np.searchsorted(sums, places, side="right"), last))


@dataclass(eq=False)
class Particles:
    """N particles; it is its own state.

    Attributes:
        poses: (N, 3) in the map frame, metres and radians.
        log_weights: (N,) since the last resampling.
        path_weights: (N,) logarithms for whole paths: not reset by resampling.
        best: index of the greatest path weight.
        n_eff: stamps of the filter steps, seconds, with the effective number of particles.
    """

    poses: F64
    log_weights: F64
    path_weights: F64
    best: int = 0
    n_eff: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def of(cls, count: int) -> Particles:
        """Return equal ones at the origin."""
        return cls(np.zeros((count, 3)), np.zeros(count), np.zeros(count))

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def best_pose(self) -> Pose2:
        """Pose of the best one in the map frame."""
        return pose_of(self.poses[self.best])

    def move(self, poses: F64, log_evidence: F64) -> None:
        """Set the poses (N, 3), and add log evidence (N,) to the weights."""
        self.poses = poses
        self.log_weights = self.log_weights + log_evidence
        self.path_weights = self.path_weights + log_evidence

    def weigh(self, stamp_s: float, gain: float) -> tuple[F64, float]:
        """Return (N,) normalised weights, and how many particles are effective."""
        shares = normalised_weights(self.log_weights, gain)
        n_eff = effective_particles(shares)
        self.n_eff.append((stamp_s, n_eff))
        return shares, n_eff

    def resample(self, parents: I64) -> None:
        """Replace every particle by its parent, (N,), with equal weights."""
        self.poses = self.poses[parents]
        self.path_weights = self.path_weights[parents]
        self.log_weights = np.zeros(len(self))

    def series(self, limit_share: float) -> tuple[Series, ...]:
        """Return the effective number of particles over time, with a limit as a share of all."""
        if not self.n_eff:
            return ()
        stamps_s, values = np.array(self.n_eff).T
        return (Series("effective particles", "", stamps_s, values, limit_share * len(self)),)


def better_half(log_weights: F64) -> I64:
    """Return (N,) parents: each of the better half of the particles, and each again."""
    better = np.argsort(-log_weights, kind="stable")[: -(-len(log_weights) // 2)]
    return np.resize(better, len(log_weights))


def normalised_weights(log_weights: F64, gain: float) -> F64:
    """Return weights that sum to 1, evened out by gmapping's ``ogain`` times the particles."""
    away = log_weights - log_weights.max()
    weights = np.exp(away / (gain * len(log_weights)))
    return np.asarray(weights / weights.sum())


# Share of hits among a cell's beams above which the matcher sees a wall; the published map uses
# ``occ_thresh``.
MATCHER_SHARE = 0.1
# Entries of the score field's table by squared distance.
TABLE_STEPS = 256
# Share of ``memory_budget`` at which particles are resampled for it: the rest is room for a scan.
BUDGET_SHARE = 0.8
BYTES_PER_MB = 1e6


class ParticleMaps(Stateful):
    """Maps of N particles on shared tiles; ``anchor`` (2,) is in the map frame, metres."""

    STATE = ("anchor", "tiles")

    def __init__(self, config: Any, device: ComputeDevice, count: int) -> None:
        self.anchor = np.zeros(2)
        words, pairs = np.zeros((TILE, TILE), np.uint32), np.zeros((TILE, PAIRS), np.uint16)
        empty: dict[str, NDArray[Any]] = {"counts": words, "sums": words, "field": pairs}
        self.tiles = SharedTileMaps(device, count, empty)
        self._config = config
        self._device = device
        # How the score field follows from the counts. No occupied cell within reach is farther than
        # this, in (1/256 cell)^2.
        farthest = 2.0 * ((config.kernelSize + 0.5) * 256.0) ** 2
        shift = max(0, math.ceil(math.log2(farthest / TABLE_STEPS)))
        squared_m2 = np.arange(TABLE_STEPS) * 2.0**shift / 65536.0 * config.delta**2
        self.field_rule = FieldRule(
            table=np.rint(255.0 * np.exp(-squared_m2 / config.sigma)).astype(np.uint8),
            shift=shift,
            reach=config.kernelSize,
            occupied=round(MATCHER_SHARE * 65536),
            least_hits=1,
        )

    @property
    def corner(self) -> F64:
        """Lower-left corner of the window in the map frame, (2,) x and y in cells."""
        return np.asarray(self.anchor / self._config.delta + self.tiles.origin)

    @property
    def is_over_budget(self) -> bool:
        """Whether the maps hold nearly all of ``memory_budget``, if there is one."""
        budget = BUDGET_SHARE * self._config.memory_budget * BYTES_PER_MB
        return bool(0.0 < budget < self.tiles.used_bytes)

    def begin_at(self, place: F64) -> None:
        """Place the map frame's lattice of cells near a place (2,), metres."""
        cell = self._config.delta
        self.anchor = np.floor(place / cell) * cell

    def walls(self, index: int) -> FieldMap:
        """Return one particle's map as the matcher sees it."""
        tiles = self.tiles
        field, pages = tiles.pools["field"], tiles.page_table(index)
        window = partial(self._device.field_window, field, pages)
        return FieldMap(window, self.corner, self._config.delta)

    def grid(self, index: int, name: str) -> OccupancyGrid:
        """Return one particle's map as it is published."""
        share = self._config.occ_thresh

        def published(counts: U32) -> I8:
            return percent_of_counts(counts >> 16, counts & 0xFFFF, share)

        percent, first = self.tiles.made(published, np.int8, ("counts",), index)
        return known_part(percent, self.anchor, first, self._config.delta, name)

    def integrate(self, beams: Beams, poses: F64, alive: I64) -> None:
        """Integrate a scan into the maps of some particles, given the poses (N, 3) of all."""
        config, maps, device = self._config, self.tiles, self._device
        cell = config.delta
        every = -(-len(beams.ends) // MOST_BEAMS)  # the limit of the counts
        ends, is_hit, laser = beams.ends[::every], beams.is_hit[::every], beams.laser
        near = config.kernelSize + 1  # tiles repeat the next cells
        reach = float(np.hypot(*np.vstack((ends, laser)).T).max()) / cell + near + 1.0
        at = (poses - (*self.anchor, 0.0))[alive] / (cell, cell, 1.0)
        low, high = corners(at)
        maps.cover(low - reach, high + reach)
        table = pose_table(at, 1.0, maps.origin)
        scan = BeamScan(
            (ends / cell).astype(np.float32), is_hit, (laser / cell).astype(np.float32), table
        )
        pages = maps.page_tables_of(alive)
        written = np.zeros(maps.pages.shape, dtype=np.bool_)
        written[alive] = touched = device.touch_pages(pages, scan, near)
        maps.make_writable(written)
        pages, pools = maps.page_tables_of(alive), maps.pools
        layers = pools["counts"], pools["sums"], pools["field"]
        if device.count_and_settle(*layers, pages, touched, scan, self.field_rule):
            halve_counts(device, pools)


# Least standard deviations of a cloud, metres, metres, radians: its entropy stays finite.
LEAST_SIGMAS = (1e-3, 1e-3, 1e-3)


class ParticlePaths(Stateful):
    """The paths of N particles.

    A node is a filter step: a pose of each particle. Where particles were resampled, each has a
    parent in the node before. Of the first nodes, where all particles have one ancestor, only its
    poses are kept. Scans between two nodes are the same small motion for every particle, counted
    from the last node.
    """

    STATE = ("_common", "_poses", "_resampled", "_entropies", "_scans")

    def __init__(self, count: int) -> None:
        self._count = count
        self._common = Rows(3)
        # Poses of the nodes since then, those of all particles in a row.
        self._poses = Rows(3 * count)
        # Each resampling: the node, counted from the first of all, and parents (N,) before it.
        self._resampled: list[tuple[int, I64]] = []
        self._entropies = Rows(1)
        # Stamp, node, and motion since the node.
        self._scans = Rows(5)

    @property
    def memory_bytes(self) -> int:
        """Bytes of nodes and scans."""
        poses = len(self._common) + len(self._poses) * self._count
        return poses * 24 + len(self._scans) * 40

    def add_node(self, poses: F64, parents: I64 | None) -> None:
        """Add a filter step with poses (N, 3) and parents (N,); None: each is its own parent."""
        if parents is not None:
            self._resampled.append((len(self._entropies), parents))
            self._join()
        self._poses.append(*poses.flat)
        self._entropies.append(_entropy(poses))

    def add_scan(self, stamp_s: float, moved: Pose2) -> None:
        """Add a scan by its motion since the last node, or since the origin before the first."""
        self._scans.append(stamp_s, len(self._entropies) - 1, moved.x, moved.y, moved.yaw_rad)

    def path(self, index: int, name: str) -> Trajectory:
        """Return the path of a particle at every scan."""
        # Node -1, before the first, is the frame's origin.
        at = np.concatenate((self._common.array(), self._line(index), np.zeros((1, 3))))
        scans = self._scans.array()
        nodes = scans[:, 1].astype(np.int64)
        return Trajectory(scans[:, 0], compose_poses(at[nodes], scans[:, 2:]), name)

    def _line(self, index: int) -> F64:
        """Return the poses (K, 3) of a particle's ancestors in the nodes that are not common."""
        ancestors = np.full(len(self._poses), index)
        for node, parents in reversed(self._resampled):
            index = int(parents[index])
            ancestors[: node - len(self._common)] = index
        poses = self._poses.array().reshape(-1, self._count, 3)
        return np.asarray(poses[np.arange(len(ancestors)), ancestors])

    def _join(self) -> None:
        """Keep one pose of nodes where the particles of the next node have one ancestor."""
        ancestors = np.arange(self._count)
        for at in range(len(self._resampled) - 1, -1, -1):
            node, parents = self._resampled[at]
            ancestors = parents[ancestors]
            if (ancestors == ancestors[0]).all():
                joined = node - len(self._common)
                for pose in self._line(0)[:joined]:
                    self._common.append(*pose)
                self._poses.restore({"rows": self._poses.array()[joined:]})
                del self._resampled[: at + 1]
                return

    def entropy(self) -> float | None:
        """Return the mean over the nodes of the entropy of the particles there, in nats."""
        return float(np.mean(self._entropies.array()[:, 0])) if len(self._entropies) else None


def _entropy(poses: F64) -> float:
    """Return the entropy of a Gaussian around poses (N, 3), nats."""
    away = poses - poses[0]
    away[:, 2] = wrap_angles(away[:, 2])
    spread = away - away.mean(axis=0)
    covariance = spread.T @ spread / len(poses) + np.diag(np.square(LEAST_SIGMAS))
    _, log_determinant = np.linalg.slogdet(covariance)
    return 0.5 * (3.0 * math.log(math.tau * math.e) + float(log_determinant))
