"""tinySLAM [H16]: one map and a Monte-Carlo matcher.

``slam`` is the method, ``cell_models`` define what a cell holds.
"""

from __future__ import annotations

from slamfusion.slam.tinyslam.slam import TinySlam

__all__ = ["TinySlam"]
