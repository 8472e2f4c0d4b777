"""``Answers``: the producers that a player waits for, and the poses that they told."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped

from slamfusion.errors import SlamFusionError
from slamfusion.io.stamps import AHEAD_S, CONFIRMING
from slamfusion.ros import messages, qos
from slamfusion.ros.base import NodeBase
from slamfusion.ros.interrupt import Interrupt

# A scan that is not answered is sent again after this long: best-effort readers may lose one.
AGAIN_S = 1.0
# After a jump of the log's time producers wait for a scan to be sent again, and are not made to
# wait long for that.
AGAIN_AT_JUMP_S = 0.1
STAMP_TOLERANCE_S = 1e-6


class Answers:
    """Listens on each producer's ``NAME/pose``.

    Args:
        base: the node.
        names: the producers.
        interrupt: ends every wait.
        timeout_s: how long an answer may take.
    """

    def __init__(
        self, base: NodeBase, names: Sequence[str], interrupt: Interrupt, timeout_s: float
    ) -> None:
        self._node = base.node
        self._names = tuple(names)
        self._interrupt = interrupt
        self._timeout_s = timeout_s
        # Stamp of the newest pose, by producer.
        self._stamps_s: dict[str, float] = {}
        for name in names:
            base.subscribe(PoseStamped, f"{name}/pose", partial(self._on_pose, name), qos.STREAM)

    def absent(self) -> list[str]:
        """Return the producers that are not there yet."""
        return [name for name in self._names if not self._node.count_publishers(f"{name}/pose")]

    def wait(self, stamp_s: float, before_s: float | None, send_again: Callable[[], None]) -> None:
        """Wait until every producer has told its pose at a scan that was sent.

        Args:
            stamp_s: of the scan.
            before_s: stamp of the scan before it; None for the first.
            send_again: repeats the scan.

        Raises:
            SlamFusionError: one has not, however often the scan was sent.
        """
        until_s = time.monotonic() + self._timeout_s
        is_jump = before_s is not None and not 0.0 < stamp_s - before_s <= AHEAD_S
        pauses_s = [AGAIN_AT_JUMP_S] * (CONFIRMING - 1) if is_jump else []
        again_s = time.monotonic() + (pauses_s.pop() if pauses_s else AGAIN_S)
        while not self._interrupt.is_set:
            duration_s = min(again_s, until_s) - time.monotonic()
            if self._interrupt.wait_for(lambda: not self._silent(stamp_s), duration_s):
                return
            now_s = time.monotonic()
            if now_s >= until_s:
                with self._interrupt.locked():
                    silent = self._silent(stamp_s)
                if not silent:  # the last answer came with the end of the wait
                    return
                message = (
                    f"no pose at {stamp_s:.3f} s from {', '.join(silent)} within "
                    f"{self._timeout_s:g} s; the producer may have ended, or "
                    "leaves the scan out: see its diagnostics"
                )
                raise SlamFusionError(message)
            if now_s >= again_s:
                send_again()
                again_s = now_s + (pauses_s.pop() if pauses_s else AGAIN_S)

    def _silent(self, stamp_s: float) -> list[str]:
        """Return the producers whose newest pose is none at a stamp."""
        return [
            name
            for name in self._names
            if abs(self._stamps_s.get(name, math.inf) - stamp_s) > STAMP_TOLERANCE_S
        ]

    def _on_pose(self, name: str, message: Any) -> None:
        """Note that a producer has told its pose at a stamp."""
        with self._interrupt.changing():
            self._stamps_s[name] = messages.stamp_s(message)
