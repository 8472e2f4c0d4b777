"""A limit on what one compressed piece of a bag unpacks to, so that no bomb fills the memory."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

from slamfusion.io.memory import format_bytes

# A chunk or a message; those of recorders are a thousand times smaller.
PIECE_BYTES = 2**30


@cache
def limit_unpacking() -> None:
    """Replace the decompressors of ``rosbags``, which have no limit, by ``_unpack``."""
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  (with rosbags, an extra)
    from rosbags.rosbag1 import reader as reader1  # noqa: PLC0415
    from rosbags.rosbag2 import reader as reader2  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap as mcap  # noqa: PLC0415

    zstd: Any = vars(mcap)["zstd"]
    from_zstd = partial(_unpack, zstd.ZstdDecompressor)
    from_lz4 = partial(_unpack, LZ4FrameDecompressor)
    reader1.decompressors["bz2"] = partial(_unpack, bz2.BZ2Decompressor)
    reader1.decompressors["lz4"] = from_lz4
    mcap.DECOMPRESSORS["lz4"] = lambda data, _: from_lz4(data)
    mcap.DECOMPRESSORS["zstd"] = lambda data, _: from_zstd(data)
    vars(reader2)["zstd"] = SimpleNamespace(open=zstd.open, decompress=from_zstd)


def _unpack(make: Callable[[], Any], data: bytes) -> bytes:
    reader = make()
    unpacked: bytes = reader.decompress(data, PIECE_BYTES + 1)
    if len(unpacked) > PIECE_BYTES:
        message = f"a piece unpacks to more than {format_bytes(PIECE_BYTES)}, as no recording does"
        raise ValueError(message)
    if not reader.eof:
        message = "packed data that end early"
        raise ValueError(message)
    return unpacked
