"""Read the maps that a command names, each under a name of its own."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from slamfusion.cli.output import notice
from slamfusion.config import MapFileConfig
from slamfusion.errors import MapFileError
from slamfusion.grid import OccupancyGrid

__all__ = ["check_writable", "distinct_names", "load_maps"]

SUFFIXES = (".gz", ".yaml", ".yml", ".pgm", ".png", ".bmp", ".pnm")


def load_maps(
    paths: Sequence[Path], resolution: float | None, config: MapFileConfig
) -> list[OccupancyGrid]:
    """Load maps in order, named apart even where their files have one name.

    What is doubtful about a map is said on stderr.

    Args:
        paths: map_server YAML files, or bare images.
        resolution: metres per cell of the bare images.
        config: how they are read.
    """
    from slamfusion.io import load_map  # noqa: PLC0415

    return [
        load_map(
            path,
            resolution=None if _is_yaml(path) else resolution,
            name=name,
            legacy_unknown=config.legacy_unknown,
            warn=notice,
        )
        for path, name in zip(paths, distinct_names(paths), strict=True)
    ]


def check_writable(folder: Path) -> None:
    """Refuse a place that cannot be written before any work is done; nothing is made.

    Raises:
        MapFileError: the folder, or the nearest one above it that exists, takes no new files.
    """
    nearest = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not nearest.is_dir():
        message = f"{folder}: cannot write: {nearest} is not a folder; choose another name"
        raise MapFileError(message)
    if not os.access(nearest, os.W_OK | os.X_OK):
        message = f"{folder}: cannot write: no permission; choose a place you may write to"
        raise MapFileError(message)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return each file's stem, with as many of its folders as tell it from the others.

    ``a/map.yaml`` and ``b/map.yaml`` become ``a/map`` and ``b/map``; one file given twice becomes
    ``map`` and ``map#2``.
    """
    parts = [(*path.absolute().parent.parts, _stem(path)) for path in paths]
    depth = [1] * len(paths)
    while True:
        names = ["/".join(own[-count:]) for own, count in zip(parts, depth, strict=True)]
        clashes = {name for name, count in Counter(names).items() if count > 1}
        deeper = [
            min(count + 1, len(own)) if name in clashes else count
            for own, count, name in zip(parts, depth, names, strict=True)
        ]
        if deeper == depth:
            break
        depth = deeper
    seen: Counter[str] = Counter()
    for index, own in enumerate(parts):
        seen[names[index]] += 1
        if seen[names[index]] > 1:
            names[index] = f"{own[-1]}#{seen[names[index]]}"
        elif names[index] in clashes:
            names[index] = own[-1]
    return names


def _is_yaml(path: Path) -> bool:
    """Whether the file has its own cell size, so that --resolution is meant for others."""
    return path.suffix.lower() in {".yaml", ".yml"}


def _stem(path: Path) -> str:
    """Return the file's name without the suffixes of a map file."""
    name = path.name
    for suffix in SUFFIXES:
        if name.lower().endswith(suffix) and len(name) > len(suffix):
            name = name[: -len(suffix)]
    return name or str(path)
