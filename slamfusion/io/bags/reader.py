"""An open bag: its topics and decoded messages, through ``rosbags``."""

from __future__ import annotations

import errno
import heapq
import re
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from slamfusion.errors import LogError, MemoryBudgetError, SlamFusionError, extra_needed
from slamfusion.io.bags import METADATA, STORAGE_FILES
from slamfusion.io.yaml_file import read_yaml

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

    from slamfusion.io.bags.storage import Storage, Stored

SCAN_TYPES = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
# Errors of a full disk.
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
# Messages per topic that are read for a description of the frames.
FRAMES_READ = 1000
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class OpenBag:
    """An open bag, made by ``open_bag``; ``notes`` for the user on what was left out."""

    def __init__(
        self,
        path: Path,
        storages: Sequence[Storage],
        decode: Callable[[str, str, bytes], Any],
        notes: list[str],
    ) -> None:
        self.path = path
        self._storages = storages
        self._decode = decode
        self.notes = notes
        for storage in storages:
            if storage.is_cut_off:
                self._note(storage, "it has no end or no index (cut off, or still recorded)")

    @property
    def _connections(self) -> Iterator[Connection]:
        return (item for storage in self._storages for item in storage.connections)

    def choose_topic(
        self, types: Sequence[str], wanted: str | None, key: str, sibling: str = ""
    ) -> str:
        """Return the wanted topic, or the only one of its type with messages."""
        topics = sorted({item.topic for item in self._connections if _kind(item) in types})
        filled = self.topics(types, sibling)
        kind = types[0].replace("/msg/", "/")
        if wanted is not None:
            for topic in topics:
                if topic.lstrip("/") == wanted.lstrip("/"):
                    return topic
            found = ", ".join(topics) or "none"
            raise LogError(
                f"{self.path}: no {kind} topic {wanted!r} in it; found {found}; change {key} or "
                "leave it out"
            )
        if not filled:
            others = ", ".join(
                sorted(
                    item.topic if _kind(item) else f"{item.topic} (in {_encoding(item)})"
                    for item in self._connections
                )
            )
            advice = "give a bag that recorded one"
            if self.topics([POINT_CLOUD]):
                advice = "make one of the point cloud with the ROS package pointcloud_to_laserscan"
            found = f"{', '.join(topics)} without a message" if topics else others or "nothing"
            what = "laser" if key == "--scan-topic" else "pose"
            message = (
                f"{self.path}: no {what} in it: wanted a {kind} topic, found {found}; {advice}"
            )
            raise LogError(message)
        if len(filled) > 1:
            message = (
                f"{self.path}: several {kind} topics: {', '.join(filled)}; choose one with {key}"
            )
            raise LogError(message)
        return filled[0]

    def topics(self, types: Sequence[str], sibling: str = "") -> list[str]:
        """Return the topics of these types with messages, in order."""
        found = sorted(
            {item.topic for item in self._connections if _kind(item) in types and item.msgcount}
        )
        namespace = sibling.rpartition("/")[0]
        own = [topic for topic in found if topic.rpartition("/")[0] == namespace]
        return own if sibling and own else found

    def described_topics(self) -> list[str]:
        """Return each topic with its type and number of messages, in order."""
        kinds = {item.topic: _kind(item) for item in self._connections}
        return [f"{topic} ({kinds[topic]}, {self.count(topic)})" for topic in sorted(kinds)]

    def described_frames(self) -> list[str]:
        """Return each laser's frame, and each ``parent > child``, of the first messages."""
        found: dict[str, None] = {}
        for topic in self.topics(SCAN_TYPES):
            frames = (own.header.frame_id for _, _, own in self.messages(topic) if own)
            found |= dict.fromkeys(f"{topic} in {frame}" for frame in islice(frames, 1))
        for topic in self.topics(TRANSFORM_TYPES):
            for _, _, message in islice(self.messages(topic), FRAMES_READ):
                moved = message.transforms if message else ()
                found |= dict.fromkeys(
                    f"{own.header.frame_id} > {own.child_frame_id}" for own in moved
                )
        return list(found)

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic."""
        return sum(item.msgcount for item in self._connections if item.topic == topic)

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording (ns) and message, None if damaged, in that order."""
        parts = (self._stored(storage, topics) for storage in self._storages)
        for connection, recorded_ns, raw in heapq.merge(*parts, key=itemgetter(1)):
            content = None
            with suppress(Exception):  # damaged bytes fail in many ways; the caller counts them
                content = self._decode(_encoding(connection), _kind(connection), bytes(raw))
            yield connection.topic, recorded_ns, content

    def _stored(self, storage: Storage, topics: Sequence[str]) -> Iterator[Stored]:
        wanted = [item for item in storage.connections if item.topic in topics and _kind(item)]
        is_any_read = False
        try:
            for found in storage.stored(wanted) if wanted else ():
                is_any_read = True
                yield found
        except Exception as error:
            if not is_any_read or isinstance(error, MemoryError):
                raise
            self._note(storage, f"it is damaged ({_reason(error)})")

    def _note(self, storage: Storage, why: str) -> None:
        _add_note(self.notes, f"{Path(str(storage.path)).name} is read as far as it goes: {why}")


@contextmanager
def open_bag(path: Path, notes: list[str]) -> Iterator[OpenBag]:
    """Open a bag; every failure of the library is reported as damage of the bag."""
    with extra_needed("bags", f"{path}: reading bags needs", LogError):
        import rosbags.typesys  # noqa: F401, PLC0415  (slow to load)

        from slamfusion.io.bags.storage import decode, open_storage  # noqa: PLC0415
    try:
        with ExitStack() as stack:
            storages = [open_storage(file, stack) for file in _files(path, notes)]
            if not storages:
                raise FileNotFoundError  # noqa: TRY301
            is_cut_off = any(storage.is_cut_off for storage in storages)
            if is_cut_off and not any(storage.connections for storage in storages):
                raise ValueError("no message in it is whole")  # noqa: TRY301
            yield OpenBag(path, storages, decode, notes)
    except (SlamFusionError, PermissionError):
        raise
    except FileNotFoundError:
        if not path.exists():
            raise
        message = f"{path}: not a whole bag: a file of it is missing; copy all of it"
        raise LogError(message) from None
    except MemoryError:
        message = f"{path}: memory ran out while reading it; free memory, or check that it is whole"
        raise MemoryBudgetError(message) from None
    except Exception as error:
        # Only unpacked files are written.
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            raise LogError(
                f"{path}: cannot be unpacked in {tempfile.gettempdir()}: {error.strerror}; free "
                "some space there, or let TMPDIR name another folder"
            ) from None
        raise LogError(
            f"{path}: cannot be read as a bag ({_reason(error)}); check that it was recorded and "
            "copied to its end"
        ) from error


def _reason(error: Exception) -> str:
    return textwrap.shorten(str(error), 120) or type(error).__name__


def _files(path: Path, notes: list[str]) -> list[Path]:
    """Return the storage files of a bag: those in its index, else all of one kind."""
    if not path.is_dir():
        return [path]

    def place(file: Path) -> list[str | int]:
        # Part 10 is after part 2.
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)]

    kinds = (sorted(path.glob(pattern), key=place) for pattern in STORAGE_FILES)
    there = next((files for files in kinds if files), [])
    try:
        index = read_yaml(path / METADATA, LogError, "a bag's metadata", as_text=True)
        names = index["rosbag2_bagfile_information"]["relative_file_paths"]
        named = [path / PurePosixPath(name).name for name in names]
    except (OSError, SlamFusionError, LookupError, TypeError):
        # The index is not needed, and may have been edited by hand.
        return there
    found = [file for file in named if file.exists()]
    missing = [file.name for file in named if not file.exists()]
    if found and missing:
        _add_note(notes, f"{', '.join(missing)} is missing in the bag; the rest is read")
    return found or there


def _add_note(notes: list[str], note: str) -> None:
    """Add a sentence once: a bag is opened for each pass."""
    if note not in notes:
        notes.append(note)


def _encoding(connection: Connection) -> str:
    return str(getattr(connection.ext, "serialization_format", "ros1"))


def _kind(connection: Connection) -> str:
    """Return the type of messages in ROS 2 spelling; empty if they cannot be read."""
    package, _, name = connection.msgtype.replace("/msg/", "/").partition("/")
    return f"{package}/msg/{name}" if _encoding(connection) in {"cdr", "ros1"} else ""


def stamp_s(message: Any) -> float:
    """Return the time in a message's header, seconds."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec * 1e-9)
