"""``Scene``: the newest state of all that is shown, and what of it is newer than a number."""

from __future__ import annotations

import itertools
import logging
import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, OccupancyGrid
from slamfusion.palette import AGREED_WALL_RGB, DISAGREEMENT_RGB, FREE_RGB, Rgb, colours_of
from slamfusion.trajectory import Trajectory
from slamfusion.viewer.messages import FASTEST, TILE, Place, TiledLayer, encode_tile, to_text
from slamfusion.vote.lattice import Lattice

_LOG = logging.getLogger(__name__)

# An input's map, what it is compared with (the fused map, the true one), or the share of votes for
# the winner (0 to 100).
Kind = Literal["input", "fused", "agreement"]
Message = str | bytes
# Of a path: the number of the point, x and y in metres, and its time in seconds.
_Point = tuple[int, float, float, float]

# What the front end calls the maps that are no input's.
FUSED, AGREEMENT, TRUTH = "fused", "agreement", "truth"

EVENTS = 500
# Points of a path, each this far from the one before, metres: 20 km of driving.
POINTS, STEP_M = 200_000, 0.1


def layer_name(name: str) -> str:
    """Return the name of an input's layer, which is none of the fused map or the agreement."""
    return f"{name} (input)" if name in {FUSED, AGREEMENT} else name


def unlaid(name: str, reason: str = "") -> dict[str, Any]:
    """Return what ``put_status`` takes of a map without a vote, in its own frame.

    Args:
        name: of its layer.
        reason: shown with it.
    """
    place = [0.0, 0.0, 0.0]
    return {"name": name, "votes": None, "reason": reason, "score": None, "transform": place}


@dataclass
class _Layer:
    """A map that was put.

    Attributes:
        kind, epoch: see ``Scene``; the epoch counts the lattices that it had.
        is_shown: whether one sees it at first.
        tiled: its tiles.
        seq: when its description changed last.
        sent: of every tile ever sent in this epoch, when it changed last and its bytes.
        size: height and width of the newest state, cells.
        is_gone: whether it was taken away; it may come again.
    """

    kind: Kind
    is_shown: bool
    tiled: TiledLayer = field(default_factory=TiledLayer)
    epoch: int = 0
    seq: int = 0
    sent: dict[Place, tuple[int, bytes]] = field(default_factory=dict)
    size: tuple[int, int] = (0, 0)
    is_gone: bool = False


class Scene:
    """What pages are told. Any thread may put and ask; maps come and go in one thread at a time.

    Everything that is put gets a number, ``seq``, that only grows. A page that has everything up to
    a number is told what is newer, each thing once and in its newest state, however much came in
    between.

    Args:
        title: of the page.
        is_live: whether more is to come.
        names: of layers, in the order in which they have their colours; others come after them.
        clock: seconds since 1970.
        level: how hard tiles are packed, 1 to 9.

    Attributes:
        id: of this scene's life; the numbers of another one mean nothing here.
        title, is_live: as given.
        on_change: called, in whatever thread, after something was put.
    """

    def __init__(
        self,
        title: str,
        *,
        is_live: bool,
        names: Sequence[str] = (),
        clock: Callable[[], float] = time.time,
        level: int = FASTEST,
    ) -> None:
        self.id = secrets.token_hex(8)
        self.title = title
        self.is_live = is_live
        self.on_change: Callable[[], None] = lambda: None
        self._clock = clock
        self._level = level
        self._colours = colours_of(names)
        self._lock = threading.Lock()
        self._seq = 0
        self._layers: dict[str, _Layer] = {}
        self._status: tuple[int, Mapping[str, Any]] | None = None
        self._votes: dict[str, tuple[bool, str]] = {}
        self._events: deque[tuple[int, Mapping[str, Any]]] = deque(maxlen=EVENTS)
        self._trails: dict[str, deque[_Point]] = {}

    # -- what comes -------------------------------------------------------------------------------

    def put_map(self, name: str, grid: OccupancyGrid, kind: Kind, *, is_shown: bool = True) -> int:
        """Take the newest state of a map, and return how many tiles of it have changed.

        Args:
            name: of the map.
            grid: its cells; they must stay.
            kind: what it is.
            is_shown: whether one sees it at first; the agreement never is.
        """
        layer = self._layers.get(name)
        if layer is None:
            layer = _Layer(kind, is_shown and kind != "agreement")
        is_new, changed = layer.tiled.put(grid)
        stamp_s = self._clock()
        empty = np.full((TILE, TILE), UNKNOWN, dtype=np.int8)
        sent = {
            place: encode_tile(
                name, *place, stamp_s, layer.tiled.tiles.get(place, empty), level=self._level
            )
            for place in changed
        }
        with self._lock:
            if kind != "agreement":
                self._name([name])
            if is_new:
                layer.epoch += 1
                layer.sent.clear()
            if is_new or layer.size != grid.cells.shape:
                layer.seq = self._next()
            layer.size, layer.is_gone = (grid.height, grid.width), False
            layer.sent |= {place: (self._next(), data) for place, data in sent.items()}
            self._layers[name] = layer
        if is_new or changed:
            self.on_change()
        return len(changed)

    def remove(self, name: str) -> None:
        """Take a map away, and the path of that name."""
        with self._lock:
            self._votes.pop(name, None)
            self._trails.pop(name, None)
            layer = self._layers.get(name)
            if layer is None:
                return
            layer.tiled, layer.is_gone = TiledLayer(), True
            layer.sent.clear()
            layer.seq = self._next()
        self.on_change()

    def put_status(self, inputs: Sequence[Mapping[str, Any]], **figures: Any) -> None:
        """Take how the inputs are; live, an input that got or lost its vote becomes an event.

        Args:
            inputs: of each ``name``, ``votes`` (None: it was not asked), ``reason``, ``transform``
                (x, y in metres and yaw in radians of its map frame in the fused one; None
                without), ``score``.
            figures: whatever else the page shows.
        """
        for item in inputs:
            if item["votes"] is None or not self.is_live:
                continue
            name, now = item["name"], (bool(item["votes"]), str(item["reason"]))
            before = self._votes.get(name)
            self._votes[name] = now
            if before is None or before[0] != now[0]:
                verb = "votes" if now[0] else "does not vote"
                self.put_event("ok" if now[0] else "warn", f"{name} {verb}: {now[1]}")
        with self._lock:
            self._name(item["name"] for item in inputs)
            status = {"inputs": list(inputs), **figures, "colours": self._colours}
            status["place_rgb"] = DISAGREEMENT_RGB
            self._status = self._next(), {**status, "stamp_s": self._clock()}
        self.on_change()

    def put_event(
        self, level: Literal["ok", "warn", "error"], text: str, stamp_s: float | None = None
    ) -> None:
        """Take something for the log of events; default: it happened now."""
        with self._lock:
            stamp_s = self._clock() if stamp_s is None else stamp_s
            event = {"stamp_s": stamp_s, "level": level, "text": text}
            self._events.append((self._next(), event))
        self.on_change()

    def put_point(self, name: str, x_m: float, y_m: float, stamp_s: float | None = None) -> None:
        """Take the next point of a path, in the frame of the map of that name; default time: now.

        A step below ``STEP_M`` is left out.
        """
        with self._lock:
            trail = self._trails.setdefault(name, deque(maxlen=POINTS))
            if trail and math.dist(trail[-1][1:3], (x_m, y_m)) < STEP_M:
                return
            stamp_s = self._clock() if stamp_s is None else stamp_s
            trail.append((self._next(), x_m, y_m, stamp_s))
        self.on_change()

    def put_path(self, name: str, path: Trajectory, start_s: float | None = None) -> None:
        """Take a whole path; its times count from ``start_s``, default its first pose."""
        start_s = float(path.stamps_s[0]) if start_s is None else start_s
        for stamp_s, (x_m, y_m, _) in zip(path.stamps_s, path.poses, strict=True):
            self.put_point(name, float(x_m), float(y_m), float(stamp_s) - start_s)

    def _name(self, names: Iterable[str]) -> None:
        self._colours = colours_of([*self._colours, *names])

    def _next(self) -> int:
        self._seq += 1
        return self._seq

    # -- messages ---------------------------------------------------------------------------------

    def since(self, seq: int) -> tuple[list[Message], int]:
        """Return everything newer than a number, maps last, and the number of the newest."""
        with self._lock:
            texts: list[Message] = []
            if self._status is not None and self._status[0] > seq:
                texts.append(to_text("status", self._status[1]))
            texts += [to_text("event", event) for number, event in self._events if number > seq]
            for name, trail in self._trails.items():
                if points := _newer(trail, seq):
                    texts.append(to_text("trail", {"name": name, "points": points}))
            texts += [
                to_text("layer", _described(name, layer, self._colours))
                for name, layer in self._layers.items()
                if layer.seq > seq
            ]
            tiles = sorted(
                (number, data)
                for layer in self._layers.values()
                for number, data in layer.sent.values()
                if number > seq
            )
            return [*texts, *(data for _, data in tiles)], self._seq


def _newer(trail: deque[_Point], seq: int) -> list[tuple[float, float, float]]:
    """Return x, y and time of the points of a path after a number, in order."""
    after = itertools.takewhile(lambda point: point[0] > seq, reversed(trail))
    return [(round(x_m, 3), round(y_m, 3), round(at_s, 1)) for _, x_m, y_m, at_s in after][::-1]


def _described(name: str, layer: _Layer, colours: Mapping[str, Rgb]) -> dict[str, Any]:
    """Return what a page needs to place and colour a map's tiles, or that it is gone."""
    if layer.is_gone:
        return {"name": name, "gone": True}
    lattice = layer.tiled.lattice or Lattice(1.0, Pose2())
    return {
        "name": name,
        "kind": layer.kind,
        "is_shown": layer.is_shown,
        "epoch": layer.epoch,
        "resolution": lattice.resolution,
        "anchor": [lattice.origin.x, lattice.origin.y, lattice.origin.yaw_rad],
        "size": list(layer.size),
        "tile": TILE,
        "colours": {
            "wall": DISAGREEMENT_RGB if layer.kind == "agreement" else colours[name],
            "free": FREE_RGB,
            "agreed": AGREED_WALL_RGB,
        },
    }


class Feed:
    """Hands maps to a scene in a thread of its own, of each map only the newest.

    Whoever has a map does not wait: ``put`` returns at once, cutting it comes later.

    As many maps wait as there are names. Without a viewer they are not cut.

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
