"""Pictures of maps in and out: PGM, PNG and BMP, each also gzipped. Pillow decodes and encodes."""

from __future__ import annotations

import gzip
import hashlib
import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.errors import MapFileError, SlamFusionError
from slamfusion.io.files import WORKING_BYTES, check_memory, format_bytes, open_regular

# (H, W) grey, (H, W, 3) colour or (H, W, 4) colour and alpha, uint8 or uint16; row 0 is the top.
Pixels = npt.NDArray[Any]

# Limit of the bytes after unpacking.
GZIP_LIMIT = 2**30
FORMATS = ("PPM", "PNG", "BMP")
# Pillow's modes: the mode to convert to, and the bytes per pixel while reading.
_MODES = {"1": ("L", 3), "L": ("L", 3), "I;16": ("I;16", 6), "I": ("I", 12)}
_MODES |= {"P": ("RGB", 12), "RGB": ("RGB", 12), "LA": ("RGBA", 16), "RGBA": ("RGBA", 16)}
_MAGIC = (b"\x1f\x8b", b"\x89PNG", b"BM", b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"\xff\xd8\xff")


def looks_like_image(path: Path) -> bool:
    """Return whether the file's name or first bytes are those of a picture, supported or not."""
    name = path.name.lower().removesuffix(".gz")
    if name.endswith((".pgm", ".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff", ".gif")):
        return True
    if name.endswith((".yaml", ".yml")):
        return False
    with _opened(path) as file:
        return file.read(4).startswith(_MAGIC)


def read_image(path: Path) -> Pixels:
    """Read a PGM, PNG or BMP, gzipped or not.

    A colour picture with 16 bits per channel, and a PGM whose maximum is below 255, are read with 8
    bits. Palettes become colours, and a transparent colour an alpha channel.
    """
    import PIL.Image  # noqa: PLC0415  (nodes are to start light)

    PIL.Image.MAX_IMAGE_PIXELS = None  # the header is compared with the memory that is available
    with _opened(path) as file:
        stream: BufferedReader | io.BytesIO = file
        if file.peek(2).startswith(b"\x1f\x8b"):
            stream = _unpacked(path, file)
        try:
            with PIL.Image.open(stream, formats=FORMATS) as picture:
                mode, pixel_bytes = _MODES[picture.mode]
                width, height = picture.size
                needed = pixel_bytes * width * height + WORKING_BYTES
                check_memory(needed, f"a {width} x {height} picture", str(path))
                picture.verify()
            stream.seek(0)
            with PIL.Image.open(stream, formats=FORMATS) as picture:
                if "transparency" in picture.info and not mode.startswith("I"):
                    mode = "RGBA"
                pixels = np.asarray(picture if picture.mode == mode else picture.convert(mode))
        except PIL.UnidentifiedImageError:
            stream.seek(0)
            raise MapFileError(
                f"{path}: wanted a PGM, PNG or BMP image with pixels, found a file that starts "
                f"with {stream.read(8)!r}; save the map again or convert it to PNG"
            ) from None
        except (SlamFusionError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - decoders fail in many ways on damaged files
            reason = " ".join(str(error).split())
            message = f"{path}: damaged picture: {reason}; copy or save the map again"
            raise MapFileError(message) from None
    return pixels.astype(np.uint16) if mode == "I" else pixels


def pixel_digest(pixels: Pixels) -> str:
    """Return the SHA-256 of a picture's size and pixels, 64 hexadecimal digits."""
    digest = hashlib.sha256(str(pixels.shape).encode())
    digest.update(np.ascontiguousarray(pixels).data)
    return digest.hexdigest()


def encode_image(pixels: npt.NDArray[np.uint8], image_format: str) -> memoryview:
    """Return a PGM of (H, W) pixels, top row first, or a PNG or BMP, also of (H, W, 3 or 4)."""
    if image_format == "pgm":
        height, width = pixels.shape
        return memoryview(b"P5\n%d %d\n255\n" % (width, height) + pixels.tobytes())
    import PIL.Image  # noqa: PLC0415  (nodes are to start light)

    data = io.BytesIO()
    PIL.Image.fromarray(pixels).save(data, image_format)
    return data.getbuffer()


@contextmanager
def _opened(path: Path) -> Iterator[BufferedReader]:
    try:
        with open_regular(path, MapFileError) as file:
            yield file
    except OSError as error:
        raise cannot_read(path, error) from None


def cannot_read(path: Path, error: OSError) -> MapFileError:
    """Return the error for a map file that cannot be read."""
    if isinstance(error, FileNotFoundError):
        return MapFileError(f"{path}: no such file; check the path")
    reason = error.strerror or error
    return MapFileError(f"{path}: cannot read: {reason}; check the path and its permissions")


def _unpacked(path: Path, file: BufferedReader) -> io.BytesIO:
    try:
        data = gzip.GzipFile(fileobj=file).read(GZIP_LIMIT + 1)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise MapFileError(f"{path}: damaged gzip file ({error}); copy or pack it again") from None
    if len(data) > GZIP_LIMIT:
        message = (
            f"{path}: unpacks to more than {format_bytes(GZIP_LIMIT)}; gunzip it and give that file"
        )
        raise MapFileError(message)
    return io.BytesIO(data)
