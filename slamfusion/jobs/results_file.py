"""Results in a file, to be compared later: one zip with everything that was measured.

In it are ``manifest.json`` (how it was made: version, command, settings, the inputs' SHA-256),
``document.json`` (what the command prints with ``--json``), ``items.json`` (each map's or path's
figures) and ``series/*.csv`` (single errors along a path). The same results give the same bytes.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.errors import SlamFusionError, shown
from slamfusion.evaluation import ErrorSeries, MeasuredItem
from slamfusion.io import write_atomic
from slamfusion.io.map_yaml import existing, read_map_yaml
from slamfusion.io.memory import format_bytes
from slamfusion.io.regular import open_regular
from slamfusion.jobs.documents import record_bytes, versions
from slamfusion.jobs.inputs import map_file
from slamfusion.version import __version__

__all__ = [
    "InputFile",
    "ResultsFileError",
    "SavedResults",
    "map_inputs",
    "read_results",
    "write_results_file",
]

FORMAT, FORMAT_VERSION = "slamfusion-results", 1
MANIFEST, DOCUMENT, ITEMS, SERIES = "manifest.json", "document.json", "items.json", "series"
# What a file of results may unpack to: a thousand paths of ten thousand poses.
MOST_BYTES = 2**29
READ_BYTES = 2**20
# Of what is wrong with a file, in a message.
WHY_CHARACTERS = 150
# A zip holds dates; one and the same keeps the bytes of equal results equal.
NO_DATE = (1980, 1, 1, 0, 0, 0)
# What zipfile raises for files that are none.
_BROKEN = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError)


class ResultsFileError(SlamFusionError):
    """A file is none of saved results, or is damaged."""


@dataclass(frozen=True)
class InputFile:
    """A file that results rest on.

    Attributes:
        role: what it was: map, truth, path, log, ...
        case: that it belongs to; empty: all.
        path: as it was given.
    """

    role: str
    case: str
    path: Path


@dataclass(frozen=True, eq=False)
class SavedResults:
    """What a file of results says, as far as comparisons need it.

    Attributes:
        name: what tables call it.
        command: that made it, its words.
        version: of the program that made it.
        items: what was measured.
        yardsticks: (role, case) and SHA-256 of each truth, relations file and log.
    """

    name: str
    command: str
    version: str
    items: tuple[MeasuredItem, ...]
    yardsticks: Mapping[tuple[str, str], str]


def map_inputs(role: str, case: str, paths: Sequence[Path]) -> list[InputFile]:
    """Return the files of maps: each one's YAML, and the image that it names."""
    found = []
    for given in paths:
        path = map_file(given)
        found.append(InputFile(role, case, path))
        if path.suffix.lower() in {".yaml", ".yml"}:
            found.append(InputFile(f"{role} image", case, existing(read_map_yaml(path).image)))
    return found


# --- writing ------------------------------------------------------------------------------------


def write_results_file(
    path: str | Path,
    *,
    command: str,
    arguments: Sequence[str],
    document: Mapping[str, Any],
    items: Sequence[MeasuredItem],
    inputs: Sequence[InputFile] = (),
) -> None:
    """Write results to a zip, whole or not at all.

    Args:
        path: of the file.
        command: its words, e.g. ``trajectory``.
        arguments: as they were typed.
        document: what the command prints with ``--json``.
        items: what was measured, of distinct cases and methods.
        inputs: files that it rests on.

    Raises:
        SlamFusionError: the file cannot be written.
        OSError: an input cannot be read any more.
    """
    series: dict[str, bytes] = {}
    records = []
    for item in items:
        places = {}
        for name, own in item.series.items():
            places[name] = f"{SERIES}/{len(series) + 1:04d}.csv"
            series[places[name]] = _series_bytes(own)
        records.append({**item.to_json(), "series": places})
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "command": command,
        "arguments": list(arguments),
        "settings": document.get("config", {}),
        "versions": versions(),
        "inputs": [record for file in inputs for record in _input_records(file)],
    }
    contents = {
        MANIFEST: record_bytes(manifest),
        DOCUMENT: record_bytes(document),
        ITEMS: record_bytes({"items": records}),
        **series,
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name, NO_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            packed.writestr(entry, data)
    write_atomic(path, buffer.getvalue())


def _series_bytes(series: ErrorSeries) -> bytes:
    """Return a series as CSV: the places, then the error, in full."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    count = series.at.shape[1]
    writer.writerow([*(["at"] if count == 1 else [f"at_{n + 1}" for n in range(count)]), "error"])
    writer.writerows(
        [*map(repr, place), repr(error)]
        for place, error in zip(series.at.tolist(), series.errors.tolist(), strict=True)
    )
    return stream.getvalue().encode()


def _input_records(file: InputFile) -> Iterator[dict[str, Any]]:
    """Yield the record of a file; of a folder (a bag), one of each file in it."""
    paths = [file.path]
    if file.path.is_dir():
        paths = sorted(path for path in file.path.rglob("*") if path.is_file())
    for path in paths:
        digest, size = hashlib.sha256(), 0
        with open_regular(path, ResultsFileError) as data:
            while block := data.read(READ_BYTES):
                digest.update(block)
                size += len(block)
        yield {
            "role": file.role,
            "case": file.case,
            "name": str(path),
            "bytes": size,
            "sha256": digest.hexdigest(),
        }


# --- reading ------------------------------------------------------------------------------------


def read_results(path: str | Path, name: str | None = None) -> SavedResults:
    """Read a file of saved results.

    Args:
        path: of the zip.
        name: what tables call it; default: its stem.

    Raises:
        ResultsFileError: it is none, is damaged, of a newer version, or unpacks to too much.
        OSError: it cannot be opened.
    """
    where = Path(path)
    with open_regular(where, ResultsFileError) as file:
        try:
            with zipfile.ZipFile(file) as packed:
                return _Reader(where, packed).read(name or where.stem)
        except _BROKEN as error:
            found, why = "a damaged one or none", _short(error)
        except (NotImplementedError, RuntimeError) as error:
            found, why = "one that is packed in another way", _short(error)
    message = f"{where}: wanted a zip of --save-results, found {found} ({why}); save it again"
    raise ResultsFileError(message)


@dataclass(frozen=True)
class _Reader:
    """Reads the entries of one file, each checked.

    Attributes:
        where: the file, for messages.
        packed: the open zip.
    """

    where: Path
    packed: zipfile.ZipFile

    def read(self, name: str) -> SavedResults:
        """Return what the file says."""
        entries = self.packed.infolist()
        if MANIFEST not in {entry.filename for entry in entries}:
            message = (
                f"{self.where}: wanted a zip of --save-results, found one without {MANIFEST}; give "
                "a file that --save-results wrote"
            )
            raise ResultsFileError(message)
        unpacked = sum(entry.file_size for entry in entries)
        if unpacked > MOST_BYTES:
            message = (
                f"{self.where}: unpacks to {format_bytes(unpacked)}, more than the "
                f"{format_bytes(MOST_BYTES)} that saved results may have; check what the file is"
            )
            raise ResultsFileError(message)
        manifest = self._json(MANIFEST)
        self._check_version(manifest)
        try:
            items = tuple(self._item(record) for record in _list(self._json(ITEMS), "items"))
            yardsticks = {
                (_text(record, "role"), _text(record, "case")): _text(record, "sha256")
                for record in _list(manifest, "inputs")
            }
            made_by = _text(manifest, "command"), _text(manifest, "version")
        except (ValueError, OverflowError) as error:
            raise self._damaged(ITEMS, error) from None
        if len({(item.case, item.method) for item in items}) < len(items):
            raise self._damaged(ITEMS, "two items are of one case and method")
        return SavedResults(name, *made_by, items, yardsticks)

    def _check_version(self, manifest: Any) -> None:
        """Refuse what another program wrote, or a later version of this one."""
        if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
            message = (
                f"{self.where}: wanted a zip of --save-results, found the {MANIFEST} of another "
                "program; give a file that --save-results wrote"
            )
            raise ResultsFileError(message)
        version = manifest.get("format_version")
        if not isinstance(version, int) or version < 1:
            raise self._damaged(MANIFEST, "format_version is no whole number of 1 or more")
        if version > FORMAT_VERSION:
            message = (
                f"{self.where}: wanted results of format {FORMAT_VERSION} or older, found "
                f"{version}, written by SLAMfusion {shown(manifest.get('version'))}; "
                "update SLAMfusion"
            )
            raise ResultsFileError(message)

    def _item(self, record: Any) -> MeasuredItem:
        """Return one map or path.

        Raises:
            ValueError: something about it is wrong; says what.
        """
        figures = _mapping(record, "figures")
        for name, value in figures.items():
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not is_number or not math.isfinite(value):
                message = f"{name!r} is {shown(value)}, no number"
                raise ValueError(message)
        series = {name: self._series(place) for name, place in _mapping(record, "series").items()}
        return MeasuredItem(
            _text(record, "case"),
            _text(record, "method"),
            {name: float(value) for name, value in figures.items()},
            series,
        )

    def _series(self, place: Any) -> ErrorSeries:
        """Return the single errors of an entry."""
        if not isinstance(place, str) or not place.startswith(f"{SERIES}/"):
            message = f"a series lies in {shown(place)}"
            raise ValueError(message)
        text = self._bytes(place).decode("ascii", errors="replace")
        if len(text.splitlines()) < 2:
            message = f"{place} has no error"
            raise ValueError(message)
        try:
            rows = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1, ndmin=2)
            return ErrorSeries(rows[:, :-1], rows[:, -1])
        except (ValueError, IndexError) as error:
            message = f"{place}: {error}"
            raise ValueError(message) from None

    def _json(self, name: str) -> Any:
        try:
            return json.loads(self._bytes(name))
        except (ValueError, RecursionError) as error:
            raise self._damaged(name, error) from None

    def _bytes(self, name: str) -> bytes:
        """Return an entry, which never unpacks to more than it says."""
        try:
            return self.packed.read(name)
        except KeyError:
            raise self._damaged(name, "it is missing") from None

    def _damaged(self, entry: str, what: object) -> ResultsFileError:
        what = _short(what)
        message = f"{self.where}: its {_short(entry)} is damaged: {what}; save the results again"
        return ResultsFileError(message)


def _short(what: object) -> str:
    """Return the words of an error, which may name anything that stands in the file."""
    text = str(what)
    return text if len(text) <= WHY_CHARACTERS else f"{text[:WHY_CHARACTERS]}..."


def _text(record: Any, key: str) -> str:
    value = record.get(key) if isinstance(record, dict) else None
    if not isinstance(value, str):
        message = f"wanted a text {key!r}, found {shown(value)}"
        raise ValueError(message)  # noqa: TRY004 - a file's content, not a caller's type
    return value


def _list(record: Any, key: str) -> list[Any]:
    value = record.get(key) if isinstance(record, dict) else None
    if not isinstance(value, list):
        message = f"wanted a list {key!r}, found {shown(value)}"
        raise ValueError(message)  # noqa: TRY004 - a file's content, not a caller's type
    return value


def _mapping(record: Any, key: str) -> dict[str, Any]:
    value = record.get(key) if isinstance(record, dict) else None
    if not isinstance(value, dict):
        message = f"wanted names under {key!r}, found {shown(value)}"
        raise ValueError(message)  # noqa: TRY004 - a file's content, not a caller's type
    return value
