"""``FusionInputs``: the inputs of a fusion node, which come and go while it runs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.parameter import Parameter
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_topic_name import validate_topic_name

from slamfusion.compute.layout import MOST_INPUTS
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.grid import OccupancyGrid
from slamfusion.ros.base import Level, NodeBase, invalid_name
from slamfusion.ros.discovery import Discovery
from slamfusion.ros.input_entries import input_names, topic_of
from slamfusion.ros.map_source import MapSource
from slamfusion.ros.parameters import declare_names
from slamfusion.slam.registry import BUILT_IN

DEFAULT = tuple(f"{name}/map" for name in BUILT_IN)
TEXT = (
    "what is fused: map topics, and file:PATH for saved maps; NAME=TOPIC gives a name of its own; "
    "may be changed while the node runs; default with discover: none but what is found"
)
SHOWN_S = 10.0


@dataclass(frozen=True, eq=False)
class Taken:
    """What came of the inputs since it was asked last.

    Attributes:
        removed: names of those that are inputs no more; older than all else.
        saved: saved maps of new ones.
        maps: the newest message of each input that sent one, when it came (``time.monotonic``) and
            the frame of the one before.
    """

    removed: list[str] = field(default_factory=list)
    saved: list[OccupancyGrid] = field(default_factory=list)
    maps: list[tuple[MapSource, Any, float, str]] = field(default_factory=list)


class FusionInputs:
    """Which maps are fused, by name: the parameter ``inputs``, and what is discovered.

    In the executor's thread, apart from ``take``, ``has_come`` and ``is_waiting``.

    Args:
        base: the node, which gets the parameter.
        outputs: topics that a fusion writes, relative; they are not discovered.
        is_open: whether there may be none at first, since they are discovered.
        on_change: called after a change with the names of those that are inputs no more.

    Attributes:
        entries: those of ``inputs`` by name; this and the next one are replaced as wholes.
        sources: of the map topics, by name; none before ``begin``.

    Raises:
        ConfigError: there is none, or one is given twice.
    """

    def __init__(
        self,
        base: NodeBase,
        outputs: Collection[str],
        *,
        is_open: bool,
        on_change: Callable[[list[str]], None],
    ) -> None:
        self._base = base
        self._on_change = on_change
        self._discovery = Discovery(base, outputs)
        given = declare_names(
            base.node,
            "inputs",
            () if is_open else DEFAULT,
            TEXT,
            check=self._checked,
            on_change=self._change,
        )
        if not given and not is_open:
            message = "inputs is empty; name at least one map: -p inputs:=[a/map,b/map]"
            raise ConfigError(message)
        self.entries = input_names(given)
        self.sources: dict[str, MapSource] = {}
        self._saved: dict[str, OccupancyGrid] = {}
        # Topics, resolved, of inputs that were removed and not added again.
        self._unwanted: set[str] = set()
        self._load: Callable[[str, str], OccupancyGrid | None] = lambda *_: None
        self._make: Callable[[str, str], MapSource]
        self._lock = threading.Lock()
        self._removed: list[str] = []
        self._fresh: list[OccupancyGrid] = []
        # Saved maps by entry, from when they were checked until they are taken.
        self._loaded: dict[str, OccupancyGrid | None] = {}

    def begin(
        self,
        load: Callable[[str, str], OccupancyGrid | None],
        make: Callable[[str, str], MapSource],
    ) -> None:
        """Load the saved maps and listen to the topics.

        Args:
            load: returns the saved map of a name and its entry, None of a topic.
            make: returns the source of a name and its topic.

        Raises:
            ConfigError: there are too many, or one topic is given twice or is none.
            MapFileError: a saved map cannot be read.
        """
        self._load, self._make = load, make
        entries, self.entries = [*self.entries.values()], {}
        self._replace(self._checked(entries))

    def discover(self, settings: FusionNodeConfig) -> None:
        """Let topics that fit ``discover`` be inputs, as many as can be; not those removed."""
        topics = self._discovery.look(settings)
        known = {*self._topics(self.entries), *self._unwanted} if topics else set()
        found = [self._discovery.entry(topic) for topic in topics if topic not in known]
        room = MOST_INPUTS - len(self.entries)
        if found[room:]:
            text = (
                f"found and not fused: {', '.join(found[room:])}; at most {MOST_INPUTS} can be: "
                "remove others (slamfusion live remove NAME)"
            )
            self._base.diagnostics.add("not fused", Level.WARN, text, SHOWN_S)
        if found[:room] and (problem := self._ask([*self.entries.values(), *found[:room]])):
            text = f"found and not fused: {', '.join(found)}: {problem}"
            self._base.diagnostics.add("not fused", Level.WARN, text, SHOWN_S)

    def load(self, entry: str) -> tuple[OccupancyGrid | None, str]:
        """Let a saved map be an input, read again where it is one; return it, or why not."""
        others = [other for other in self.entries.values() if other != entry]
        if len(others) < len(self.entries):
            try:
                self._load("", entry)
            except SlamFusionError as error:
                return None, str(error)
            if problem := self._ask(others):
                return None, problem
        if problem := self._ask([*others, entry]):
            return None, problem
        name = next(name for name, other in self.entries.items() if other == entry)
        return self._saved[name], ""

    def _ask(self, entries: Sequence[str]) -> str:
        """Set the parameter; return why it was refused, empty where it was not."""
        parameter = Parameter("inputs", Parameter.Type.STRING_ARRAY, [*entries])
        (result,) = self._base.node.set_parameters([parameter])
        return "" if result.successful else str(result.reason)

    def _checked(self, entries: Sequence[str]) -> dict[str, str]:
        """Return what is to be fused from now on by name, and load what is saved of it.

        Raises:
            ConfigError: none would be left, there are too many, one stands there twice, or its
                topic is none.
            MapFileError: a saved map cannot be read.
        """
        if not entries and self.entries:
            message = "inputs: one at least must stay; end the node to fuse nothing"
            raise ConfigError(message)
        if len(entries) > MOST_INPUTS:
            message = f"inputs: at most {MOST_INPUTS} maps can be fused, found {len(entries)}"
            raise ConfigError(message)
        names = input_names(entries, self.entries)
        topics = self._topics(names)
        twice = {topic for topic in topics if topics.count(topic) > 1}
        if twice:
            message = f"inputs names one map twice: {', '.join(entries)} ({twice.pop()})"
            raise ConfigError(message)
        self._loaded = {
            entry: self._load(name, entry) for name, entry in _others(names, self.entries).items()
        }
        return names

    def _topics(self, names: Mapping[str, str]) -> list[str]:
        """Return the whole names of the topics among entries.

        Raises:
            ConfigError: one is no name of a topic.
        """
        topics = [topic for entry in names.values() if (topic := topic_of(entry)) is not None]
        node = self._base.node
        try:
            for topic in topics:
                validate_topic_name(topic)
                whole = expand_topic_name(topic, node.get_name(), node.get_namespace())
                validate_full_topic_name(whole)
        except NameValidationException as error:
            message = f"inputs: {invalid_name(error)}"
            raise ConfigError(message) from None
        return [str(node.resolve_topic_name(topic)) for topic in topics]

    def _change(self, entries: Sequence[str]) -> None:
        """Take other inputs, and say who came and who left."""
        names, before = input_names(entries, self.entries), self.entries
        removed, added = _others(before, names), _others(names, before)
        if not {*added.values()} <= self._loaded.keys():  # it was checked, as a rule
            self._checked(entries)
        self._replace(names)
        self._unwanted |= {*self._topics(removed)}
        for name, entry in removed.items():
            text = f"{name} is removed from the inputs ({entry}), and its vote with it"
            self._base.diagnostics.add(f"removed {name}", Level.WARN, text, SHOWN_S)
        for name, entry in added.items():
            self._base.log.info(f"{name} is an input now ({entry})")
        self._on_change([*removed])

    def _replace(self, names: dict[str, str]) -> None:
        """Let these be the inputs, checked."""
        added, removed = _others(names, self.entries), _others(self.entries, names)
        sources = {name: source for name, source in self.sources.items() if name not in removed}
        saved = [grid for entry in added.values() if (grid := self._loaded[entry]) is not None]
        for name, entry in added.items():
            if (topic := topic_of(entry)) is not None:
                sources[name] = self._make(name, topic)
        with self._lock:
            gone = [source for name, source in self.sources.items() if name in removed]
            self._removed += removed
            self._fresh = [grid for grid in self._fresh if grid.name not in removed] + saved
            kept = {name: grid for name, grid in self._saved.items() if name not in removed}
            self._saved = kept | {grid.name: grid for grid in saved}
            self.sources = {name: sources[name] for name in names if name in sources}
            self.entries = names
        self._unwanted -= {*self._topics(names)}
        self._loaded = {}
        for source in gone:
            source.close()

    # --- the worker's thread -----------------------------------------------------------------

    def take(self) -> Taken:
        """Return what came since the last call, as of one moment."""
        with self._lock:
            taken = Taken(self._removed, self._fresh)
            self._removed, self._fresh = [], []
            for source in self.sources.values():
                before = source.frame
                if (newest := source.take()) is not None:
                    taken.maps.append((source, *newest, before))
        return taken

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a map, or is a saved one."""
        source = self.sources.get(name)
        return name in self._saved or (source is not None and bool(source.frame))

    @property
    def is_waiting(self) -> bool:
        """Whether anything waits to be taken."""
        if self._removed or self._fresh:
            return True
        return any(source.is_waiting for source in self.sources.values())


def _others(names: Mapping[str, str], before: Mapping[str, str]) -> dict[str, str]:
    """Return the entries by name that stood otherwise, or not at all, in others."""
    return {name: entry for name, entry in names.items() if before.get(name) != entry}
