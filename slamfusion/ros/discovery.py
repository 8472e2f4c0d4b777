"""``Discovery``: finds map topics by a pattern, as robots come."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase

from slamfusion.config import FusionNodeConfig
from slamfusion.ros.base import NodeBase

MAP_TYPE = "nav_msgs/msg/OccupancyGrid"
ANY_WORDS = "**"


def fits(topic: str, pattern: str) -> bool:
    """Return whether a topic fits a pattern; both are whole names that begin with a slash.

    ``*``, ``?`` and ``[ab]`` stand for parts of one word between slashes, ``**`` for any words.
    """
    return _fit(topic.split("/"), pattern.split("/"))


def _fit(words: Sequence[str], wanted: Sequence[str]) -> bool:
    if not wanted:
        return not words
    if wanted[0] == ANY_WORDS:
        return any(_fit(words[count:], wanted[1:]) for count in range(len(words) + 1))
    return bool(words) and fnmatchcase(words[0], wanted[0]) and _fit(words[1:], wanted[1:])


class Discovery:
    """Looks for map topics that fit ``discover``; in the executor's thread.

    Topics that only somebody reads are none. The maps that a fusion makes are never found, neither
    this one's nor another's: theirs hold the inputs once more.

    Args:
        base: the node.
        outputs: topics that a fusion writes, relative.
    """

    def __init__(self, base: NodeBase, outputs: Collection[str]) -> None:
        self._base = base
        self._outputs = tuple(outputs)
        self._looked_s = float("-inf")

    def look(self, settings: FusionNodeConfig) -> list[str]:
        """Return the topics that fit, whole names in order; none before it is time to look again.

        Args:
            settings: say what fits and how often to look.
        """
        now_s = time.monotonic()
        if not settings.discover or now_s - self._looked_s < 1.0 / settings.discovery_rate_hz:
            return []
        self._looked_s = now_s
        patterns = [self._whole(part.strip()) for part in settings.discover.split(",")]
        return sorted(
            topic
            for topic, types in self._base.node.get_topic_names_and_types()
            if MAP_TYPE in types
            and any(fits(topic, pattern) for pattern in patterns)
            and not self._is_output(topic)
            and self._base.node.count_publishers(topic)
        )

    def _whole(self, pattern: str) -> str:
        """Return a pattern in the node's namespace, where it does not begin with a slash."""
        space = str(self._base.node.get_namespace()).rstrip("/")
        return pattern if pattern.startswith("/") else f"{space}/{pattern}"

    def entry(self, topic: str) -> str:
        """Return a topic as relative as it can be: robots are called by their own namespaces."""
        space = str(self._base.node.get_namespace()).rstrip("/") + "/"
        return topic.removeprefix(space) if topic.startswith(space) else topic

    def _is_output(self, topic: str) -> bool:
        own = {self._base.node.resolve_topic_name(name) for name in self._outputs}
        return topic in own or any(topic.endswith(f"/{name}") for name in self._outputs)
