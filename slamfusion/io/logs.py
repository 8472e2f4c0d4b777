"""``open_log``: any log or bag as a stream of scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.io.bags import (
    MCAP_MAGIC,
    METADATA,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    STORAGE_FILES,
    ZSTD_MAGIC,
)
from slamfusion.io.carmen import CARMEN_WORDS, CarmenLog
from slamfusion.io.lines import KINDS, read_head, strip_gz
from slamfusion.io.log import ScanLog
from slamfusion.io.tinyslam_dat import FIELDS, TinySlamDat

Reader = Callable[[Path, LogConfig], ScanLog]


def _bag_log(path: Path, config: LogConfig) -> ScanLog:
    from slamfusion.io.bags.log import BagLog  # noqa: PLC0415  (text logs are to start light)

    return BagLog(path, config)


# Also of unclosed and packed bags.
BAG_SUFFIXES = (".bag", ".db3", ".mcap", ".active", ".zstd", ".zst")
# By the end of the name, without .gz; clear content has precedence.
_READERS: dict[str, Reader] = {
    ".clf": CarmenLog,
    ".log": CarmenLog,
    ".gfs": CarmenLog,
    ".carmen": CarmenLog,
    ".txt": CarmenLog,
    ".dat": TinySlamDat,
    **dict.fromkeys(BAG_SUFFIXES, _bag_log),
}
_BAG_MAGICS = (ROS1_MAGIC, SQLITE_MAGIC, MCAP_MAGIC, ZSTD_MAGIC)
# Number of logs of a folder that a message names.
_NAMED = 5
_BAG_FILES = (METADATA, *STORAGE_FILES)
# Text has no control characters but tab, line feed, form feed and carriage return.
_NO_TEXT = bytes(set(range(32)) - set(b"\t\n\f\r"))


def open_log(
    path: str | Path, config: LogConfig = LogConfig(), scan_odometry: str | Path | None = None
) -> ScanLog:
    """Open a log or bag.

    Args:
        path: CARMEN (.clf, .log, .gfs, .carmen, .txt) or tinySLAM (.dat), each also as .gz; a
            ROS 1 bag (.bag, .bag.active); a ROS 2 bag's folder, its metadata.yaml, .db3 or .mcap
            (also packed, .zstd); a folder with a single log in it.
        config: topics and frames of bags, the no-return value, the period for broken stamps.
        scan_odometry: a CSV file with odometry for each laser line of a CARMEN log (see
            ``read_scan_odometry``); default: the log's own.

    Raises:
        LogError: empty, an unknown kind of log, or no laser in it; or ``scan_odometry`` cannot be
            read or is of another log.
        OSError: the file cannot be opened.
    """
    where = log_at(Path(path))
    reader = _reader(where)
    log: ScanLog
    if scan_odometry is None:
        log = reader(where, config)
    elif reader is CarmenLog:
        log = CarmenLog(where, config, scan_odometry)
    else:
        raise LogError(
            f"{where}: only a CARMEN log takes its odometry from {scan_odometry}; leave it out"
        )
    if config.deskew == "auto":
        log.learn_sweep()
    return log


def bag_at(path: Path) -> Path | None:
    """Return the bag that ``open_log`` reads at a path; None for another log."""
    where = log_at(path)
    return where if _reader(where) is _bag_log else None


def is_bag_folder(folder: Path) -> bool:
    """Return whether a folder has the files of a ROS 2 bag."""
    return any(any(folder.glob(pattern)) for pattern in _BAG_FILES)


def log_sources(path: Path) -> list[Path]:
    """Return the files that ``open_log`` reads."""
    where = log_at(path)
    files = [item for pattern in _BAG_FILES for item in where.glob(pattern)]
    return files if where.is_dir() else [where]


def log_at(path: Path) -> Path:
    """Return the folder of a bag for its index, and for another folder the one log in it."""
    if path.name == _BAG_FILES[0]:
        return path.parent
    if path.is_dir() and not is_bag_folder(path) and len(logs := _logs_in(path)) == 1:
        return logs[0]
    return path


def _suffix(where: Path) -> str:
    return Path(strip_gz(where.name)).suffix


def _logs_in(folder: Path) -> list[Path]:
    return sorted(item for item in folder.iterdir() if _suffix(item) in _READERS)


def check_folder(path: Path, others: str = "") -> None:
    """Refuse a folder that is neither of a bag nor of one log; ``others``: what else it may be."""
    where = log_at(path)
    if not where.is_dir() or is_bag_folder(where):
        return
    kinds = {item.name: KINDS.get(_suffix(item)) for item in sorted(where.iterdir())}
    found = f"{', '.join([*kinds][:_NAMED]) or 'nothing'} in it; name a log or a bag's folder"
    if logs := _logs_in(where):
        found = f"several logs ({', '.join(item.name for item in logs[:_NAMED])}); name one"
    elif where.suffix in KINDS:
        found = KINDS[where.suffix]
    else:
        found = next((f"one with {name}, {kind}" for name, kind in kinds.items() if kind), found)
    raise LogError(
        f"{where}: wanted {others}the folder of a ROS 2 bag (metadata.yaml, .db3 or .mcap) or of "
        f"one log, found {found}"
    )


def _reader(where: Path) -> Reader:
    check_folder(where)
    if where.is_dir():
        return _bag_log
    head = read_head(where)
    suffix, known = _suffix(where), _reader_by_content(head)
    if suffix not in _READERS:
        found = f"{suffix or 'no extension'!r}; give a log"
        if known is not None:
            found = f"a log that ends in {suffix!r}; rename it by its kind"
        raise LogError(
            f"{where}: wanted a log named {', '.join(_READERS)} (text also .gz) or a ROS 2 bag's "
            f"folder, found {KINDS.get(suffix, found) if known is None else found}"
        )
    if not head:
        raise LogError(f"{where}: the file is empty; give a log with scans")
    if known is not None:
        return known
    if _READERS[suffix] is not _bag_log and head.translate(None, _NO_TEXT) != head:
        raise LogError(f"{where}: wanted a text log, found binary data; check what the file is")
    return _READERS[suffix]


def _reader_by_content(head: bytes) -> Reader | None:
    if head.startswith(_BAG_MAGICS):
        return _bag_log
    for fields in map(bytes.split, head.splitlines()):
        if not fields or fields[0].startswith(b"#"):
            continue
        if fields[0] in CARMEN_WORDS:
            return CarmenLog
        if len(fields) == FIELDS and fields[0].isdigit():
            return TinySlamDat
    return None
