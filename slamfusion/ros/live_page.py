"""``LivePage``: a fusion node's maps and status on the page in the browser."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Iterable, Sequence

from slamfusion.config import FusionNodeConfig
from slamfusion.errors import ConfigError
from slamfusion.fusion.live.session import FusedMap, FusionState
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.ros.base import Level, NodeBase, Status, shown
from slamfusion.ros.fusion_inputs import PREFIX
from slamfusion.ros.input_health import MapSource
from slamfusion.web.scene import AGREEMENT, FUSED, Scene, layer_name, layer_status

LEVELS = {Level.OK: "good", Level.WARN: "warn", Level.ERROR: "bad", Level.STALE: "warn"}
# A token for the page that outlives the node.
PAGE_TOKEN = "SLAMFUSION_PAGE_TOKEN"  # noqa: S105 - its name
TOKEN = re.compile(r"[A-Za-z0-9_-]{24,}")


class LivePage:
    """Passes a node's data to the page's server, and the page's requests to the node.

    Nothing here blocks: a thread of the server cuts maps into tiles, and another one calls
    ``command`` with ``save`` or ``reset``.

    Raises:
        SlamFusionError: it cannot listen there, or the extra ``page`` is not installed.
    """

    def __init__(
        self, base: NodeBase, settings: FusionNodeConfig, command: Callable[[str], tuple[bool, str]]
    ) -> None:
        from slamfusion.web.server import PageServer  # noqa: PLC0415  (an extra)

        self._command = command
        self._lock = threading.Lock()
        # Inputs whose maps were shown.
        self._inputs: set[str] = set()
        self._scene = Scene(f"SLAMfusion: {base.name}", is_live=True)
        token = os.environ.get(PAGE_TOKEN, "")
        if token and not TOKEN.fullmatch(token):
            raise ConfigError(f"{PAGE_TOKEN}: wanted 24 or more of A-Z, a-z, 0-9, - and _")
        self._server = PageServer(
            self._scene,
            host=settings.page_host,
            port=settings.page_port,
            command=self._obey,
            token=token,
        )
        base.log.info(f"the live page: {self._server.url}")

    # -- in the worker's thread -------------------------------------------------------------------

    def put_input(self, name: str, grid: OccupancyGrid) -> None:
        """Show the newest map of an input."""
        self._inputs.add(name)
        self._scene.put_map(layer_name(name), grid, "input")

    def put_fused(self, fused: FusedMap) -> None:
        """Show a published fused map and its agreement."""
        self._scene.put_map(FUSED, fused.grid, "fused")
        self._scene.put_map(AGREEMENT, fused.agreement, "agreement")

    # -- in the node's thread ---------------------------------------------------------------------

    def put_pose(self, name: str, pose: Pose2) -> None:
        """Add a point to the path of an input."""
        self._scene.put_point(layer_name(name), pose.x, pose.y)

    def show(
        self, lines: Sequence[Status], state: FusionState, sources: Iterable[MapSource]
    ) -> None:
        """Show the diagnostics, the fusion's line first, and the poses of the inputs."""
        fusion, *others = lines
        names = [line.name.removeprefix(PREFIX) for line in others]
        for name in self._inputs.difference(names):
            self._inputs.discard(name)
            self._scene.remove(layer_name(name))
            self._scene.put_event("warn", f"{name} is removed from the inputs")
        poses = []
        for source in sources:
            transform = state.transform(source.name)
            if transform is not None and source.pose is not None:
                pose = transform.compose(source.pose.pose)
                place = [pose.x, pose.y, pose.yaw_rad]
                poses.append({"name": layer_name(source.name), "pose": place})
        self._scene.put_status(
            [_shown(name, line, state) for name, line in zip(names, others, strict=True)],
            poses=poses,
            headline=fusion.message,
            level=LEVELS[fusion.level],
            figures={name: shown(value) for name, value in fusion.values.items()},
        )

    def close(self) -> None:
        """End the server."""
        self._server.close()

    # -- in the server's threads ------------------------------------------------------------------

    def _obey(self, name: str) -> tuple[bool, str]:
        """Execute the commands of pages one at a time."""
        with self._lock:
            is_done, text = self._command(name)
        self._scene.put_event("ok" if is_done else "error", f"{name}: {text}")
        return is_done, text


def _shown(name: str, line: Status, state: FusionState) -> dict[str, object]:
    told = layer_name(name), line.message
    if (record := state.inputs.get(name)) is None:
        return layer_status(*told, votes=False, place=None)
    score = round(record.fit.score, 4)
    return layer_status(*told, score, record.transform, votes=record.accepted)
