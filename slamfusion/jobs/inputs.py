"""What a job is given: maps as files or in memory, each under a name of its own; a device."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from slamfusion.config import SMALLEST, FusionConfig, RunConfig, VoteConfig, VoteMode
from slamfusion.errors import ConfigError, MapFileError
from slamfusion.io.lines import MAP_SUFFIXES
from slamfusion.jobs.outputs import FUSED
from slamfusion.json_values import printed_as

if TYPE_CHECKING:
    from slamfusion.compute import ComputeDevice
    from slamfusion.grid import OccupancyGrid

# A map in memory, or a map_server YAML file or bare image.
MapInput: TypeAlias = "OccupancyGrid | str | Path"
# The least and the greatest size of a plan's pixels, metres; free: half and twice what they say.
PixelSizes: TypeAlias = tuple[float, float] | Literal["free"]
# Called with a stage, the number of its steps that are done, parts included, and of all of them.
Progress = Callable[[str, float, int], None]
# Called with a sentence on what is doubtful about an input; by default it is logged.
Warn = Callable[[str], None]
log_warning: Warn = logging.getLogger("slamfusion.jobs").warning

# What a pixel of a plan is taken for before its scale is searched, metres.
PIXEL_M = 0.05
# Maps of a folder that a message names.
MOST_NAMED = 5
SUFFIXES = (".gz", *MAP_SUFFIXES, ".tum", ".txt", ".csv")


def check_count(*names: str) -> None:
    """Refuse one map alone before any work."""
    from slamfusion.fusion.groups import LEAST_FUSED  # noqa: PLC0415  (NumPy loads slowly)

    if len(names) < LEAST_FUSED:
        raise ConfigError(
            f"wanted at least {LEAST_FUSED} maps to fuse, found that of {names[0]} alone; name "
            "more SLAMs in --producers, add a saved map with --inputs, or make this map with "
            f"`slamfusion slam {names[0]}`"
        )


@dataclass(frozen=True)
class LogFiles:
    """A log, and the files that its results are compared with."""

    log: Path | None = None
    """The log; null where paths were measured without it."""
    relations: Path | None = None
    """The file of known relations."""
    odometry: Path | None = field(default=None, metadata=printed_as("odometry_file"))
    """The file of raw odometry."""
    scan_odometry: Path | None = field(default=None, kw_only=True)
    """The file that gave the scans their odometry."""
    truth: Path | None = None
    """The file of the true trajectory."""
    truth_map: Path | None = None
    """The true map's file."""

    def inputs(self, case: str) -> list[tuple[str, str, Path]]:
        """Return role, case and path of each file, for ``write_results_file``."""
        named = [(item.name, getattr(self, item.name)) for item in fields(LogFiles)]
        return [(name.replace("_", " "), case, path) for name, path in named if path is not None]


@dataclass(frozen=True)
class GivenMaps:
    """The files of the inputs of a fusion."""

    saved_maps: tuple[Path, ...] = ()
    """In the order of the inputs; empty for maps from memory."""
    resolution: float | None = None
    """Metres per cell of bare images, as it was given; null: not given."""

    @classmethod
    def of(cls, maps: Sequence[MapInput], resolution: float | None) -> GivenMaps:
        """Return the files of inputs; none where one of them came from memory."""
        files = tuple(Path(item) for item in maps if isinstance(item, (str, Path)))
        return cls(files if len(files) == len(maps) else (), resolution)


NO_FILES = GivenMaps()


def load_maps(
    maps: Sequence[MapInput],
    config: RunConfig,
    *,
    resolution: float | None = None,
    warn: Warn = log_warning,
    measured: bool = False,
) -> list[OccupancyGrid]:
    """Return maps in order with distinct names; files are loaded.

    Args:
        maps: in memory, map_server YAML files, bare images, or folders with a fused map or a single
            one.
        resolution: metres per cell of the bare images.
        measured: they are compared with a truth, or are one: drawings have edges of grey cells.
    """
    from slamfusion.io import load_map  # noqa: PLC0415  (OpenCV loads slowly; --help needs none)

    files = [map_file(Path(item)) for item in maps if isinstance(item, (str, Path))]
    loaded = (
        load_map(
            file,
            resolution=None if is_yaml(file) else resolution,
            name=name,
            legacy_unknown=config.map_files.legacy_unknown,
            settle_edges=measured,
            warn=warn,
        )
        for file, name in zip(files, distinct_names(files), strict=True)
    )
    return [next(loaded) if isinstance(item, (str, Path)) else item for item in maps]


def map_file(path: Path) -> Path:
    """Return the fused or only map of a folder; other paths as given."""
    if not path.is_dir():
        return path
    maps = [item for item in sorted(path.iterdir()) if is_yaml(item)]
    chosen = [item for item in maps if item.stem == FUSED] or maps
    if len(chosen) == 1:
        return chosen[0]
    found = ", ".join(item.name for item in maps[:MOST_NAMED]) or "no YAML file"
    raise MapFileError(f"{path}: wanted a map, found a folder with {found}; name a map in it")


def load_truth(
    truth: MapInput,
    config: RunConfig,
    *,
    resolution: float | None = None,
    scale: PixelSizes | None = None,
    warn: Warn = log_warning,
    producers: Sequence[str] = (),
) -> OccupancyGrid:
    """Return the map that others are compared with; see ``load_maps``.

    Args:
        resolution: metres per cell of a bare image; default for a plan: ``PIXEL_M``.
        scale: of a floor plan, whose scale is searched; None: the truth is a map.
        producers: whose maps will be compared with it; GridError if its cells are unlike theirs.
    """
    from slamfusion.align.normalize import check_ratio  # noqa: PLC0415  (NumPy loads slowly)
    from slamfusion.evaluation.map_error import known_truth  # noqa: PLC0415
    from slamfusion.slam.registry import producer, settings_of  # noqa: PLC0415

    if scale is not None and resolution is None:
        resolution = PIXEL_M
    (grid,) = load_maps([truth], config, resolution=resolution, warn=warn, measured=True)
    known_truth(grid.classified(config.fusion.normalize))
    for name in producers if scale is None else ():
        check_ratio(grid, producer(name).resolution(settings_of(config, name)) or grid.resolution)
    return grid


def as_path(path: str | Path | None) -> Path | None:
    """Return the path of a file that may not have been named."""
    return None if path is None else Path(path)


def device_for(config: RunConfig, device: ComputeDevice | None = None) -> ComputeDevice:
    """Return the device given, or the one that the settings name."""
    from slamfusion.compute import open_device  # noqa: PLC0415

    return open_device(config.device.device) if device is None else device


def check_writable(folder: Path) -> None:
    """Raise ``MapFileError`` if the folder cannot be created or written; nothing is made."""
    nearest = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not nearest.is_dir():
        message = f"{folder}: cannot write: {nearest} is not a folder; choose another name"
        raise MapFileError(message)
    if not os.access(nearest, os.W_OK | os.X_OK):
        message = f"{folder}: cannot write: no permission; choose a place you may write to"
        raise MapFileError(message)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return each file's stem with the folders that distinguish it; repeats end in ``#2``."""
    parts = [(*path.absolute().parent.parts, _stem(path)) for path in paths]
    ends = Counter(own[-depth:] for own in set(parts) for depth in range(1, len(own) + 1))
    names, seen = [], Counter[tuple[str, ...]]()
    for own in parts:
        seen[own] += 1
        if parts.count(own) == 1:
            depth = next(depth for depth in range(1, len(own) + 1) if ends[own[-depth:]] == 1)
            names.append("/".join(own[-depth:]))
        else:
            names.append(own[-1] if seen[own] == 1 else f"{own[-1]}#{seen[own]}")
    return names


def is_yaml(path: Path) -> bool:
    """Whether the file has its own cell size, so that --resolution is meant for others."""
    return path.suffix.lower() in {".yaml", ".yml"}


def _stem(path: Path) -> str:
    """Return the file's name without the suffixes of a map file."""
    name = path.name
    for suffix in SUFFIXES:
        if name.lower().endswith(suffix) and len(name) > len(suffix):
            name = name[: -len(suffix)]
    return name or str(path)


# How the maps of a drive vote where no map can be drawn of it; see docs/concepts/voting.md.
RUN_VOTE: VoteMode = "consensus"
# Of ``run_log``. The map that all scans draw at the fused path is nearer to the truth than any vote
# on maps, and than the best producer's own drawn alike; see docs/concepts/paths.md.
RUN_DEFAULTS = replace(
    RunConfig(), fusion=replace(FusionConfig(), vote=replace(VoteConfig(), mode="drawn"))
)
# How [F16] fuses: a majority in which unknown is a value, in the frame and box of the smallest map.
LIKE_PAPER = RunConfig(
    fusion=FusionConfig(
        vote=VoteConfig(mode="majority", unknown="value", extent="reference"), reference=SMALLEST
    )
)
