"""``Clocks``: names inputs whose machines' clocks are off, by the stamps of what they send."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

from slamfusion.ros.base import Diagnostics, Level

# Clocks that differ by less are near enough, and messages come late by as much, seconds.
SKEW_S = 2.0
# Stamps kept of each input, and what they must be to tell a clock: so many, and so far apart that
# none of them is a kept map of some time ago. Seconds.
KEPT, LEAST, SPAN_S = 50, 4, 1.0
# Of the last stamps this share is farther ahead than the one that counts: a stray one does not.
UPPER = 0.25


class Clocks:
    """Compares the clocks of the inputs' machines with each other and with this one's.

    A stamp is as far ahead of the node's clock as the sender's clock is, less the time that the
    message took: of an input's last stamps one of those farthest ahead tells its clock best. The
    clock that most have, this machine's among them, is taken for the right one, so that a log that
    is played without simulated time is not named. Nothing is refused for its clock: alignment and
    votes go by when a map came.

    In the executor's thread.

    Args:
        clock_s: the node's time, seconds; 0 or less while it is not known.
        diagnostics: says who is off.
    """

    def __init__(self, clock_s: Callable[[], float], diagnostics: Diagnostics) -> None:
        self._clock_s = clock_s
        self._diagnostics = diagnostics
        # Stamps, and how far ahead of the node's clock they were, by name and kind of message.
        self._heard: dict[tuple[str, str], deque[tuple[float, float]]] = {}

    def hear(self, name: str, kind: str, stamp_s: float) -> None:
        """Take the stamp of a message that has just come.

        Args:
            name: of the input.
            kind: of the message; stamps of one kind grow, or begin again.
            stamp_s: seconds.
        """
        now_s = self._clock_s()
        if now_s <= 0.0:
            return
        heard = self._heard.setdefault((name, kind), deque(maxlen=KEPT))
        if heard and stamp_s == heard[-1][0]:
            return
        if heard and stamp_s < heard[-1][0]:
            heard.clear()
        heard.append((stamp_s, stamp_s - now_s))

    def ahead_s(self) -> dict[str, float]:
        """Return by how much the clock of each input is ahead of the one that most have, seconds.

        Inputs that sent too little to tell are left out; without two there is nothing to compare.
        """
        ahead_s: dict[str, float] = {}
        for (name, _), heard in self._heard.items():
            if len(heard) >= LEAST and heard[-1][0] - heard[0][0] >= SPAN_S:
                own_s = sorted(ahead for _, ahead in heard)[-1 - int(UPPER * len(heard))]
                ahead_s[name] = max(own_s, ahead_s.get(name, own_s))
        if len(ahead_s) < 2:
            return {}
        ordered = sorted([0.0, *ahead_s.values()])
        middle = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
        right_s = min(middle, key=abs)
        return {name: ahead - right_s for name, ahead in ahead_s.items()}

    def look(self, names: Collection[str]) -> None:
        """Name who is off, and no more who was; ``names`` are those of the inputs."""
        for name in {name for name, _ in self._heard} - {*names}:
            self._heard = {key: heard for key, heard in self._heard.items() if key[0] != name}
            self._diagnostics.clear(f"clock {name}")
        known = self.ahead_s()
        for name in names:
            key, ahead_s = f"clock {name}", known.get(name, 0.0)
            if abs(ahead_s) <= SKEW_S:
                self._diagnostics.clear(key)
                continue
            way = "ahead of" if ahead_s > 0.0 else "behind"
            late = "" if ahead_s > 0.0 else ", or its messages come that late"
            text = (
                f"the clock of {name!r} is {abs(ahead_s):.1f} s {way} the others'{late}; its maps "
                "count all the same; set the clock of its machine"
            )
            self._diagnostics.add(key, Level.WARN, text)

    def forget(self) -> None:
        """Forget every stamp: time jumped back."""
        self._heard.clear()
