"""PNG pictures, checked and bared before libpng sees them: it prints lines of its own."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamfusion.errors import MapFileError

__all__ = ["PNG_MAGIC", "checked_png"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

# Without these libpng draws the same pixels.
_NEEDED = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
# By colour type: channels, and the depths there are.
_COLOURS = {0: (1, (1, 2, 4, 8, 16)), 2: (3, (8, 16)), 3: (1, (1, 2, 4, 8)), 4: (2, (8, 16))}
_COLOURS[6] = (4, (8, 16))
# Of an interlaced picture's seven parts: first column and row, and the steps between them.
_PASSES = (
    (0, 0, 8, 8),
    (4, 0, 8, 8),
    (0, 4, 4, 8),
    (2, 0, 4, 4),
    (0, 2, 2, 4),
    (1, 0, 2, 2),
    (0, 1, 1, 2),
)
_FILTERS = 5
_PART_BYTES = 1 << 22
_END = bytes(4) + b"IEND" + zlib.crc32(b"IEND").to_bytes(4, "big")


def checked_png(path: Path, data: bytearray) -> tuple[bytearray, int | None]:
    """Return a PNG with only the chunks that its pixels need, and the transparent grey if named.

    Args:
        path: named in messages.
        data: the file.

    Raises:
        MapFileError: a chunk is missing, cut short or damaged, or the pixels do not unpack.
    """
    bare = bytearray(PNG_MAGIC)
    pixels: list[memoryview] = []
    transparent = None
    palette = 0
    depth, colour = data[24], data[25]
    for name, content, whole in _chunks(path, data):
        if name not in _NEEDED or (name == b"IHDR" and len(bare) > len(PNG_MAGIC)):
            continue
        if name == b"IDAT":
            pixels.append(content)
        elif name == b"PLTE":
            palette = len(content) // 3
            if len(content) % 3 or not 0 < palette <= 256 or colour in {0, 4}:
                raise _damaged(path, "its palette is none")
        elif name == b"tRNS":
            wanted = {0: (2,), 2: (6,), 3: range(1, palette + 1)}.get(colour, ())
            if len(content) not in wanted:
                continue
            if colour == 0:
                (transparent,) = struct.unpack(">H", content)
                # OpenCV stretches shallow greys to 0..255.
                transparent = transparent * 255 // (2**depth - 1) if depth < 8 else transparent
        bare += _END if name == b"IEND" else whole
    if colour == 3 and palette == 0:
        raise _damaged(path, "its palette is missing")
    _check_pixels(path, data, pixels)
    return bare, transparent


def _chunks(path: Path, data: bytearray) -> Iterator[tuple[bytes, memoryview, memoryview]]:
    """Yield name, content and bytes of every chunk, each of which is whole."""
    view = memoryview(data)
    at, name = len(PNG_MAGIC), b""
    while name != b"IEND":
        if at + 12 > len(data):
            message = f"{path}: cut short: the PNG has no end; copy or save it again"
            raise MapFileError(message)
        (length,) = struct.unpack_from(">I", data, at)
        name = bytes(view[at + 4 : at + 8])
        end = at + 8 + length
        if end + 4 > len(data):
            message = f"{path}: cut short: the PNG ends within its pixels; copy or save it again"
            raise MapFileError(message)
        (checksum,) = struct.unpack_from(">I", data, end)
        if zlib.crc32(view[at + 4 : end]) != checksum:
            raise _damaged(path, "a checksum is wrong")
        yield name, view[at + 8 : end], view[at : end + 4]
        at = end + 4


def _check_pixels(path: Path, data: bytearray, parts: list[memoryview]) -> None:
    """Refuse pixels that do not unpack to every row, each with a filter that there is."""
    width, height, depth, colour, packing, filters, interlace = struct.unpack_from(
        ">IIBBBBB", data, 16
    )
    channels, depths = _COLOURS.get(colour, (0, ()))
    if depth not in depths or packing or filters or interlace > 1:
        raise _damaged(path, "its header is none")
    firsts, total = _row_starts(width, height, channels * depth, is_interlaced=bool(interlace))
    reader, seen = zlib.decompressobj(), 0
    try:
        for part in parts:
            rest: bytes | memoryview = part
            while rest and not reader.eof and seen <= total:
                rows = reader.decompress(rest, _PART_BYTES)
                low, high = np.searchsorted(firsts, (seen, seen + len(rows)))
                if (np.frombuffer(rows, np.uint8)[firsts[low:high] - seen] >= _FILTERS).any():
                    raise _damaged(path, "a row has no filter that there is")
                seen, rest = seen + len(rows), reader.unconsumed_tail
    except zlib.error:
        raise _damaged(path, "its pixels do not unpack") from None
    if seen != total or not reader.eof:
        raise _damaged(path, "its pixels do not unpack to every row")


def _row_starts(
    width: int, height: int, bits: int, *, is_interlaced: bool
) -> tuple[npt.NDArray[np.int64], int]:
    """Return where each row begins among the unpacked bytes, and how many bytes there are."""
    total, firsts = 0, []
    for col, row, right, down in _PASSES if is_interlaced else ((0, 0, 1, 1),):
        cols, rows = -(-(width - col) // right), -(-(height - row) // down)
        if cols > 0 and rows > 0:
            row_bytes = 1 + -(-cols * bits // 8)
            firsts.append(total + row_bytes * np.arange(rows, dtype=np.int64))
            total += row_bytes * rows
    return np.concatenate(firsts), total


def _damaged(path: Path, reason: str) -> MapFileError:
    return MapFileError(f"{path}: damaged PNG: {reason}; copy or save it again")
