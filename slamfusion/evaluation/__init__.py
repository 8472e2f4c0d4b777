"""Errors of maps and trajectories against the truth, measured distances or known relations.

Pure functions on value types.
"""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
