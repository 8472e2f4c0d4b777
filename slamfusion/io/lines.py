"""Lines of a text file, plain or gzip."""

from __future__ import annotations

import codecs
import gzip
import io
import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from slamfusion.errors import LogError, SlamFusionError
from slamfusion.io.files import check_memory, open_regular

# A row of ten numbers as a list of Python floats, and in the table made of it.
ROW_BYTES = 600
GZIP_MAGIC = b"\x1f\x8b"
_DAMAGE = (EOFError, gzip.BadGzipFile, zlib.error)
_DAMAGED = "the packed file ends early or is damaged; copy it again"
_BUFFER_BYTES = 1 << 16
# zlib level: 9 takes four times as long and saves 2 %.
PACKING = 5
# A scan of 100 000 beams takes about 1 MB; a longer line is not text.
_LINE_BYTES = 1 << 24
# Memory is checked after this number of kept lines.
_CHECKED_LINES = 1 << 17


def text_lines(
    path: Path, cut_off: type[SlamFusionError], *, kept_bytes: int = 0
) -> Iterator[tuple[int, bytes]]:
    """Yield number, from 1, and line of a text file, plain or gzip, as ASCII or UTF-8.

    Args:
        cut_off: raised if packed data end early or are damaged.
        kept_bytes: memory per line that the caller keeps; checked while reading.
    """
    number = 0
    with open_regular(path, LogError) as file:
        try:
            read = partial(_text(file.raw).readline, _LINE_BYTES)
            for number, line in enumerate(iter(read, b""), start=1):
                if len(line) == _LINE_BYTES:
                    raise LogError(
                        f"{path}: line {number} is longer than {_LINE_BYTES >> 20} MiB, so this "
                        "is no text log; check the file"
                    )
                if kept_bytes and number % _CHECKED_LINES == 0:
                    check_memory(number * kept_bytes, f"keeping {number} lines", str(path))
                yield number, line
        except _DAMAGE:
            raise cut_off(f"{path}: line {number + 1}: {_DAMAGED}") from None


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file, unpacked if gzip, as far as they can be read.

    Raises:
        LogError: none of the packed bytes can be read.
    """
    with open_regular(path, LogError) as file:
        head = bytearray()
        try:
            stream = _text(file.raw)
            while (left := _BUFFER_BYTES - len(head)) and (part := stream.read1(left)):
                head += part
        except _DAMAGE:
            if not head:
                raise LogError(f"{path}: {_DAMAGED}") from None
    return bytes(head)


# Maps by the ends of their names. And what maps and paths are where another file is wanted.
MAP_SUFFIXES = (".yaml", ".yml", ".pgm", ".png", ".bmp", ".pnm", ".dxf")
KINDS = {
    ".tum": "a path; `slamfusion trajectory` and `judge` read paths, and the true path is "
    "--truth-trajectory of `run`, --truth of other commands",
    **dict.fromkeys((".json", ".html"), "results; `slamfusion info` and `show` read their folder"),
    ".zip": "a zip; `slamfusion compare` reads those of --save-results",
    ".zarr": "a store of fused maps; the Python package zarr reads it, and a map that is not too "
    "large is also in the YAML file next to it",
    **dict.fromkeys(
        MAP_SUFFIXES,
        "a map; `slamfusion fuse` and `evaluate` read maps, and the true map is --truth-map of "
        "`slam`, --truth of other commands",
    ),
}


def saved_files(
    stem: Path, mode: str = "trinary", image_format: str | None = None
) -> tuple[Path, Path]:
    """Return the YAML and the picture that ``save_map`` writes."""
    if image_format is None:
        image_format = "png" if mode == "scale" else "pgm"
    return Path(f"{stem}.yaml"), Path(f"{stem}.{image_format}")


def numbers(
    fields: Sequence[bytes],
    at: str,
    error: type[SlamFusionError],
    columns: Iterable[int] | None = None,
) -> list[float]:
    """Return the finite numbers in columns of a line, by default all; else raise the error.

    ``at``: the file and the line, for its message.
    """
    found = []
    for column in range(len(fields)) if columns is None else columns:
        try:
            value = float(fields[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise error(
                f"{at}, column {column + 1} of {len(fields)}: wanted a finite number, found "
                f"{printable(fields[column])!r}; fix or remove the line"
            )
        found.append(value)
    return found


def printable(text: bytes) -> str:
    """Return the begin of a line or field for a message."""
    words = text.decode("ascii", "replace")[:60]
    return "".join(item if item.isprintable() else "?" for item in words)


def strip_gz(name: str) -> str:
    """Return a file name in lower case without its ``.gz``."""
    return name.lower().removesuffix(".gz")


def packed_by_name(path: Path, data: bytes) -> bytes:
    """Return the data, packed if the name ends in ``.gz``; the same data give the same bytes."""
    if not path.name.lower().endswith(".gz"):
        return data
    packed = io.BytesIO()
    with gzip.GzipFile(
        filename="", mode="wb", compresslevel=PACKING, fileobj=packed, mtime=0
    ) as file:
        file.write(data)
    return packed.getvalue()


class _Recoded(io.RawIOBase):
    """UTF-8 with lines that end in LF, of a text in another form."""

    def __init__(self, text: io.TextIOWrapper) -> None:
        self._text = text

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read some bytes; see ``io.RawIOBase.readinto``."""
        data = self._text.read(len(buffer) // 4).encode(errors="surrogateescape")
        buffer[: len(data)] = data
        return len(data)


def _text(raw: Any) -> io.BufferedReader | gzip.GzipFile:
    """Return a file as UTF-8 without its mark; also UTF-16, and lines that end in CR alone."""
    stream = _unpacked(raw)
    head = stream.peek(_BUFFER_BYTES)
    if head.startswith(codecs.BOM_UTF8):
        stream.read(len(codecs.BOM_UTF8))
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = io.TextIOWrapper(stream, "utf-16", "replace")
    elif b"\r" in head and b"\n" not in head:
        text = io.TextIOWrapper(stream, "utf-8", "surrogateescape")
    else:
        return stream
    return io.BufferedReader(_Recoded(text), _BUFFER_BYTES)


def _unpacked(raw: Any) -> io.BufferedReader | gzip.GzipFile:
    raw.seek(0)
    magic = raw.read(len(GZIP_MAGIC))
    raw.seek(0)
    if magic != GZIP_MAGIC:
        return io.BufferedReader(raw, _BUFFER_BYTES)
    # Not within another reader, which would lose what was unpacked before the file ends early.
    return gzip.GzipFile(fileobj=raw, mode="rb")
