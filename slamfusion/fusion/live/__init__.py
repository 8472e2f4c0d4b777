"""Live fusion: maps that arrive again and again become one map whose frame never moves.

Data flows one way: maps wait in the ``mailbox``; ``fusion``, which is the whole of it, with the
rules, empties it, refuses maps that contain no place (``limits``) and lets the ``track`` of an
input compare its new map with the one before; the ``supervisor`` decides whom to align and who
votes, from the first fusion over tracking, search and confirmation (``align``, ``poses``) to the
last fused map (``recovery``); ``voting`` carries what changed to the ``layers`` and votes on those
boxes. ``state`` carries it over a restart; ``session`` runs it beside a program.
"""

from __future__ import annotations

from slamfusion.fusion.live.fusion import LiveFusion, LiveInput, LiveUpdate
from slamfusion.fusion.live.inputs import State
from slamfusion.fusion.live.mailbox import Evidence
from slamfusion.fusion.live.state import LiveState, StateError

__all__ = ["Evidence", "LiveFusion", "LiveInput", "LiveState", "LiveUpdate", "State", "StateError"]
