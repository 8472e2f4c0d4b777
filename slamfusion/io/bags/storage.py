"""The storage files of bags, through ``rosbags``; damaged ones are read as far as possible.

Message definitions and QoS in a file are not used: only standard messages are read, and other
topics must not make a bag unreadable.
"""

from __future__ import annotations

import bz2
import os
import shutil
import sqlite3
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slamfusion.errors import LogError
from slamfusion.io.bags import MCAP_MAGIC, ROS1_MAGIC, SQLITE_MAGIC, ZSTD_MAGIC
from slamfusion.io.bags.reader import TRANSFORM_TYPES
from slamfusion.io.files import format_bytes, open_regular

# Limit of an unpacked chunk or message; those of recorders are a thousand times smaller.
PIECE_BYTES = 2**30
# Connection of a message, its recording time in nanoseconds, and its bytes.
Stored = tuple[Connection, int, bytes]
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
# Raised on damaged records of ROS 1 bags.
_DAMAGE = (rosbag1.ReaderError, ValueError, LookupError, RuntimeError, OSError, AssertionError)
_MCAP_FOOTER = b"\x02"
zstd: Any = vars(mcap)["zstd"]


class Mcap(mcap.McapReader):
    """An MCAP file; without a usable end it is read up to its last complete record."""

    is_cut_off = False

    def stored(self, connections: Sequence[Connection]) -> Iterator[Stored]:
        """Yield the messages of connections; without an index, in the order of the file."""
        read = self.messages if self.chunks else self.messages_scan
        for connection, recorded_ns, raw in read(connections):
            yield connection, recorded_ns, _plain(raw)

    def _open(self) -> None:
        try:
            super()._open()
        except Exception:  # noqa: BLE001  (damaged bytes fail in many ways)
            self._scan()

    def _scan(self) -> None:
        """Find the messages without the index at the end."""
        file: Any = self.bio
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise ReaderError("File magic is invalid.")
        self.data_start = file.tell()
        ends = [self.data_start]
        while len(head := file.read(9)) == 9 and not head.startswith(_MCAP_FOOTER):
            end = file.tell() + int.from_bytes(head[1:], "little")
            if end > size:
                break
            ends.append(file.seek(end))
        self.is_cut_off = not head.startswith(_MCAP_FOOTER)
        try:
            self._count(ends[-1])
        except Exception:  # noqa: BLE001  (as above)
            # Up to the record that is damaged.
            self.is_cut_off = True
            self._count(ends[bisect_left(ends, file.tell()) - 1])

    def _count(self, end: int) -> None:
        self.data_end = end
        for found in (self.schemas, self.channels, self.chunks, self.connections):
            found.clear()
        self.meta_scan()
        counts = self.statistics.channel_message_counts if self.statistics else {}
        self.connections = [
            item._replace(msgcount=counts.get(item.id, 0)) for item in self.connections
        ]


class Bag1(rosbag1.Reader):
    """A ROS 1 bag; without an index (while it is recorded) it is read from the start."""

    is_cut_off = False

    def open(self) -> None:
        """Open the file, and find its messages."""
        try:
            super().open()
        except PermissionError:
            raise
        except Exception:  # noqa: BLE001  (damaged bytes fail in many ways)
            self.bio = self.path.open("rb")
            try:
                self._scan(self.bio)
            except BaseException:
                self.close()
                raise

    def stored(self, connections: Sequence[Connection]) -> Iterator[Stored]:
        """Yield the messages of connections, in the order of recording."""
        # An unreadable chunk stays closed.
        self.current_chunk = (-1, BytesIO())
        yield from self.messages(connections)

    def _scan(self, file: Any) -> None:
        """Find the messages without the index at the end."""
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        magic, header = file.readline(), rosbag1.Header.read(file, rosbag1.RecordType.BAGHEADER)
        if magic != b"#ROSBAG V2.0\n" or header.get("encryptor"):
            raise rosbag1.ReaderError("it is encrypted, or of another version than 2.0")
        file.seek(rosbag1.read_uint32(file), os.SEEK_CUR)
        self.is_cut_off = True
        indexes: dict[int, list[Any]] = defaultdict(list)
        found: dict[int, Connection] = {}
        with suppress(*_DAMAGE):
            while (place := file.tell()) < size:
                header = rosbag1.Header.read(file)
                length, start = rosbag1.read_uint32(file), file.tell()
                if header.get_uint8("op") == rosbag1.RecordType.CHUNK:
                    # A chunk that is being written has no length yet.
                    length = min(length or size, size - start)
                    unpack = rosbag1.decompressors[header.get_string("compression")]
                    self.chunks[place] = rosbag1.Chunk(length, start, unpack)
                    self._scan_chunk(place, unpack(file.read(length)), indexes, found)
                file.seek(start + length)
        self.indexes = {number: sorted(indexes[number]) for number in found}
        self.connections = [
            item._replace(msgcount=len(indexes[number])) for number, item in found.items()
        ]

    def _scan_chunk(
        self, place: int, data: bytes, indexes: dict[int, list[Any]], found: dict[int, Connection]
    ) -> None:
        """Add the topics of an unpacked chunk, and the places of its complete messages."""
        file, self.bio = self.bio, BytesIO(data)
        try:
            while (offset := self.bio.tell()) < len(data):
                header = rosbag1.Header.read(self.bio)
                end = rosbag1.read_uint32(self.bio) + self.bio.tell()
                if end > len(data):
                    break
                number = header.get_uint32("conn")
                if header.get_uint8("op") == rosbag1.RecordType.MSGDATA:
                    entry = rosbag1.IndexData(header.get_time("time"), place, offset)
                    indexes[number].append(entry)
                else:
                    self.bio.seek(offset)
                    found[number] = self.read_connection()
                self.bio.seek(end)
        finally:
            self.bio = file


class Sqlite:
    """A .db3 file."""

    is_cut_off = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []

    def open(self) -> None:
        """Open the file, and find its topics."""
        uri = f"{self.path.absolute().as_uri()}?immutable=1"
        self._base = sqlite3.connect(uri, uri=True, check_same_thread=False)
        query = (
            "SELECT topics.id, name, type, serialization_format, count(messages.id) FROM topics "
            "LEFT JOIN messages ON topics.id = messages.topic_id GROUP BY topics.id"
        )
        try:
            for number, topic, kind, encoding, count in self._base.execute(query):
                ext = ConnectionExtRosbag2(encoding, [])
                self.connections.append(
                    Connection(number, topic, kind, _NO_DEFINITION, "", count, ext, self)
                )
        except sqlite3.Error:
            self.close()
            raise

    def stored(self, connections: Sequence[Connection]) -> Iterator[Stored]:
        """Yield the messages of connections, in the order of recording."""
        by_number = {item.id: item for item in connections}
        marks = ", ".join("?" * len(by_number))
        query = (
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) "  # noqa: S608
            "ORDER BY timestamp"
        )
        with closing(self._base.execute(query, tuple(by_number))) as rows:
            for number, recorded_ns, data in rows:
                yield by_number[number], recorded_ns, _plain(data)

    def close(self) -> None:
        """Close the file."""
        self._base.close()


Storage = Mcap | Bag1 | Sqlite
_KINDS: dict[bytes, Callable[[Path], Storage]] = {
    ROS1_MAGIC: Bag1,
    SQLITE_MAGIC: Sqlite,
    MCAP_MAGIC: Mcap,
}


def open_storage(path: Path, stack: ExitStack) -> Storage:
    """Open a storage file; a packed one is unpacked to a temporary folder."""
    _adapt_rosbags()
    with open_regular(path, LogError) as file:
        head, empty = file.peek(20), "it is empty"
        if head.startswith(ZSTD_MAGIC):
            folder = stack.enter_context(TemporaryDirectory())
            path = Path(folder, path.stem)
            # A packed file may be cut off, too.
            with path.open("wb") as unpacked, suppress(EOFError, zstd.ZstdError):
                shutil.copyfileobj(zstd.open(file, "rb"), unpacked)
            with path.open("rb") as inner:
                head, empty = inner.read(20), "nothing of it can be unpacked"
    kind = next((kind for magic, kind in _KINDS.items() if head.startswith(magic)), None)
    if kind is None:
        raise ValueError(f"it starts with {head[:8]!r}" if head else empty)
    storage = kind(path)
    storage.open()
    stack.callback(storage.close)
    return storage


@cache
def _adapt_rosbags() -> None:
    """Let ``rosbags`` limit unpacked sizes, and skip definitions, QoS and text of other topics."""
    from_lz4 = partial(_unpack, LZ4FrameDecompressor)
    rosbag1.decompressors["bz2"] = partial(_unpack, bz2.BZ2Decompressor)
    rosbag1.decompressors["lz4"] = from_lz4
    mcap.DECOMPRESSORS["lz4"] = lambda data, _: from_lz4(data)
    mcap.DECOMPRESSORS["zstd"] = lambda data, _: _unpack_zstd(data)
    vars(mcap).update(
        get_msgdef=lambda _: _NO_DEFINITION,
        get_qos=lambda _: [],
        # The schemas of other encodings are not text.
        read_string=lambda file: mcap.read_bytes(file).decode(errors="replace"),
    )


def decode(encoding: str, kind: str, raw: bytes) -> Any:
    """Return a message."""
    return _decoder(encoding)(raw, kind)


@cache
def _decoder(encoding: str) -> Callable[[bytes, str], Any]:
    is_ros1 = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    for kind in TRANSFORM_TYPES:
        if kind not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store.deserialize_ros1 if is_ros1 else store.deserialize_cdr


def _plain(raw: bytes) -> bytes:
    """Return the bytes of a message, unpacked if needed."""
    return _unpack_zstd(raw) if raw.startswith(ZSTD_MAGIC) else raw


def _unpack_zstd(data: bytes) -> bytes:
    return _unpack(zstd.ZstdDecompressor, data)


def _unpack(make: Callable[[], Any], data: bytes) -> bytes:
    reader = make()
    unpacked: bytes = reader.decompress(data, PIECE_BYTES + 1)
    if len(unpacked) > PIECE_BYTES:
        message = f"a piece unpacks to more than {format_bytes(PIECE_BYTES)}, as no recording does"
        raise ValueError(message)
    if not reader.eof:
        raise ValueError("packed data that end early")
    return unpacked
