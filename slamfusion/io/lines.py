"""Lines of a text file, plain or gzip, as a stream that knows how far it is."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from slamfusion.errors import LogError

__all__ = ["GZIP_MAGIC", "TextLines", "gzip_bytes", "read_head", "strip_gz"]

GZIP_MAGIC = b"\x1f\x8b"
_DAMAGE = (EOFError, gzip.BadGzipFile, zlib.error)
_BUFFER_BYTES = 1 << 16
# A scan of 100 000 beams takes about 1 MB; what is longer than this is no text.
_LINE_BYTES = 1 << 24


class TextLines:
    """The lines of a file; each iteration reads from the start and takes constant memory.

    Attributes:
        path: the file; whether it is packed is told from its first bytes, not from its name.
        fraction_read: share of the file's bytes (packed, where it is packed) read so far.
        is_cut_off: the last iteration met packed data that end early or are damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fraction_read = 0.0
        self.is_cut_off = False

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Yield line number, from 1, and line.

        Raises:
            LogError: a line is too long to be text.
        """
        self.fraction_read, self.is_cut_off = 0.0, False
        with self.path.open("rb", buffering=0) as raw:
            size = max(raw.seek(0, io.SEEK_END), 1)
            stream = _unpacked(raw)
            try:
                read = partial(stream.readline, _LINE_BYTES)
                for number, line in enumerate(iter(read, b""), start=1):
                    if len(line) == _LINE_BYTES:
                        message = (
                            f"{self.path}: line {number} is longer than {_LINE_BYTES >> 20} MiB, "
                            "so this is no text log; check the file"
                        )
                        raise LogError(message)
                    self.fraction_read = min(raw.tell() / size, 1.0)
                    yield number, line
            except _DAMAGE:
                self.is_cut_off = True
        self.fraction_read = 1.0


def read_head(path: Path, count: int = _BUFFER_BYTES) -> bytes:
    """Return the first bytes of a file, unpacked where it is gzip; less where it is damaged."""
    with path.open("rb", buffering=0) as raw:
        stream = _unpacked(raw)
        head = bytearray()
        try:
            while len(head) < count and (part := stream.read1(count - len(head))):
                head += part
        except _DAMAGE:
            pass
    return bytes(head)


def strip_gz(name: str) -> str:
    """Return a file name in small letters without its ``.gz``."""
    return name.lower().removesuffix(".gz")


def gzip_bytes(data: bytes) -> bytes:
    """Pack bytes so that the same bytes always give the same file: no name, no time."""
    packed = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=packed, mtime=0) as file:
        file.write(data)
    return packed.getvalue()


def _unpacked(raw: io.FileIO) -> io.BufferedReader:
    """Return the file's bytes from its start, through gzip where the first bytes say so."""
    raw.seek(0)
    magic = raw.read(len(GZIP_MAGIC))
    raw.seek(0)
    if magic != GZIP_MAGIC:
        return io.BufferedReader(raw, _BUFFER_BYTES)
    return io.BufferedReader(gzip.GzipFile(fileobj=raw, mode="rb"), _BUFFER_BYTES)
