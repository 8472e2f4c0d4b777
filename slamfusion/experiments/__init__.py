"""The experiments of the papers; each adds rows to one table of results."""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
