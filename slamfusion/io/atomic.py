"""Files that appear whole or not at all.

Data goes into temporary files beside their targets, is forced to disk, and only then renamed. What
was there before stays until that moment, and stays for good when anything fails, also when the
process is killed at any moment (``journal``).
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import stat
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamfusion.errors import MapFileError
from slamfusion.io.journal import Entry, Journal, hold_folders, move_back, put_right, sync_folder

__all__ = ["AtomicFiles", "write_atomic", "write_json_atomic", "write_text_atomic"]

_MENDS = {
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some of the quota or write elsewhere",
    errno.EFBIG: "raise the file size limit or write elsewhere",
    errno.EACCES: "choose a place you may write to",
    errno.EPERM: "choose a place you may write to",
    errno.EROFS: "choose a place you may write to",
    errno.ENAMETOOLONG: "choose a shorter name",
}


class AtomicFiles:
    """A set of files that are put in place together when the ``with`` block ends well.

    Within the block ``add`` stages each file, ``remove`` the removal of one; leaving it switches
    the whole set. An exception, also a keyboard interrupt, removes what was staged and leaves old
    files as they were. Missing parent folders are made. Links are followed, so a linked file stays
    a link.

    A single file is renamed over the old one: a reader meets one or the other. Of several files
    all old ones go before the first new one comes, so that no reader ever meets old and new side
    by side; for about a millisecond it meets none. A process that is killed in that time leaves a
    ``journal``, by which the next ``load_map`` or ``AtomicFiles`` in the folder brings the old set
    back; what a killed process leaves otherwise is removed by the next ``AtomicFiles`` there.

    Raises:
        MapFileError: a target cannot be written; names it, the system's reason and the mend.
    """

    def __init__(self) -> None:
        self._entries: list[Entry] = []
        self._journals: dict[Path, Journal] = {}
        self._made_folders: list[Path] = []
        self._token = secrets.token_hex(8)
        self._is_half_switched = False

    @property
    def targets(self) -> frozenset[Path]:
        """The files that will be put in place; absolute, links followed."""
        return frozenset(entry.target for entry in self._entries if entry.is_new)

    def add(self, path: str | Path, *parts: bytes | bytearray | memoryview) -> None:
        """Stage one file.

        Args:
            path: the target; absent or a regular file.
            parts: its bytes, in order; several parts save a large array from being copied.
        """
        try:
            target = Path(os.path.realpath(path))
            self._make_folder(target.parent)
            mode = _mode_of_regular(target)
            entry = self._enter(target, is_new=True)
            temporary = entry.temporary(self._token)
            with temporary.open("xb") as file:
                for part in parts:
                    file.write(part)
                file.flush()
                os.fsync(file.fileno())
            if mode is not None:
                temporary.chmod(mode)
        except (OSError, ValueError) as error:
            raise _cannot_write(path, error) from None

    def remove(self, path: str | Path) -> None:
        """Stage the removal of a file, which need not be there; not one that is also added."""
        try:
            target = Path(os.path.realpath(path))
            if _mode_of_regular(target) is not None:
                self._enter(target, is_new=False)
        except (OSError, ValueError) as error:
            raise _cannot_write(path, error) from None

    def __enter__(self) -> AtomicFiles:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._publish()
                self._made_folders.clear()
        finally:
            self._discard()

    def _make_folder(self, folder: Path) -> None:
        """Make the folder and its missing parents, and remember which were made."""
        missing = [part for part in (folder, *folder.parents) if not part.exists()]
        for part in reversed(missing):
            part.mkdir(exist_ok=True)
            self._made_folders.append(part)

    def _enter(self, target: Path, *, is_new: bool) -> Entry:
        """Take a file into the set, and begin the journal of its folder."""
        folder = target.parent
        if folder not in self._journals:
            put_right(folder)
            self._journals[folder] = Journal(folder, self._token)
        entry = Entry(target, len(self._entries), is_new, target.exists())
        self._entries.append(entry)
        return entry

    def _publish(self) -> None:
        """Put every staged file in place; on failure bring the old files back."""
        if not self._entries:
            return
        try:
            with hold_folders(self._journals):
                if len(self._entries) == 1 and self._entries[0].is_new:
                    entry = self._entries[0]
                    entry.temporary(self._token).replace(entry.target)
                else:
                    self._switch()
        except OSError as error:
            raise _cannot_write(self._entries[0].target, error) from None
        for folder in self._journals:
            sync_folder(folder)

    def _switch(self) -> None:
        """Put several files in place: the old ones go, the new ones come, the set counts."""
        home, *others = self._journals.values()
        self._entries = [replace(item, was_there=item.target.exists()) for item in self._entries]
        target = self._entries[0].target
        self._is_half_switched = True
        try:
            for other in others:
                other.point_to(home)
            home.write(self._entries, list(self._journals))
            for entry in self._entries:
                target = entry.target
                with suppress(FileNotFoundError):
                    target.replace(entry.old(self._token))
            for entry in self._entries:
                target = entry.target
                if entry.is_new:
                    entry.temporary(self._token).replace(target)
            for folder in self._journals:
                sync_folder(folder)
            home.empty()
        except BaseException as error:
            move_back(self._entries, self._token)
            self._is_half_switched = False
            if isinstance(error, OSError):
                raise _cannot_write(target, error) from None
            raise
        self._is_half_switched = False

    def _discard(self) -> None:
        """Remove what still waits, the journals (the home first), and the folders made for them.

        Where the old files could not be brought back, they and the journals stay for the next try.
        """
        for journal in self._journals.values():
            journal.close(keep=self._is_half_switched)
        for folder in reversed(self._made_folders):
            with suppress(OSError):
                folder.rmdir()
        self._entries.clear()
        self._journals.clear()
        self._made_folders.clear()


def write_atomic(
    path: str | Path, data: bytes | bytearray | memoryview, *, files: AtomicFiles | None = None
) -> None:
    """Write one file whole or not at all; see ``AtomicFiles`` for the rules and errors.

    Args:
        path: the file.
        data: all of it.
        files: stage the file here, to appear together with others; default: write it now.
    """
    if files is not None:
        files.add(path, data)
        return
    with AtomicFiles() as own:
        own.add(path, data)


def write_text_atomic(path: str | Path, text: str) -> None:
    """Write text as UTF-8, whole or not at all."""
    write_atomic(path, text.encode())


def write_json_atomic(path: str | Path, value: Any) -> None:
    """Write a value as indented JSON, whole or not at all; NaN and infinity are refused."""
    write_text_atomic(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def _mode_of_regular(target: Path) -> int | None:
    """Return the permissions of the file to replace, or None when there is none.

    A device, pipe or folder is refused: a rename would remove it.
    """
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a device or pipe"
        message = f"it is {what}, not a regular file"
        raise ValueError(message)
    return stat.S_IMODE(mode)


def _cannot_write(path: str | Path, error: OSError | ValueError) -> MapFileError:
    """Say in one line which file could not be written, why, and what to do."""
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        mend = _MENDS.get(error.errno or 0, "check the path or write elsewhere")
    else:
        reason, mend = str(error), "choose another name"
    return MapFileError(f"{path}: cannot write: {reason}; {mend}")
