"""tinySLAM's record in the registry of producers."""

from __future__ import annotations

from slamfusion.config import TinySlamConfig
from slamfusion.slam.registry import Producer
from slamfusion.slam.tinyslam.slam import TinySlam

PRODUCER = Producer(
    name="tinyslam",
    summary="tinySLAM: one map and a Monte-Carlo scan matcher",
    config=TinySlamConfig(),
    make=TinySlam,
    cost=1.0,
    prefers_small_kernels=True,
)
