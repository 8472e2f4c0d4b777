"""Predictive consistency: how well a path's map of other times predicts what each scan saw.

Each judged beam has a likelihood under the map of all chunks except its own and the two next to it,
drawn by the scored path: that it hits something where it did, and that it passes one place on its
way. The score of a path is the mean log-likelihood of a judged beam. A logarithmic score is
proper [1]: a wrong path gains nothing in expectation. Unseen places have a fixed price, so a path
that misses a revisit pays for each hit there; and one that draws walls everywhere, as a path that
stands still does, for what its beams pass. Unlike the entropy of a map [2] or counts of its corners
and enclosed places [3] it predicts readings that were not drawn, so a torn map cannot look crisp by
showing everything twice.

Source: [1] Gneiting and Raftery, Strictly proper scoring rules, prediction, and estimation, JASA
102(477), 2007, sections 4.1 and 7.1 (cross-validated logarithmic score). [2] Droeschel and Behnke,
Efficient continuous-time SLAM for 3D lidar-based online mapping, ICRA 2018, mean map entropy.
[3] Filatov, Filatov, Krinkin, Chen and Molodan, 2D SLAM quality evaluation methods, FRUCT 2017.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import BEAM_ONE, FACINGS, TILE
from slamfusion.compute.tiles import dense_pages
from slamfusion.errors import TrajectoryError
from slamfusion.evidence.beams import CHUNKS, JudgedScans, cover_stamps, no_common_time
from slamfusion.geometry import (
    B8,
    F64,
    I32,
    I64,
    U32,
    Pose2,
    compose_poses,
    corners,
    invert_poses,
    pose_of,
    transform_points,
)
from slamfusion.grid import FREE, OCCUPIED, OccupancyGrid
from slamfusion.grid import UNKNOWN as NOT_SEEN
from slamfusion.trajectory import Trajectory

# Parts of the judged scans in the bootstrap: four per chunk, so that a path that is wrong for a
# tenth of the drive is wrong in many of them.
BLOCKS = 96
DRAWS = 2000
# Significance levels: of a difference, and of one that decides something.
SIGNIFICANT, SURE = 0.05, 0.01


@dataclass(frozen=True)
class Comparison:
    """How the scans compare one path with another."""

    verdict: Literal["better", "worse", "cannot tell"]
    """What the scans say of the first path against the second."""
    difference: float
    """Score of the first path less that of the second, log-likelihood of a hit."""
    difference_95: tuple[float, float]
    """Interval of that, 95 % of the draws."""
    p_value: float
    """Two-sided, of no difference: share of the draws in which its sign turns, doubled; 1 for equal
    paths."""


def compare_sums(
    first: F64, second: F64, beams: I64, is_judged: B8, blocks: int = BLOCKS
) -> Comparison:
    """Compare the sums of log-likelihoods of two paths on the same hits: a paired block bootstrap.

    Scores of neighbouring scans are dependent; blocks of them are not. A block is resampled with
    the scores of both paths in it. The arrays are (N,): sums and judged hits of each scan.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, sections 8.5 and 16.4
    (blocks of a series, and achieved significance).
    """
    judged = np.flatnonzero(is_judged)
    block = np.arange(len(judged)) * blocks // len(judged)
    apart = np.bincount(block, (first - second)[judged], blocks)
    hits = np.bincount(block, beams[judged], blocks)
    difference = float(apart.sum() / hits.sum())
    draws = _draws(blocks)
    drawn = (draws @ apart) / np.maximum(draws @ hits, 1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    turned = min(np.count_nonzero(drawn <= 0.0), np.count_nonzero(drawn >= 0.0))
    p_value = min(1.0, 2.0 * (turned + 1) / (DRAWS + 1))
    verdict: Literal["better", "worse", "cannot tell"] = "cannot tell"
    if p_value < SIGNIFICANT:
        verdict = "better" if difference > 0.0 else "worse"
    return Comparison(verdict, difference, (float(low), float(high)), p_value)


@lru_cache
def _draws(blocks: int) -> I64:
    """Return the number of copies of each block in each draw, (DRAWS, blocks); always the same."""
    shares = np.full(blocks, 1.0 / blocks)
    return np.random.default_rng(0).multinomial(blocks, shares, DRAWS).astype(np.int64)


# The lattice is turned against the first pose, radians, since walls along the cells are drawn
# thinner than others.
LATTICE_YAW_RAD = 0.5
_CHUNK_BITS = np.uint32(1) << np.arange(CHUNKS, dtype=np.uint32)
_APART = np.abs(np.subtract.outer(np.arange(CHUNKS), np.arange(CHUNKS)))
# For each chunk the bits of the chunks next to it, and of those that are neither it nor next to it.
NEIGHBOURS, OTHERS = (
    np.where(are_asked, _CHUNK_BITS, 0).sum(axis=1).astype(np.uint32)
    for are_asked in (_APART == 1, _APART > 1)
)
# The most pages of a map; 2^24 are a square of 6.5 km of cells of 0.05 m.
MOST_PAGES = 1 << 24


# Likelihood of a hit: side of a cell, metres; deviation of a hit about a wall, cells; likelihood of
# an unexplained hit in seen places, and in unseen places.
CELL_M, SPREAD_CELLS, STRAY, UNKNOWN = 0.05, 1.0, 0.03, 0.35
# Range in which walls are searched, cells; and distance of a hit from a wall in a seen place.
REACH_CELLS, KNOWN_CELLS = 4, 2.0
# How far from a hit a beam passes nothing for sure, metres: walls are thick, and seen at an angle.
# The place on its way differs from beam to beam, by the golden ratio.
PASSING_M, GOLDEN = 0.5, 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class PathScore:
    """Evidence of the scans for one path.

    Attributes:
        poses: (N, 3) float64, of the path at each scan; NaN where it has none.
        is_own: (N,) bool, where the path itself has a pose for the scan.
        sums: (N,) float64, sum of the log-likelihoods of each scan's judged hits; 0 where the scan
            was not judged.
        beams: (N,) int64, judged hits of each scan, the same for all paths.
        seen: (N,) int64, of these, hits in places that other chunks have seen.
    """

    poses: F64
    is_own: B8
    sums: F64
    beams: I64
    seen: I64

    @property
    def consistency(self) -> float:
        """Mean log-likelihood of a judged hit; larger is better, at most 0."""
        return float(self.sums.sum() / self.beams.sum())

    @property
    def seen_share(self) -> float:
        """Share of the judged hits that lie where other chunks have seen something."""
        return float(self.seen.sum() / self.beams.sum())

    @property
    def seen_consistency(self) -> float:
        """Mean log-likelihood of a hit where other chunks have seen something; NaN for no hit.

        Unlike ``consistency`` it does not depend on the share of places seen once, so drives
        compare.
        """
        seen = int(self.seen.sum())
        price = (int(self.beams.sum()) - seen) * np.log(UNKNOWN)
        return float((self.sums.sum() - price) / seen) if seen else float("nan")


@dataclass(frozen=True, eq=False)
class PathEvidence:
    """Evidence of the scans of a drive for its paths.

    Attributes:
        is_judged: (N,) bool, scans that every path has a pose for.
        scores: of the paths, by name, in the order given.
        device: computed the scores, and answers further questions to the evidence.
        gaps: results of ``path_gaps``, by the names of both paths.
    """

    scans: JudgedScans
    is_judged: B8
    scores: Mapping[str, PathScore]
    device: ComputeDevice
    gaps: dict[tuple[str, str], F64] = field(default_factory=dict, init=False, repr=False)

    def of_paths(self, names: Collection[str]) -> PathEvidence:
        """Return the evidence for some of the paths, in the order of the names."""
        return replace(self, scores={name: self.scores[name] for name in names})

    def ranking(self) -> tuple[str, ...]:
        """Return the names, the best path first; of equals the first given."""
        return tuple(sorted(self.scores, key=lambda name: -self.scores[name].consistency))

    def compare(self, a: str, b: str) -> Comparison:
        """Say whether path ``a`` is better than path ``b``, or worse, or cannot be told from it."""
        first, second = self.scores[a], self.scores[b]
        return compare_sums(first.sums, second.sums, first.beams, self.is_judged)

    def own_path(self, name: str) -> Trajectory:
        """Return a path at the scans that it has a pose for itself."""
        score = self.scores[name]
        return Trajectory(self.scans.stamps_s[score.is_own], score.poses[score.is_own], name)

    def over_time(self, name: str) -> tuple[F64, F64, I64, F64]:
        """Return a path's score over the chunks of the drive.

        Returns:
            (CHUNKS,) mean time of each chunk's scans in seconds, its mean log-likelihood of a hit,
            the hits judged, and the share of these that other chunks have seen too, 0 to 1; NaN
            where no hit was judged.
        """
        score, chunks = self.scores[name], self.scans.chunks
        beams = np.bincount(chunks, score.beams, CHUNKS).astype(np.int64)
        scans = np.maximum(np.bincount(chunks, minlength=CHUNKS), 1)
        times_s = np.bincount(chunks, self.scans.stamps_s, CHUNKS) / scans
        mean, seen = (
            np.where(beams > 0, np.bincount(chunks, part, CHUNKS) / np.maximum(beams, 1), np.nan)
            for part in (score.sums, score.seen)
        )
        return times_s, mean, beams, seen


def score_paths(
    scans: JudgedScans, paths: Mapping[str, Trajectory], device: ComputeDevice
) -> PathEvidence:
    """Score paths of one drive by predictive consistency.

    paths: by name, each in its own frame, on the clock of the scans; may be sparse.

    Returns:
        Scores of all paths on the same hits: those of the scans that every path has a pose for.

    Raises:
        TrajectoryError: no path; one that meets no scan in time, or the others at none; or one
            that spreads over many kilometres.
    """
    if not paths:
        raise TrajectoryError("there is no path to score; give at least one")
    covered = {name: _covered(name, path, scans) for name, path in paths.items()}
    return _score_covered(covered, scans, device)


def with_path(evidence: PathEvidence, name: str, path: Trajectory) -> PathEvidence:
    """Score one more path of a drive; the same as if all were scored together.

    path: in its own frame, on the clock of the scans; may be sparse; with a new name.

    Returns:
        Scores of all paths, this one last. The others are scored again only where it has no pose
        for a scan that was judged.

    Raises:
        TrajectoryError: see ``score_paths``.
    """
    scans, is_judged, device = evidence.scans, evidence.is_judged, evidence.device
    own = _covered(name, path, scans)
    if np.isfinite(own[0][is_judged, 0]).all():
        score = _score(name, own, scans, is_judged, device)
        return replace(evidence, scores={**evidence.scores, name: score})
    covered = {known: (score.poses, score.is_own) for known, score in evidence.scores.items()}
    return _score_covered({**covered, name: own}, scans, device)


def _covered(name: str, path: Trajectory, scans: JudgedScans) -> tuple[F64, B8]:
    """Return a path's pose at each scan from its first to its last; refuse one that has none."""
    if not len(path):
        raise TrajectoryError(f"{name}: the path has no pose; give one with poses")
    poses, is_own = cover_stamps(path, scans)
    # Beyond its ends the odometry would be judged in its place.
    is_within = (scans.stamps_s >= path.stamps_s[0]) & (scans.stamps_s <= path.stamps_s[-1])
    poses[~(is_within | is_own)] = np.nan
    if not np.isfinite(poses[:, 0]).any():
        raise no_common_time(name, path, scans.stamps_s)
    return poses, is_own


def _score_covered(
    covered: Mapping[str, tuple[F64, B8]], scans: JudgedScans, device: ComputeDevice
) -> PathEvidence:
    """Score paths on the hits of the scans that each has a pose for."""
    known = {name: np.isfinite(poses[:, 0]) for name, (poses, _) in covered.items()}
    is_judged = np.logical_and.reduce(list(known.values()))
    if not is_judged[scans.hit_scans].any():
        shares = ", ".join(f"{name} {own.mean():.0%}" for name, own in known.items())
        message = f"no scan has a pose in every path (each alone: {shares}); leave one out"
        raise TrajectoryError(message)
    scores = {name: _score(name, own, scans, is_judged, device) for name, own in covered.items()}
    return PathEvidence(scans, is_judged, scores, device)


def _score(
    name: str, covered: tuple[F64, B8], scans: JudgedScans, is_judged: B8, device: ComputeDevice
) -> PathScore:
    """Draw the map of a path and look up every judged hit in what the other chunks drew."""
    poses, is_own = covered
    drawn = DrawnChunks.of(name, poses, scans, is_judged, device)
    likelihoods, is_seen = drawn.look_up()
    likelihoods += drawn.passing()
    count = len(scans)
    return PathScore(
        poses=poses,
        is_own=is_own,
        sums=np.bincount(drawn.hit_scans, likelihoods, count).astype(np.float64),
        beams=np.bincount(drawn.hit_scans, minlength=count).astype(np.int64),
        seen=np.bincount(drawn.hit_scans[is_seen], minlength=count).astype(np.int64),
    )


@dataclass(frozen=True, eq=False)
class DrawnChunks:
    """The map that a path draws, from which each chunk of the drive can be left out.

    Attributes:
        origin: of its lattice, in the frame of the path.
        hit_scans: (B,) int64, the scan of each judged hit.
        chunks: (B,) int64, the chunk of each.
        beams, facings: of the judged hits, see ``chunk_marks``.
    """

    device: ComputeDevice
    reach_cells: int
    origin: Pose2
    hit_scans: I64
    chunks: I64
    beams: I32
    facings: I32
    table: DeviceArray[np.int32]
    hits: DeviceArray[np.uint32]
    seen: DeviceArray[np.uint32]

    @classmethod
    def of(
        cls,
        name: str,
        poses: F64,
        scans: JudgedScans,
        is_judged: B8,
        device: ComputeDevice,
        reach_cells: int = REACH_CELLS,
    ) -> DrawnChunks:
        """Draw the judged hits of a drive at the poses (N, 3) of a path at its scans.

        They are drawn on a lattice of pages, with tiles wherever a hit is looked up.
        """
        kept = is_judged[scans.hit_scans]
        hit_scans = scans.hit_scans[kept]
        first = poses[np.flatnonzero(is_judged)[0]]
        lattice = np.array([0.0, 0.0, LATTICE_YAW_RAD])
        laid = compose_poses(lattice, compose_poses(invert_poses(first), poses))
        places = transform_points(laid, scans.hits[kept], hit_scans)
        lasers = transform_points(laid, scans.lasers)[hit_scans]
        cells = np.concatenate((places, lasers), axis=1)
        del places, lasers  # of all hits, as the next ones: some MB each
        cells /= CELL_M
        least, most = (np.floor(corner / TILE) for corner in corners(cells.reshape(-1, 2)))
        low = least - 1
        width, height = (most + 2 - low).astype(np.int64)
        if width * height > MOST_PAGES:
            side_m = TILE * CELL_M
            raise TrajectoryError(
                f"{name}: what it sees spreads over {width * side_m:.0f} x "
                f"{height * side_m:.0f} m, more than can be scored; check the unit and the frame "
                "of its poses"
            )
        cells -= np.tile(low * TILE, 2)
        cells *= BEAM_ONE
        beams = np.floor(cells, out=cells).astype(np.int32)
        del cells
        col, row = (beams[:, :2] // BEAM_ONE).T
        used = np.zeros((height, width), dtype=np.bool_)
        for dx in (-reach_cells, reach_cells):
            for dy in (-reach_cells, reach_cells):
                used[(row + dy) // TILE, (col + dx) // TILE] = True
        pages = np.where(used, np.cumsum(used).reshape(used.shape), 0).astype(np.int32)
        turned = (laid[hit_scans, 2] + scans.facings_rad[kept]) * FACINGS / (2.0 * np.pi)
        facings = (np.rint(turned).astype(np.int64) % FACINGS).astype(np.int32)
        chunks = scans.chunks[hit_scans]
        table = device.upload(pages)
        tiles = int(pages.max()) + 1
        hits, seen = (
            device.zeros((tiles, *cells), np.uint32)
            for cells in ((FACINGS, TILE, TILE), (TILE, TILE))
        )
        ends, faces = device.upload(beams), device.upload(facings)
        device.mark_chunks(hits, seen, table, ends, faces, device.upload(_CHUNK_BITS[chunks]))
        lattice_m = np.append(low * (TILE * CELL_M), 0.0)
        origin = pose_of(compose_poses(first, compose_poses(invert_poses(lattice), lattice_m)))
        return cls(
            device, reach_cells, origin, hit_scans, chunks, beams, facings, table, hits, seen
        )

    def look_up(
        self, picked: I64 | slice = np.s_[:], among: U32 = OTHERS, moved_m: F64 | None = None
    ) -> tuple[F64, B8]:
        """Return how likely hits are under what other chunks drew.

        among: (CHUNKS,) uint32, for each chunk the bits of the chunks that count; default: all
            except itself and its neighbours.
        moved_m: (P, 2) float64, by how much each is moved along the lattice, metres.

        Returns:
            (P,) float64 log-likelihoods, and (P,) bool, whether others have seen the place.
        """
        beams = self.beams[picked]
        if moved_m is not None:
            beams = beams.copy()
            beams[:, :2] += np.rint(moved_m * (BEAM_ONE / CELL_M)).astype(np.int32)
        chunks, facings = self.chunks[picked], self.facings[picked]
        return log_likelihoods(self._nearest(beams, facings, among[chunks], self.reach_cells))

    def moved(self, motion: Pose2) -> DrawnChunks:
        """Return the same map, and all hits moved in the frame of the path."""
        own = self.origin.inverse().compose(motion).compose(self.origin)
        beams = self.beams.copy()
        places = self.beams[:, :2] * (CELL_M / BEAM_ONE)
        beams[:, :2] = np.rint(own.transform(places) * (BEAM_ONE / CELL_M))
        turn = round(own.yaw_rad * FACINGS / (2.0 * np.pi))
        return replace(self, beams=beams, facings=(self.facings + turn) % FACINGS)

    def grids(self, *parts: np.uint32) -> Iterator[OccupancyGrid]:
        """Yield the map of some chunks, given by their bits, in the frame of the path."""
        download = self.device.download
        pages, seen = download(self.table), download(self.seen)
        hits = np.bitwise_or.reduce(download(self.hits), axis=1)
        for bits in parts:
            tiles = np.where(hits & bits, OCCUPIED, np.where(seen & bits, FREE, NOT_SEEN))
            cells = dense_pages(tiles, pages).view(np.int8)
            yield OccupancyGrid(cells, CELL_M, self.origin, "drawn")

    def passing(self) -> F64:
        """Return how likely beams pass a place on their way, (B,) log-likelihoods; short ones 0.

        Only a wall that faces the laser would stop them there.
        """
        way = (self.beams[:, 2:] - self.beams[:, :2]).astype(np.float64)
        free = 1.0 - PASSING_M / CELL_M * BEAM_ONE / np.maximum(np.hypot(*way.T), 1.0)
        back = 1.0 - free * (np.arange(len(way)) * GOLDEN % 1.0)
        beams = self.beams.copy()
        beams[:, :2] += np.rint(back[:, None] * way).astype(np.int32)
        turned = np.arctan2(way[:, 1], way[:, 0]) * FACINGS / (2.0 * np.pi)
        facings = np.rint(turned).astype(np.int32) % FACINGS
        found = self._nearest(beams, facings, OTHERS[self.chunks], 0)
        return np.where(free > 0.0, np.log(1.0 - (1.0 - STRAY) * _nearness(found)), 0.0)

    def _nearest(self, beams: I32, facings: I32, among: U32, reach_cells: int) -> I32:
        """Return the nearest marks of the chunks ``among`` (B,) at the ends of beams."""
        upload = self.device.upload
        return self.device.nearest_marks(
            self.hits,
            self.seen,
            self.table,
            upload(beams),
            upload(facings),
            upload(~among),
            reach_cells,
        )


def log_likelihoods(found: I32) -> tuple[F64, B8]:
    """Return log-likelihoods, (B,), of what ``nearest_marks`` found, and whether it was seen."""
    is_wall = (found[:, 0] >= 0) & (found[:, 0] <= (KNOWN_CELLS * BEAM_ONE) ** 2)
    is_seen = (found[:, 1] != 0) | is_wall
    explained = np.log((1.0 - STRAY) * _nearness(found) + STRAY)
    return np.where(is_seen, explained, np.log(UNKNOWN)), is_seen


def _nearness(found: I32) -> F64:
    """Return how near each place is to a wall, (B,): 1 on it, 0 where none is within reach."""
    squared = np.where(found[:, 0] >= 0, found[:, 0] / float(BEAM_ONE) ** 2, np.inf)
    return np.asarray(np.exp(-0.5 * squared / SPREAD_CELLS**2))
