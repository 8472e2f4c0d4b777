"""``WallMap``: the walls that scans show along a path, as short lines; a scan is matched to them.

Hits are sorted into patches by place and by the side that they are seen from, and a line is fitted
to each patch. ``refine_path`` moves the poses of all scans until the hits lie on their lines;
``WallMap.match`` moves scans onto the lines of a path that is solved.

Source: Chen and Medioni, Object modelling by registration of multiple range images, Image and
Vision Computing 10(3), 1992 (distances from surfaces, and not from points); Geman and McClure as in
``fused_path`` (the weights of hits).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from slamfusion.evidence.beams import JudgedScans, ScanHits, cover_stamps
from slamfusion.evidence.known_motions import turned
from slamfusion.evidence.path_frames import FROM_MEDIAN, geman_mcclure
from slamfusion.geometry import (
    B8,
    F64,
    I64,
    Pose2,
    compose_poses,
    invert_poses,
    pose_of,
    transform_points,
    wrap_angle,
    wrap_angles,
)
from slamfusion.trajectory import Trajectory

# Side of a patch of wall, metres, and the number of directions of its normal.
PATCH_M, FACINGS = 0.2, 8
# Least number of hits of a patch, and least length of the mean of their normals.
LEAST_HITS, LEAST_UNITY = 4, 0.9
# Deviation of a hit about its patch, metres; a hit at twice this has a quarter of its weight, at
# the second distance none.
SPREAD_M, REACH_M = 0.04, 0.15
# The most hits used.
MOST_HITS = 200_000
# A hit that faces the laser within this has no neighbours and thus no known direction, radians: it
# would wrongly fix the place along a corridor.
LONE_RAD = 1e-9
# Rounds that find the line of a patch without outliers, and rounds that turn its normal to it.
LINE_ROUNDS, TURN_ROUNDS = 3, 2
# Deviation of the normal of a patch from the mean of its hits' directions, radians: noise along the
# beam turns these towards the laser.
TILT_RAD = 0.5
# Hits at equal distance and slant spread alike: number of distance classes, limits of the cosine of
# the slant, and least hits of a class for its own spread.
FAR_SHARES, SLANTS, LEAST_OF_KIND = 6, (0.25, 0.5, 0.8), 30
KINDS = FAR_SHARES * (len(SLANTS) + 1)
# Least deviation of a hit, metres, since walls are not flat.
LEAST_SPREAD_M = 0.015
# Least scales of the distances in the steps of a match, metres.
SCALES_M = (2.0 * SPREAD_M,) * 4 + (0.0,) * 2
# A hit fits its wall within this number of deviations. A scan fits if more than the first share of
# its hits meets a wall, and more than the second share of these fits.
FITTING, LEAST_KNOWN, LEAST_FITTING = 3.0, 0.05, 0.75
# The most patches along one axis: combines two indices into one number.
ROW = 1 << 28
# Lattices in turn: offsets of a third of a patch, and other limits of the directions.
MOVES, TURNS = 3, 2
LATTICES = MOVES * TURNS


@dataclass(frozen=True, eq=False)
class SurfaceHits:
    """Hits of the scans with a pose, on surfaces with more than one hit.

    Attributes:
        points: (B, 2) float64, in the robot's base frame, metres.
        facings_rad: (B,) float64, the direction that the surface at each faces, there.
        scans: (B,) int64, the scan of each, counted among those with a pose.
        kinds: (B,) int64, 0 to ``KINDS`` - 1, alike for hits as far away and as slant.
    """

    points: F64
    facings_rad: F64
    scans: I64
    kinds: I64

    @classmethod
    def of(cls, scans: JudgedScans, kept: I64) -> SurfaceHits:
        """Take the hits of some of the scans."""
        number = np.full(len(scans), -1, dtype=np.int64)
        number[kept] = np.arange(len(kept))
        of = number[scans.hit_scans]
        to_laser = scans.lasers[scans.hit_scans] - scans.hits
        slants_rad = _turned_rad(scans.facings_rad, to_laser)
        own = np.flatnonzero((of >= 0) & (np.abs(slants_rad) > LONE_RAD))
        own = own[:: max(1, -(-len(own) // MOST_HITS))]
        if not len(own):
            return cls(np.zeros((0, 2)), np.zeros(0), own, own)
        away_m = np.hypot(*to_laser[own].T)
        limits_m = np.quantile(away_m, np.arange(1, FAR_SHARES) / FAR_SHARES)
        slants = np.array(SLANTS).searchsorted(np.cos(slants_rad[own]))
        kinds = limits_m.searchsorted(away_m) * (len(SLANTS) + 1) + slants
        return cls(scans.hits[own], scans.facings_rad[own], of[own], np.asarray(kinds, np.int64))


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of wall at some poses, on one lattice, and what each hit says of its own.

    Attributes:
        keys: (P,) int64, rising, the place and side of each patch; see ``_keys``.
        middles: (P, 2) float64, the mean of its hits, metres.
        normals: (P, 2) float64, unit vectors.
        lines: (P, 2) float64, where its wall lies along the normal, metres, and its tilt.
        is_wall: (P,) bool, whether its hits are enough and face one way.
        of: (B,) int64, the patch of each hit.
        slopes: (B, 3) float64, how each hit's place along the normal of its patch changes with its
            scan's pose: x, y, yaw.
        sides_m: (B,) float64, distance of each hit from the middle of its patch along the wall.
        away_m: (B,) float64, how far each hit lies from its patch along the normal.
        weights: (B,) float64, weight of each hit over its variance, 1 / m2; 0: none.
    """

    number: int
    keys: I64
    middles: F64
    normals: F64
    lines: F64
    is_wall: B8
    of: I64
    slopes: F64
    sides_m: F64
    away_m: F64
    weights: F64

    @classmethod
    def at(cls, hits: SurfaceHits, poses: F64, number: int, *, by_kind: bool) -> Patches:
        """Sort hits into patches on a lattice; ``by_kind`` weighs them by their kind's spread."""
        own = poses[hits.scans]
        arms = turned(hits.points, np.stack((np.cos(own[:, 2]), np.sin(own[:, 2])), axis=1))
        places = own[:, :2] + arms
        facings_rad = hits.facings_rad + own[:, 2]
        keys, of, sizes = np.unique(
            _keys(places, facings_rad, number), return_inverse=True, return_counts=True
        )
        count = len(keys)
        normals = _means(of, sizes, np.stack((np.cos(facings_rad), np.sin(facings_rad)), axis=1))
        unity = np.hypot(*normals.T)
        normals /= np.maximum(unity, 1e-9)[:, None]
        middles = _means(of, sizes, places)
        offsets = places - middles[of]
        is_wall = (sizes >= LEAST_HITS) & (unity > LEAST_UNITY)
        sure = np.full(len(of), SPREAD_M**-2.0)
        found = normals
        for _ in range(TURN_ROUNDS):
            normals = found
            normal = normals[of]
            across_m, sides_m = _along(offsets, normal)
            say = np.ones(len(of))
            for _ in range(LINE_ROUNDS):
                lines = _lines(of, count, sides_m, across_m, say * sure)
                away_m = across_m - lines[of, 0] - lines[of, 1] * sides_m
                say = geman_mcclure(away_m / (2.0 * SPREAD_M))
            tilts_rad = np.arctan(lines[:, 1])
            found = turned(normals, np.stack((np.cos(tilts_rad), -np.sin(tilts_rad)), axis=1))
            is_used = is_wall[of] & (np.abs(away_m) < REACH_M)
            if by_kind and is_used.any():
                sure = _spreads_m(away_m[is_used], hits.kinds[is_used])[hits.kinds] ** -2.0
        slopes = _slopes(arms, normal)
        return cls(
            number, keys, middles, normals, lines, is_wall, of, slopes, sides_m, away_m,
            say * is_used * sure,
        )  # fmt: skip


def _along(offsets: F64, normals: F64) -> tuple[F64, F64]:
    """Return offsets, (..., 2), along normals and to the left of them, (...) each."""
    across_m = np.asarray((offsets * normals).sum(axis=-1), dtype=np.float64)
    return across_m, offsets[..., 1] * normals[..., 0] - offsets[..., 0] * normals[..., 1]


def _slopes(arms: F64, normals: F64) -> F64:
    """Return how places along normals, (..., 2), change with a scan's pose, (..., 3).

    ``arms`` lead from the scan to the places.
    """
    turning = arms[..., 0] * normals[..., 1] - arms[..., 1] * normals[..., 0]
    return np.concatenate((normals, turning[..., None]), axis=-1)


def _turned_rad(facings_rad: F64, to_laser: F64) -> F64:
    """Return how far surfaces, (B,), are turned away from the laser, to which (B, 2) points."""
    return wrap_angles(facings_rad - np.arctan2(to_laser[:, 1], to_laser[:, 0]))


def _keys(places: F64, facings_rad: F64, number: int | I64) -> I64:
    """Return a number for the patch of each hit on a round's lattice: by place and side.

    (B,) of one round, or (L, B) of the (L, 1) numbers of several.
    """
    moved = np.asarray(number % MOVES / MOVES)[..., None]
    cells = np.floor(places / PATCH_M + moved).astype(np.int64)
    side = np.rint(facings_rad * FACINGS / (2.0 * np.pi) + number % TURNS / TURNS).astype(np.int64)
    return np.asarray((cells[..., 0] * ROW + cells[..., 1]) * FACINGS + side % FACINGS)


def _means(of: I64, sizes: I64, values: F64) -> F64:
    """Return the mean of two values, (B, 2), over each patch, (P, 2)."""
    sums = [np.bincount(of, part, len(sizes)) for part in values.T]
    return np.asarray(np.stack(sums, axis=1) / sizes[:, None])


def _spreads_m(away_m: F64, kinds: I64) -> F64:
    """Return how far hits of each kind spread about their patches, (KINDS,) metres."""
    far_m = np.abs(away_m)
    usual_m = np.full(KINDS, np.median(far_m))
    for kind in np.flatnonzero(np.bincount(kinds, minlength=KINDS) >= LEAST_OF_KIND):
        usual_m[kind] = np.median(far_m[kinds == kind])
    return np.asarray(np.hypot(FROM_MEDIAN * usual_m, LEAST_SPREAD_M))


def _lines(of: I64, count: int, sides_m: F64, across_m: F64, weights: F64) -> F64:
    """Return height and tilt of the line through the hits of each patch, (P, 2)."""
    inverse = line_inverses(of, count, sides_m, weights)
    right = line_sums(of, count, sides_m, weights * across_m)
    return np.asarray(np.einsum("pab,pb->pa", inverse, right))


def line_sums(of: I64, count: int, sides_m: F64, values: F64) -> F64:
    """Return the right side of each patch's equations of height and tilt, (P, 2), for values."""
    parts = (values, values * sides_m)
    return np.stack([np.bincount(of, part, count) for part in parts], axis=1).astype(np.float64)


def line_inverses(of: I64, count: int, sides_m: F64, weights: F64) -> F64:
    """Return the inverse of each patch's equations of height and tilt, (P, 2, 2)."""
    # A patch without weighted hits does not move.
    mass = np.bincount(of, weights, count) + 1e-9
    first = np.bincount(of, weights * sides_m, count)
    second = np.bincount(of, weights * sides_m**2, count) + TILT_RAD**-2.0
    parts = np.stack((second, -first, -first, mass), axis=1).reshape(count, 2, 2)
    return np.asarray(parts / (mass * second - first**2)[:, None, None])


@dataclass(frozen=True, eq=False)
class ScanMatch:
    """Where a scan lies on a map of walls.

    Attributes:
        pose: in the frame of the map.
        covariance: (3, 3) float64, x and y in metres, yaw in radians, in axes of that frame.
        fits: whether the scan shows that place.
    """

    pose: Pose2
    covariance: F64
    fits: bool


class Walls(NamedTuple):
    """Patches that are walls, of the lattices 0 to ``MOVES`` - 1.

    Attributes:
        keys: (P,) int64, rising: ``MOVES`` times the patch's key, and its lattice.
        middles, normals, lines: as in ``Patches``, (P, 2) float64.
    """

    keys: I64
    middles: F64
    normals: F64
    lines: F64


@dataclass(frozen=True, eq=False)
class WallMap:
    """The walls that the scans of a drive show at the poses of a path.

    Attributes:
        walls: of the drive, and of what was seen since.
        spread_m: deviation of a hit about its wall, metres.
        covariance: (3, 3) float64, of the walls' place in the frame of the path: x and y in metres,
            yaw in radians.
    """

    walls: tuple[Walls, ...]
    spread_m: float
    covariance: F64

    @classmethod
    def of(cls, scans: JudgedScans, path: Trajectory, covariance: F64) -> WallMap | None:
        """Draw the walls; None where no scan with a pose sees one."""
        given, is_own = cover_stamps(path, scans)
        kept = np.flatnonzero(is_own)
        hits = SurfaceHits.of(scans, kept)
        if not len(hits.scans):
            return None
        poses = given[kept]
        lattices = [Patches.at(hits, poses, number, by_kind=False) for number in range(MOVES)]
        keys = np.concatenate([MOVES * own.keys[own.is_wall] + own.number for own in lattices])
        if not len(keys):
            return None
        order = np.argsort(keys)
        middles, normals, lines = (
            np.concatenate([getattr(own, name)[own.is_wall] for own in lattices])[order]
            for name in ("middles", "normals", "lines")
        )
        walls = Walls(keys[order], middles, normals, lines)
        far_m = np.concatenate([np.abs(own.away_m[own.weights > 0.0]) for own in lattices])
        usual_m = float(np.median(far_m)) if len(far_m) else 0.0
        return cls((walls,), max(FROM_MEDIAN * usual_m, LEAST_SPREAD_M), covariance)

    def joined(self, seen: WallMap) -> WallMap:
        """Return these walls with others, which stand as sure as those."""
        return replace(seen, walls=(*self.walls, *seen.walls), spread_m=self.spread_m)

    def match(self, scans: Sequence[ScanHits], poses: F64, covariance: F64) -> ScanMatch:
        """Find where scans lie on these walls, all as one, near poses that are expected.

        Gauss-Newton steps on the distances of hits from the lines of their patches, without far
        hits. Directions that walls leave open, as along a corridor, stay as expected.

        Args:
            scans: N of them, at least 1.
            poses: (N, 3) expected poses, metres and radians; the answer is the last one.
            covariance: (3, 3) of the last one, square metres and radians.
        """
        expected, prior = poses[-1], np.linalg.inv(covariance)
        relative = compose_poses(invert_poses(expected), poses)
        rows = np.concatenate([scan.rows for scan in scans])
        of = np.repeat(np.arange(len(scans)), [len(scan.rows) for scan in scans])
        to_laser = np.array([scan.laser for scan in scans])[of] - rows[:, :2]
        is_seen = np.abs(_turned_rad(rows[:, 2], to_laser)) > LONE_RAD
        rows, of = rows[is_seen], of[is_seen]
        points = transform_points(relative, rows[:, :2], of)
        facings_rad = rows[:, 2] + relative[of, 2]
        pose = expected
        for scale_m in SCALES_M:
            slopes, away_m, is_known = self._measure(points, facings_rad, pose)
            weights = geman_mcclure(away_m / max(scale_m, 2.0 * self.spread_m))
            weights *= is_known * (np.abs(away_m) < REACH_M)
            weights *= self.spread_m**-2.0 / (MOVES * len(self.walls))
            information = prior + (weights[:, None] * slopes).T @ slopes
            moved = pose - expected
            moved[2] = wrap_angle(moved[2])
            pose = pose - np.linalg.solve(
                information, slopes.T @ (weights * away_m) + prior @ moved
            )
        is_fitting = is_known & (np.abs(away_m) < FITTING * self.spread_m)
        known, fitting = int(np.count_nonzero(is_known)), int(np.count_nonzero(is_fitting))
        fits = known > LEAST_KNOWN * len(is_known) and fitting > LEAST_FITTING * known
        sure = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return ScanMatch(pose_of(pose), sure, fits)

    def _measure(self, points: F64, facings_rad: F64, pose: F64) -> tuple[F64, F64, B8]:
        """Return (L * H, ...) derivatives by the pose (3), distances (m), and whether known."""
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        arms = points @ np.array(((cos, sin), (-sin, cos)))
        places = pose[:2] + arms
        numbers = np.arange(MOVES)[:, None]
        keys = MOVES * _keys(places, facings_rad + pose[2], numbers) + numbers
        found = []
        for own in self.walls:
            at = np.minimum(np.searchsorted(own.keys, keys), len(own.keys) - 1)
            normals, lines = own.normals[at], own.lines[at]
            across_m, sides_m = _along(places - own.middles[at], normals)
            away_m = across_m - lines[..., 0] - lines[..., 1] * sides_m
            is_known = own.keys[at] == keys
            slopes = _slopes(arms, normals)
            found.append((slopes.reshape(-1, 3), away_m.ravel(), is_known.ravel()))
        slopes, distances_m, are_known = (np.concatenate(part) for part in zip(*found, strict=True))
        return slopes, distances_m, are_known
