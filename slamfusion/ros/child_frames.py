"""``ChildFrames``: the frame that each input's transform is sent to, one for each input."""

from __future__ import annotations

from collections.abc import Collection, Iterator

MAP_SUFFIX = "map"


def in_namespace(namespace: str, frame: str) -> str:
    """Return a frame's name as nodes of a namespace call it: ``robot1/map`` in ``/robot1``."""
    space = namespace.strip("/")
    return f"{space}/{frame}" if space else frame


class ChildFrames:
    """Tells inputs apart whose maps claim one frame.

    Two robots that run the same programs call their maps' frames the same. The first that claims a
    frame keeps it; the frame of another is put into as much of its topic's namespace as tells the
    two apart: ``graph_map`` of ``robot2/graph/map`` is ``robot2/graph_map`` where that of
    ``robot1/graph/map`` came before. What was told once stays: no frame changes its place when
    others come, go or lose their votes.

    Args:
        taken: frames that no input may have, such as the fused one.
    """

    def __init__(self, taken: Collection[str] = ()) -> None:
        self._taken = set(taken)
        # The child frame and its input's namespace, by the input's name and its map's frame.
        self._children: dict[tuple[str, str], tuple[str, tuple[str, ...]]] = {}

    def of(self, name: str, topic: str, frame: str) -> str:
        """Return the frame that an input's transform is sent to.

        Args:
            name: of the input.
            topic: of its maps, resolved.
            frame: of its maps; not empty.
        """
        key = name, frame
        if key not in self._children:
            space = _space(topic)
            others = [theirs for (_, own), (_, theirs) in self._children.items() if own == frame]
            child = next(self._names(space, frame, others)) if others else frame
            self._children[key] = child, space
            self._taken.add(child)
        return self._children[key][0]

    def renamed(self) -> dict[str, tuple[str, str]]:
        """Return the map's frame and the one that is sent, of inputs where these differ."""
        return {
            name: (frame, child)
            for (name, frame), (child, _) in self._children.items()
            if child != frame
        }

    def _names(
        self, space: tuple[str, ...], frame: str, others: Collection[tuple[str, ...]]
    ) -> Iterator[str]:
        """Yield names that nobody has, the one with the shortest namespace first."""
        for length in range(1, len(space) + 1):
            is_own = all(theirs[:length] != space[:length] for theirs in others)
            child = "/".join((*space[:length], frame))
            if is_own and child not in self._taken:
                yield child
        number = 2
        while True:
            child = "/".join((*space, f"{frame}_{number}"))
            if child not in self._taken:
                yield child
            number += 1


def _space(topic: str) -> tuple[str, ...]:
    """Return the words of a topic but the last ``map``; of a bare topic that is all."""
    words = tuple(filter(None, topic.split("/")))
    return words[:-1] if len(words) > 1 and words[-1] == MAP_SUFFIX else words
