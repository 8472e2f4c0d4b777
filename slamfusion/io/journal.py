"""The journal of files that are put in place together, and how a folder is put right after a kill.

A writer holds one locked file ``.slamfusion-TOKEN.journal`` in every folder that it writes to. Its
new files wait beside it as ``.slamfusion-TOKEN-N.tmp``, and while the set is switched the files
that were there wait as ``.slamfusion-TOKEN-N.old``. The first folder's journal, the home, names all
of them before the first is touched; that it is empty again is the moment in which the new set
counts. The system gives up the lock when the writer ends, in whatever way: a journal that can be
locked is that of a dead writer, and what it lists is moved back.

A journal is believed only where it was written: it carries a seal of this machine, this user and
the file that it is. One that came with a copied or unpacked folder could name any file of the
user's; it is left alone, with all that belongs to it.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import os
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = [
    "Entry",
    "Journal",
    "hold_folders",
    "is_switching",
    "move_back",
    "put_right",
    "sync_folder",
]

PREFIX = ".slamfusion-"
SUFFIX = ".journal"
# Files of no journal are left by a version that had none, or by hand; a writer of such a version
# may be at work, so only those that nobody touched for this long are removed.
ORPHAN_S = 86_400.0
# Creating a journal and locking it are two steps; a sweeper may come between them.
LOCK_TRIES = 100
# Seconds to wait for another writer's switch, which takes milliseconds unless it is stopped.
SWITCH_S, LOOK_S = 5.0, 0.002

# Names this machine, where the system has such a file.
MACHINE = Path("/etc/machine-id")
SEAL = "seal"

_LOG = logging.getLogger(__name__)
_LEFT = re.compile(r"\.slamfusion-([0-9a-f]{16})(-\d+)?\.(tmp|old)")


@dataclass(frozen=True)
class Entry:
    """One file of a set.

    Attributes:
        target: where it goes; an absolute path.
        number: tells its waiting files from those of the set's others.
        is_new: whether a file is put there; else the one that is there goes.
        was_there: whether a file was there when the set was written.
    """

    target: Path
    number: int
    is_new: bool
    was_there: bool

    def temporary(self, token: str) -> Path:
        """Return where the new file waits."""
        return self.target.parent / f"{PREFIX}{token}-{self.number}.tmp"

    def old(self, token: str) -> Path:
        """Return where the file that was there waits."""
        return self.target.parent / f"{PREFIX}{token}-{self.number}.old"


class Journal:
    """One writer's locked journal in one folder.

    Args:
        folder: exists.
        token: 16 hexadecimal digits, the same in all folders of the set.

    Raises:
        OSError: no file can be made there.
    """

    def __init__(self, folder: Path, token: str) -> None:
        self.folder = folder
        self.token = token
        self.path = folder / f"{PREFIX}{token}{SUFFIX}"
        self._descriptor = _create_locked(self.path)

    def write(self, entries: list[Entry], folders: list[Path]) -> None:
        """Make this the home of a set: from now on a kill brings the old files back.

        Args:
            entries: the files of the set.
            folders: all folders of the set.
        """
        self._write(
            {
                "folders": [self._relative(folder) for folder in folders],
                "entries": [
                    {
                        "target": self._relative(entry.target),
                        "number": entry.number,
                        "is_new": entry.is_new,
                        "was_there": entry.was_there,
                    }
                    for entry in entries
                ],
            }
        )

    def point_to(self, home: Journal) -> None:
        """Say where the home of the set is."""
        self._write({"home": self._relative(home.path)})

    def empty(self) -> None:
        """End the switch: of a home, the new set counts from now on."""
        os.ftruncate(self._descriptor, 0)
        os.fsync(self._descriptor)

    def close(self, *, keep: bool = False) -> None:
        """Give up the lock; remove what waits in the folder, then the journal, if not to keep."""
        if not keep:
            _sweep(self.folder, self.token)
        os.close(self._descriptor)

    def _relative(self, path: Path) -> str:
        return os.path.relpath(path, self.folder)

    def _write(self, record: dict[str, Any]) -> None:
        record = {**record, SEAL: _seal(self._descriptor)}
        data = f"{json.dumps(record)}\n".encode("utf-8", errors="surrogateescape")
        done = 0
        while done < len(data):
            done += os.write(self._descriptor, data[done:])
        os.fsync(self._descriptor)
        sync_folder(self.folder)


def put_right(folder: Path, *, sweep: bool = True) -> None:
    """Move back what a killed writer left half switched, and remove what it left behind.

    Files of a live writer are not touched.

    Args:
        folder: need not exist.
        sweep: also remove files that wait for nothing; a reader leaves them.

    Raises:
        OSError: files cannot be moved back.
    """
    for path in _journals(folder):
        with _lock(path) as descriptor:
            if descriptor is None:
                continue
            record = _read(descriptor)
            if _is_foreign(record, descriptor, path):
                continue
            home = record.get("home")
            if home is not None and not _put_home_right(folder / home):
                continue
            if "entries" in record:
                _roll_back(path, descriptor, record)
            if record or sweep:
                _sweep(folder, _token(path))
    if sweep:
        _sweep_orphans(folder)


@contextmanager
def hold_folders(folders: Iterable[Path]) -> Iterator[None]:
    """Keep other writers from switching files in folders meanwhile; wait while one does.

    Raises:
        OSError: another one did not come to its end.
    """
    held: list[int] = []
    try:
        for folder in sorted(set(folders)):
            held.append(os.open(folder, os.O_RDONLY))
            end_s = time.monotonic() + SWITCH_S
            while not _try_lock(held[-1]):
                if time.monotonic() > end_s:
                    raise OSError(errno.EBUSY, "another process does not end writing there")
                time.sleep(LOOK_S)
        yield
    finally:
        for descriptor in held:
            os.close(descriptor)


def is_switching(folder: Path) -> bool:
    """Whether a live writer is putting a set of files in place there."""
    for path in _journals(folder):
        with suppress(OSError), _lock(path) as descriptor:
            if descriptor is None and path.stat().st_size:
                return True
    return False


def sync_folder(folder: Path) -> None:
    """Force what was made, renamed and removed in a folder to disk, where the system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def move_back(entries: list[Entry], token: str) -> None:
    """Bring the files back that were there before a switch, however far it came.

    First every new file goes, then the old ones come: old and new never lie side by side.

    Raises:
        OSError: a file cannot be moved.
    """
    for entry in entries:
        temporary, old = entry.temporary(token), entry.old(token)
        # New files come when all old ones have gone: where one was and has not, it is still there.
        has_come = entry.is_new and not temporary.exists() and entry.target.exists()
        if has_come and (old.exists() or not entry.was_there):
            entry.target.replace(temporary)
    for entry in entries:
        old = entry.old(token)
        if old.exists() and not entry.target.exists():
            old.replace(entry.target)
    for folder in {entry.target.parent for entry in entries}:
        sync_folder(folder)


def _put_home_right(home: Path) -> bool:
    """Move back what the journal of another folder lists; where it is gone or empty, nothing.

    Returns:
        Whether that is done; False while another process is at it.
    """
    if not home.exists():
        return True
    with _lock(home) as descriptor:
        if descriptor is None:
            return False
        record = _read(descriptor)
        if _is_foreign(record, descriptor, home):
            return True
        if record:
            _roll_back(home, descriptor, record)
        _sweep(home.parent, _token(home))
    return True


def _roll_back(home: Path, descriptor: int, record: dict[str, Any]) -> None:
    """Move back what a home lists, in all its folders, and empty it."""
    token = _token(home)
    entries = [
        Entry(
            Path(os.path.normpath(home.parent / values["target"])),
            values["number"],
            values["is_new"],
            values["was_there"],
        )
        for values in record["entries"]
    ]
    folders = [Path(os.path.normpath(home.parent / folder)) for folder in record["folders"]]
    with hold_folders(folder for folder in folders if folder.is_dir()):
        move_back(entries, token)
    _truncate(home)
    os.fsync(descriptor)
    for folder in folders:
        if folder != home.parent:
            _sweep(folder, token)


def _truncate(path: Path) -> None:
    descriptor = os.open(path, os.O_WRONLY)
    try:
        os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def _create_locked(path: Path) -> int:
    """Make a file and lock it; the lock goes with the process."""
    for _ in range(LOCK_TRIES):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            if not _try_lock(descriptor) or not _is_at(descriptor, path):
                # A reader that looked into it holds it for a moment, and leaves it there.
                path.unlink(missing_ok=True)
                os.close(descriptor)
                continue
        except BaseException:
            os.close(descriptor)
            path.unlink(missing_ok=True)
            raise
        return descriptor
    raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))


def _try_lock(descriptor: int) -> bool:
    """Lock a file; False where another holds it. A system without locks locks nothing."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the path still leads to the open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


@contextmanager
def _lock(path: Path) -> Iterator[int | None]:
    """Hold the journal of a dead writer; None where that is not sure, or the journal gone."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        yield None
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_held = _is_at(descriptor, path)
        except OSError:
            is_held = False
        yield descriptor if is_held else None
    finally:
        os.close(descriptor)


def _read(descriptor: int) -> dict[str, Any]:
    """Return what a journal says; empty where it was not written whole: then nothing was moved."""
    parts = []
    os.lseek(descriptor, 0, os.SEEK_SET)
    while part := os.read(descriptor, 1 << 16):
        parts.append(part)
    data = b"".join(parts)
    if not data.endswith(b"\n"):
        return {}
    try:
        record = json.loads(data.decode("utf-8", errors="surrogateescape"))
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def _seal(descriptor: int) -> str:
    """Return what only this machine writes into this file: a digest, 32 hexadecimal digits."""
    try:
        machine = MACHINE.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        machine = ""
    parts = (machine, os.getuid(), os.fstat(descriptor).st_ino)
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def _is_foreign(record: dict[str, Any], descriptor: int, path: Path) -> bool:
    """Whether a journal was written elsewhere; said each time that it is met."""
    if not record or record.get(SEAL) == _seal(descriptor):
        return False
    _LOG.warning("%s: written elsewhere (a copied folder?), so it is not followed", path)
    return True


def _journals(folder: Path) -> list[Path]:
    """Return the journals in a folder, in order."""
    try:
        with os.scandir(folder) as items:
            names = [item.name for item in items if item.name.startswith(PREFIX)]
    except (OSError, ValueError):
        return []
    return [folder / name for name in sorted(names) if name.endswith(SUFFIX)]


def _token(path: Path) -> str:
    return path.name.removeprefix(PREFIX).removesuffix(SUFFIX)


def _sweep(folder: Path, token: str) -> None:
    """Remove a set's waiting files, and last its journal."""
    with suppress(OSError):
        for path in folder.glob(f"{PREFIX}{token}-*"):
            path.unlink(missing_ok=True)
        (folder / f"{PREFIX}{token}{SUFFIX}").unlink(missing_ok=True)


def _sweep_orphans(folder: Path) -> None:
    """Remove waiting files of no journal that nobody touched for long."""
    with suppress(OSError):
        for path in folder.glob(f"{PREFIX}*"):
            found = _LEFT.fullmatch(path.name)
            if found is None or (folder / f"{PREFIX}{found[1]}{SUFFIX}").exists():
                continue
            if time.time() - path.stat().st_ctime > ORPHAN_S:
                path.unlink(missing_ok=True)
