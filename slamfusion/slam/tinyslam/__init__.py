"""tinySLAM [H16]: one map and a Monte-Carlo matcher."""

from __future__ import annotations

from slamfusion.slam.tinyslam.slam import TinySlam

__all__ = ["TinySlam"]
