"""``FusionPorts``: where the session of a fusion node takes its maps from, and publishes to."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from slamfusion.errors import SlamFusionError
from slamfusion.fusion.live import LiveInput
from slamfusion.fusion.live.session import Arrived
from slamfusion.ros import messages
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.fused_output import FusedOutput
from slamfusion.ros.map_source import MapSource

__all__ = ["FusionPorts"]

SHOWN_S = 10.0


class FusionPorts:
    """Converts what came and says what is decided; see ``slamfusion.fusion.live.session.Ports``.

    In the worker's thread.

    Args:
        base: the node.
        sources: its inputs by name, but the saved maps.
        saved: names of the saved maps.
        output: publishes.
        heard: told every map that was taken.
    """

    def __init__(
        self,
        base: NodeBase,
        sources: Mapping[str, MapSource],
        saved: Collection[str],
        output: FusedOutput,
        heard: Callable[[Arrived], None] = lambda _: None,
    ) -> None:
        self._base = base
        self._sources = sources
        self._saved = saved
        self._output = output
        self._heard = heard

    def take(self) -> list[Arrived]:
        """Return the newest map of each input that sent one, converted; see ``Ports``."""
        taken = [self._take(source) for source in self._sources.values()]
        arrived = [item for item in taken if item is not None]
        for item in arrived:
            self._heard(item)
        return arrived

    def _take(self, source: MapSource) -> Arrived | None:
        """Convert the newest map of an input; None where it sent none."""
        frame = source.frame
        taken = source.take()
        if taken is None:
            return None
        message, arrived_s = taken
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
        return any(source.is_waiting for source in self._sources.values())

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a map, or is a saved one."""
        return name in self._saved or bool(self._sources[name].frame)

    def send(self, *, with_agreement: bool = True) -> None:
        """Publish what is due."""
        self._output.send(with_agreement=with_agreement)

    def stamp_s(self, voters: Collection[str]) -> float:
        """Return the stamp of a fused map: of the newest map in it, 0 where all were saved ones."""
        sources = [source for name, source in self._sources.items() if name in voters]
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
