"""Files that appear whole or not at all.

The data goes into a temporary file next to its target, is forced to disk, and is only then renamed
over the target. The old file stays until that moment, and stays for good if anything fails.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from slamfusion.errors import MapFileError

_FIXES = {
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some of the quota or write elsewhere",
    errno.EFBIG: "raise the file size limit or write elsewhere",
    errno.EACCES: "choose a place you may write to",
    errno.EPERM: "choose a place you may write to",
    errno.EROFS: "choose a place you may write to",
    errno.ENAMETOOLONG: "choose a shorter name",
}


class AtomicFiles:
    """Several files that are put in place together when the ``with`` block ends well.

    Within the block ``add`` writes each file next to its target. At the end of the block they all
    are renamed over their targets, in the order in which they were added, and then the files passed
    to ``remove`` are removed; two processes that do so in one folder take turns. An exception in
    the block, also a keyboard interrupt, removes what was written and leaves the old files as they
    were. Missing parent folders are made. Links are followed, so a linked file stays a link.

    A process that is killed between two renames leaves new files next to old ones, each of them
    whole. A file that depends on another one is therefore added after it, and holds its digest
    (``save_map``).

    Raises:
        MapFileError: a target cannot be written; names it, the system's reason and what to do.
    """

    def __init__(self) -> None:
        self._targets: dict[Path, Path] = {}  # by temporary file
        self._removed: list[Path] = []
        self._made_folders: list[Path] = []

    def add(self, path: str | Path, *parts: bytes | bytearray | memoryview) -> None:
        """Write one file next to its target.

        Args:
            path: the target; absent or a regular file.
            parts: its bytes, in order; several parts save a large array from being copied.
        """
        try:
            target = Path(os.path.realpath(path))
            self._make_folder(target.parent)
            mode = _mode_of_regular(target)
            temporary = target.parent / f".slamfusion-{secrets.token_hex(8)}.tmp"
            self._targets[temporary] = target
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
        """Remove a file, which need not be there, at the end of the block."""
        self._removed.append(Path(path))

    def __enter__(self) -> AtomicFiles:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        path = None
        try:
            if kind is None:
                with _locked({path.parent for path in self._targets.values()}):
                    for temporary, path in self._targets.items():
                        temporary.replace(path)
                    for path in self._removed:
                        path.unlink(missing_ok=True)
        except OSError as error:
            raise _cannot_write(path, error) from None
        finally:
            for temporary in self._targets:
                with suppress(OSError):
                    temporary.unlink(missing_ok=True)
            for folder in reversed(self._made_folders):
                with suppress(OSError):  # it holds files
                    folder.rmdir()

    def _make_folder(self, folder: Path) -> None:
        """Make the folder and its missing parents, and remember which were made."""
        missing = [part for part in (folder, *folder.parents) if not part.exists()]
        for part in reversed(missing):
            part.mkdir(exist_ok=True)
            self._made_folders.append(part)


@contextmanager
def _locked(folders: set[Path]) -> Iterator[None]:
    """Let one process at a time rename files in the folders: the files of two are not mixed."""
    with ExitStack() as held:
        for folder in sorted(folders):
            descriptor = os.open(folder, os.O_RDONLY)
            held.callback(os.close, descriptor)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


def write_atomic(
    path: str | Path, data: bytes | bytearray | memoryview, *, files: AtomicFiles | None = None
) -> None:
    """Write one file whole or not at all; see ``AtomicFiles`` for the rules and errors.

    Args:
        path: the file.
        data: all of it.
        files: add the file to these, to appear together with them; default: write it now.
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


def _cannot_write(path: str | Path | None, error: OSError | ValueError) -> MapFileError:
    """Say in one line which file could not be written, why, and what to do."""
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        fix = _FIXES.get(error.errno or 0, "check the path or write elsewhere")
    else:
        reason, fix = str(error), "choose another name"
    return MapFileError(f"{path}: cannot write: {reason}; {fix}")
