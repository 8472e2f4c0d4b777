"""Live fusion: maps that arrive repeatedly become one map whose frame never moves.

``fusion`` is the whole with its rules: maps wait in its ``Mailbox``, ``supervisor`` decides what is
aligned and who votes, and ``voting`` votes on what changed. ``session`` runs it in a thread.
"""

from __future__ import annotations

from slamfusion.fusion.live.fusion import Evidence, LiveFusion, LiveInput, LiveUpdate
from slamfusion.fusion.live.inputs import State
from slamfusion.fusion.live.state import LiveState, StateError

__all__ = ["Evidence", "LiveFusion", "LiveInput", "LiveState", "LiveUpdate", "State", "StateError"]
