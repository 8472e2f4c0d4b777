"""``PlayerMaps``: the newest maps of some topics, written to a folder at the end of a log."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from nav_msgs.msg import OccupancyGrid

from slamfusion.errors import SlamFusionError
from slamfusion.io.logs import log_sources
from slamfusion.io.map_server import save_map, saved_files
from slamfusion.io.overwriting import refuse_overwriting
from slamfusion.ros import messages, qos
from slamfusion.ros.base import NodeBase
from slamfusion.ros.interrupt import Interrupt
from slamfusion.ros.player_answers import STAMP_TOLERANCE_S


class PlayerMaps:
    """Keeps the newest map of every topic.

    Args:
        base: the node.
        topics: of the maps.
        folder: where they are written; made when missing.
        interrupt: ends the wait for the last ones.
        log: that is played.

    Raises:
        SlamFusionError: a map would be written over a file of the log.
        OSError: the folder cannot be made, or written to: said before the log plays, not after.
    """

    def __init__(
        self, base: NodeBase, topics: Sequence[str], folder: Path, interrupt: Interrupt, log: Path
    ) -> None:
        self._stems = {
            topic: folder / topic.strip("/").removesuffix("/map").replace("/", "_")
            for topic in topics
        }
        refuse_overwriting(
            [(log, file) for file in log_sources(log)],
            [(f"save {stem}", file) for stem in self._stems.values() for file in saved_files(stem)],
        )
        _check_writable(folder)
        self._node, self._log = base.node, base.log
        self._topics = tuple(topics)
        self._folder = folder
        self._interrupt = interrupt
        self._maps: dict[str, Any] = {}
        for topic in topics:
            base.subscribe(OccupancyGrid, topic, partial(self._on_map, topic), qos.MAP)

    def save(self, stamp_s: float, timeout_s: float, played: str) -> None:
        """Write the newest map of every topic, as soon as they hold the last scan.

        When the node is ended before, those that have come.

        Args:
            stamp_s: of the last scan.
            timeout_s: how long its map may take.
            played: what was played so far, in words.

        Raises:
            SlamFusionError: no map came, or one is none or cannot be written.
        """
        is_early = self._interrupt.is_set
        self._interrupt.wait_for(lambda: not self._late(stamp_s), timeout_s)
        with self._interrupt.locked():
            maps, late = dict(self._maps), self._late(stamp_s)
        if is_early:
            ends = "the maps that have come are saved" if maps else "no map has come to be saved"
            self._log.warning(f"stopped after {played}; {ends}")
            late = []
        for topic in late:
            what = "it is older than the last scan" if topic in maps else "no map came"
            self._log.warning(f"the map on {self._node.resolve_topic_name(topic)!r}: {what}")
        if not maps and not is_early:
            message = f"no map came on {', '.join(self._topics) or '(no topic)'}"
            raise SlamFusionError(message)
        self._folder.mkdir(parents=True, exist_ok=True)
        for topic, message in maps.items():
            path, _ = save_map(messages.grid_from_message(message, topic), self._stems[topic])
            self._log.info(f"wrote {path}")

    def _late(self, stamp_s: float) -> list[str]:
        """Return the topics whose newest map does not hold the scan of a stamp."""
        return [
            topic
            for topic in self._topics
            if topic not in self._maps
            or messages.stamp_s(self._maps[topic]) < stamp_s - STAMP_TOLERANCE_S
        ]

    def _on_map(self, topic: str, message: Any) -> None:
        """Keep the newest map of a topic."""
        with self._interrupt.changing():
            self._maps[topic] = message


def _check_writable(folder: Path) -> None:
    """Make a folder, and refuse one in which no file can be made.

    Raises:
        OSError: the folder cannot be made, or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
