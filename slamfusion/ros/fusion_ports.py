"""``FusionPorts``: where the session of a fusion node takes its maps from, and publishes to."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any

from slamfusion.errors import SlamFusionError
from slamfusion.fusion.live import LiveInput
from slamfusion.fusion.live.session import Arrived
from slamfusion.ros import messages
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.fused_output import FusedOutput
from slamfusion.ros.fusion_inputs import FusionInputs
from slamfusion.ros.map_source import MapSource

SHOWN_S = 10.0


class FusionPorts:
    """Converts what came and says what is decided; see ``slamfusion.fusion.live.session.Ports``.

    In the worker's thread.

    Args:
        base: the node.
        inputs: of the node.
        output: publishes.
        heard: told every map that was taken, and who was removed.
    """

    def __init__(
        self,
        base: NodeBase,
        inputs: FusionInputs,
        output: FusedOutput,
        heard: Callable[[Arrived], None] = lambda _: None,
    ) -> None:
        self._base = base
        self._inputs = inputs
        self._output = output
        self._heard = heard

    def take(self) -> list[Arrived]:
        """Return what came, the newest map of each input converted; see ``Ports``."""
        taken, now_s = self._inputs.take(), time.monotonic()
        arrived = [Arrived(name, None, "", now_s, is_removed=True) for name in taken.removed]
        arrived += [Arrived(grid.name, grid, "", now_s, is_saved=True) for grid in taken.saved]
        arrived += [self._converted(*item) for item in taken.maps]
        for item in arrived:
            self._heard(item)
        return arrived

    def _converted(self, source: MapSource, message: Any, arrived_s: float, frame: str) -> Arrived:
        """Convert a map; ``frame`` is that of the input's last one."""
        if frame and source.frame != frame:
            text = f"the map of {source.name!r} was in {frame!r} and is in {source.frame!r} now"
            self._base.diagnostics.add(f"frame {source.name}", Level.WARN, text, SHOWN_S)
        try:
            grid = messages.grid_from_message(message, source.name)
        except SlamFusionError as error:
            return Arrived(source.name, None, str(error), arrived_s)
        return Arrived(source.name, grid, "", arrived_s)

    def has_maps(self) -> bool:
        """Whether a map waits to be taken."""
        return self._inputs.is_waiting

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a map, or is a saved one."""
        return self._inputs.has_come(name)

    def send(self, *, with_agreement: bool = True) -> None:
        """Publish what is due."""
        self._output.send(with_agreement=with_agreement)

    def stamp_s(self, voters: Collection[str]) -> float:
        """Return the stamp of a fused map: of the newest map in it, 0 where all were saved ones."""
        sources = [source for name, source in self._inputs.sources.items() if name in voters]
        stamps = [source.stamp_s for source in sources if source.stamp_s is not None]
        # None of their stamps can be right: then the node's time is.
        return max(stamps, default=self._base.clock_s() if sources else 0.0)

    def say_vote(self, record: LiveInput) -> None:
        """Log that an input got or lost its vote."""
        # Two calls: rclpy ties a place in the code to one level.
        if record.accepted:
            self._base.log.info(f"{record.name} votes: {record.reason}")
        else:
            self._base.log.warning(f"{record.name} does not vote: {record.reason}")
