"""``Stamps``: stamps from a future that neither the clock nor the other inputs know of."""

from __future__ import annotations

from collections.abc import Callable

# A stamp that is further ahead than this is wrong; clocks of machines that nobody has set together
# differ by less, seconds.
AHEAD_S = 60.0


class Stamps:
    """Tells a stamp that is far ahead of the node's clock while another input's is not.

    A robot whose clock is wrong has all of its inputs ahead of this node's clock alike, and a log
    lies behind it; neither is refused. Inputs are compared by how far they are ahead of the clock,
    so one that has been silent for an hour is no witness for an hour ago. Each method is one
    operation on a mapping and safe between threads.

    Args:
        clock_s: the node's time, seconds; 0 or less while it is not known (simulated time before
            its first message).
    """

    def __init__(self, clock_s: Callable[[], float]) -> None:
        self._clock_s = clock_s
        self._ahead_s: dict[str, float] = {}

    def ahead_s(self, name: str, stamp_s: float) -> float | None:
        """Note a stamp of an input; return by how much it is too far ahead, or None.

        Args:
            name: of the input.
            stamp_s: of its map or its pose, seconds.
        """
        now_s = self._clock_s()
        if now_s <= 0.0:
            return None
        ahead_s = self._ahead_s[name] = stamp_s - now_s
        others = [other for key, other in list(self._ahead_s.items()) if key != name]
        if not others or ahead_s <= AHEAD_S:
            return None
        return ahead_s if ahead_s - min(others) > AHEAD_S else None

    def forget(self) -> None:
        """Forget every stamp: time jumped back."""
        self._ahead_s.clear()

    def remove(self, name: str) -> None:
        """Forget the stamps of an input that is none any more."""
        self._ahead_s.pop(name, None)
