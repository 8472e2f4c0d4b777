"""The producers of maps: tinySLAM, and the protocol that every SLAM here keeps."""

from __future__ import annotations

from slamfusion.slam.base import Health, SlamBackend, Step

__all__ = ["Health", "SlamBackend", "Step"]
