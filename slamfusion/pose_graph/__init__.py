"""Pose graphs in the plane: least squares over relative measurements, false closures left out.

``PoseGraph`` is the value, ``optimize`` finds its poses, and ``read_g2o`` / ``write_g2o`` take them
in and out of files. Sparse normal equations are built for all edges at once in NumPy and factorised
by SciPy's SuperLU.
"""

from __future__ import annotations

from slamfusion.pose_graph.g2o import GraphFile, read_g2o, write_g2o
from slamfusion.pose_graph.graph import PoseGraph, loop_closing
from slamfusion.pose_graph.least_squares import Steps, take_steps
from slamfusion.pose_graph.optimize import (
    Optimized,
    Robust,
    Start,
    chi2_of,
    optimize,
    optimize_in_steps,
)

__all__ = [
    "GraphFile",
    "Optimized",
    "PoseGraph",
    "Robust",
    "Start",
    "Steps",
    "chi2_of",
    "loop_closing",
    "optimize",
    "optimize_in_steps",
    "read_g2o",
    "take_steps",
    "write_g2o",
]
