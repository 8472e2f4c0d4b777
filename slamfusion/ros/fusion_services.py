"""``FusionServices``: the services of the fusion node."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nav_msgs.srv import GetMap, LoadMap
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import Trigger

from slamfusion.errors import SlamFusionError
from slamfusion.io.files import refuse_overwriting, user_path
from slamfusion.io.lines import saved_files
from slamfusion.io.map_server import map_sources, save_map
from slamfusion.io.trajectories import replace_tum
from slamfusion.ros import messages
from slamfusion.ros.fusion_inputs import saved_path
from slamfusion.ros.parameters import outcome

if TYPE_CHECKING:
    from slamfusion.ros.fusion_node import FusionNode

try:
    # With nav2, in a sourced ROS.
    from nav2_msgs.srv import LoadMap as Nav2LoadMap
    from nav2_msgs.srv import SaveMap as Nav2SaveMap
except ImportError:
    Nav2LoadMap = Nav2SaveMap = None

MAP_TOPIC, SAVE_AS = "fused/map", "save_map_as"
# Keys and types of a ``save_map_as`` request; ``save_map`` calls format image_format.
RULES = dict.fromkeys(("path", "format", "mode"), (str,)) | dict.fromkeys(
    ("free_thresh", "occupied_thresh"), (float, int)
)


class FusionServices:
    """The services ``get_map``, ``save_map``, ``save_map_as``, ``load_map`` and ``reset``.

    With nav2 ``~/save_map`` and ``~/load_map`` have its types. Maps are written only into the
    folder of the initial ``save_path``, or below it.
    """

    def __init__(self, node: FusionNode) -> None:
        self._node = node
        self._root = Path(os.path.realpath(user_path(node.settings.save_path).parent))
        services: list[tuple[Any, str, Callable[[Any, Any], str | None]]] = [
            (GetMap, "get_map", self._get_map),
            (Trigger, "save_map", lambda *_: self._save()),
            (SetParametersAtomically, SAVE_AS, self._save_map_as),
            (LoadMap, "load_map", self._load_map),
            (Trigger, "reset", self._reset),
        ]
        if Nav2SaveMap is not None:
            services.append((Nav2SaveMap, "~/save_map", self._save_for_nav2))
            services.append((Nav2LoadMap, "~/load_map", self._load_map))
        for kind, name, answer in services:
            node.node.create_service(kind, name, self._serve(answer))
        node.node.add_on_set_parameters_callback(self._check_path)
        checked = self._check_path([Parameter("save_path", value=node.settings.save_path)])
        if not checked.successful:
            node.log.warning(f"no map can be saved: {checked.reason}")

    def carry_out(self, name: str) -> tuple[bool, str]:
        """Execute ``save`` or ``reset``, and return the answer."""
        answer = {"save": lambda *_: self._save(), "reset": self._reset}[name]
        response = self._serve(answer)(None, Trigger.Response())
        return bool(response.success), str(response.message)

    def _serve(self, answer: Callable[[Any, Any], str | None]) -> Callable[[Any, Any], Any]:
        """Return a callback of a service; its text, or why it failed, is put into the response."""

        def callback(request: Any, response: Any) -> Any:
            try:
                _tell(response, answer(request, response), is_done=True)
            except (SlamFusionError, OSError) as error:
                refused = "not loaded" if answer == self._load_map else "not saved"
                self._node.diagnostics.note(refused, f"{refused}: {error}")
                _tell(response, f"{refused}: {error}", is_done=False)
            except Exception as error:  # noqa: BLE001  (a node must outlive a request)
                if hasattr(response, "RESULT_UNDEFINED_FAILURE"):
                    response.result = response.RESULT_UNDEFINED_FAILURE
                _tell(response, self._node.failed(request, error, "service"), is_done=False)
            return response

        return callback

    def _get_map(self, _: Any, response: Any) -> None:
        published = self._node.published
        if published is None:
            response.map.header.frame_id = self._node.settings.fused_frame
        else:
            response.map = published[0]

    def _save_map_as(self, request: Any, _: Any) -> str:
        given = {item.name: parameter_value_to_python(item.value) for item in request.parameters}
        # By type: a bool is an int, too.
        wrong = {name: v for name, v in given.items() if type(v) not in RULES.get(name, ())}
        if wrong:
            wanted = "path, format and mode as texts, free_thresh and occupied_thresh as numbers"
            found = ", ".join(f"{name} = {value!r}" for name, value in wrong.items())
            raise SlamFusionError(f"wanted {wanted}, found {found}")
        return self._save(**{"image_format" if n == "format" else n: v for n, v in given.items()})

    def _save_for_nav2(self, request: Any, response: Any) -> None:
        """Save the last published map as nav2 does; zeros and '' are defaults."""
        response.result = False
        if not f"/{request.map_topic or MAP_TOPIC}".endswith(f"/{MAP_TOPIC}"):
            raise SlamFusionError(f"wanted the topic {MAP_TOPIC}, found {request.map_topic!r}")
        rules = {
            "image_format": request.image_format,
            "mode": request.map_mode,
            "free_thresh": request.free_thresh,
            "occupied_thresh": request.occupied_thresh,
        }
        given = {name: value for name, value in rules.items() if value}
        self._save(request.map_url or None, **given)
        response.result = True

    def _load_map(self, request: Any, response: Any) -> None:
        path = str(request.map_url).strip().removeprefix("file://")
        response.result = LoadMap.Response.RESULT_INVALID_MAP_DATA
        if not path or not user_path(path).exists():
            response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
        grid = self._node.inputs.load(path)
        stamp = self._node.node.get_clock().now().to_msg()
        response.map = messages.grid_to_message(grid, f"{grid.name}_map", stamp)
        response.result = LoadMap.Response.RESULT_SUCCESS

    def _reset(self, _: Any, __: Any) -> str:
        self._node.log.warning("reset was called: the newest maps begin a new fused frame")
        self._node.ask_reset()
        return "the newest maps begin a new fused frame"

    def _save(self, path: str | None = None, **rules: Any) -> str:
        """Write the last published map by rules of ``save_map``; return the path of its YAML."""
        node = self._node
        if (published := node.published) is None:
            snapshot = node.session.snapshot
            is_reset = snapshot.sent_maps > 0
            why = "nothing is fused since the reset" if is_reset else snapshot.nothing_fused
            raise SlamFusionError(why)
        given = (node.settings.save_path, "save_path") if path is None else (path, "path")
        target = self._target(*given)
        kind = {key: rules[key] for key in ("mode", "image_format") if key in rules}
        refuse_overwriting(
            [
                (saved, file)
                for entry in node.inputs.entries.values()
                if (saved := saved_path(entry)) is not None
                for file in map_sources(saved)
            ],
            [(f"the map {target}", file) for file in saved_files(target, **kind)],
        )
        written, _ = save_map(published[1], target, **rules)
        solution = node.drive.locator.solution
        driven = None if solution is None else solution.path
        replace_tum(target.with_name(f"{target.name}.tum"), driven)
        where = str(written.resolve())
        node.log.info(f"the fused map is saved as {where!r}")
        node.diagnostics.clear("not saved")
        return where

    def _check_path(self, changes: Sequence[Any]) -> Any:
        """Refuse a new ``save_path`` to which no map can be saved."""
        paths = [
            own.value for own in changes if own.name == "save_path" and isinstance(own.value, str)
        ]
        return outcome(lambda: [self._target(path, "save_path") for path in paths])

    def _target(self, save_path: str, name: str) -> Path:
        """Return the path of a map to write, without an ending, in the folder or below it."""
        given = user_path(save_path)
        is_named = given.name not in {"", ".."} and save_path[-1] != "/" and "\0" not in save_path
        if not is_named or os.path.realpath(given) == str(self._root):
            raise SlamFusionError(f"{name} {save_path!r} names no file; add a name, such as map")
        folder = Path(os.path.realpath(given.parent))
        if folder != self._root and self._root not in folder.parents:
            raise SlamFusionError(
                f"{name} {save_path!r} leads out of {str(self._root)!r}, the folder that the node "
                "was started with; name a path in it, or start the node with another save_path"
            )
        if not folder.is_dir():
            message = f"{name} {save_path!r}: there is no folder {str(folder)!r}; make it first"
            raise SlamFusionError(message)
        return folder / given.name


def _tell(response: Any, text: str | None, *, is_done: bool) -> None:
    """Put a text into an answer that has one."""
    if isinstance(response, SetParametersAtomically.Response):
        response.result.successful, response.result.reason = is_done, text
    elif isinstance(response, Trigger.Response):
        response.success, response.message = is_done, text
