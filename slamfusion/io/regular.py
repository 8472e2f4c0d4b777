"""Files that are opened to be read: regular ones only, so that nothing is waited for."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

from slamfusion.errors import SlamFusionError
from slamfusion.io.memory import format_bytes

# Files that people write by hand: settings, courses, distances, maps' YAML.
SMALL_BYTES = 2**20

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
)


def open_regular(path: Path, error: type[SlamFusionError]) -> BufferedReader:
    """Open a file for reading; what would make the reader wait or never end is refused.

    Args:
        path: the file, links followed.
        error: raised for a folder, pipe, socket or device.

    Raises:
        SlamFusionError: ``error``; it names the file and what was found.
        OSError: the file cannot be opened.
    """
    _check_regular(path, path.stat().st_mode, error)
    # What was a file a moment ago may be a pipe by now: opening must not wait for its writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        _check_regular(path, os.fstat(descriptor).st_mode, error)
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def read_small(path: Path, error: type[SlamFusionError], what: str) -> bytes:
    """Return the bytes of a file that a person may have written, at most ``SMALL_BYTES``.

    Args:
        path: the file.
        error: raised where it is no regular file, or larger.
        what: the file should be, with its article.

    Raises:
        SlamFusionError: ``error``.
        OSError: the file cannot be read.
    """
    with open_regular(path, error) as file:
        data = file.read(SMALL_BYTES + 1)
    if len(data) > SMALL_BYTES:
        message = (
            f"{path}: wanted {what} of at most {format_bytes(SMALL_BYTES)}, found more; "
            "check what the file is"
        )
        raise error(message)
    return data


def _check_regular(path: Path, mode: int, error: type[SlamFusionError]) -> None:
    if not stat.S_ISREG(mode):
        found = next((name for is_kind, name in _KINDS if is_kind(mode)), "a device")
        mend = "name a file in it" if stat.S_ISDIR(mode) else "save it to a file and name that"
        message = f"{path}: wanted a file, found {found}; {mend}"
        raise error(message)
