"""The ``slamfusion`` command: parse, call the core, print, save. No algorithm lives here."""

from __future__ import annotations

__all__: list[str] = []
