"""Files that appear whole or not at all.

Data goes into temporary files beside their targets, is forced to disk, and only then renamed. What
was there before stays until that moment, and stays for good when anything fails.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from slamfusion.errors import MapFileError

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

    Within the block ``add`` stages each file; leaving it renames all, in the order they were added.
    An exception, also a keyboard interrupt, removes what was staged and leaves old files as they
    were. Missing parent folders are made. Links are followed, so a linked file stays a link. Each
    rename is atomic; between two of them a reader may meet one new and one old file.

    Raises:
        MapFileError: a target cannot be written; names it, the system's reason and the mend.
    """

    def __init__(self) -> None:
        self._staged: list[tuple[Path, Path]] = []
        self._made_folders: list[Path] = []

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
            temporary = target.parent / f".slamfusion-{secrets.token_hex(8)}.tmp"
            with temporary.open("xb") as file:
                self._staged.append((temporary, target))
                for part in parts:
                    file.write(part)
                file.flush()
                os.fsync(file.fileno())
            if mode is not None:
                temporary.chmod(mode)
        except (OSError, ValueError) as error:
            raise _cannot_write(path, error) from None

    def __enter__(self) -> AtomicFiles:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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

    def _publish(self) -> None:
        """Rename every staged file to its target; on failure put the old files back."""
        backups: list[Path] = []
        done: list[tuple[Path, Path | None]] = []
        target = Path()
        try:
            for temporary, target in self._staged:
                backup = _link_beside(target)
                if backup is not None:
                    backups.append(backup)
                was_there = target.exists()
                temporary.replace(target)
                if backup is not None or not was_there:
                    done.append((target, backup))
        except BaseException as error:
            for written, old in done:
                if old is None:
                    written.unlink(missing_ok=True)
                else:
                    old.replace(written)
            if isinstance(error, OSError):
                raise _cannot_write(target, error) from None
            raise
        finally:
            for backup in backups:
                backup.unlink(missing_ok=True)
        for folder in {target.parent for _, target in self._staged}:
            _sync_folder(folder)

    def _discard(self) -> None:
        """Remove what is still staged and the folders made for it."""
        for temporary, _ in self._staged:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        for folder in reversed(self._made_folders):
            with suppress(OSError):
                folder.rmdir()
        self._staged.clear()
        self._made_folders.clear()


def write_atomic(path: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Write one file whole or not at all; see ``AtomicFiles`` for the rules and errors."""
    with AtomicFiles() as files:
        files.add(path, data)


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


def _link_beside(target: Path) -> Path | None:
    """Keep the old file reachable under a second name until the new set is in place."""
    backup = target.parent / f".slamfusion-{secrets.token_hex(8)}.old"
    try:
        backup.hardlink_to(target)
    except OSError:  # no old file, or a file system without hard links
        return None
    return backup


def _sync_folder(folder: Path) -> None:
    """Force the renames in a folder to disk, where the file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _cannot_write(path: str | Path, error: OSError | ValueError) -> MapFileError:
    """Say in one line which file could not be written, why, and what to do."""
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        mend = _MENDS.get(error.errno or 0, "check the path or write elsewhere")
    else:
        reason, mend = str(error), "choose another name"
    return MapFileError(f"{path}: cannot write: {reason}; {mend}")
