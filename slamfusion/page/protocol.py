"""What page and server say to each other: JSON texts, and tiles of maps as bytes.

Server to page, ``type`` of the JSON text:

- ``hello``: ``scene`` (of this server's life), ``may_command``, ``title``, ``is_live``.
- ``layer``: a map's lattice and place, see ``Layer``; one that was dropped has ``gone: true``.
- ``status``: inputs, votes, poses and figures, as they were given; ``stamp_s``.
- ``trail``: ``name`` and new ``points`` (x, y in the frame of the map of that name).
- ``event``: ``stamp_s``, ``level``, ``text``.
- ``end``: all of this batch was sent; ``seq`` of the newest thing in it.
- ``answer``: to a command, ``id``, ``success``, ``message``.

A tile is bytes: the header's length (uint16, little endian), the header as JSON (``layer``,
``row``, ``column``, ``stamp_s``), then the cells: one byte where all are alike, else TILE x TILE
bytes in zlib's format, row by row from the lowest. A cell is an int8 seen as uint8: 255 is -1.

Page to server: ``hello`` with ``token`` (may be empty), ``scene`` and ``seq`` of what it has; then
``seen`` with ``seq`` after each ``end``, before which nothing more is sent, so that a slow page
gets the newest state and never all that came between; and ``command`` with ``id`` and ``name``.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.errors import SlamFusionError
from slamfusion.jobs.documents import plain

__all__ = [
    "COMMANDS",
    "MESSAGE_BYTES",
    "TILE",
    "Command",
    "Hello",
    "PageMessageError",
    "Seen",
    "decode_tile",
    "encode_tile",
    "parse_message",
    "to_text",
]

# Cells along a tile's side.
TILE = 128
COMMANDS = ("save", "reset")
# A page says no more than this at once.
MESSAGE_BYTES = 4096
# Of 1 to 9; maps are mostly alike, and the fastest makes them nearly as small.
LEVEL = 1
HEADER = struct.Struct("<H")


class PageMessageError(SlamFusionError):
    """Something that no page of ours says."""


@dataclass(frozen=True)
class Hello:
    """The first message of a page.

    Attributes:
        token: what lets it command; empty for a page that only looks.
        scene, seq: what it has from a connection before; empty and 0 for nothing.
    """

    token: str
    scene: str
    seq: int


@dataclass(frozen=True)
class Seen:
    """The page has taken everything up to ``seq``."""

    seq: int


@dataclass(frozen=True)
class Command:
    """The page asks for something; ``id`` comes back with the answer."""

    id: int
    name: str


def parse_message(text: str) -> Hello | Seen | Command:
    """Return what a page says.

    Raises:
        PageMessageError: it is nothing of the protocol.
    """
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        message = "no JSON"
        raise PageMessageError(message) from None
    if not isinstance(found, dict):
        message = "no JSON object"
        raise PageMessageError(message)
    kind = found.get("type")
    if kind == "hello":
        return Hello(_text(found, "token"), _text(found, "scene"), _count(found, "seq"))
    if kind == "seen":
        return Seen(_count(found, "seq"))
    if kind == "command" and found.get("name") in COMMANDS:
        return Command(_count(found, "id"), _text(found, "name"))
    message = "an unknown message"
    raise PageMessageError(message)


def _text(found: Mapping[str, Any], key: str) -> str:
    value = found.get(key, "")
    if not isinstance(value, str):
        message = f"{key} is no text"
        raise PageMessageError(message)
    return value


def _count(found: Mapping[str, Any], key: str) -> int:
    value = found.get(key, 0)
    if type(value) is not int or not 0 <= value < 2**53:
        message = f"{key} is no count"
        raise PageMessageError(message)
    return value


def to_text(kind: str, content: Mapping[str, Any]) -> str:
    """Return a JSON text of the server; NaN and infinity become null."""
    return json.dumps(plain({"type": kind, **content}), allow_nan=False, separators=(",", ":"))


def encode_tile(
    layer: str, row: int, column: int, stamp_s: float, cells: npt.NDArray[np.int8]
) -> bytes:
    """Return a tile's bytes; see the module.

    Args:
        layer: name of the map.
        row, column: of the tile, from the lattice's anchor; may be negative.
        stamp_s: when it came, seconds since 1970.
        cells: (TILE, TILE) int8.
    """
    header = {"layer": layer, "row": row, "column": column, "stamp_s": round(stamp_s, 3)}
    head = json.dumps(header, separators=(",", ":")).encode()
    first = cells.flat[0]
    alike = bool((cells == first).all())
    body = bytes([int(first) & 0xFF]) if alike else zlib.compress(cells.tobytes(), LEVEL)
    return HEADER.pack(len(head)) + head + body


def decode_tile(data: bytes) -> tuple[dict[str, Any], npt.NDArray[np.int8]]:
    """Return a tile's header and cells, as the page reads them."""
    (length,) = HEADER.unpack_from(data)
    header = json.loads(data[HEADER.size : HEADER.size + length])
    body = data[HEADER.size + length :]
    raw = body * (TILE * TILE) if len(body) == 1 else zlib.decompress(body)
    return header, np.frombuffer(raw, dtype=np.int8).reshape(TILE, TILE)
