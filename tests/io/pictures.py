"""Pictures drawn byte by byte, so that the tests do not lean on the code they test."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

YAML = """\
image: {image}
resolution: 0.05
origin: [1.0, 2.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def pgm(rows: Sequence[Sequence[int]], maxval: int = 255, *, plain: bool = False) -> bytes:
    """Return a PGM of the given rows, top first."""
    header = f"{'P2' if plain else 'P5'}\n# drawn\n{len(rows[0])} {len(rows)}\n{maxval}\n".encode()
    if plain:
        return header + b"\n".join(" ".join(map(str, row)).encode() for row in rows) + b"\n"
    size = ">B" if maxval < 256 else ">H"
    return header + b"".join(struct.pack(size, value) for row in rows for value in row)


def chunk(name: bytes, data: bytes) -> bytes:
    """Return one PNG chunk with its checksum."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(
    rows: Sequence[bytes],
    width: int,
    depth: int = 8,
    colour: int = 0,
    extra: bytes = b"",
    height: int | None = None,
) -> bytes:
    """Return a PNG whose rows are given as packed bytes; ``extra`` chunks precede the pixels.

    The header names ``height`` rows; default: as many as there are.
    """
    rows_named = len(rows) if height is None else height
    header = struct.pack(">IIBBBBB", width, rows_named, depth, colour, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\x00" + row for row in rows))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + extra
        + chunk(b"IDAT", pixels)
        + chunk(b"IEND", b"")
    )


def bmp24(rows: Sequence[Sequence[int]]) -> bytes:
    """Return a 24-bit BMP of grey rows, top first."""
    width, height = len(rows[0]), len(rows)
    padding = b"\x00" * (-3 * width % 4)
    data = b"".join(b"".join(bytes([v, v, v]) for v in row) + padding for row in reversed(rows))
    header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, len(data), 0, 0, 0, 0)
    return struct.pack("<2sIHHI", b"BM", 54 + len(data), 0, 0, 54) + header + data


def write_map(
    folder: Path, picture: bytes, picture_name: str = "map.pgm", /, **changes: str
) -> Path:
    """Write ``map.yaml`` and its picture; a change replaces, or with "" removes, a key's line."""
    (folder / picture_name).write_bytes(picture)
    lines = {line.split(":")[0]: line for line in YAML.format(image=picture_name).splitlines()}
    for key, value in changes.items():
        lines[key] = f"{key}: {value}"
        if value == "":
            del lines[key]
    path = folder / "map.yaml"
    path.write_text("\n".join(lines.values()) + "\n")
    return path
