"""The paths of the command line: what each is read for, or what is written to it."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from slamfusion.cli.output import notice
from slamfusion.errors import SlamFusionError
from slamfusion.io.files import refuse_overwriting
from slamfusion.io.lines import MAP_SUFFIXES
from slamfusion.jobs.cases import CaseFile, case_names
from slamfusion.jobs.inputs import check_writable, is_yaml, map_file
from slamfusion.jobs.outputs import STORE_END, TRIALS

# Files of a path, kept by name among the values that the command was given.
Files = Callable[[Path, Mapping[str, Any]], Iterable[Path]]


class InputPath(click.Path):
    """A path that is read (``files``: by its files) and need not exist; ``~`` is expanded."""

    def __init__(self, files: Files) -> None:
        super().__init__(readable=False, path_type=Path)
        self.files = files

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; ``~NAME`` stays if there is no user NAME."""
        return super().convert(os.path.expanduser(value), param, ctx)  # noqa: PTH111 - pathlib raises


class CasePath(InputPath):
    """An input that may be said to belong to a case: ``CASE=FILE``."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the file and the case."""
        found = CaseFile.parse(value)
        return replace(found, path=super().convert(str(found.path), param, ctx))


class OutputPath(InputPath):
    """A path that is written to: a file, or a folder or start of names for several.

    A folder in place of a name, a wrong suffix, or a missing extra that the module ``needs`` loads,
    is an error before any work.
    """

    def __init__(
        self, files: Files, ends: Sequence[str] = (), needs: str = "", *, is_folder: bool = False
    ) -> None:
        super().__init__(files)
        self.ends, self.needs, self.is_folder = ends, needs, is_folder

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path."""
        path: Path = super().convert(value, param, ctx)
        is_folder = str(value).endswith(os.sep) or path.name in {"", ".."} or path.is_dir()
        if is_folder and not self.is_folder and path.suffix != STORE_END:
            message = f"{value}: wanted a name, found a folder; write e.g. {path / 'NAME'}"
            self.fail(message, param, ctx)
        if self.ends and path.suffix.lower() not in self.ends:
            self.fail(f"{path}: wanted a name that ends in {', '.join(self.ends)}", param, ctx)
        if self.needs:
            importlib.import_module(self.needs)
        return path


def _read_of_file(path: Path, _: Mapping[str, Any]) -> Iterable[Path]:
    from slamfusion.io.logs import log_sources  # noqa: PLC0415  (OpenCV loads slowly)

    return [path, *log_sources(path)]


def _read_of_map(path: Path, _: Mapping[str, Any]) -> Iterable[Path]:
    from slamfusion.io.map_server import map_sources  # noqa: PLC0415  (OpenCV loads slowly)

    return map_sources(map_file(path))


# A file of any kind, or the folder of a log or bag; a map.
FILE, CASE_FILE = InputPath(_read_of_file), CasePath(_read_of_file)
MAP, CASE_MAP = InputPath(_read_of_map), CasePath(_read_of_map)


def stem_of(out: Path) -> Path:
    """Take ``-o OUT`` as the stem of files; the suffix of a map, a path or a record is dropped."""
    is_file = out.suffix.lower() in {*MAP_SUFFIXES, ".tum", ".json", STORE_END}
    return out.with_suffix("") if is_file else out


def case_folders(folder: Path, files: Sequence[CaseFile]) -> list[Path]:
    """Return the folder of each case of several truths or logs; of one the folder itself."""
    return [folder] if len(files) < 2 else [folder / case for case in case_names(files)]


def _given_paths(
    context: click.Context, given: Mapping[str, Any]
) -> Iterator[tuple[click.Parameter, InputPath, Path]]:
    """Yield each path that a command was given, after its option and its kind."""
    for option in context.command.params:
        value = given.get(option.name or "")
        for item in value if isinstance(value, tuple) else () if value is None else (value,):
            if isinstance(option.type, InputPath):
                yield option, option.type, item.path if isinstance(item, CaseFile) else item


def has_only_yaml(context: click.Context) -> bool:
    """Return whether there are maps among the inputs of a command, each with a YAML."""
    given = _given_paths(context, context.params)
    maps = [map_file(path) for _, kind, path in given if kind in {MAP, CASE_MAP}]
    return bool(maps) and all(is_yaml(path) for path in maps)


@contextmanager
def checked_paths(context: click.Context, given: Mapping[str, Any]) -> Iterator[None]:
    """Refuse outputs that replace inputs or each other, or cannot be written.

    After the command, name those that it did not write: of an earlier one, they look like its own.
    """
    reads: list[tuple[Path, Path]] = []
    writes: list[tuple[str, Path]] = []
    for option, kind, path in _given_paths(context, given):
        files = kind.files(path, given)
        if isinstance(kind, OutputPath):
            writes += [(f"{option.opts[0]} {path}", file) for file in files]
        else:
            reads += [(path, file) for file in files]
    try:
        refuse_overwriting(reads, writes)
    except SlamFusionError as error:
        raise click.BadParameter(str(error)) from None
    for folder in dict.fromkeys(file.parent for _, file in writes):
        check_writable(folder)
    earlier = {
        file: file.stat().st_ino
        for _, file in writes
        if file.parent.name != TRIALS and file.exists()
    }
    yield
    # Whatever writes a file puts a new one in its place.
    stays = [str(file) for file in earlier if file.exists() and file.stat().st_ino == earlier[file]]
    if stays:
        notice(f"not from this command, though named like its results: {', '.join(stays)}")
