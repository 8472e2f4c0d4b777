"""``Writers``: names several nodes on a topic that should have one, by what DDS knows of them."""

from __future__ import annotations

import time
from collections.abc import Mapping

from slamfusion.ros.base import Level, NodeBase

# A process that was killed is known to DDS for another 20 s; two writers of one name are more than
# a dead one and its successor only after this long, seconds.
DEAD_KNOWN_S = 45.0
UNKNOWN = "_NODE_NAME_UNKNOWN_"


class Writers:
    """Looks who writes the maps that are fused, and the fused one.

    Args:
        base: the node.
        output: topic of the fused map.

    Attributes:
        rival: another node that writes the fused map; empty without.
    """

    def __init__(self, base: NodeBase, output: str) -> None:
        self.rival = ""
        self._base = base
        self._output = output
        self._alike_since_s: dict[str, float] = {}

    def look(self, topics: Mapping[str, str]) -> None:
        """Name topics with several writers; ``topics`` of the inputs by their names."""
        for name, topic in topics.items():
            nodes = self._nodes(topic)
            shown = self._base.node.resolve_topic_name(topic)
            who = " and ".join(repr(node) for node in nodes)
            self._say(
                f"writers {name}",
                f"{len(nodes)} nodes publish {shown!r}, {who}, and their maps take turns as one "
                "input: end one, or give each a topic of its own in inputs"
                if len(nodes) > 1
                else None,
                Level.WARN,
            )
        own = self._base.node.get_fully_qualified_name()
        others = self._nodes(self._output)
        if own in others:
            others.remove(own)
        self.rival = others[0] if others else ""
        shown = self._base.node.resolve_topic_name(self._output)
        self._say(
            "other fusion",
            f"another node, {self.rival!r}, publishes {shown!r} too: end one of the two, or start "
            "it in a namespace of its own (-r __ns:=/NAME)"
            if self.rival
            else None,
            Level.ERROR,
        )

    def remove(self, name: str) -> None:
        """Forget what was said of an input that is none any more."""
        self._base.diagnostics.clear(f"writers {name}")

    def _nodes(self, topic: str) -> list[str]:
        """Return the nodes that write a topic, each once; one more by a name that stays double."""
        infos = self._base.node.get_publishers_info_by_topic(topic)
        names = [
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in infos
            if info.node_name != UNKNOWN
        ]
        single = sorted(set(names))
        if len(names) == len(single):
            self._alike_since_s.pop(topic, None)
            return single
        now_s = time.monotonic()
        if now_s - self._alike_since_s.setdefault(topic, now_s) < DEAD_KNOWN_S:
            return single
        return sorted(names)

    def _say(self, key: str, text: str | None, level: Level) -> None:
        if text is None:
            self._base.diagnostics.clear(key)
        else:
            self._base.diagnostics.add(key, level, text)
