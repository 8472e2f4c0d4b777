"""An open bag: its topics, and its messages with the bytes taken apart.

Bags are read through ``rosbags``, which needs no ROS; it comes with the extra ``bags``.
"""

from __future__ import annotations

import errno
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from slamfusion.errors import LogError, MemoryBudgetError, SlamFusionError
from slamfusion.io.bags.unpack import limit_unpacking
from slamfusion.io.regular import open_regular
from slamfusion.io.yaml_file import read_yaml

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

METADATA = "metadata.yaml"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
_PARTS = (METADATA, "*.db3", "*.mcap", "*.zstd")


class BagMessage(NamedTuple):
    """One message.

    Attributes:
        topic: where it was sent.
        recorded_ns: when it was recorded.
        content: its fields; None when its bytes are none.
    """

    topic: str
    recorded_ns: int
    content: Any


class OpenBag:
    """A bag that is open; ``open_bag`` makes it."""

    def __init__(self, path: Path, reader: AnyReader) -> None:
        self._path = path
        self._reader = reader

    def choose_topic(
        self, types: Sequence[str], wanted: str | None, key: str, sibling: str = ""
    ) -> str:
        """Return the topic that was asked for, or the only one of its type.

        Args:
            types: message types that will do, the one to name in errors first.
            wanted: the topic that was asked for; None: any with messages.
            key: the setting that asks for it.
            sibling: a topic; of several ones those in its namespace are taken.

        Raises:
            LogError: there is none, or there are several and none was asked for.
        """
        topics = sorted({item.topic for item in self._reader.connections if item.msgtype in types})
        filled = self.topics(types, sibling)
        kind = types[0].replace("/msg/", "/")
        if wanted is not None:
            for topic in topics:
                if topic.lstrip("/") == wanted.lstrip("/"):
                    return topic
            found = ", ".join(topics) or "none"
            message = (
                f"{self._path}: no {kind} topic {wanted!r} in it; found {found}; change {key} or "
                "leave it out"
            )
            raise LogError(message)
        if not filled:
            others = ", ".join(sorted({item.topic for item in self._reader.connections}))
            advice = "give a bag that recorded one"
            if self.topics([POINT_CLOUD]):
                advice = "make one of the point cloud with the ROS package pointcloud_to_laserscan"
            found = f"{', '.join(topics)} without a message" if topics else others or "nothing"
            message = (
                f"{self._path}: no laser in it: wanted a {kind} topic, found {found}; {advice}"
            )
            raise LogError(message)
        if len(filled) > 1:
            message = (
                f"{self._path}: several {kind} topics: {', '.join(filled)}; choose one with {key}"
            )
            raise LogError(message)
        return filled[0]

    def topics(self, types: Sequence[str], sibling: str = "") -> list[str]:
        """Return the topics of these types that have messages, in order.

        Args:
            types: of messages.
            sibling: a topic; only those in its namespace are returned, if there are any.
        """
        found = sorted(
            {
                item.topic
                for item in self._reader.connections
                if item.msgtype in types and item.msgcount
            }
        )
        namespace = sibling.rpartition("/")[0]
        own = [topic for topic in found if topic.rpartition("/")[0] == namespace]
        return own if sibling and own else found

    def count(self, topic: str) -> int:
        """Return how many messages a topic has."""
        return sum(item.msgcount for item in self._connections([topic]))

    def messages(self, *topics: str) -> Iterator[BagMessage]:
        """Yield the messages of topics, in the order of recording."""
        connections = self._connections(topics)
        # The reader takes an empty list for all topics.
        for connection, recorded_ns, raw in (
            self._reader.messages(connections) if connections else ()
        ):
            yield BagMessage(connection.topic, recorded_ns, self._content(connection, raw))

    def _connections(self, topics: Sequence[str]) -> list[Connection]:
        return [item for item in self._reader.connections if item.topic in topics]

    def _content(self, connection: Connection, raw: bytes) -> Any:
        """Return the message, or None when its bytes are none."""
        try:
            return self._reader.deserialize(raw, connection.msgtype)
        except Exception:  # noqa: BLE001  (damaged bytes fail in many ways; the caller counts them)
            return None


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag; whatever the library stumbles over is damage of the bag.

    Raises:
        LogError: not a readable bag, or ``rosbags`` is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415  (an extra, and slow to load)
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        message = f"{path}: reading bags needs rosbags; pip install 'slamfusion[bags]'"
        raise LogError(message) from error
    try:
        # Old ROS 2 bags do not carry their message definitions.
        store = get_typestore(Stores.LATEST)
        _check_files(path)
        limit_unpacking()
        with ExitStack() as stack:
            yield OpenBag(path, _reader(path, partial(AnyReader, default_typestore=store), stack))
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
    except OSError as error:
        if error.errno not in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}:
            raise _not_a_bag(path, error) from error
        # Nothing is written but what is unpacked.
        message = (
            f"{path}: cannot be unpacked in {tempfile.gettempdir()}: {error.strerror}; free some "
            "space there, or let TMPDIR name another folder"
        )
        raise LogError(message) from None
    except Exception as error:
        raise _not_a_bag(path, error) from error


def _reader(path: Path, make: Callable[[list[Path]], AnyReader], stack: ExitStack) -> AnyReader:
    """Return the open reader of a bag; where its index leads to nothing, of its storage files."""
    files = _storage(path) if path.is_dir() else []
    try:
        reader = stack.enter_context(make(_files(path)))
    except Exception:
        # People edit the index by hand; the messages may be whole.
        if not files:
            raise
        return stack.enter_context(make(files))
    if files and next(reader.messages(), None) is None:
        return stack.enter_context(make(files))
    return reader


def _not_a_bag(path: Path, error: Exception) -> LogError:
    """Say in one line what the library stumbled over."""
    reason = textwrap.shorten(str(error), 120) or type(error).__name__
    message = (
        f"{path}: cannot be read as a bag ({reason}); check that it was recorded and copied to "
        "its end"
    )
    return LogError(message)


def _files(path: Path) -> list[Path]:
    """Return what to open: the path itself, or the storage files of a folder without index."""
    is_indexed = not path.is_dir() or (path / METADATA).exists()
    return [path] if is_indexed else _storage(path) or [path]


def _storage(path: Path) -> list[Path]:
    """Return the storage files of a bag's folder, of one kind."""
    kinds = (sorted(path.glob(pattern)) for pattern in ("*.mcap", "*.db3"))
    return next((files for files in kinds if files), [])


def _check_files(path: Path) -> None:
    """Refuse pipes and devices among a bag's files, and metadata that are no small YAML."""
    if not path.is_dir():
        open_regular(path, LogError).close()
        return
    for pattern in _PARTS:
        for file in path.glob(pattern):
            open_regular(file, LogError).close()
    if (path / METADATA).exists():
        read_yaml(path / METADATA, LogError, "a bag's metadata", as_text=True)


def stamp_s(message: Any) -> float:
    """Return the time in a message's header, seconds."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec * 1e-9)
