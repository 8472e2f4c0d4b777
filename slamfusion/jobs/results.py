"""Saved results: tables of what was measured, and one zip with everything.

In it are ``manifest.json`` (how it was made: version, command, settings, the inputs' SHA-256),
``document.json`` (what the command prints with ``--json``), ``table.csv`` (a row for each map or
path: case, seed, method, kind, and its figures) and ``series.csv`` (single errors along a path: the
row of ``table.csv`` counted from 0, name of the series, place, error). The same results give the
same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
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
from slamfusion.evaluation.records import SummariesJson
from slamfusion.io import write_atomic
from slamfusion.io.map_yaml import existing, read_map_yaml
from slamfusion.io.memory import format_bytes
from slamfusion.io.regular import open_regular
from slamfusion.jobs.documents import record_bytes, versions
from slamfusion.jobs.inputs import map_file
from slamfusion.version import __version__

try:
    import pandas as pd
except ImportError as _error:
    _message = (
        "tables of several cases and saved results need pandas; pip install 'slamfusion[report]'"
    )
    raise SlamFusionError(_message) from _error

__all__ = [
    "KEYS",
    "PLACE",
    "ResultsFileError",
    "SavedResults",
    "figures_of",
    "item_table",
    "map_inputs",
    "means_of",
    "read_results",
    "summaries",
    "write_results_file",
]

FORMAT, FORMAT_VERSION = "slamfusion-results", 2
MANIFEST, DOCUMENT, TABLE, SERIES = "manifest.json", "document.json", "table.csv", "series.csv"
# What a file of results may unpack to: a thousand paths of ten thousand poses.
MOST_BYTES = 2**29
READ_BYTES = 2**20
# Of what is wrong with a file, in a message.
WHY_CHARACTERS = 150
# A zip holds dates; one and the same keeps the bytes of equal results equal.
NO_DATE = (1980, 1, 1, 0, 0, 0)
# What zipfile raises for files that are none.
_BROKEN = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError)

# What names a row of a table; the other columns are figures. So are those of a series' place.
KEYS = ["case", "seed", "method", "kind"]
PLACE = ["at_1", "at_2"]


class ResultsFileError(SlamFusionError):
    """A file is none of saved results, or is damaged."""


# --- tables -------------------------------------------------------------------------------------


def item_table(items: Sequence[MeasuredItem]) -> pd.DataFrame:
    """Return a table with a row for each item: ``KEYS``, then figures; NaN: not defined."""
    rows = [{**item.to_json(), **item.figures} for item in items]
    figures = dict.fromkeys(name for item in items for name in item.figures)
    return pd.DataFrame(rows, columns=[*KEYS, *figures])


def figures_of(table: pd.DataFrame) -> list[str]:
    """Return the names of the figures of a table, in order."""
    return [name for name in table.columns if name not in KEYS]


def means_of(table: pd.DataFrame, keys: Sequence[str], how: str = "mean") -> pd.DataFrame:
    """Return the figures of rows that have the same keys as one row, in order.

    A figure that is not defined in one of them has no mean: one over fewer rows would be compared
    with those of other methods over all of them.

    Args:
        table: of items.
        keys: columns; they become the index.
        how: ``mean``, or ``std``: the sample standard deviation, NaN for one row.
    """
    groups = table.groupby(list(keys), sort=False)[figures_of(table)]
    is_whole = groups.count().eq(groups.size(), axis=0)
    return getattr(groups, how)().where(is_whole)


def summaries(items: Sequence[MeasuredItem]) -> SummariesJson:
    """Return the means of methods over cases, and over the seeds of each case, for a document."""
    table = item_table(items)
    by_case = means_of(table, ["method", "case"]).reset_index()
    cases = by_case.groupby("method").size()
    keys = ["case", "method"]
    std, runs = means_of(table, keys, "std"), table.groupby(keys).size()
    return {
        "means": [
            {"method": method, "cases": int(cases[method]), "figures": _defined(figures)}
            for method, figures in means_of(by_case, ["method"]).iterrows()
        ],
        "repetitions": [
            {
                "case": key[0],
                "method": key[1],
                "seeds": int(runs[key]),
                "figures": _defined(figures),
                "std": _defined(std.loc[key]),
            }
            for key, figures in means_of(table, keys).iterrows()
            if runs[key] > 1
        ],
    }


def _defined(figures: pd.Series) -> dict[str, float]:
    """Return the figures of a row that are defined, by name."""
    return {name: float(value) for name, value in figures.items() if pd.notna(value)}


# --- files --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SavedResults:
    """What a file of results says, as far as comparisons need it.

    Attributes:
        name: what tables call it.
        file: where it lies.
        command: that made it, its words.
        version: of the program that made it.
        table: what was measured, a row for each map or path; see ``item_table``.
        series: single errors: ``row`` in the index of the table, ``series`` (name), ``at_1``,
            ``at_2`` (NaN where one number tells the place; see ``ErrorSeries``) and ``error``.
        yardsticks: (role, case) and SHA-256 of each truth, relations file and log.
    """

    name: str
    file: Path
    command: str
    version: str
    table: pd.DataFrame
    series: pd.DataFrame
    yardsticks: Mapping[tuple[str, str], str]

    def items(self) -> list[MeasuredItem]:
        """Return what was measured, item by item."""
        found: dict[int, dict[str, ErrorSeries]] = {}
        for (row, name), own in self.series.groupby(["row", "series"], sort=False):
            places = own[PLACE].dropna(axis="columns", how="all")
            found.setdefault(row, {})[name] = ErrorSeries(
                places.to_numpy(float), own["error"].to_numpy(float)
            )
        figures = figures_of(self.table)
        return [
            MeasuredItem(
                row["case"],
                row["method"],
                _defined(row[figures]),
                found.get(index, {}),
                row["seed"],
                row["kind"],
            )
            for index, row in self.table.iterrows()
        ]


def map_inputs(role: str, case: str, paths: Sequence[Path]) -> list[tuple[str, str, Path]]:
    """Return role, case and path of the files of maps: each one's YAML, and the image it names."""
    found = []
    for given in paths:
        path = map_file(given)
        found.append((role, case, path))
        if path.suffix.lower() in {".yaml", ".yml"}:
            found.append((f"{role} image", case, existing(read_map_yaml(path).image)))
    return found


def write_results_file(
    path: str | Path,
    *,
    command: str,
    arguments: Sequence[str],
    document: Mapping[str, Any],
    items: Sequence[MeasuredItem],
    inputs: Sequence[tuple[str, str, Path]] = (),
) -> None:
    """Write results to a zip, whole or not at all.

    Args:
        path: of the file.
        command: its words, e.g. ``trajectory``.
        arguments: as they were typed.
        document: what the command prints with ``--json``.
        items: what was measured, of distinct cases, seeds and methods.
        inputs: files that it rests on: the role (map, truth, path, log, ...), the case that it
            belongs to (empty: all), and the path.

    Raises:
        SlamFusionError: the file cannot be written.
        OSError: an input cannot be read any more.
    """
    series = [
        pd.DataFrame({"row": row, "series": name, **_places(own), "error": own.errors})
        for row, item in enumerate(items)
        for name, own in item.series.items()
    ]
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "command": command,
        "arguments": list(arguments),
        "settings": document.get("config", {}),
        "versions": versions(),
        "inputs": [record for file in inputs for record in _input_records(*file)],
    }
    no_series = pd.DataFrame(columns=["row", "series", *PLACE, "error"])
    contents = {
        MANIFEST: record_bytes(manifest),
        DOCUMENT: record_bytes(document),
        TABLE: _csv(item_table(items)),
        SERIES: _csv(pd.concat(series) if series else no_series),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name, NO_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            packed.writestr(entry, data)
    write_atomic(path, buffer.getvalue())


def _places(series: ErrorSeries) -> dict[str, Any]:
    """Return the columns of a series' places."""
    return {**dict.fromkeys(PLACE, np.nan), **dict(zip(PLACE, series.at.T, strict=False))}


def _csv(table: pd.DataFrame) -> bytes:
    """Return a table as CSV, numbers in full."""
    return str(table.to_csv(index=False, lineterminator="\n")).encode()


def _input_records(role: str, case: str, given: Path) -> Iterator[dict[str, Any]]:
    """Yield the record of a file; of a folder (a bag), one of each file in it."""
    paths = [given]
    if given.is_dir():
        paths = sorted(path for path in given.rglob("*") if path.is_file())
    for path in paths:
        digest, size = hashlib.sha256(), 0
        with open_regular(path, ResultsFileError) as data:
            while block := data.read(READ_BYTES):
                digest.update(block)
                size += len(block)
        yield {
            "role": role,
            "case": case,
            "name": str(path),
            "bytes": size,
            "sha256": digest.hexdigest(),
        }


def read_results(path: str | Path, name: str | None = None) -> SavedResults:
    """Read a file of saved results.

    Args:
        path: of the zip.
        name: what tables call it; default: its stem.

    Raises:
        ResultsFileError: it is none, is damaged, of another format version, or unpacks to too much.
        OSError: it cannot be opened.
    """
    where = Path(path)
    with open_regular(where, ResultsFileError) as file:
        try:
            with zipfile.ZipFile(file) as packed:
                return _read(where, packed, name or where.stem)
        except _BROKEN as error:
            found, why = "a damaged one or none", _short(error)
        except (NotImplementedError, RuntimeError) as error:
            found, why = "one that is packed in another way", _short(error)
    message = f"{where}: wanted a zip of --save-results, found {found} ({why}); save it again"
    raise ResultsFileError(message)


def _read(where: Path, packed: zipfile.ZipFile, name: str) -> SavedResults:
    """Return what an open file says, each entry checked."""
    entries = packed.infolist()
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > MOST_BYTES:
        message = (
            f"{where}: unpacks to {format_bytes(unpacked)}, more than the "
            f"{format_bytes(MOST_BYTES)} that saved results may have; check what the file is"
        )
        raise ResultsFileError(message)
    if MANIFEST not in packed.namelist():
        message = (
            f"{where}: wanted a zip of --save-results, found one without {MANIFEST}; give a file "
            "that --save-results wrote"
        )
        raise ResultsFileError(message)
    entry = MANIFEST
    try:
        manifest = json.loads(packed.read(entry))
        _check_version(where, manifest)
        made_by = _text(manifest, "command"), _text(manifest, "version")
        yardsticks = {
            (_text(record, "role"), _text(record, "case")): _text(record, "sha256")
            for record in manifest["inputs"]
        }
        entry = TABLE
        table = _table(packed.read(entry))
        entry = SERIES
        series = _series(packed.read(entry), len(table))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        message = f"{where}: its {entry} is damaged: {_short(error)}; save the results again"
        raise ResultsFileError(message) from None
    return SavedResults(name, where, *made_by, table, series, yardsticks)


def _check_version(where: Path, manifest: Any) -> None:
    """Refuse what another program wrote, or another version of this one."""
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        message = (
            f"{where}: wanted a zip of --save-results, found the {MANIFEST} of another program; "
            "give a file that --save-results wrote"
        )
        raise ResultsFileError(message)
    version = manifest.get("format_version")
    if version != FORMAT_VERSION:
        is_newer = isinstance(version, int) and version > FORMAT_VERSION
        message = (
            f"{where}: wanted results of format {FORMAT_VERSION}, found {_short(shown(version))}, "
            f"written by SLAMfusion {_short(shown(manifest.get('version')))}; "
            + ("update SLAMfusion" if is_newer else "run its command with --save-results again")
        )
        raise ResultsFileError(message)


def _read_csv(data: bytes, texts: Sequence[str], numbers: Sequence[str]) -> pd.DataFrame:
    """Return a table of text columns and finite numbers; NaN where a number is left out.

    Args:
        data: of the CSV file.
        texts: columns that it must have.
        numbers: likewise; columns that are named in neither are numbers, too.

    Raises:
        ValueError: a column is missing, or something is no number.
    """
    table = pd.read_csv(
        io.BytesIO(data),
        dtype=dict.fromkeys(texts, object),
        keep_default_na=False,
        na_values=[""],
        low_memory=False,
        index_col=False,
    )
    missing = [name for name in (*texts, *numbers) if name not in table.columns]
    if missing:
        message = f"it has no column {missing[0]!r}"
        raise ValueError(message)
    table = table.fillna(dict.fromkeys(texts, ""))
    for name in table.columns.difference(texts):
        values = table[name]
        is_number = values.dtype.kind in "iuf" or values.isna().all()
        table[name] = values = values.astype(float) if is_number else np.inf
        if np.isinf(values).any():
            message = f"{_short(name)!r} has a value that is no number"
            raise ValueError(message)
    return table


def _table(data: bytes) -> pd.DataFrame:
    """Return the rows of ``table.csv``, checked."""
    table = _read_csv(data, KEYS, ())
    if table.duplicated(KEYS[:3]).any():
        message = "two rows are of one case, seed and method"
        raise ValueError(message)
    return table


def _series(data: bytes, rows: int) -> pd.DataFrame:
    """Return the errors of ``series.csv``, checked."""
    series = _read_csv(data, ["series"], ["row", *PLACE, "error"])
    if series[["row", "at_1", "error"]].isna().any(axis=None):
        message = "a row, place or error is left out"
        raise ValueError(message)
    if not series["row"].isin(range(rows)).all():
        message = f"a series is of a row that {TABLE} has not"
        raise ValueError(message)
    return series


def _short(what: object) -> str:
    """Return the words of an error in one line, which may name anything that stands in the file."""
    text = " ".join(str(what).split())
    return text if len(text) <= WHY_CHARACTERS else f"{text[:WHY_CHARACTERS]}..."


def _text(record: Any, key: str) -> str:
    value = record.get(key) if isinstance(record, dict) else None
    if not isinstance(value, str):
        message = f"wanted a text {key!r}, found {shown(value)}"
        raise ValueError(message)  # noqa: TRY004 - a file's content, not a caller's type
    return value
