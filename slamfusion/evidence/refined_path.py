"""``refine_path``: the path near a given one under which every wall is one wall, seen all at once.

A scan matcher lays each scan on what came before it, and pulls a little: errors add up, and several
SLAMs of one drive share them. Here all scans of the drive are laid on each other at once. The hits
are sorted into patches of wall by place and by the side that they are seen from; where a patch lies
along its normal, and how it tilts, is as free as the poses are, and the poses are sought under
which the hits of all patches spread least about them. Those that spread little, near the laser or
along a wall, count the more; how much each kind spreads the drive itself tells. What walls leave
open, along a corridor, the odometry decides, calibrated by the walls of the rest of the drive
(``known_motions``); without odometry, and where it errs, the motions of the given path do. Hits far
from their patch have no say.

The lines of the patches are eliminated from the normal equations of each round (the Schur
complement), as those of points are in bundle adjustment; what is left is solved by conjugate
gradients, with the part that is banded for preconditioner. After each round hits are sorted anew,
on a lattice that lies elsewhere, so that no wall stays cut in two.

Source: Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment - a modern synthesis, Vision
Algorithms, LNCS 1883, 2000, section 6; Liu and Zhang, BALM: Bundle adjustment for lidar mapping,
IEEE RA-L 6(2), 2021 (features of lidar scans that are eliminated); Geman and McClure as in
``fused_path`` (the weights of hits).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.evidence.beams import JudgedScans, cover_stamps
from slamfusion.evidence.known_motions import KnownMotions, MotionEquations
from slamfusion.evidence.path_frames import FROM_MEDIAN, geman_mcclure, laid_onto
from slamfusion.geometry import F64, compose_poses, invert_poses, wrap_angles
from slamfusion.trajectory import Trajectory

I64 = npt.NDArray[np.int64]

# A patch of wall: its side, metres, and the directions that its normal is told apart by.
PATCH_M, FACINGS = 0.2, 8
# A patch has at least this many hits, whose normals agree at least so far (the length of their
# mean).
LEAST_HITS, LEAST_UNITY = 4, 0.9
# Deviation of a hit about its patch, metres, while walls are drawn apart; twice as far away a hit
# has lost three quarters of its say, and at the second distance all of it.
SPREAD_M, REACH_M = 0.04, 0.15
# Hits that are used at most: more say nearly the same again.
MOST_HITS = 200_000
# A hit that faces the laser as exactly as this has no neighbours that say what it faces, radians.
LONE_RAD = 1e-9
# Rounds in which the line of a patch is found without its outliers, and those in which its normal
# is turned to the line.
LINE_ROUNDS, TURN_ROUNDS = 3, 2
# Deviation of the normal of a patch from the mean of what its hits are said to face, radians: noise
# along the beam turns that towards the laser.
TILT_RAD = 0.5
# Hits that are as far away and as slant as each other spread alike: shares of them by distance, and
# limits of the cosine of the slant. Those of a kind that has this many tell how much.
FAR_SHARES, SLANTS, LEAST_OF_KIND = 6, (0.25, 0.5, 0.8), 30
KINDS = FAR_SHARES * (len(SLANTS) + 1)
# No hit is surer than this, metres: walls are not as flat.
LEAST_SPREAD_M = 0.015
# Lattices that patches are cut by in turn: moved by a third of a patch, and normals told apart by
# other limits.
MOVES, TURNS = 3, 2
LATTICES = MOVES * TURNS
# Rounds before those whose mean counts, in which all hits are equally sure; the equations of each
# are solved by this many steps at most, to this share of the first residual.
ROUNDS, MOST_STEPS, TOLERANCE = 3, 400, 1e-4


def refine_path(scans: JudgedScans, path: Trajectory) -> Trajectory:
    """Return a path that lays the scans of a drive on each other.

    Args:
        path: near the right one: walls that it draws further apart than ``REACH_M`` stay so.

    Returns:
        Poses at the stamps of ``path``, in its frame. Those at times of no scan are moved along
        with the scan next to them. A path that meets fewer than two scans is returned as it is, and
        so is one whose scans see no surface.
    """
    given = cover_stamps(path, scans)
    kept = np.flatnonzero(given.is_own)
    if len(kept) < 2:
        return path
    hits = _Hits.of(scans, kept)
    if not len(hits.scans):
        return path
    before = given.poses[kept]
    motions = KnownMotions.of(before, None if scans.odometry is None else scans.odometry[kept])
    poses, calibration, moved = before, motions.calibration, np.zeros_like(before)
    for number in range(ROUNDS + LATTICES):
        say = motions.say(poses, calibration, number)
        equations = motions.equations(poses, calibration, say)
        step, calibrated = _step(hits, poses, equations, number)
        poses, calibration = poses + step, calibration + calibrated
        # Nothing but the places of before holds the frame, and the steps are not solved to the end.
        poses = laid_onto(poses, before)
        if number >= ROUNDS:
            off = poses - before
            off[:, 2] = wrap_angles(off[:, 2])
            moved += off
    # What the walls hardly hold differs by the lattice: the mean of all of them counts.
    poses = before + moved / LATTICES
    return carried_along(path, scans.stamps_s[kept], before, poses)


def carried_along(path: Trajectory, stamps_s: F64, before: F64, poses: F64) -> Trajectory:
    """Return a path each pose of which is carried along by the scan nearest to it.

    Args:
        stamps_s: (N,) of scans, seconds, N at least 1.
        before: (N, 3) where the path has them.
        poses: (N, 3) where they are now.
    """
    near = Trajectory(stamps_s, before, path.name).nearest(path.stamps_s)
    beside = compose_poses(invert_poses(before[near]), path.poses)
    return Trajectory(path.stamps_s, compose_poses(poses[near], beside), path.name)


@dataclass(frozen=True, eq=False)
class _Hits:
    """Hits of the scans that have a pose, on surfaces of which more than one hit tells.

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
    def of(cls, scans: JudgedScans, kept: I64) -> _Hits:
        """Take the hits of some of the scans."""
        number = np.full(len(scans), -1, dtype=np.int64)
        number[kept] = np.arange(len(kept))
        of = number[scans.hit_scans]
        # One without neighbours faces the laser, whatever the wall does: it would hold the robot's
        # place along a corridor by what is no wall across it.
        to_laser = scans.lasers[scans.hit_scans] - scans.hits
        turned = wrap_angles(scans.facings_rad - np.arctan2(to_laser[:, 1], to_laser[:, 0]))
        own = np.flatnonzero((of >= 0) & (np.abs(turned) > LONE_RAD))
        own = own[:: max(1, -(-len(own) // MOST_HITS))]
        if not len(own):
            return cls(np.zeros((0, 2)), np.zeros(0), own, own)
        away_m = np.hypot(*to_laser[own].T)
        limits_m = np.quantile(away_m, np.arange(1, FAR_SHARES) / FAR_SHARES)
        slants = np.array(SLANTS).searchsorted(np.cos(turned[own]))
        kinds = limits_m.searchsorted(away_m) * (len(SLANTS) + 1) + slants
        return cls(scans.hits[own], scans.facings_rad[own], of[own], np.asarray(kinds, np.int64))


@dataclass(frozen=True, eq=False)
class _Patches:
    """What the hits say of their patches at some poses.

    Attributes:
        of: (B,) int64, the patch of each hit.
        slopes: (B, 3) float64, how each hit's place along the normal of its patch changes with its
            scan's pose: x, y, yaw.
        sides_m: (B,) float64, how far each hit lies beside the middle of its patch.
        away_m: (B,) float64, how far each hit lies from its patch along the normal.
        weights: (B,) float64, say of each hit over its variance, 1 / m2; 0: none.
    """

    count: int
    of: I64
    slopes: F64
    sides_m: F64
    away_m: F64
    weights: F64

    @classmethod
    def at(cls, hits: _Hits, poses: F64, number: int) -> _Patches:
        """Sort hits into patches, on the lattice of a round."""
        own = poses[hits.scans]
        cos, sin = np.cos(own[:, 2]), np.sin(own[:, 2])
        x = cos * hits.points[:, 0] - sin * hits.points[:, 1]
        y = sin * hits.points[:, 0] + cos * hits.points[:, 1]
        places = np.stack((own[:, 0] + x, own[:, 1] + y), axis=1)
        facings_rad = hits.facings_rad + own[:, 2]
        of, sizes = _sorted(places, facings_rad, number)
        count = len(sizes)
        normals = _means(of, sizes, np.stack((np.cos(facings_rad), np.sin(facings_rad)), axis=1))
        unity = np.hypot(*normals.T)
        normals /= np.maximum(unity, 1e-9)[:, None]
        beside = places - _means(of, sizes, places)[of]
        is_wall = ((sizes >= LEAST_HITS) & (unity > LEAST_UNITY))[of]
        sure = np.full(len(of), SPREAD_M**-2.0)
        for _ in range(TURN_ROUNDS):
            normal = normals[of]
            across_m = np.asarray((beside * normal).sum(axis=1), dtype=np.float64)
            sides_m = beside[:, 1] * normal[:, 0] - beside[:, 0] * normal[:, 1]
            say = np.ones(len(of))
            for _ in range(LINE_ROUNDS):
                lines = _lines(of, count, sides_m, across_m, say * sure)
                away_m = across_m - lines[of, 0] - lines[of, 1] * sides_m
                say = geman_mcclure(away_m / (2.0 * SPREAD_M))
            normals = _turned_to(normals, lines[:, 1])
            is_used = is_wall & (np.abs(away_m) < REACH_M)
            if number >= ROUNDS and is_used.any():
                sure = _spreads_m(away_m[is_used], hits.kinds[is_used])[hits.kinds] ** -2.0
        slopes = np.column_stack((normal, x * normal[:, 1] - y * normal[:, 0]))
        return cls(count, of, slopes, sides_m, away_m, say * is_used * sure)


def _sorted(places: F64, facings_rad: F64, number: int) -> tuple[I64, I64]:
    """Return the patch of each hit, (B,), and hits of each patch, (P,), on a round's lattice."""
    cells = np.floor(places / PATCH_M + number % MOVES / MOVES).astype(np.int64)
    cells -= cells.min(axis=0)
    side = np.rint(facings_rad * FACINGS / (2.0 * np.pi) + number % TURNS / TURNS).astype(np.int64)
    key = (cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]) * FACINGS + side % FACINGS
    _, of, sizes = np.unique(key, return_inverse=True, return_counts=True)
    return np.asarray(of, dtype=np.int64), np.asarray(sizes, dtype=np.int64)


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


def _turned_to(normals: F64, tilts: F64) -> F64:
    """Return normals, (P, 2), of lines that rise by ``tilts``, (P,), to their left."""
    by = np.arctan(tilts)
    cos, sin = np.cos(by), np.sin(by)
    x, y = normals.T
    return np.stack((cos * x + sin * y, cos * y - sin * x), axis=1)


def _lines(of: I64, count: int, sides_m: F64, across_m: F64, weights: F64) -> F64:
    """Return height and tilt of the line through the hits of each patch, (P, 2)."""
    inverse = _line_inverses(of, count, sides_m, weights)
    right = _line_sums(of, count, sides_m, weights * across_m)
    return np.asarray(np.einsum("pab,pb->pa", inverse, right))


def _line_sums(of: I64, count: int, sides_m: F64, values: F64) -> F64:
    """Return the right side of each patch's equations of height and tilt, (P, 2), for values."""
    parts = (values, values * sides_m)
    return np.stack([np.bincount(of, part, count) for part in parts], axis=1).astype(np.float64)


def _line_inverses(of: I64, count: int, sides_m: F64, weights: F64) -> F64:
    """Return the inverse of each patch's equations of height and tilt, (P, 2, 2)."""
    # A patch of which no hit has a say moves with nobody.
    mass = np.bincount(of, weights, count) + 1e-9
    first = np.bincount(of, weights * sides_m, count)
    second = np.bincount(of, weights * sides_m**2, count) + TILT_RAD**-2.0
    parts = np.stack((second, -first, -first, mass), axis=1).reshape(count, 2, 2)
    return np.asarray(parts / (mass * second - first**2)[:, None, None])


def _step(hits: _Hits, poses: F64, equations: MotionEquations, number: int) -> tuple[F64, F64]:
    """Return the step of one round towards the least sum of squares."""
    patches = _Patches.at(hits, poses, number)
    diagonal, slope = equations.diagonal.copy(), equations.slope.copy()
    count = len(poses)
    weighted = patches.weights[:, None] * patches.slopes
    for a in range(3):
        slope[:, a] += np.bincount(hits.scans, weighted[:, a] * patches.away_m, count)
        for b in range(3):
            products = weighted[:, a] * patches.slopes[:, b]
            diagonal[:, a, b] += np.bincount(hits.scans, products, count)
    banded, border = _banded(diagonal, equations.beside), equations.border
    rows = np.repeat(3 * hits.scans[:, None] + np.arange(3), 2, axis=1)
    columns = np.tile(2 * patches.of[:, None] + np.arange(2), 3)
    by_line = np.stack((np.ones(len(patches.of)), patches.sides_m), axis=1)
    values = np.repeat(weighted, 2, axis=1) * np.tile(by_line, 3)
    to_lines = scipy.sparse.csr_matrix(
        (values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, 2 * patches.count)
    )
    from_lines = to_lines.T.tocsr()
    inverses = _line_inverses(patches.of, patches.count, patches.sides_m, patches.weights)

    def through_lines(of_lines: F64) -> F64:
        """Return what the poses get of the lines' equations, solved for one right-hand side."""
        solved = np.einsum("pab,pb->pa", inverses, of_lines.reshape(-1, 2))
        return np.asarray(to_lines.dot(solved.ravel()))

    def times(step: F64) -> F64:
        """Multiply by the equations without the lines, which follow the poses."""
        own, calibration = step[:-2], step[-2:]
        of_poses = banded @ own - through_lines(np.asarray(from_lines.dot(own)))
        of_calibration = border.T @ own + equations.corner @ calibration
        return np.concatenate((of_poses + border @ calibration, of_calibration))

    factor = scipy.sparse.linalg.splu(banded)
    across = factor.solve(border)
    corner = np.linalg.inv(equations.corner - border.T @ across)

    def precondition(right: F64) -> F64:
        """Solve the equations in which the patches stay where they are."""
        own = factor.solve(right[:-2])
        calibration = corner @ (right[-2:] - border.T @ own)
        return np.concatenate((own - across @ calibration, calibration))

    size = (3 * count + 2, 3 * count + 2)
    pulls = patches.weights * patches.away_m
    of_lines = _line_sums(patches.of, patches.count, patches.sides_m, pulls)
    slopes = slope.ravel() - through_lines(of_lines)
    step, _ = scipy.sparse.linalg.cg(
        scipy.sparse.linalg.LinearOperator(size, matvec=times, dtype=np.float64),
        -np.concatenate((slopes, equations.end)),
        rtol=TOLERANCE,
        maxiter=MOST_STEPS,
        M=scipy.sparse.linalg.LinearOperator(size, matvec=precondition, dtype=np.float64),
    )
    return np.asarray(step[:-2].reshape(count, 3)), np.asarray(step[-2:])


def _banded(diagonal: F64, beside: F64) -> scipy.sparse.csc_matrix:
    """Return the symmetric matrix of (N, 3, 3) blocks and of (N - 1, 3, 3) right of them."""
    count = len(diagonal)
    first = 3 * np.arange(count)[:, None, None]
    row, col = (
        np.broadcast_to(first + part, diagonal.shape)
        for part in (np.arange(3)[:, None], np.arange(3))
    )
    values = np.concatenate([part.ravel() for part in (diagonal, beside, beside)])
    rows = np.concatenate([part.ravel() for part in (row, row[:-1], col[1:])])
    columns = np.concatenate([part.ravel() for part in (col, col[1:], row[:-1])])
    return scipy.sparse.csc_matrix((values, (rows, columns)), shape=(3 * count, 3 * count))
