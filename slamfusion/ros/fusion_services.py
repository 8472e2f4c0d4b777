"""``FusionServices``: what the fusion node answers: its map, a saved map, a new frame."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from std_srvs.srv import Trigger

from slamfusion import grid as grids
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import SlamFusionError
from slamfusion.io.map_server import save_map
from slamfusion.ros.base import Level, NodeBase

__all__ = ["FusionServices", "Served", "save_target"]

SHOWN_S = 10.0


class Served(Protocol):
    """What the services ask of the node.

    Attributes:
        settings: of now.
        published: the last published map as message and as grid; None before the first.
    """

    settings: FusionNodeConfig

    @property
    def published(self) -> tuple[OccupancyGrid, grids.OccupancyGrid] | None:
        """The last published map."""

    def nothing_fused(self) -> str:
        """Say why there is no map."""

    def ask_reset(self) -> None:
        """Let a new fused frame begin, soon."""


class FusionServices:
    """The services ``get_map``, ``save_map`` and ``reset``.

    ``save_map`` writes into the folder of the ``save_path`` that the node was started with, or into
    one below it that is there; what the parameter is set to later leads nowhere else.

    Args:
        base: the node.
        served: the same, as what is served.
    """

    def __init__(self, base: NodeBase, served: Served) -> None:
        self._base = base
        self._served = served
        self._root = Path(os.path.realpath(Path(served.settings.save_path).parent))
        node = base.node
        node.create_service(GetMap, "get_map", self._serve(self._get_map))
        node.create_service(Trigger, "save_map", self._serve(self._save_map))
        node.create_service(Trigger, "reset", self._serve(self._reset))

    def carry_out(self, name: str) -> tuple[bool, str]:
        """Do what the service ``save`` or ``reset`` does, and return its answer."""
        answer = {"save": self._save_map, "reset": self._reset}[name]
        response = self._serve(answer)(None, Trigger.Response())
        return bool(response.success), str(response.message)

    def _serve(self, answer: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service's callback that cannot bring the node down."""

        def callback(_: Any, response: Any) -> Any:
            try:
                return answer(response)
            except Exception as error:  # noqa: BLE001  (a node must outlive a request)
                self._base.log.error(traceback.format_exc())
                text = f"{type(error).__name__}: {error}"
                self._base.diagnostics.add("service", Level.ERROR, text, SHOWN_S)
                if hasattr(response, "success"):
                    response.success, response.message = False, text
                return response

        return callback

    def _get_map(self, response: Any) -> Any:
        """Answer the last published map; without cells before the first."""
        published = self._served.published
        if published is None:
            response.map.header.frame_id = self._served.settings.fused_frame
        else:
            response.map = published[0]
        return response

    def _save_map(self, response: Any) -> Any:
        """Write the last published map."""
        published = self._served.published
        if published is None:
            response.success, response.message = False, self._served.nothing_fused()
            return response
        try:
            target = save_target(self._served.settings.save_path, self._root)
            path, _ = save_map(published[1], target)
        except (SlamFusionError, OSError) as error:
            response.success, response.message = False, f"not saved: {error}"
            self._base.diagnostics.add("save", Level.WARN, response.message, SHOWN_S)
            return response
        response.success, response.message = True, str(path.resolve())
        self._base.log.info(f"the fused map is saved as {response.message!r}")
        return response

    def _reset(self, response: Any) -> Any:
        """Let a new fused frame begin."""
        self._base.log.warning("reset was called: the newest maps begin a new fused frame")
        self._served.ask_reset()
        response.success = True
        response.message = "the newest maps begin a new fused frame"
        return response


def save_target(save_path: str, root: Path) -> Path:
    """Return where a map is written, without an ending.

    Args:
        save_path: as the parameter says now; relative to the working folder.
        root: the folder that it must not leave, without links.

    Raises:
        SlamFusionError: it names no file, leaves ``root`` (also by a link), or its folder is not
            there.
    """
    given = Path(save_path)
    if given.name in {"", ".."} or "\0" in save_path:
        message = f"save_path {save_path!r} names no file; add a name"
        raise SlamFusionError(message)
    folder = Path(os.path.realpath(given.parent))
    if folder != root and root not in folder.parents:
        message = (
            f"save_path {save_path!r} leads out of {str(root)!r}, the folder that the node was "
            "started with; name a path in it, or start the node with another save_path"
        )
        raise SlamFusionError(message)
    if not folder.is_dir():
        message = f"save_path {save_path!r}: there is no folder {str(folder)!r}; make it first"
        raise SlamFusionError(message)
    return folder / given.name
