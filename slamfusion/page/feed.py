"""``Feed``: hands maps to a scene in a thread of its own, of each map only the newest."""

from __future__ import annotations

import logging
import threading

from slamfusion.grid import OccupancyGrid
from slamfusion.viewer.scene import Kind, Scene

_LOG = logging.getLogger(__name__)


class Feed:
    """Keeps whoever has a map from waiting: ``put`` returns at once, cutting it comes later.

    As many maps wait as there are names. While nobody looks they are not cut.

    Args:
        scene: what they are put into.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._changed = threading.Condition()
        # None: the map is to be taken away.
        self._waiting: dict[str, tuple[OccupancyGrid, Kind, bool] | None] = {}
        self._viewers = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="page feed", daemon=True)
        self._thread.start()

    def put(self, name: str, grid: OccupancyGrid, kind: Kind, *, is_shown: bool = True) -> None:
        """Let a map wait, in the place of an older one of that name; its cells must stay."""
        with self._changed:
            self._waiting[name] = grid, kind, is_shown
            self._changed.notify_all()

    def remove(self, name: str) -> None:
        """Let a map be taken away, also one that waits."""
        with self._changed:
            self._waiting[name] = None
            self._changed.notify_all()

    def count_viewers(self, number: int) -> None:
        """Take how many look."""
        with self._changed:
            self._viewers = number
            self._changed.notify_all()

    def close(self, timeout_s: float = 5.0) -> None:
        """End the thread; what waits is dropped."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or (self._waiting and self._viewers))
                if self._is_closed:
                    return
                # Those that have not changed for longest first.
                name = next(iter(self._waiting))
                waiting = self._waiting.pop(name)
            try:
                if waiting is None:
                    self._scene.remove(name)
                else:
                    grid, kind, is_shown = waiting
                    self._scene.put_map(name, grid, kind, is_shown=is_shown)
            except Exception:  # noqa: BLE001 - the page goes on; a map that cannot be shown is named
                _LOG.exception("the map %r cannot be shown", name)
