"""Graph SLAM: scans on submaps, loop closures, and a pose graph that makes them agree."""

from __future__ import annotations

from slamfusion.slam.graph.map_graph import GraphHealth
from slamfusion.slam.graph.slam import GraphSlam

__all__ = ["GraphHealth", "GraphSlam"]
