"""Live fusion: maps that arrive again and again become one map whose frame never moves.

Data flows one way: maps, and messages that cannot be read, wait in the ``inbox``; ``intake``
empties it, refuses what says nothing of a place (``limits``) and lets the ``track`` of an input
compare its new map with the one before; the ``supervisor`` decides whom to align and who votes,
from the first fusion (``begin``) over tracking, search and confirmation (``align``, ``mirror``,
``poses``) to the last fused map (``recovery``); ``voting`` lays what changed on the ``layers`` of
one ``lattice`` and votes on those boxes; ``fusion`` is the whole of it, with the rules, and
answers each update by ``records``. ``state`` carries it over a restart.
"""

from __future__ import annotations

from slamfusion.fusion.live.fusion import LiveFusion
from slamfusion.fusion.live.records import LiveInput, LiveUpdate
from slamfusion.fusion.live.state import LiveState, StateError

__all__ = ["LiveFusion", "LiveInput", "LiveState", "LiveUpdate", "StateError"]
