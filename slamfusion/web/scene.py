"""``Scene``: the newest state of all that a page shows, and the messages newer than a number.

``type`` of a JSON text:

- ``layer``: a map's lattice, place and colours, and whether it is shown at first.
- ``status``: inputs, votes, poses and figures, as they were given; ``stamp_s``.
- ``trail``: ``name`` and new ``points``: x, y in the frame of the map of that name, time in s.
- ``event``: ``stamp_s``, ``level``, ``text``.

A tile is bytes: the header's length (uint16, little endian), the header as JSON (``layer``,
``row``, ``column``, ``stamp_s``), then the cells: one byte where all are alike, else TILE x TILE
bytes in zlib's format, row by row from the lowest. A cell is an int8 seen as uint8: 255 is -1.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
import secrets
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from slamfusion.geometry import I8, Pose2
from slamfusion.grid import IDENTITY, UNKNOWN, CellBox, OccupancyGrid
from slamfusion.json_values import plain
from slamfusion.palette import AGREED_WALL_RGB, DISAGREEMENT_RGB, FREE_RGB, colours_of
from slamfusion.trajectory import Trajectory
from slamfusion.vote.lattice import Lattice

_LOG = logging.getLogger(__name__)

# An input's map, what it is compared with (the fused map, the true one), or the share of votes for
# the winner (0 to 100).
Kind = Literal["input", "fused", "agreement"]
Message = str | bytes
# Row and column of a tile, from the lattice's anchor; may be negative.
Place = tuple[int, int]
# Of a path: the number of the point, x and y in metres, and its time in seconds.
_Point = tuple[int, float, float, float]

# What the front end calls the maps that are no input's.
FUSED, AGREEMENT, TRUTH = "fused", "agreement", "truth"

# Cells along a tile's side.
TILE = 128
# How hard tiles are packed, of 1 to 9; maps are mostly alike, and this makes them nearly as small.
FASTEST = 1
HEADER = struct.Struct("<H")
EVENTS = 500
# Points of a path, each this far from the one before, metres: 20 km of driving.
POINTS, STEP_M = 200_000, 0.1


def layer_name(name: str) -> str:
    """Return the name of an input's layer, which is none of the fused map or the agreement."""
    return f"{name} (input)" if name in {FUSED, AGREEMENT} else name


def layer_status(
    name: str,
    reason: str = "",
    score: float | None = None,
    place: Pose2 | None = IDENTITY,
    *,
    votes: bool | None = None,
) -> dict[str, Any]:
    """Return what ``put_status`` takes of a layer; ``place``: its pose, None without one."""
    pose = None if place is None else [place.x, place.y, place.yaw_rad]
    return {"name": name, "votes": votes, "reason": reason, "score": score, "transform": pose}


def to_text(kind: str, content: Mapping[str, Any]) -> str:
    """Return a JSON text; NaN and infinity become null."""
    return json.dumps(plain({"type": kind, **content}), allow_nan=False, separators=(",", ":"))


def encode_tile(layer: str, place: Place, stamp_s: float, cells: I8, level: int = FASTEST) -> bytes:
    """Return the bytes of a tile, (TILE, TILE) int8; see the module."""
    row, column = place
    header = {"layer": layer, "row": row, "column": column, "stamp_s": round(stamp_s, 3)}
    head = json.dumps(header, separators=(",", ":")).encode()
    first = cells.flat[0]
    alike = bool((cells == first).all())
    body = bytes([int(first) & 0xFF]) if alike else zlib.compress(cells.tobytes(), level)
    return HEADER.pack(len(head)) + head + body


def _cut(cells: I8, offset: Place) -> dict[Place, I8]:
    """Return the tiles of cells at an offset, but those without a known cell."""
    box = CellBox(0, 0, *cells.shape).moved(*offset)
    first = box.row0 // TILE, box.col0 // TILE
    rows, columns = -(-box.row1 // TILE) - first[0], -(-box.col1 // TILE) - first[1]
    whole = CellBox(0, 0, rows * TILE, columns * TILE).moved(first[0] * TILE, first[1] * TILE)
    tiles = whole.cut(cells, box, UNKNOWN).reshape(rows, TILE, columns, TILE)
    blocks = tiles.swapaxes(1, 2)
    known = (blocks != UNKNOWN).any(axis=(2, 3))
    return {
        (first[0] + int(row), first[1] + int(column)): np.ascontiguousarray(blocks[row, column])
        for row, column in np.argwhere(known)
    }


@dataclass
class _Layer:
    """A map of a scene. Tiles are counted from its first anchor, so that growth resends none.

    Attributes:
        kind: see ``Scene.put_map``.
        lattice: of the tiles; None without a map.
        tiles: (TILE, TILE) int8 by place; those without a known cell are left out.
        epoch: the number of lattices that it had.
        seq: when its description changed last.
        sent: of every tile ever sent in this epoch, when it changed last and its bytes.
        size: height and width of the newest state, cells.
    """

    kind: Kind
    is_shown: bool
    lattice: Lattice | None = None
    tiles: dict[Place, I8] = field(default_factory=dict)
    epoch: int = 0
    seq: int = 0
    sent: dict[Place, tuple[int, bytes]] = field(default_factory=dict)
    size: tuple[int, int] = (0, 0)


class Scene:
    """The state that pages show. Any thread may put and ask.

    Every change gets a growing number, ``seq``. A page asks for what is newer than the number that
    it has, and gets each thing once, in its newest state. Maps are cut into tiles when a page asks.

    Args:
        is_live: whether more is to come.
        names: of layers, in the order of their colours; others follow.
        clock: seconds since 1970.
        level: compression of tiles, 1 to 9.

    Attributes:
        id: of this scene; the numbers of another one mean nothing here.
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
        self._clock = clock
        self._level = level
        self._colours = colours_of(names)
        self._lock = threading.Lock()
        # Held while maps are cut, before the other.
        self._cutting = threading.Lock()
        self._waiting: dict[str, tuple[OccupancyGrid, Kind, bool]] = {}
        self._seq = 0
        self._layers: dict[str, _Layer] = {}
        self._status: tuple[int, Mapping[str, Any]] | None = None
        self._votes: dict[str, bool] = {}
        self._events: deque[tuple[int, Mapping[str, Any]]] = deque(maxlen=EVENTS)
        self._trails: dict[str, deque[_Point]] = {}

    # -- what comes -------------------------------------------------------------------------------

    def put_map(self, name: str, grid: OccupancyGrid, kind: Kind, *, is_shown: bool = True) -> None:
        """Take the newest state of a map; its cells must stay. The agreement is hidden at first."""
        with self._lock:
            self._waiting[name] = grid, kind, is_shown
            if kind != "agreement":
                self._name([name])

    def remove(self, name: str) -> None:
        """Take a map away, and the path of that name."""
        with self._lock:
            self._votes.pop(name, None)
            self._trails.pop(name, None)
            self._waiting.pop(name, None)
            if (old := self._layers.get(name)) is not None:
                gone = _Layer(old.kind, old.is_shown, epoch=old.epoch, seq=self._next())
                self._layers[name] = gone

    def put_status(self, inputs: Sequence[Mapping[str, Any]], **figures: Any) -> None:
        """Take the state of the inputs; live, a gained or lost vote becomes an event.

        Args:
            inputs: of each its ``layer_status``; the transform is of its map frame in the fused
                one, x and y in metres and yaw in radians; no vote is an unknown one.
            figures: whatever else the page shows.
        """
        for item in inputs:
            if item["votes"] is None or not self.is_live:
                continue
            name, votes = item["name"], bool(item["votes"])
            if self._votes.get(name) != votes:
                verb = "votes" if votes else "does not vote"
                self.put_event("ok" if votes else "warn", f"{name} {verb}: {item['reason']}")
            self._votes[name] = votes
        with self._lock:
            self._name(item["name"] for item in inputs)
            status = {"inputs": list(inputs), **figures, "colours": self._colours}
            status["place_rgb"] = DISAGREEMENT_RGB
            self._status = self._next(), {**status, "stamp_s": self._clock()}

    def put_event(
        self, level: Literal["ok", "warn", "error"], text: str, stamp_s: float | None = None
    ) -> None:
        """Take something for the log of events; default: it happened now."""
        with self._lock:
            stamp_s = self._clock() if stamp_s is None else stamp_s
            event = {"stamp_s": stamp_s, "level": level, "text": text}
            self._events.append((self._next(), event))

    def put_point(self, name: str, x_m: float, y_m: float, stamp_s: float | None = None) -> None:
        """Take the next point of a path in its map's frame; steps below ``STEP_M`` are dropped."""
        with self._lock:
            trail = self._trails.setdefault(name, deque(maxlen=POINTS))
            if trail and math.dist(trail[-1][1:3], (x_m, y_m)) < STEP_M:
                return
            stamp_s = self._clock() if stamp_s is None else stamp_s
            trail.append((self._next(), x_m, y_m, stamp_s))

    def put_paths(self, paths: Mapping[str, Trajectory]) -> None:
        """Take whole paths by name; their times count from the first pose of all of them."""
        start_s = min((float(path.stamps_s[0]) for path in paths.values()), default=0.0)
        for name, path in paths.items():
            for stamp_s, (x_m, y_m, _) in zip(path.stamps_s, path.poses, strict=True):
                self.put_point(name, float(x_m), float(y_m), float(stamp_s) - start_s)
            with self._lock:
                trail, end_s = self._trails[name], float(stamp_s) - start_s
                if trail[-1][3] < end_s:  # the robot stood or turned until then
                    trail.append((self._next(), float(x_m), float(y_m), end_s))

    def _name(self, names: Iterable[str]) -> None:
        self._colours = colours_of([*self._colours, *names])

    def _next(self) -> int:
        self._seq += 1
        return self._seq

    # -- messages ---------------------------------------------------------------------------------

    def has_news(self, seq: int) -> bool:
        """Whether there may be something newer than a number."""
        return bool(self._waiting) or self._seq > seq

    def since(self, seq: int) -> tuple[list[Message], int]:
        """Return everything newer than a number, maps last, and the number of the newest."""
        with self._cutting:
            with self._lock:
                waiting = list(self._waiting)
            for name in waiting:
                try:
                    self._cut(name)
                except Exception:  # noqa: BLE001 - the page goes on
                    _LOG.exception("the map %r cannot be shown", name)
        with self._lock:
            texts: list[Message] = []
            if self._status is not None and self._status[0] > seq:
                texts.append(to_text("status", self._status[1]))
            texts += [to_text("event", event) for number, event in self._events if number > seq]
            for name, trail in self._trails.items():
                if points := _newer(trail, seq):
                    texts.append(to_text("trail", {"name": name, "points": points}))
            texts += [
                to_text("layer", {"name": name, **self._described(name, layer)})
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

    def _cut(self, name: str) -> None:
        """Cut a map that waits into tiles, and keep those that have changed."""
        with self._lock:
            if name not in self._waiting:  # it was taken away
                return
            grid, kind, is_shown = self._waiting.pop(name)
            layer = self._layers.setdefault(name, _Layer(kind, is_shown and kind != "agreement"))
            lattice, before = layer.lattice, layer.tiles
        offset = None if lattice is None else lattice.cell_of(grid)
        if offset is None:
            lattice, before = None, {}
        tiles = _cut(grid.cells, offset or (0, 0))
        changed = [
            place
            for place, cells in tiles.items()
            if (old := before.get(place)) is None or not np.array_equal(old, cells)
        ]
        changed += [place for place in before if place not in tiles]
        stamp_s, empty = self._clock(), np.full((TILE, TILE), UNKNOWN, dtype=np.int8)
        sent = {
            place: encode_tile(name, place, stamp_s, tiles.get(place, empty), self._level)
            for place in changed
        }
        with self._lock:
            if self._layers[name] is not layer:  # it was taken away in the meantime
                return
            if lattice is None:
                layer.lattice = Lattice(grid.resolution, grid.origin)
                layer.epoch += 1
                layer.sent.clear()
            if lattice is None or layer.size != grid.cells.shape:
                layer.seq = self._next()
            layer.tiles, layer.size = tiles, (grid.height, grid.width)
            layer.sent |= {place: (self._next(), data) for place, data in sent.items()}

    def _described(self, name: str, layer: _Layer) -> dict[str, Any]:
        """Return what a page needs to place and colour a map's tiles, or that it is gone."""
        if layer.lattice is None:
            return {"gone": True}
        anchor: Pose2 = layer.lattice.origin
        wall = DISAGREEMENT_RGB if layer.kind == "agreement" else self._colours[name]
        return {
            "kind": layer.kind,
            "is_shown": layer.is_shown,
            "epoch": layer.epoch,
            "resolution": layer.lattice.resolution,
            "anchor": [anchor.x, anchor.y, anchor.yaw_rad],
            "size": list(layer.size),
            "tile": TILE,
            "colours": {"wall": wall, "free": FREE_RGB, "agreed": AGREED_WALL_RGB},
        }


def _newer(trail: deque[_Point], seq: int) -> list[tuple[float, float, float]]:
    """Return x, y and time of the points of a path after a number, in order."""
    after = itertools.takewhile(lambda point: point[0] > seq, reversed(trail))
    return [(round(x_m, 3), round(y_m, 3), round(at_s, 1)) for _, x_m, y_m, at_s in after][::-1]
