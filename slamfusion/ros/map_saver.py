"""``MapSaver``: writes the last published map where it is asked for, and nowhere else."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from nav_msgs.msg import OccupancyGrid

from slamfusion import grid as grids
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import SlamFusionError
from slamfusion.io.map_server import map_sources, save_map, saved_files
from slamfusion.io.overwriting import refuse_overwriting
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.fusion_inputs import FusionInputs
from slamfusion.ros.input_entries import saved_path

SHOWN_S = 10.0


class Saved(Protocol):
    """What is saved.

    Attributes:
        settings: of now.
        inputs: what is fused; no saved map of these is written over.
        published: the last published map as message and as grid; None before the first.
    """

    settings: FusionNodeConfig
    inputs: FusionInputs

    @property
    def published(self) -> tuple[OccupancyGrid, grids.OccupancyGrid] | None:
        """The last published map."""

    def nothing_fused(self) -> str:
        """Say why there is no map."""


class MapSaver:
    """Writes into the folder of the ``save_path`` that the node was started with, or below it.

    What the parameter is set to later, or what a request names, leads nowhere else.

    Args:
        base: the node.
        saved: the same, as what is saved.
    """

    def __init__(self, base: NodeBase, saved: Saved) -> None:
        self._base = base
        self._saved = saved
        self._root = Path(os.path.realpath(Path(saved.settings.save_path).parent))

    def save(self, path: str | None = None, **rules: Any) -> tuple[bool, str]:
        """Write the last published map.

        Args:
            path: without an ending; relative to the working folder; None: ``save_path``.
            rules: mode, image_format, free_thresh and occupied_thresh of ``save_map``.

        Returns:
            Whether it was written, and the path of its YAML file or why not.
        """
        published = self._saved.published
        if published is None:
            return False, self._saved.nothing_fused()
        try:
            if path is None:
                target = save_target(self._saved.settings.save_path, self._root)
            else:
                target = save_target(path, self._root, "path")
            kind = {key: rules[key] for key in ("mode", "image_format") if key in rules}
            refuse_overwriting(
                [
                    (given, file)
                    for entry in self._saved.inputs.entries.values()
                    if (given := saved_path(entry)) is not None
                    for file in map_sources(given)
                ],
                [(f"the map {target}", file) for file in saved_files(target, **kind)],
            )
            written, _ = save_map(published[1], target, **rules)
        except (SlamFusionError, OSError) as error:
            text = f"not saved: {error}"
            self._base.diagnostics.add("save", Level.WARN, text, SHOWN_S)
            return False, text
        where = str(written.resolve())
        self._base.log.info(f"the fused map is saved as {where!r}")
        return True, where


def save_target(save_path: str, root: Path, name: str = "save_path") -> Path:
    """Return where a map is written, without an ending.

    Args:
        save_path: as the parameter says now, or a request; relative to the working folder.
        root: the folder that it must not leave, without links.
        name: of what gave it.

    Raises:
        SlamFusionError: it names no file, leaves ``root`` (also by a link), or its folder is not
            there.
    """
    given = Path(save_path)
    if given.name in {"", ".."} or "\0" in save_path:
        message = f"{name} {save_path!r} names no file; add a name"
        raise SlamFusionError(message)
    folder = Path(os.path.realpath(given.parent))
    if folder != root and root not in folder.parents:
        message = (
            f"{name} {save_path!r} leads out of {str(root)!r}, the folder that the node was "
            "started with; name a path in it, or start the node with another save_path"
        )
        raise SlamFusionError(message)
    if not folder.is_dir():
        message = f"{name} {save_path!r}: there is no folder {str(folder)!r}; make it first"
        raise SlamFusionError(message)
    return folder / given.name
