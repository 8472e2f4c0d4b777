"""The messages of a scene to pages: JSON texts, and tiles of maps as bytes.

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

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.grid import UNKNOWN, OccupancyGrid
from slamfusion.json_values import plain
from slamfusion.vote.lattice import Lattice

# Cells along a tile's side.
TILE = 128
# How hard tiles are packed, of 1 to 9; maps are mostly alike, and this makes them nearly as small.
FASTEST = 1
HEADER = struct.Struct("<H")


def to_text(kind: str, content: Mapping[str, Any]) -> str:
    """Return a JSON text; NaN and infinity become null."""
    return json.dumps(plain({"type": kind, **content}), allow_nan=False, separators=(",", ":"))


def encode_tile(
    layer: str,
    row: int,
    column: int,
    stamp_s: float,
    cells: npt.NDArray[np.int8],
    *,
    level: int = FASTEST,
) -> bytes:
    """Return a tile's bytes; see the module.

    Args:
        layer: name of the map.
        row, column: of the tile, from the lattice's anchor; may be negative.
        stamp_s: when it came, seconds since 1970.
        cells: (TILE, TILE) int8.
        level: how hard it is packed, 1 to 9.
    """
    header = {"layer": layer, "row": row, "column": column, "stamp_s": round(stamp_s, 3)}
    head = json.dumps(header, separators=(",", ":")).encode()
    first = cells.flat[0]
    alike = bool((cells == first).all())
    body = bytes([int(first) & 0xFF]) if alike else zlib.compress(cells.tobytes(), level)
    return HEADER.pack(len(head)) + head + body


Place = tuple[int, int]


class TiledLayer:
    """Cuts each state of a map into tiles and finds those that differ from the last state.

    Tiles are counted from where the map first began, so that one that grows to the left or below
    sends no tile twice.

    Attributes:
        lattice: of the tiles; None before the first map.
        tiles: (TILE, TILE) int8 by (row, column) of the tile; those without a known cell are not
            in it.
    """

    def __init__(self) -> None:
        self.lattice: Lattice | None = None
        self.tiles: dict[Place, npt.NDArray[np.int8]] = {}

    def put(self, grid: OccupancyGrid) -> tuple[bool, list[Place]]:
        """Take a new state.

        Returns:
            Whether the lattice is another one, so that all that was sent before is void, and the
            places of the tiles that changed; those that hold nothing any more are not in ``tiles``.
        """
        offset = None if self.lattice is None else self.lattice.cell_of(grid)
        is_new = offset is None
        if offset is None:
            self.lattice, offset, self.tiles = Lattice(grid.resolution, grid.origin), (0, 0), {}
        found = _cut(grid.cells, offset)
        changed = [
            place
            for place, cells in found.items()
            if (old := self.tiles.get(place)) is None or not np.array_equal(old, cells)
        ]
        changed += [place for place in self.tiles if place not in found]
        self.tiles = found
        return is_new, changed


def _cut(cells: npt.NDArray[np.int8], offset: Place) -> dict[Place, npt.NDArray[np.int8]]:
    """Return the tiles of cells at an offset, but those without a known cell."""
    (row0, column0), (height, width) = offset, cells.shape
    first = row0 // TILE, column0 // TILE
    last = (row0 + height - 1) // TILE, (column0 + width - 1) // TILE
    whole = np.full(
        ((last[0] - first[0] + 1) * TILE, (last[1] - first[1] + 1) * TILE), UNKNOWN, dtype=np.int8
    )
    top, left = row0 - first[0] * TILE, column0 - first[1] * TILE
    whole[top : top + height, left : left + width] = cells
    rows, columns = whole.shape[0] // TILE, whole.shape[1] // TILE
    blocks = whole.reshape(rows, TILE, columns, TILE).swapaxes(1, 2)
    known = (blocks != UNKNOWN).any(axis=(2, 3))
    return {
        (first[0] + int(row), first[1] + int(column)): np.ascontiguousarray(blocks[row, column])
        for row, column in np.argwhere(known)
    }
