"""No file that is read is written over."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from slamfusion.errors import SlamFusionError


def refuse_overwriting(
    reads: Iterable[tuple[Path, Path]], writes: Iterable[tuple[str, Path]]
) -> None:
    """Refuse outputs that would replace an input or each other, and what no file can replace.

    Two paths are of one file where they are the same without links, or lead to the same inode:
    hard links, or names that differ in letters which the file system does not tell apart.

    Args:
        reads: inputs as they were given, each with a file that is read for it.
        writes: outputs as they were asked for, in words, each with a file that may be written or
            removed for it.

    Raises:
        SlamFusionError: names the input and the output.
    """
    taken: dict[Hashable, str] = {}
    for given, file in reads:
        words = f"the input {file}" + ("" if file == given else f" (of {given})")
        for mark in _marks(file):
            taken.setdefault(mark, words)
    for asked, file in writes:
        own = f"a file of {asked}"
        for mark in _marks(file):
            words = taken.setdefault(mark, own)
            if words != own:
                message = f"{asked} would replace {words} with {file}; choose another name"
                raise SlamFusionError(message)
        if file.exists() and not file.is_file():
            what = "a folder" if file.is_dir() else "a device or pipe"
            message = f"{asked} cannot be written: {file} is {what}; name a file"
            raise SlamFusionError(message)


def _marks(path: Path) -> Iterator[Hashable]:
    """Yield what a path has in common with every other one of its file."""
    with suppress(OSError, ValueError):  # a path that cannot be is named when it is opened
        yield os.path.realpath(path)
        found = path.stat()
        yield found.st_dev, found.st_ino
