"""The graph SLAM's record in the registry of producers."""

from __future__ import annotations

from slamfusion.config import GraphConfig
from slamfusion.slam.graph.slam import GraphSlam
from slamfusion.slam.registry import Producer

PRODUCER = Producer(
    name="graph",
    summary="graph SLAM: scans on submaps, loop closures, a pose graph",
    config=GraphConfig(),
    make=GraphSlam,
    load=GraphSlam.load_state,
    cost=3.0,
    closes_loops=True,
    prefers_small_kernels=True,
)
