"""The producers by name: each record tells how to create or resume one.

Three are built in. Any package adds its own by an entry point of the group
``slamfusion.producers`` whose name is the producer's and whose object is a ``Producer``; it then
takes part in ``slam``, ``run`` and ``node`` by that name. Nothing else knows producers by name.
"""

from __future__ import annotations

import logging
import os
import pkgutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamfusion.config import GmappingConfig, GraphConfig, RunConfig, TinySlamConfig, from_mapping
from slamfusion.cores import usable_cores
from slamfusion.errors import ConfigError, SlamFusionError, shown, unknown

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from slamfusion.compute import ComputeDevice
    from slamfusion.slam.common.mapper import Mapper
    from slamfusion.slam.common.runner import Resumable

_LOG = logging.getLogger(__name__)

ENTRY_POINTS = "slamfusion.producers"
# Seconds between two published maps of a producer that names no other interval.
MAP_INTERVAL_S = 1.0


@dataclass(frozen=True)
class Producer:
    """How a producer is created, and its properties.

    Attributes:
        name: on the command line, in configurations, topics and file names: a letter, then letters,
            digits and underscores.
        summary: one sentence without a full stop.
        config: its default settings: an instance of a frozen dataclass that derives from
            ``slamfusion.config.Checked``.
        make: returns a mapper with an empty map, from settings, device and seed.
        load: returns a mapper in the state of a file of ``Resumable.save_state``, from the file,
            settings, device and seed; raises SlamFusionError for any other file. None: it cannot
            be resumed.
        cost: time for a scan relative to tinySLAM's: the longest job of several starts first.
        closes_loops: whether it corrects its path at known places; such maps are bent least.
        map_interval_s: seconds between two published maps, from its settings.
        prefers_small_kernels: see ``open_device``.
        resolution: metres per cell of its maps, from its settings; None: not known.
    """

    name: str
    summary: str
    config: Any
    make: Callable[[Any, ComputeDevice, int], Mapper]
    load: Callable[[Path, Any, ComputeDevice, int], Resumable] | None = None
    cost: float = 1.0
    closes_loops: bool = False
    map_interval_s: Callable[[Any], float] = lambda _: MAP_INTERVAL_S
    prefers_small_kernels: bool = False
    resolution: Callable[[Any], float | None] = lambda config: getattr(config, "resolution", None)

    def __post_init__(self) -> None:
        if not (self.name.isascii() and self.name.isidentifier() and self.name[0] != "_"):
            message = (
                f"a producer's name must be letters, digits and underscores, found {self.name!r}"
            )
            raise ValueError(message)


def _imported(place: str, *arguments: Any) -> Any:
    return pkgutil.resolve_name(f"slamfusion.slam.{place}")(*arguments)


# Our own producers, in the order of the papers' tables.
_BUILT_IN = {
    own.name: own
    for own in (
        Producer(
            name="tinyslam",
            summary="tinySLAM: one map and a Monte-Carlo scan matcher",
            config=TinySlamConfig(),
            make=partial(_imported, "tinyslam.slam:TinySlam"),
            cost=1.0,
            prefers_small_kernels=True,
        ),
        Producer(
            name="gmapping",
            summary="gmapping: a Rao-Blackwellised particle filter",
            config=GmappingConfig(),
            make=partial(_imported, "gmapping.slam:Gmapping"),
            load=partial(_imported, "gmapping.slam:Gmapping.load_state"),
            cost=6.0,
            map_interval_s=lambda config: float(config.chosen().map_update_interval or 0.0),
            resolution=lambda config: config.chosen().delta,
        ),
        Producer(
            name="graph",
            summary="graph SLAM: scans on submaps, loop closures, a pose graph",
            config=GraphConfig(),
            make=partial(_imported, "graph.slam:GraphSlam"),
            load=partial(_imported, "graph.slam:GraphSlam.load_state"),
            cost=3.0,
            closes_loops=True,
            prefers_small_kernels=True,
        ),
    )
}
BUILT_IN = tuple(_BUILT_IN)


@cache
def other_producers() -> Mapping[str, EntryPoint]:
    """Return the entry points of other packages by name, without importing them."""
    from importlib.metadata import entry_points  # noqa: PLC0415  (loads slowly)

    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=ENTRY_POINTS):
        if point.name in _BUILT_IN or point.name in found:
            _LOG.warning(
                "the producer %r of %s is not used: another one has this name",
                point.name,
                point.value,
            )
            continue
        found[point.name] = point
    return found


def producer_names() -> tuple[str, ...]:
    """Return the names of all producers: those built in, then those of other packages."""
    return (*BUILT_IN, *sorted(other_producers()))


def check_names(names: Sequence[str]) -> None:
    """Refuse no producer, an unknown one, or one given twice."""
    known = producer_names()
    for name in names:
        if name not in known:
            raise ConfigError(f"the SLAM {unknown(name, known)}")
    if not names or len(set(names)) < len(names):
        found = ", ".join(names) or "none"
        raise ConfigError(f"wanted some of {', '.join(known)}, each once, found {found}")


def producer(name: str) -> Producer:
    """Return a producer's record."""
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    if name in other_producers():
        point = other_producers()[name]
        try:
            found = point.load()
        except Exception as error:
            message = f"the producer {name!r} cannot be loaded from {point.value}: {error!r}"
            raise SlamFusionError(message) from error
    else:
        raise SlamFusionError(f"the SLAM {unknown(name, producer_names())}")
    if not isinstance(found, Producer) or found.name != name:
        shown = f"one called {found.name!r}" if isinstance(found, Producer) else repr(found)
        message = f"the entry point {name!r} must name a Producer of this name, found {shown}"
        raise SlamFusionError(message)
    return found


def loop_closers(names: Collection[str]) -> tuple[str, ...]:
    """Return the names of producers that close loops."""
    known = producer_names()
    return tuple(name for name in names if name in known and producer(name).closes_loops)


# --- settings ------------------------------------------------------------------------------------


def settings_of(config: RunConfig, name: str) -> Any:
    """Return the settings of a producer, by default its own."""
    return config.producers[name] if name in config.producers else producer(name).config


def with_settings(config: RunConfig, name: str, **changed: Any) -> RunConfig:
    """Return a configuration with some settings of a producer changed."""
    settings = replace(settings_of(config, name), **changed)
    return replace(config, producers={**config.producers, name: settings})


def with_producers(config: RunConfig, names: Collection[str] = BUILT_IN) -> RunConfig:
    """Return a configuration with the settings of these producers, defaults included."""
    added = {name: settings_of(config, name) for name in names}
    return replace(config, producers={**config.producers, **added})


def load_config(path: str | Path, base: RunConfig | None = None) -> RunConfig:
    """Read a configuration from a YAML file, with the settings of the producers that it names.

    Settings stand under ``producers`` by name; at the top of the file, as until version 0.1, they
    are read with a warning. ``base`` gives what the file leaves out; default: the defaults.

    Raises:
        ConfigError: no YAML, an unknown key or producer, a wrong type or range.
    """
    from slamfusion.io.yaml_file import read_yaml  # noqa: PLC0415  (OpenCV loads slowly)

    whole = RunConfig() if base is None else base
    values = read_yaml(path, ConfigError, "a YAML file of settings")
    if not isinstance(values, dict):
        return from_mapping(whole, values, str(path))
    sections = values.get("producers") or {}
    if isinstance(sections, dict):
        moved = {name: values.pop(name) for name in BUILT_IN if name in values}
        if moved:
            _LOG.warning(
                "%s: settings of %s stand under 'producers:' from now on; the next version does "
                "not read them at the top",
                path,
                ", ".join(moved),
            )
        sections = {**moved, **sections}
        values["producers"] = sections
        try:
            whole = with_producers(
                whole, [name if isinstance(name, str) else shown(name) for name in sections]
            )
        except SlamFusionError as error:
            raise ConfigError(f"{path}: producers: {error}") from None
    return from_mapping(whole, values, str(path))


# --- mappers -------------------------------------------------------------------------------------


def open_producer_device(name: str, config: RunConfig) -> ComputeDevice:
    """Return the device for a producer that has a process to itself.

    If PoCL would have one or two threads, the kernels run in the calling thread: launches cost a
    fifth, and two threads that wait for each other are no faster.
    """
    from slamfusion.compute import open_device  # noqa: PLC0415  (loads slowly)

    threads = os.environ.get("POCL_MAX_PTHREAD_COUNT") or str(usable_cores())
    is_small = producer(name).prefers_small_kernels or threads in {"1", "2"}
    return open_device(config.device.device, small_kernels=is_small)


def make_producer(name: str, config: RunConfig, device: ComputeDevice) -> Mapper:
    """Return a producer with its settings and an empty map; SlamFusionError if it is unknown."""
    return producer(name).make(settings_of(config, name), device, config.seed)


def resume_producer(name: str, path: Path, config: RunConfig, device: ComputeDevice) -> Resumable:
    """Return a producer in the state that a file holds."""
    load = producer(name).load
    if load is None:
        able = ", ".join(other for other in producer_names() if producer(other).load is not None)
        message = f"{name} cannot go on from a saved state; wanted one of {able or '(none)'}"
        raise SlamFusionError(message)
    return load(path, settings_of(config, name), device, config.seed)
