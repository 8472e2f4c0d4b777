"""The producers of maps, each in its own folder, and what they share (``common``)."""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
