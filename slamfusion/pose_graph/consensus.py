"""Closures that support each other: the first to accept when some may be false.

Two closures that are near each other at both ends form a short loop with the odometry between their
ends. That loop depends on few poses, so drift and false closures elsewhere do not matter. All pairs
are checked at once: the covariance of the odometry between two poses is a difference of two sums
along the path.

Checking pairs follows Mangelson, Dominic, Eustice and Vasudevan, Pairwise Consistent Measurement
Set Maximization, ICRA 2018; here pairs are near and all of them count, instead of a largest clique.
"""

from __future__ import annotations

import numpy as np
import scipy

from slamfusion.geometry import B8, F64, I64, compose_poses, invert_poses, wrap_angles
from slamfusion.pose_graph.least_squares import Measurements
from slamfusion.pose_graph.uncertainty import inverted, moved, turned

# Poses between the ends of two near closures: at first, and at most if few have mates.
NEAR_POSES, FAR_POSES = 20, 160
# The range is widened until this share of the closures is supported.
ENOUGH = 0.5
# Quantiles of chi-square with 3 degrees of freedom: 0.5 and 0.99.
MEDIAN, LARGE = 2.366, 11.345
# A loop closes if its error is at most this many times that of the typical closing loop. Otherwise
# too cautious information would let loops close by chance.
TYPICAL_TIMES = 20.0
# Loops looked at together, and the most to be looked at, counted both ways round.
PAIRS_AT_ONCE, MOST_PAIRS = 100_000, 2_000_000
# With fewer loops the typical error is unknown.
FEWEST_LOOPS = 20


def find_consensus(measured: Measurements, may_be_outlier: B8) -> tuple[I64, float]:
    """Find the possible outliers, (M,) bool, that support each other.

    Returns:
        (C,) int64, the number of those with which each closes a short loop; and the squared errors
        of such loops relative to the information, 1 if there are too few loops.
    """
    edges, motions = measured.edges, measured.motions
    covariances = inverted(measured.information)
    odometry = _Odometry(edges, motions, covariances, ~may_be_outlier)
    closures = _Closures(
        edges[may_be_outlier], motions[may_be_outlier], covariances[may_be_outlier]
    )
    places = scipy.spatial.cKDTree(np.stack((closures.first, closures.last), axis=1))
    reach = NEAR_POSES
    while True:
        pairs = places.query_pairs(reach, p=np.inf, output_type="ndarray")
        errors = np.concatenate(
            [
                _loop_errors(odometry, closures, pairs[start : start + PAIRS_AT_ONCE])
                for start in range(0, max(len(pairs), 1), PAIRS_AT_ONCE)
            ]
        )
        plausible = errors[errors <= LARGE]
        is_known = len(plausible) >= FEWEST_LOOPS
        scale = float(np.median(plausible)) / MEDIAN if is_known else 1.0
        closes = errors <= min(LARGE, TYPICAL_TIMES * MEDIAN * scale)
        mates = np.bincount(pairs[closes].ravel(), minlength=len(closures.first))
        is_supported = mates > 0
        reach *= 2
        is_enough = is_supported.mean() >= ENOUGH or reach > FAR_POSES
        if is_enough or places.count_neighbors(places, reach, p=np.inf) > MOST_PAIRS:
            return mates, scale


class _Odometry:
    """Poses along the odometry, and their relative uncertainty.

    Of the trusted edges it takes the first between each two consecutive poses, in either direction.

    Attributes:
        poses: (N, 3); where odometry has a gap, the next pose is put on the last.
        piece: (N,) number of gaps so far.
    """

    def __init__(self, edges: I64, motions: F64, covariances: F64, is_trusted: B8) -> None:
        count = int(edges.max()) + 1
        steps, noises = np.zeros((count, 3)), np.zeros((count, 3, 3))
        acts_at = np.arange(count)
        is_measured = np.zeros(count, np.bool_)
        way = edges[:, 1] - edges[:, 0]
        chosen = np.flatnonzero(is_trusted & (np.abs(way) == 1))[::-1]
        later = edges[chosen].max(axis=1)
        is_forward = (way[chosen] == 1)[:, None]
        steps[later] = np.where(is_forward, motions[chosen], invert_poses(motions[chosen]))
        noises[later] = covariances[chosen]
        acts_at[later] = edges[chosen, 1]
        is_measured[later] = True

        yaw = np.cumsum(steps[:, 2])
        before = np.concatenate(([0.0], yaw[:-1]))
        cos, sin = np.cos(before), np.sin(before)
        x = np.cumsum(cos * steps[:, 0] - sin * steps[:, 1])
        y = np.cumsum(sin * steps[:, 0] + cos * steps[:, 1])
        self.poses = poses = np.stack((x, y, yaw), axis=1)
        self.piece = np.cumsum(~is_measured)
        # The covariances of all steps so far, each moved to the origin.
        noises = moved(turned(noises, poses[acts_at, 2]), -poses[acts_at])
        self._sums = np.cumsum(noises, axis=0)

    def covariance(self, start: I64, end: I64, point: F64) -> F64:
        """Return the covariance of the way between poses at a point that goes with one of them."""
        first, last = np.minimum(start, end), np.maximum(start, end)
        return moved(self._sums[last] - self._sums[first], point)


class _Closures:
    """Closures from the earlier pose ``first`` to the later one ``last``, (C,) each.

    ``motion`` (C, 3) is the later pose in the frame of the earlier.
    """

    def __init__(self, edges: I64, motions: F64, covariances: F64) -> None:
        # Covariances are in the axes of the measured pose: the later one where it is forward.
        self._is_forward, self._covariance = edges[:, 0] < edges[:, 1], covariances
        self.first, self.last = edges.min(axis=1), edges.max(axis=1)
        self.motion = np.where(self._is_forward[:, None], motions, invert_poses(motions))

    def noise(self, which: I64, first: F64, last: F64, point: F64) -> F64:
        """Return the covariances at points that go with the later pose, in the world's axes."""
        acts_at = np.where(self._is_forward[which, None], last, first)
        own = turned(self._covariance[which], acts_at[:, 2])
        return moved(own, point[:, :2] - acts_at[:, :2])


def _loop_errors(odometry: _Odometry, closures: _Closures, pairs: I64) -> F64:
    """Return the squared errors of the loops that pairs of closures make, in their deviations.

    The later pose of one closure is placed twice in the frame of the odometry: by that closure, and
    through the other. Infinite if odometry does not connect the ends.
    """
    one, other = pairs.T
    poses = odometry.poses
    first, first_other = closures.first[one], closures.first[other]
    last, last_other = closures.last[one], closures.last[other]
    placed = compose_poses(poses[first], closures.motion[one])
    placed_other = compose_poses(poses[first_other], closures.motion[other])
    rest = compose_poses(invert_poses(poses[last_other]), poses[last])
    by_way = compose_poses(placed_other, rest)
    error = by_way - placed
    error[:, 2] = wrap_angles(error[:, 2])

    at_last = odometry.covariance(last, last_other, poses[last])
    covariance = (
        odometry.covariance(first, first_other, placed)
        + turned(at_last, by_way[:, 2] - poses[last, 2])
        + closures.noise(one, poses[first], placed, placed)
        + closures.noise(other, poses[first_other], placed_other, placed)
    )
    squared = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    piece = odometry.piece
    is_joined = (piece[first] == piece[first_other]) & (piece[last] == piece[last_other])
    return np.where(is_joined, squared, np.inf)
