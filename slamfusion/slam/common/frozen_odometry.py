"""Odometry that stands still while the scans say that the robot drives: a dead encoder or topic."""

from __future__ import annotations

import numpy as np

from slamfusion.trajectory import Trajectory, flag_runs

# The path gets this far from where it was, metres, while the odometry says the same pose: more
# than scan matching trembles, less than a dead encoder goes unseen on a drive.
DRIVEN_M = 1.0
# Written odometry has this many metres or radians at least between two poses of a robot that moves.
STANDS = 1e-9


def frozen_span(odometry: Trajectory, path: Trajectory) -> tuple[float, float] | None:
    """Return the longest time in which raw odometry stands still and the path does not.

    Args:
        odometry: raw, of the scans.
        path: what a producer made of them.

    Returns:
        (from, to), seconds of their stamps; None where the odometry goes along.
    """
    stands = np.asarray((np.abs(np.diff(odometry.poses, axis=0)) < STANDS).all(axis=1))
    longest: tuple[float, float] | None = None
    for here in flag_runs(stands):
        from_s, to_s = float(odometry.stamps_s[here.start]), float(odometry.stamps_s[here.stop])
        if longest is not None and to_s - from_s <= longest[1] - longest[0]:
            continue
        during = (path.stamps_s >= from_s) & (path.stamps_s <= to_s)
        places = path.poses[during, :2]
        if len(places) and np.hypot(*(places - places[0]).T).max() > DRIVEN_M:
            longest = from_s, to_s
    return longest
