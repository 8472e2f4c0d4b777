"""``LivePage``: what a fusion node hears and makes, on the page in the browser."""

from __future__ import annotations

import os
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future

from slamfusion.config import FusionNodeConfig
from slamfusion.errors import ConfigError
from slamfusion.fusion.live.session import FusedMap, FusionState
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.ros.base import Level, NodeBase, Status, shown
from slamfusion.ros.fusion_inputs import PREFIX
from slamfusion.ros.input_health import MapSource
from slamfusion.web.scene import AGREEMENT, FUSED, Scene, layer_name

LEVELS = {Level.OK: "good", Level.WARN: "warn", Level.ERROR: "bad", Level.STALE: "warn"}
# Holds the token of the page where that is to outlive the node.
PAGE_TOKEN = "SLAMFUSION_PAGE_TOKEN"  # noqa: S105 - its name
TOKEN = re.compile(r"[A-Za-z0-9_-]{24,}")
# Commands that wait; more are refused.
WAITING = 8
ENDS = "the node ends"


class LivePage:
    """Hands a page's server what the node has, and the node what pages ask for.

    Nothing here waits: maps are cut into tiles in a thread of the server, and commands wait until
    ``look`` is called.

    Args:
        command: carries out ``save`` or ``reset`` in the node's own thread.

    Raises:
        ConfigError: it cannot listen there, or the extra ``page`` is not installed.
    """

    def __init__(
        self, base: NodeBase, settings: FusionNodeConfig, command: Callable[[str], tuple[bool, str]]
    ) -> None:
        # Nobody else needs what it stands on.
        try:
            from slamfusion.web.server import PageServer  # noqa: PLC0415
        except ImportError as error:
            raise ConfigError(str(error)) from error

        self._command = command
        self._lock = threading.Lock()
        self._asked: deque[tuple[str, Future[tuple[bool, str]]]] = deque()
        self._is_closed = False
        # Whose maps were shown.
        self._inputs: set[str] = set()
        self._scene = Scene(f"SLAMfusion: {base.name}", is_live=True)
        token = os.environ.get(PAGE_TOKEN, "")
        if token and not TOKEN.fullmatch(token):
            raise ConfigError(f"{PAGE_TOKEN}: wanted 24 or more of A-Z, a-z, 0-9, - and _")
        self._server = PageServer(
            self._scene,
            host=settings.page_host,
            port=settings.page_port,
            command=self._ask,
            token=token,
        )
        base.log.info(f"the live page: {self._server.url}")

    # -- in the worker's thread -------------------------------------------------------------------

    def put_input(self, name: str, grid: OccupancyGrid) -> None:
        """Show the newest map of an input."""
        self._inputs.add(name)
        self._server.feed.put(layer_name(name), grid, "input")

    def put_problem(self, name: str, problem: str) -> None:
        """Say that a map of an input cannot be read."""
        self._scene.put_event("warn", f"a map of {name}: {problem}")

    def put_fused(self, fused: FusedMap) -> None:
        """Show a fused map that was published, and where its voters agree."""
        self._server.feed.put(FUSED, fused.grid, "fused")
        self._server.feed.put(AGREEMENT, fused.agreement, "agreement")

    # -- in the node's thread ---------------------------------------------------------------------

    def look(self) -> None:
        """Carry out what pages asked for."""
        with self._lock:
            asked = list(self._asked)
            self._asked.clear()
        for name, future in asked:
            answer = self._command(name)
            self._scene.put_event("ok" if answer[0] else "error", f"{name}: {answer[1]}")
            future.set_result(answer)

    def put_pose(self, name: str, pose: Pose2) -> None:
        """Let the path of an input go on."""
        self._scene.put_point(layer_name(name), pose.x, pose.y)

    def show(
        self, lines: Sequence[Status], state: FusionState, sources: Iterable[MapSource]
    ) -> None:
        """Show how the inputs are, and no more the maps of those that were removed.

        Args:
            lines: of the diagnostics, the fusion's first.
            state: after the last fusion.
            sources: of the inputs, whose poses are drawn.
        """
        fusion, *others = lines
        names = [line.name.removeprefix(PREFIX) for line in others]
        for name in self._inputs.difference(names):
            self._inputs.discard(name)
            self._server.feed.remove(layer_name(name))
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
        """End the server; who still waits for a command is told."""
        with self._lock:
            self._is_closed = True
            waiting = [future for _, future in self._asked]
        for future in waiting:
            future.set_result((False, ENDS))
        self._server.close()

    # -- in the server's threads ------------------------------------------------------------------

    def _ask(self, name: str) -> tuple[bool, str]:
        """Let a command wait for the node's thread, and return its outcome."""
        future: Future[tuple[bool, str]] = Future()
        with self._lock:
            if self._is_closed:
                return False, ENDS
            if len(self._asked) >= WAITING:
                return False, "too much is asked at once"
            self._asked.append((name, future))
        return future.result()


def _shown(name: str, line: Status, state: FusionState) -> dict[str, object]:
    """Return an input as the page shows it."""
    record = state.inputs.get(name)
    transform = None if record is None else record.transform
    return {
        "name": layer_name(name),
        "votes": record is not None and record.accepted,
        "reason": line.message,
        "score": None if record is None else round(record.score, 4),
        "transform": None if transform is None else [transform.x, transform.y, transform.yaw_rad],
    }
