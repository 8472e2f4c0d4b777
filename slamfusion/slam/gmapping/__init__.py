"""gmapping [G07]: a particle filter over paths, each particle with a map of its own."""

from __future__ import annotations

from slamfusion.slam.gmapping.slam import FilterHealth, Gmapping

__all__ = ["FilterHealth", "Gmapping"]
