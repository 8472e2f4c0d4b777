"""Where the maps of a group lie: all its links solved together as a pose graph."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from slamfusion.align.answer import conclude
from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.search import SearchResult
from slamfusion.config import AlignConfig
from slamfusion.geometry import Pose2
from slamfusion.pose_graph import PoseGraph, optimize
from slamfusion.pose_graph.covariance import inverted, moved

# What an alignment may be off in the middle between the two maps, metres and radians: maps are
# bent by a few cells.
SHIFT_SIGMA_M, YAW_SIGMA_RAD = 0.1, math.radians(0.4)


def solve_poses(
    group: Sequence[str],
    start: Mapping[str, Pose2],
    links: Sequence[Alignment],
    features: Mapping[str, GridFeatures],
) -> tuple[dict[str, Pose2], list[Alignment]]:
    """Return the pose of each map's frame that fits all links best, and the links that do not fit.

    Args:
        group: names of the maps; the frame of the first is that of all poses.
        start: poses to begin with.
        links: alignments that join the group, those that are believed most first.
        features: of the maps.

    Source: ``pose_graph.robust``, graduated non-convexity.
    """
    if len(links) < len(group):
        return dict(start), []
    number = {name: index for index, name in enumerate(group)}
    middles = {name: Pose2(*features[name].middle) for name in group}
    nodes = [start[name].compose(middles[name]) for name in group]
    motions, covariances = [], []
    for pair in links:
        motion = middles[pair.reference].inverse().compose(pair.transform)
        motion = motion.compose(middles[pair.moving])
        between = motion.inverse()
        covariance = np.diag([SHIFT_SIGMA_M, SHIFT_SIGMA_M, YAW_SIGMA_RAD]) ** 2
        way = -0.5 * np.array([[between.x, between.y]])
        covariances.append(moved(covariance[None], way)[0])
        motions.append(_row(motion))
    information = inverted(np.array(covariances))
    graph = PoseGraph(
        poses=np.array([_row(node) for node in nodes]),
        edges=np.array([(number[pair.reference], number[pair.moving]) for pair in links]),
        motions=np.array(motions),
        information=0.5 * (information + information.transpose(0, 2, 1)),
        is_closure=np.ones(len(links), dtype=np.bool_),
    )
    solved = optimize(graph, robust="gnc", start="given")
    poses = {
        name: Pose2(*(float(value) for value in row)).compose(middles[name].inverse())
        for name, row in zip(group, solved.poses, strict=True)
    }
    first = poses[group[0]].inverse()
    out = [pair for pair, is_out in zip(links, solved.is_outlier, strict=True) if is_out]
    return {name: first.compose(pose) for name, pose in poses.items()}, out


def placed(
    pair: Pair,
    transform: Pose2,
) -> Alignment:
    """Return the record of a map that other alignments place, with the numbers of its walls there.

    Args:
        pair: the two maps; they may share nothing.
        transform: moving map frame to the reference's, metres; kept as it is.
    """
    found = SearchResult(pair.motion_of(transform)[None], None, "tracked")
    began = time.perf_counter()
    measured = conclude(pair, AlignConfig(), found, transform, 1, began)
    reason = "placed over other maps, with which it is aligned"
    return replace(measured, transform=transform, accepted=True, reason=reason, decision="accepted")


def _row(pose: Pose2) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.yaw_rad
