"""What pages are told of a scene: JSON texts, and tiles of maps as bytes.

``type`` of a JSON text:

- ``layer``: a map's lattice, place and colours, and whether it is shown at first.
- ``status``: inputs, votes, poses and figures, as they were given; ``stamp_s``.
- ``trail``: ``name`` and new ``points`` (x, y in the frame of the map of that name).
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

from slamfusion.json_values import plain

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


def decode_tile(data: bytes) -> tuple[dict[str, Any], npt.NDArray[np.int8]]:
    """Return a tile's header and cells, as the page reads them."""
    (length,) = HEADER.unpack_from(data)
    header = json.loads(data[HEADER.size : HEADER.size + length])
    body = data[HEADER.size + length :]
    raw = body * (TILE * TILE) if len(body) == 1 else zlib.decompress(body)
    return header, np.frombuffer(raw, dtype=np.int8).reshape(TILE, TILE)
