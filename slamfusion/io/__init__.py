"""Read and write maps, logs and trajectories.

Input is checked when it is read; output files appear complete or not at all (``AtomicFiles``).
"""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
