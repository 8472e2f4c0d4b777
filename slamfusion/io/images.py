"""Pictures in and out: PGM, PNG and BMP, each also gzipped, checked before they are decoded.

The header is read first. It says how large the picture is, so that what does not fit into memory is
refused with numbers, and how many bytes may follow, so that a damaged file is named and a gzip bomb
never unpacked. PGM is decoded here, because OpenCV ignores its maximum; PNG and BMP by OpenCV.
"""

from __future__ import annotations

import gzip
import os
import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.errors import MapFileError, MemoryBudgetError
from slamfusion.io.atomic import write_atomic
from slamfusion.io.memory import WORKING_BYTES, check_memory, format_bytes
from slamfusion.io.png import PNG_MAGIC, checked_png
from slamfusion.io.regular import open_regular

__all__ = ["Image", "cannot_read", "encode_image", "looks_like_image", "read_image", "save_image"]

GZIP_MAGIC = b"\x1f\x8b"
GZIP_LIMIT = 2**30
"""A gzipped picture may unpack to this many bytes; larger ones are unpacked by their owner."""

_HEAD_BYTES = 2**16
_CHUNK_BYTES = 2**22
_TRAILING_BYTES = 2**20

_OTHER_FORMATS = {
    b"\xff\xd8\xff": "a JPEG",
    b"GIF8": "a GIF",
    b"II*\x00": "a TIFF",
    b"MM\x00*": "a TIFF",
    b"RIFF": "a WebP",
    b"P1": "a bitmap (PBM, P1)",
    b"P3": "a colour PPM (P3)",
    b"P4": "a bitmap (PBM, P4)",
    b"P6": "a colour PPM (P6)",
    b"P7": "a PAM (P7)",
}

# A separator of the PGM header is white space or a comment that runs to the end of its line.
_PGM_SEPARATOR = rb"(?:\s|#[^\r\n]*[\r\n])+"
_PGM_HEADER = re.compile(
    rb"P[25]" + rb"".join(_PGM_SEPARATOR + rb"(\d{1,10})" for _ in range(3)) + rb"\s"
)
# By colour type: channels in the file, and channels that OpenCV may make of them.
_PNG_CHANNELS = {0: (1, 1), 2: (3, 4), 3: (1, 4), 4: (2, 4), 6: (4, 4)}

# What OpenCV logs of a picture that it cannot decode is in our message.
if hasattr(cv2.utils, "logging"):
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
elif hasattr(cv2, "setLogLevel"):
    cv2.setLogLevel(0)


@dataclass(frozen=True)
class Image:
    """A decoded picture; row 0 is the top.

    Attributes:
        pixels: (H, W) grey, (H, W, 3) colour or (H, W, 4) colour and alpha (last, large is
            opaque), uint8 or uint16. The order of the colours is left open: maps average them.
        maxval: the value of white, 1..65535.
    """

    pixels: npt.NDArray[Any]
    maxval: int


@dataclass(frozen=True)
class _Header:
    """What the first bytes say of a picture.

    Attributes:
        kind: ``PGM``, ``plain PGM``, ``PNG`` or ``BMP``.
        width: columns.
        height: rows.
        maxval: the value of white.
        decoded_bytes_per_pixel: what decoding allocates beside the file.
        data_offset: where pixels start, for PGM and BMP.
        data_bytes: how many bytes of pixels must follow there; 0 where compressed.
        file_bytes: more bytes than this cannot belong to the picture.
    """

    kind: str
    width: int
    height: int
    maxval: int
    decoded_bytes_per_pixel: int
    data_offset: int
    data_bytes: int
    file_bytes: int

    @property
    def title(self) -> str:
        """The picture's size and kind, for messages."""
        return f"a {self.width} x {self.height} {self.kind}"


def looks_like_image(path: Path) -> bool:
    """Return whether the file's name or first bytes are those of a picture, known or not."""
    name = path.name.lower().removesuffix(".gz")
    if name.endswith((".pgm", ".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff", ".gif")):
        return True
    if name.endswith((".yaml", ".yml")):
        return False
    with _opened(path) as file:
        head = file.read(len(PNG_MAGIC))
    known = (GZIP_MAGIC, PNG_MAGIC, b"BM", b"P2", b"P5", *_OTHER_FORMATS)
    return head.startswith(known)


def read_image(path: Path) -> Image:
    """Read a PGM, PNG or BMP, gzipped or not.

    Raises:
        MapFileError: the file is missing, unreadable, damaged or of another format.
        MemoryBudgetError: the picture and its map would not fit into memory.
    """
    with _opened(path) as file:
        try:
            return _read_stream(path, file)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            reason = "it ends early" if isinstance(error, EOFError) else str(error)
            message = f"{path}: damaged gzip file ({reason}); copy or pack it again"
            raise MapFileError(message) from None
        except MemoryError:
            message = f"{path}: memory ran out while reading it; free memory or crop the map"
            raise MemoryBudgetError(message) from None


def save_image(path: str | Path, array: npt.NDArray[np.uint8]) -> None:
    """Write a picture as PNG, whole or not at all.

    Args:
        path: the target, by custom ``*.png``.
        array: (H, W) grey or (H, W, 3) red, green, blue; uint8; row 0 is the top.

    Raises:
        MapFileError: the file cannot be written.
    """
    if array.dtype != np.uint8 or array.ndim not in {2, 3} or array.size == 0:
        message = f"{path}: wanted (H, W) or (H, W, 3) uint8, found {array.dtype} {array.shape}"
        raise MapFileError(message)
    pixels = array if array.ndim == 2 else np.ascontiguousarray(array[..., ::-1])
    write_atomic(path, encode_image(pixels, "png", str(path)))


def encode_image(pixels: npt.NDArray[np.uint8], image_format: str, where: str) -> memoryview:
    """Return the bytes of a PNG or BMP file.

    Args:
        pixels: (H, W) grey, (H, W, 3) blue, green, red or (H, W, 4) with alpha; row 0 is the top.
        image_format: ``png`` or ``bmp``.
        where: what messages call the target.
    """
    try:
        encoded, data = cv2.imencode(f".{image_format}", pixels)
    except cv2.error as error:
        message = f"{where}: cannot encode as {image_format}: {_first_line(error)}; use pgm"
        raise MapFileError(message) from None
    if not encoded:
        message = f"{where}: cannot encode {pixels.shape} pixels as {image_format}; use pgm"
        raise MapFileError(message)
    return data.data.cast("B")


@contextmanager
def _opened(path: Path) -> Iterator[BufferedReader]:
    """Open a picture for reading.

    Raises:
        MapFileError: opening, or reading within the ``with`` block, failed; names the file.
    """
    try:
        with open_regular(path, MapFileError) as file:
            yield file
    except OSError as error:
        raise cannot_read(path, error) from None


def cannot_read(path: Path, error: OSError) -> MapFileError:
    """Say in one line why a file of a map cannot be read."""
    if isinstance(error, FileNotFoundError):
        return MapFileError(f"{path}: no such file; check the path")
    reason = error.strerror or error
    return MapFileError(f"{path}: cannot read: {reason}; check the path and its permissions")


def _read_stream(path: Path, file: BufferedReader) -> Image:
    """Read the header, check what it asks for, and only then the rest."""
    size = os.fstat(file.fileno()).st_size
    is_gzip = file.peek(2).startswith(GZIP_MAGIC)
    stream: BufferedReader | gzip.GzipFile = gzip.GzipFile(fileobj=file) if is_gzip else file
    head = stream.read(_HEAD_BYTES)
    header = _read_header(path, head)
    cells = header.width * header.height
    needed = cells * (header.decoded_bytes_per_pixel + 1) + max(size, header.data_bytes)
    check_memory(needed + WORKING_BYTES, header.title, str(path))
    allowed = min(header.file_bytes, GZIP_LIMIT) if is_gzip else header.file_bytes
    if is_gzip and header.data_bytes > allowed:
        message = (
            f"{path}: {header.title} unpacks to {format_bytes(header.data_bytes)}, more than the "
            f"{format_bytes(GZIP_LIMIT)} that is unpacked here; gunzip it and give that file"
        )
        raise MapFileError(message)
    data = bytearray(head)
    while len(data) <= allowed and (chunk := stream.read(_CHUNK_BYTES)):
        data += chunk
    if len(data) > allowed:
        message = (
            f"{path}: {header.title} takes at most {format_bytes(allowed)}, found more; "
            "the file is damaged or not what its header says"
        )
        raise MapFileError(message)
    if len(data) < header.data_offset + header.data_bytes:
        message = (
            f"{path}: cut short: {header.title} needs {header.data_bytes} bytes of pixels, found "
            f"{max(len(data) - header.data_offset, 0)}; copy or save it again"
        )
        raise MapFileError(message)
    if header.kind == "PGM":
        return _decode_pgm(path, header, data)
    if header.kind == "plain PGM":
        return _decode_plain_pgm(path, header, data)
    return _decode_with_opencv(path, header, data)


def _read_header(path: Path, head: bytes) -> _Header:
    """Return what the picture is, or say why it is none."""
    if not head:
        message = f"{path}: the file is empty; save the map again"
        raise MapFileError(message)
    if head.startswith((b"P2", b"P5")):
        header = _read_pgm_header(path, head)
    elif head.startswith(PNG_MAGIC):
        header = _read_png_header(path, head)
    elif head.startswith(b"BM"):
        header = _read_bmp_header(path, head)
    else:
        found = [title for magic, title in _OTHER_FORMATS.items() if head.startswith(magic)]
        what = found[0] if found else f"bytes that start with {head[:8]!r}"
        message = f"{path}: wanted a PGM, PNG or BMP image, found {what}; convert it to PNG"
        raise MapFileError(message)
    if header.width < 1 or header.height < 1:
        message = (
            f"{path}: the image is {header.width} x {header.height}, without a single cell; "
            "save the map again"
        )
        raise MapFileError(message)
    return header


def _read_pgm_header(path: Path, head: bytes) -> _Header:
    """Read width, height and maximum of a PGM; comments may stand between them."""
    match = _PGM_HEADER.match(head)
    if match is None:
        message = f"{path}: the PGM header lacks width, height or maximum; save the map again"
        raise MapFileError(message)
    width, height, maxval = (int(number) for number in match.groups())
    if not 1 <= maxval <= 65535:
        message = f"{path}: the PGM's maximum must lie in 1..65535, found {maxval}; save it again"
        raise MapFileError(message)
    cells = width * height
    if head.startswith(b"P2"):
        # Each number takes two bytes at least; sixteen leave room for padding and comments.
        file_bytes = match.end() + 16 * cells + _TRAILING_BYTES
        return _Header("plain PGM", width, height, maxval, 24, match.end(), 0, file_bytes)
    data_bytes = cells * (1 if maxval < 256 else 2)
    file_bytes = match.end() + data_bytes + _TRAILING_BYTES
    return _Header("PGM", width, height, maxval, 0, match.end(), data_bytes, file_bytes)


def _read_png_header(path: Path, head: bytes) -> _Header:
    """Read the IHDR chunk of a PNG."""
    try:
        name, width, height, depth, colour = struct.unpack_from(">4sIIBB", head, 12)
        channels, decoded_channels = _PNG_CHANNELS[colour]
    except (struct.error, KeyError):
        name, width, height, depth, channels, decoded_channels = b"", 0, 0, 0, 0, 0
    if name != b"IHDR" or depth not in {1, 2, 4, 8, 16}:
        message = f"{path}: damaged PNG header; save the map again"
        raise MapFileError(message)
    raw_bytes = height * (1 + -(-width * channels * depth // 8))
    decoded = decoded_channels * max(depth // 8, 1)
    file_bytes = 2 * raw_bytes + 16 * _TRAILING_BYTES
    maxval = 65535 if depth == 16 else 255
    return _Header("PNG", width, height, maxval, decoded, 0, 0, file_bytes)


def _read_bmp_header(path: Path, head: bytes) -> _Header:
    """Read the file and bitmap headers of a BMP; the rows must be uncompressed."""
    try:
        offset, header_size = struct.unpack_from("<II", head, 10)
        width, height, _, bits, compression = struct.unpack_from("<iiHHI", head, 18)
    except struct.error:
        message = f"{path}: damaged BMP header; save the map again"
        raise MapFileError(message) from None
    if header_size < 40:  # OpenCV would mix the colours of the old OS/2 form by luminance
        message = f"{path}: wanted a Windows BMP, found one of OS/2; convert it to PNG"
        raise MapFileError(message)
    if compression not in {0, 3} or bits not in {1, 4, 8, 16, 24, 32}:
        message = (
            f"{path}: wanted an uncompressed BMP, found compression {compression} with {bits} "
            "bits; convert it to PNG"
        )
        raise MapFileError(message)
    data_bytes = abs(height) * (-(-width * bits // 32) * 4)
    file_bytes = offset + data_bytes + _TRAILING_BYTES
    return _Header(
        "BMP", width, abs(height), 255, 4 if bits == 32 else 3, offset, data_bytes, file_bytes
    )


def _decode_pgm(path: Path, header: _Header, data: bytearray) -> Image:
    """View the rows of a binary PGM without copying them."""
    kind = np.dtype(np.uint8 if header.maxval < 256 else ">u2")
    cells = header.width * header.height
    values = np.frombuffer(data, kind, count=cells, offset=header.data_offset)
    return _checked_pgm(path, header, values)


def _decode_plain_pgm(path: Path, header: _Header, data: bytearray) -> Image:
    """Read the numbers of a plain PGM."""
    cells = header.width * header.height
    text = re.sub(rb"#[^\r\n]*", b"", bytes(memoryview(data)[header.data_offset :]))
    try:
        with warnings.catch_warnings():
            # NumPy only warns of text that is no number. Its ``count`` would fill up with garbage.
            warnings.simplefilter("error", DeprecationWarning)
            values = np.fromstring(text, dtype=np.int32, sep=" ")[:cells]
    except (ValueError, DeprecationWarning):
        values = np.empty(0, dtype=np.int32)
    if values.size < cells or values.min() < 0:
        message = (
            f"{path}: cut short or damaged: {header.title} needs {cells} numbers from 0 to "
            f"{header.maxval}; save it again"
        )
        raise MapFileError(message)
    return _checked_pgm(path, header, values)


def _checked_pgm(path: Path, header: _Header, values: npt.NDArray[Any]) -> Image:
    """Refuse pixels above the header's maximum and give the rest their shape."""
    highest = int(values.max())
    if highest > header.maxval:
        message = (
            f"{path}: the PGM's maximum is {header.maxval}, but a pixel is {highest}; save it again"
        )
        raise MapFileError(message)
    kind = np.uint8 if header.maxval < 256 else np.uint16
    shape = (header.height, header.width)
    return Image(values.astype(kind, copy=False).reshape(shape), header.maxval)


def _decode_with_opencv(path: Path, header: _Header, data: bytearray) -> Image:
    """Decode a PNG or BMP that is known to be whole."""
    limit = int(os.environ.get("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**30)))
    if header.width * header.height > limit or max(header.width, header.height) > 2**20:
        message = (
            f"{path}: {header.title} is more than OpenCV decodes ({limit} pixels, 1048576 a "
            "side); convert it to PGM"
        )
        raise MapFileError(message)
    transparent = None
    if header.kind == "PNG":
        data, transparent = checked_png(path, data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        message = f"{path}: damaged {header.kind}: {_first_line(error)}; save the map again"
        raise MapFileError(message) from None
    if pixels is None or pixels.shape[:2] != (header.height, header.width):
        message = f"{path}: damaged {header.kind}: its pixels do not decode; save the map again"
        raise MapFileError(message)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if transparent is not None and pixels.ndim == 2:
        # OpenCV drops the transparent grey of a PNG; the matte is a channel to a map server.
        check_memory(8 * pixels.nbytes, f"{header.title} with alpha", str(path))
        alpha = np.where(pixels == transparent, 0, header.maxval).astype(pixels.dtype)
        pixels = np.stack((pixels, pixels, pixels, alpha), axis=-1)
    return Image(pixels, header.maxval)


def _first_line(error: Exception) -> str:
    """Return an error's words on one line."""
    return " ".join(str(error).split())
