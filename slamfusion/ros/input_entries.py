"""Entries of the fusion node's ``inputs``: map topics and saved maps, and what they are called."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from slamfusion.config import MapFileConfig
from slamfusion.errors import ConfigError
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map

FILE_PREFIX = "file:"
MAP_SUFFIX = "/map"
# No topic has it in its name.
NAMED = "="


def input_names(entries: Sequence[str], before: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return a short name for every entry of ``inputs``, and the entry, in order.

    ``robot/map`` is called robot, ``file:lab.yaml`` lab; ``yard=TOPIC`` and ``yard=file:PATH`` are
    called yard. Where two would be called the same, both are called by their whole entry.

    Args:
        entries: what is fused.
        before: entries by the names that they have and keep: a new one that would be called as one
            of these is called by its whole entry.

    Raises:
        ConfigError: one is given twice, or two are given one name.
    """
    if len(set(entries)) < len(entries):
        message = f"inputs names one map twice: {', '.join(entries)}"
        raise ConfigError(message)
    kept = {entry: name for name, entry in (before or {}).items() if entry in entries}
    called = {entry: kept.get(entry) or _short_name(entry) for entry in entries}
    names: dict[str, str] = {}
    for entry, name in called.items():
        is_shared = list(called.values()).count(name) > 1 and entry not in kept
        if is_shared and _given_name(entry):
            message = f"inputs calls two maps {name!r}: {', '.join(entries)}"
            raise ConfigError(message)
        names[entry if is_shared else name] = entry
    return names


def entry_for(name: str, topic: str | None = None) -> str:
    """Return the entry of an input of a name.

    Args:
        name: what it is to be called.
        topic: of its maps, or ``file:PATH``; None: ``NAME/map``.

    Raises:
        ConfigError: the name is none.
    """
    if not name.strip("/") or NAMED in name or "," in name or name.startswith(FILE_PREFIX):
        message = f"{name!r} is no name of an input; wanted one like robot3, and --topic for others"
        raise ConfigError(message)
    where = f"{name.rstrip('/')}{MAP_SUFFIX}" if topic is None else topic
    return where if _short_name(where) == name.strip("/") else f"{name}{NAMED}{where}"


def topic_of(entry: str) -> str | None:
    """Return the map topic of an entry; None of a saved map."""
    where = _place(entry)
    return None if where.startswith(FILE_PREFIX) else where


def saved_path(entry: str) -> Path | None:
    """Return the file of a saved map's entry; None of a topic."""
    where = _place(entry)
    return Path(where.removeprefix(FILE_PREFIX)) if where.startswith(FILE_PREFIX) else None


def load_saved(
    name: str, entry: str, config: MapFileConfig, warn: Callable[[str], Any]
) -> OccupancyGrid | None:
    """Return the map of a saved one's entry, None of a topic.

    Args:
        name: of the input.
        entry: as in ``inputs``.
        config: how saved maps are read.
        warn: told what is doubtful about the map.

    Raises:
        MapFileError: it cannot be read.
    """
    path = saved_path(entry)
    if path is None:
        return None
    return load_map(path, name=name, legacy_unknown=config.legacy_unknown, warn=warn)


def _given_name(entry: str) -> str:
    """Return the name that an entry gives itself; empty without."""
    name, is_named, _ = entry.partition(NAMED)
    return name if is_named and not entry.startswith(FILE_PREFIX) else ""


def _place(entry: str) -> str:
    """Return an entry without the name that it gives itself."""
    return entry.partition(NAMED)[2] if _given_name(entry) else entry


def _short_name(entry: str) -> str:
    if name := _given_name(entry):
        return name
    if entry.startswith(FILE_PREFIX):
        return Path(entry.removeprefix(FILE_PREFIX)).stem
    return entry.removesuffix(MAP_SUFFIX).strip("/") or entry
