"""``FusionServices``: what the fusion node answers: its map, saved maps, a new frame."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from nav_msgs.srv import GetMap, LoadMap
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import Trigger

from slamfusion.grid import OccupancyGrid
from slamfusion.ros import messages
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.fused_output import MAP_TOPIC
from slamfusion.ros.input_entries import FILE_PREFIX
from slamfusion.ros.map_saver import SHOWN_S, MapSaver, Saved

try:
    # With nav2, in a sourced ROS.
    from nav2_msgs.srv import LoadMap as Nav2LoadMap
    from nav2_msgs.srv import SaveMap as Nav2SaveMap
except ImportError:
    Nav2LoadMap = Nav2SaveMap = None

SAVE_AS = "save_map_as"
TEXT, NUMBER = (str,), (float, int)
# What a request of ``save_map_as`` may say, as ``slamfusion.io.save_map`` calls it, and its types.
RULES: dict[str, tuple[str, tuple[type, ...]]] = {
    "path": ("path", TEXT),
    "format": ("image_format", TEXT),
    "mode": ("mode", TEXT),
    "free_thresh": ("free_thresh", NUMBER),
    "occupied_thresh": ("occupied_thresh", NUMBER),
}


class Served(Saved, Protocol):
    """What the services ask of the node."""

    def ask_reset(self) -> None:
        """Let a new fused frame begin, soon."""

    def load_input(self, entry: str) -> tuple[OccupancyGrid | None, str]:
        """Let a saved map be an input; return it, or why not."""


class FusionServices:
    """The services ``get_map``, ``save_map``, ``save_map_as``, ``load_map`` and ``reset``.

    Where nav2 is installed ``~/save_map`` and ``~/load_map`` have its types.

    Args:
        base: the node.
        served: the same, as what is served.
    """

    def __init__(self, base: NodeBase, served: Served) -> None:
        self._base = base
        self._served = served
        self._saver = MapSaver(base, served)
        services = [
            (GetMap, "get_map", self._get_map),
            (Trigger, "save_map", self._save_map),
            (SetParametersAtomically, SAVE_AS, self._save_map_as),
            (LoadMap, "load_map", self._load_map),
            (Trigger, "reset", self._reset),
        ]
        if Nav2SaveMap is not None:
            services.append((Nav2SaveMap, "~/save_map", self._save_for_nav2))
            services.append((Nav2LoadMap, "~/load_map", self._load_map))
        for kind, name, answer in services:
            base.node.create_service(kind, name, self._serve(answer))

    def carry_out(self, name: str) -> tuple[bool, str]:
        """Do what the service ``save`` or ``reset`` does, and return its answer."""
        answer = {"save": self._save_map, "reset": self._reset}[name]
        response = self._serve(answer)(None, Trigger.Response())
        return bool(response.success), str(response.message)

    def _serve(self, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service's callback that cannot bring the node down."""

        def callback(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except Exception as error:  # noqa: BLE001  (a node must outlive a request)
                self._base.log.error(traceback.format_exc())
                text = f"{type(error).__name__}: {error}"
                self._base.diagnostics.add("service", Level.ERROR, text, SHOWN_S)
                _fail(response, text)
                return response

        return callback

    def _get_map(self, _: Any, response: Any) -> Any:
        """Answer the last published map; without cells before the first."""
        published = self._served.published
        if published is None:
            response.map.header.frame_id = self._served.settings.fused_frame
        else:
            response.map = published[0]
        return response

    def _save_map(self, _: Any, response: Any) -> Any:
        """Write the last published map where ``save_path`` says."""
        response.success, response.message = self._saver.save()
        return response

    def _save_map_as(self, request: Any, response: Any) -> Any:
        """Write the last published map as the request says."""
        given = {item.name: parameter_value_to_python(item.value) for item in request.parameters}
        result = response.result
        # By its type: a truth value is an int, too, and no number.
        wrong = {n: v for n, v in given.items() if n not in RULES or type(v) not in RULES[n][1]}
        if wrong:
            wanted = "path, format and mode as texts, free_thresh and occupied_thresh as numbers"
            found = ", ".join(f"{name} = {value!r}" for name, value in wrong.items())
            result.successful, result.reason = False, f"not saved: wanted {wanted}, found {found}"
            return response
        rules = {RULES[name][0]: value for name, value in given.items()}
        result.successful, result.reason = self._saver.save(**rules)
        return response

    def _save_for_nav2(self, request: Any, response: Any) -> Any:
        """Write the last published map as nav2's map saver would; zeros and '' are defaults."""
        if not f"/{request.map_topic or MAP_TOPIC}".endswith(f"/{MAP_TOPIC}"):
            text = f"not saved: wanted the topic {MAP_TOPIC}, found {request.map_topic!r}"
            self._base.diagnostics.add("save", Level.WARN, text, SHOWN_S)
            response.result = False
            return response
        rules = {
            "image_format": request.image_format,
            "mode": request.map_mode,
            "free_thresh": request.free_thresh,
            "occupied_thresh": request.occupied_thresh,
        }
        given = {name: value for name, value in rules.items() if value}
        response.result, _ = self._saver.save(request.map_url or None, **given)
        return response

    def _load_map(self, request: Any, response: Any) -> Any:
        """Let a saved map be an input, and answer it."""
        path = str(request.map_url).strip().removeprefix("file://")
        grid, problem = self._served.load_input(f"{FILE_PREFIX}{path}")
        if grid is not None:
            response.result = LoadMap.Response.RESULT_SUCCESS
            stamp = self._base.node.get_clock().now().to_msg()
            response.map = messages.grid_to_message(grid, f"{grid.name}_map", stamp)
            return response
        response.result = LoadMap.Response.RESULT_INVALID_MAP_DATA
        if not path or not Path(path).exists():
            response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
        text = f"not loaded: {problem}"
        self._base.diagnostics.add("load", Level.WARN, text, SHOWN_S)
        return response

    def _reset(self, _: Any, response: Any) -> Any:
        """Let a new fused frame begin."""
        self._base.log.warning("reset was called: the newest maps begin a new fused frame")
        self._served.ask_reset()
        response.success = True
        response.message = "the newest maps begin a new fused frame"
        return response


def _fail(response: Any, text: str) -> None:
    """Let an answer of any of the services, nav2's too, be that of a failure."""
    if isinstance(response, SetParametersAtomically.Response):
        response.result.successful, response.result.reason = False, text
    elif isinstance(response, Trigger.Response):
        response.success, response.message = False, text
    elif hasattr(response, "RESULT_UNDEFINED_FAILURE"):
        response.result = response.RESULT_UNDEFINED_FAILURE
