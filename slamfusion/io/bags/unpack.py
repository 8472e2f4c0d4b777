"""What ``rosbags`` unpacks of a bag counts against a budget, so that no bomb fills memory or disk.

The library unpacks whatever it is given, to the end. Its tables of unpackers are replaced, once,
by ones that stop where the budget of the bag that is open ends.
"""

from __future__ import annotations

import bz2
import contextvars
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from slamfusion.io.budget import BAG_FREE_BYTES, BAG_RATIO, UnpackBudget

__all__ = ["unpack_budget"]

_CHUNK_BYTES = 1 << 20
_BUDGET: contextvars.ContextVar[UnpackBudget | None] = contextvars.ContextVar(
    "what the open bag may unpack to", default=None
)


def _budget(where: object) -> UnpackBudget:
    return UnpackBudget(where, BAG_RATIO, BAG_FREE_BYTES)


@contextmanager
def unpack_budget(path: Path) -> Iterator[None]:
    """Let whatever is unpacked of a bag within the ``with`` block count against one budget.

    Raises:
        LogError: it was more than any bag unpacks to.
    """
    _limit_library()
    token = _BUDGET.set(_budget(path))
    try:
        yield
    finally:
        _BUDGET.reset(token)


@cache
def _limit_library() -> None:
    """Replace the unpackers of the library that is installed."""
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  (with rosbags, an extra)
    from rosbags.rosbag1 import reader as reader1  # noqa: PLC0415
    from rosbags.rosbag2 import reader as reader2  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap as mcap  # noqa: PLC0415

    zstd: Any = vars(mcap)["zstd"]
    of_lz4 = _limited(LZ4FrameDecompressor)
    of_zstd = _limited(zstd.ZstdDecompressor)
    reader1.decompressors["bz2"] = _limited(bz2.BZ2Decompressor)
    reader1.decompressors["lz4"] = of_lz4
    mcap.DECOMPRESSORS["lz4"] = lambda data, _: of_lz4(data)
    mcap.DECOMPRESSORS["zstd"] = lambda data, _: of_zstd(data)
    vars(reader2)["zstd"] = _LimitedZstd(zstd, of_zstd)


def _limited(make: Callable[[], Any]) -> Callable[[bytes], bytes]:
    """Return a function that unpacks one packed piece within the budget of the open bag."""

    def unpack(data: bytes) -> bytes:
        budget = _BUDGET.get() or _budget("a bag")
        reader = make()
        # One byte more than allowed tells that there is more.
        unpacked: bytes = reader.decompress(data, budget.allowed(len(data)) + 1)
        budget.spend(len(data), len(unpacked))
        if not reader.eof:
            message = "packed data that end early"
            raise ValueError(message)
        return unpacked

    return unpack


class _LimitedZstd:
    """The library's module of zstd, of which only what reads bags is used."""

    def __init__(self, zstd: Any, decompress: Callable[[bytes], bytes]) -> None:
        self._zstd = zstd
        self.decompress = decompress

    def open(self, file: Any, mode: str) -> io.RawIOBase:
        """Return a packed file as one that is read unpacked."""
        return _LimitedFile(self._zstd.open(file, mode), file)


class _LimitedFile(io.RawIOBase):
    """A packed file that is read unpacked, within the budget of the open bag."""

    def __init__(self, unpacked: Any, packed: Any) -> None:
        self._unpacked = unpacked
        self._packed = packed
        self._seen_bytes = 0
        self._budget = _BUDGET.get() or _budget("a bag")

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, and count them."""
        data: bytes = self._unpacked.read(_CHUNK_BYTES if size < 0 else size)
        at_byte = self._packed.tell()
        self._budget.spend(at_byte - self._seen_bytes, len(data))
        self._seen_bytes = at_byte
        return data
