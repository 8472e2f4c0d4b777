"""The inputs of a fusion node: the parameter ``inputs``, discovered topics, and changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from rclpy.exceptions import NameValidationException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.parameter import Parameter
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_topic_name import validate_topic_name

from slamfusion.compute.layout import MOST_INPUTS
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.grid import OccupancyGrid
from slamfusion.io.files import user_path
from slamfusion.ros.base import NodeBase, invalid_name
from slamfusion.ros.input_health import MAP_SUFFIX, MapSource
from slamfusion.ros.interface import INPUTS
from slamfusion.ros.parameters import declare_names

# Diagnostics lines: the fusion's, the prefix of an input's, and its value with the entry.
FUSION, PREFIX, ENTRY = "fusion", "input ", "entry"
FILE_PREFIX = "file:"
# Not allowed in topic names.
NAMED = "="
MAP_TYPE = "nav_msgs/msg/OccupancyGrid"
ANY_WORDS = "**"


def input_names(entries: Sequence[str], before: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the entries of ``inputs`` by short name, in order.

    ``robot/map`` is robot, ``file:lab.yaml`` lab; ``yard=TOPIC`` and ``yard=file:PATH`` are yard.
    Entries with equal short names are called by the whole entry; those of ``before`` keep their
    names.

    Raises:
        ConfigError: one is given twice, or two are given one name.
    """
    if len(set(entries)) < len(entries):
        raise ConfigError(f"inputs names one map twice: {', '.join(entries)}")
    kept = {entry: name for name, entry in (before or {}).items() if entry in entries}
    called = {entry: kept.get(entry) or _short_name(entry) for entry in entries}
    names: dict[str, str] = {}
    for entry, name in called.items():
        is_shared = list(called.values()).count(name) > 1 and entry not in kept
        if is_shared and _split(entry)[0]:
            raise ConfigError(f"inputs calls two maps {name!r}: {', '.join(entries)}")
        names[entry if is_shared else name] = entry
    return names


def entry_for(name: str, topic: str | None = None) -> str:
    """Return the entry of an input, by default ``NAME/map``; ConfigError for an invalid name.

    Without ``topic`` the name may be that of its topic.
    """
    own = name if topic is not None else name.removesuffix(MAP_SUFFIX)
    if not own.strip("/") or NAMED in own or "," in own or own.startswith(FILE_PREFIX):
        message = f"{name!r} is no name of an input; wanted one like robot3, and --topic for others"
        raise ConfigError(message)
    where = f"{own.rstrip('/')}{MAP_SUFFIX}" if topic is None else topic
    return where if _short_name(where) == own.strip("/") else f"{own}{NAMED}{where}"


def topic_of(entry: str) -> str | None:
    """Return the map topic of an entry; None for a saved map."""
    where = _split(entry)[1]
    return None if where.startswith(FILE_PREFIX) else where


def saved_path(entry: str) -> Path | None:
    """Return the file of a saved map's entry; None for a topic."""
    where = _split(entry)[1]
    return user_path(where.removeprefix(FILE_PREFIX)) if where.startswith(FILE_PREFIX) else None


def _split(entry: str) -> tuple[str, str]:
    """Return an entry's explicit name (or empty), and its topic or file."""
    name, is_named, where = entry.partition(NAMED)
    return (name, where) if is_named and not entry.startswith(FILE_PREFIX) else ("", entry)


def _short_name(entry: str) -> str:
    name, where = _split(entry)
    if not name and where.startswith(FILE_PREFIX):
        return Path(where.removeprefix(FILE_PREFIX)).stem
    return name or where.removesuffix(MAP_SUFFIX).strip("/") or entry


def fits(topic: str, pattern: str) -> bool:
    """Return whether a topic fits a pattern; both are full names with a leading slash.

    ``*``, ``?`` and ``[ab]`` match within one word between slashes, ``**`` any words.
    """
    return _fit(topic.split("/"), pattern.split("/"))


def _fit(words: Sequence[str], wanted: Sequence[str]) -> bool:
    if not wanted:
        return not words
    if wanted[0] == ANY_WORDS:
        return any(_fit(words[count:], wanted[1:]) for count in range(len(words) + 1))
    return bool(words) and fnmatchcase(words[0], wanted[0]) and _fit(words[1:], wanted[1:])


class FusionInputs:
    """The fused maps by name: the parameter ``inputs``, and what is discovered.

    In the executor's thread. The mappings are replaced as a whole.

    Args:
        outputs: topics of a fusion, relative; not discovered.
        is_open: whether there may be none at first.
        load: returns the saved map of a name and a file, or raises MapFileError.
        listen: returns the source of a name and a topic.
        on_change: called with the removed names and the new saved maps.

    Attributes:
        entries: those of ``inputs`` by name.
        sources, saved: map topics and saved maps by name; none before ``begin``.

    Raises:
        ConfigError: there is none, or one is given twice.
    """

    def __init__(
        self,
        base: NodeBase,
        outputs: Collection[str],
        *,
        is_open: bool,
        load: Callable[[str, Path], OccupancyGrid],
        listen: Callable[[str, str], MapSource],
        on_change: Callable[[list[str], list[OccupancyGrid]], None],
    ) -> None:
        self._base = base
        self._load, self._listen, self._on_change = load, listen, on_change
        self._outputs = tuple(outputs)
        self._looked_s = float("-inf")
        given = declare_names(
            base.node, INPUTS, () if is_open else None, check=self._checked, on_change=self._change
        )
        if not given and not is_open:
            raise ConfigError("inputs is empty; name at least one map: -p inputs:=[a/map,b/map]")
        self.entries = input_names(given)
        self.sources: dict[str, MapSource] = {}
        self.saved: dict[str, OccupancyGrid] = {}
        # Resolved topics of inputs that were removed and not added again.
        self._unwanted: set[str] = set()
        # Checked saved maps by entry, until they are inputs.
        self._loaded: dict[str, OccupancyGrid] = {}

    def begin(self) -> None:
        """Load the saved maps and subscribe; ConfigError or MapFileError for bad entries."""
        entries, self.entries = [*self.entries.values()], {}
        self._take(self._checked(entries))

    def discover(self, settings: FusionNodeConfig) -> None:
        """Add topics that fit ``discover``, up to the limit, except removed ones.

        Topics need a publisher. Fused maps, of any fusion, are not discovered.
        """
        now_s = time.monotonic()
        if not settings.discover or now_s - self._looked_s < 1.0 / settings.discovery_rate_hz:
            return
        self._looked_s = now_s
        node = self._base.node
        space = str(node.get_namespace()).rstrip("/") + "/"
        patterns = [part if part[0] == "/" else space + part for part in settings.patterns]
        known = {*self._topics(self.entries), *self._unwanted}
        known |= {self._base.resolved(name) for name in self._outputs}
        published = [
            topic
            for topic, types in sorted(node.get_topic_names_and_types())
            if MAP_TYPE in types
            and topic not in known
            and not any(topic.endswith(f"/{name}") for name in self._outputs)
            and node.count_publishers(topic)
        ]
        # Relative names: robots are called by their own namespaces.
        found = [
            topic.removeprefix(space)
            for topic in published
            if any(fits(topic, pattern) for pattern in patterns)
        ]
        missed = None
        if published and not (found or self.entries):
            missed = f"no map fits discover, {settings.discover}; published: {', '.join(published)}"
        self._base.diagnostics.say("discover", missed)
        room = MOST_INPUTS - len(self.entries)
        if found[room:]:
            text = (
                f"found and not fused: {', '.join(found[room:])}; at most {MOST_INPUTS} can be: "
                "remove others (slamfusion live remove NAME)"
            )
            self._base.diagnostics.note("not fused", text)
        if found[:room] and (problem := self._ask([*self.entries.values(), *found[:room]])):
            text = f"found and not fused: {', '.join(found)}: {problem}"
            self._base.diagnostics.note("not fused", text)

    def load(self, path: str) -> OccupancyGrid:
        """Add a saved map, or read it again, and return it; SlamFusionError if refused."""
        entry = f"{FILE_PREFIX}{path}"
        others = [other for other in self.entries.values() if other != entry]
        steps = [[*others, entry]]
        if len(others) < len(self.entries):
            self._load("", user_path(path))  # if unreadable, the old one stays
            steps = [others, *steps]
        for entries in steps:
            if problem := self._ask(entries):
                raise SlamFusionError(problem)
        return next(self.saved[name] for name, other in self.entries.items() if other == entry)

    def _ask(self, entries: Sequence[str]) -> str:
        """Set the parameter; return why it was refused, or empty."""
        parameter = Parameter("inputs", Parameter.Type.STRING_ARRAY, [*entries])
        (result,) = self._base.node.set_parameters([parameter])
        return "" if result.successful else str(result.reason)

    def _checked(self, entries: Sequence[str]) -> dict[str, str]:
        """Return the entries by name after loading their new saved maps; refuse wrong ones."""
        if not entries and self.entries:
            raise ConfigError("inputs: one at least must stay; end the node to fuse nothing")
        if len(entries) > MOST_INPUTS:
            message = f"inputs: at most {MOST_INPUTS} maps can be fused, found {len(entries)}"
            raise ConfigError(message)
        names = input_names(entries, self.entries)
        topics = self._topics(names)
        for topic in topics:
            if topic in map(self._base.resolved, self._outputs):
                raise ConfigError(f"inputs: {topic!r} is the map that this node makes")
            self._base.check_type(OccupancyGridMessage, topic)
        twice = {topic for topic in topics if topics.count(topic) > 1}
        if twice:
            raise ConfigError(f"inputs names one map twice: {', '.join(entries)} ({twice.pop()})")
        self._loaded = {
            entry: self._load(name, path)
            for name, entry in names.items()
            if self.entries.get(name) != entry and (path := saved_path(entry)) is not None
        }
        return names

    def _topics(self, names: Mapping[str, str]) -> list[str]:
        topics = [topic for entry in names.values() if (topic := topic_of(entry)) is not None]
        node = self._base.node
        try:
            for topic in topics:
                validate_topic_name(topic)
                whole = expand_topic_name(topic, node.get_name(), node.get_namespace())
                validate_full_topic_name(whole)
        except NameValidationException as error:
            raise ConfigError(f"inputs: {invalid_name(error)}") from None
        return [self._base.resolved(topic) for topic in topics]

    def _change(self, entries: Sequence[str]) -> None:
        removed, added = self._take(input_names(entries, self.entries))
        for name, entry in removed.items():
            text = f"{name} is removed from the inputs ({entry}), and its vote with it"
            self._base.diagnostics.note(f"removed {name}", text)
        for name, entry in added.items():
            self._base.log.info(f"{name} is an input now ({entry})")
        self._on_change([*removed], [grid for name, grid in self.saved.items() if name in added])

    def _take(self, names: dict[str, str]) -> tuple[dict[str, str], dict[str, str]]:
        """Replace the inputs; return the removed and the added entries by name."""
        before = self.entries
        added = {name: entry for name, entry in names.items() if before.get(name) != entry}
        removed = {name: entry for name, entry in before.items() if names.get(name) != entry}
        for name in removed:
            if name in self.sources:
                self.sources[name].close()
        sources, saved = {}, {}
        for name, entry in names.items():
            topic, path = topic_of(entry), saved_path(entry)
            if topic is not None:
                sources[name] = self._listen(name, topic) if name in added else self.sources[name]
            elif path is not None:
                known = self._loaded.get(entry) if name in added else self.saved[name]
                saved[name] = known or self._load(name, path)
        self.sources, self.saved, self.entries, self._loaded = sources, saved, names, {}
        self._unwanted = {*self._unwanted, *self._topics(removed)} - {*self._topics(names)}
        return removed, added
