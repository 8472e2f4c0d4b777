"""The table of measured figures (see ``slamfusion.evaluation.Row``), and the zip that keeps it.

The zip holds ``results.csv`` (the table), ``manifest.json`` (version, command, settings and the
inputs' SHA-256) and ``document.json`` (the output of ``--json``). The same results give the same
bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.errors import SlamFusionError, extra_needed, shown
from slamfusion.evaluation.measured import Row
from slamfusion.io import write_atomic
from slamfusion.io.files import open_regular
from slamfusion.io.map_server import existing, read_map_yaml
from slamfusion.jobs.inputs import is_yaml, map_file
from slamfusion.jobs.records import Summaries, record_bytes
from slamfusion.json_values import plain
from slamfusion.version import __version__, versions

with extra_needed("report", "tables of several cases and saved results need"):
    import pandas as pd

FORMAT, FORMAT_VERSION = "slamfusion-results", 3
MANIFEST, DOCUMENT, TABLE = "manifest.json", "document.json", "results.csv"
# The most that a file of results may unpack to: a thousand paths of ten thousand poses.
MOST_BYTES = 2**30
# A zip holds dates; one and the same keeps the bytes of equal results equal.
NO_DATE = (1980, 1, 1, 0, 0, 0)
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, NotImplementedError),
    *(ValueError, KeyError, TypeError, RuntimeError, OverflowError),
)

KEYS = ["case", "seed", "method"]
NUMBERS = ["value", "at", "to"]
COLUMNS = [*KEYS, "figure", *NUMBERS]


class ResultsFileError(SlamFusionError):
    """A file is none of saved results, or is damaged."""


def results_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Return rows as a table of ``COLUMNS``."""
    return pd.DataFrame(list(rows), columns=COLUMNS)


def figures_of(table: pd.DataFrame) -> pd.DataFrame:
    """Return the figures of whole maps and paths, a row per ``KEYS``, in order; NaN: undefined."""
    own = table[table["at"].isna()]
    wide = own.set_index([*KEYS, "figure"])["value"].unstack()  # noqa: PD010 - there is no mean
    order = pd.MultiIndex.from_frame(own[KEYS].drop_duplicates())
    return wide.reindex(order)[own["figure"].unique()].dropna(axis="columns", how="all")


def means_of(figures: pd.DataFrame, keys: Sequence[str], how: str = "mean") -> pd.DataFrame:
    """Return the figures of rows with the same keys as one row, in order.

    A figure that is undefined in one of the rows has no mean.
    """
    groups = figures.groupby(level=list(keys), sort=False)
    return groups.agg(how).where(groups.count().eq(groups.size(), axis=0))


def summaries(rows: Iterable[Row]) -> Summaries:
    """Return the means of methods over cases, and over the seeds of each case, for a document."""
    figures = figures_of(results_table(rows))
    keys = ["case", "method"]
    by_case, std = means_of(figures, keys), means_of(figures, keys, "std")
    seeds = figures.groupby(level=keys, sort=False).size()
    cases = by_case.groupby(level="method", sort=False).size()
    return Summaries(
        means=[
            {"method": method, "cases": int(cases[method]), "figures": own.dropna().to_dict()}
            for method, own in means_of(by_case, ["method"]).iterrows()
        ],
        repetitions=[
            {
                "case": case,
                "method": method,
                "seeds": int(seeds[case, method]),
                "figures": own.dropna().to_dict(),
                "std": std.loc[(case, method)].dropna().to_dict(),
            }
            for (case, method), own in by_case.iterrows()
            if seeds[case, method] > 1
        ],
    )


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of texts as Markdown; columns without a number are aligned left."""
    is_text = [all(not _is_number(row[index]) for row in rows) for index in range(len(heads))]
    lines = [heads, ["---" if text else "---:" for text in is_text], *rows]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines
    )


def _is_number(cell: str) -> bool:
    return cell[:1].isdigit() or cell[:1] in {"-", "+", "<"}


@dataclass(frozen=True, eq=False)
class SavedResults:
    """A file of saved results, or one method of it."""

    name: str
    """Its name below: that of its file without the ending, or the method."""
    file: Path
    """Its file."""
    command: str
    """The command that saved it."""
    version: str
    """Version of the program that saved it."""
    table: pd.DataFrame = field(repr=False)
    """The results; see ``results_table``."""
    yardsticks: Mapping[tuple[str, str], str] = field(repr=False)
    """(Role, case) and SHA-256 of each truth, relations file and log."""


def map_inputs(role: str, case: str, paths: Sequence[Path]) -> list[tuple[str, str, Path]]:
    """Return role, case and path of the files of maps: each one's YAML, and the image it names."""
    found = []
    for given in paths:
        path = map_file(given)
        found.append((role, case, path))
        if is_yaml(path):
            found.append((f"{role} image", case, existing(read_map_yaml(path).image)))
    return found


def write_results_file(
    path: str | Path,
    *,
    command: str,
    arguments: Sequence[str],
    document: Any,
    rows: Iterable[Row],
    inputs: Sequence[tuple[str, str, Path]] = (),
) -> None:
    """Write results to a zip, whole or not at all.

    Args:
        command: its words, e.g. ``trajectory``.
        document: the record or mapping that the command prints as JSON.
        inputs: of each measured or reference file the role (map, truth, path, log, ...), the case
            (empty: all) and the path.

    Raises:
        SlamFusionError: the file cannot be written.
    """
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "command": command,
        "arguments": list(arguments),
        "settings": plain(document).get("config", {}),
        "versions": versions(),
        "inputs": [record for file in inputs for record in input_records(*file)],
    }
    contents = {
        MANIFEST: record_bytes(manifest),
        DOCUMENT: record_bytes(document),
        TABLE: results_table(rows).to_csv(index=False, lineterminator="\n").encode(),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name, NO_DATE)
            entry.external_attr = 0o644 << 16
            packed.writestr(entry, data, zipfile.ZIP_DEFLATED)
    write_atomic(path, buffer.getvalue())


def input_records(role: str, case: str, given: Path) -> Iterator[dict[str, Any]]:
    """Yield the record of a file; of a folder (a bag), one of each file in it."""
    paths = (
        sorted(item for item in given.rglob("*") if item.is_file()) if given.is_dir() else [given]
    )
    for path in paths:
        digest, size = hashlib.sha256(), 0
        with open_regular(path, ResultsFileError) as data:
            while block := data.read(2**20):
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
    """Read a file of saved results, by default named by its stem.

    Raises:
        ResultsFileError: it holds no results, is damaged, of another format version, or too large.
    """
    where = Path(path)
    with open_regular(where, ResultsFileError) as file:
        try:
            with zipfile.ZipFile(file) as packed:
                if sum(entry.file_size for entry in packed.infolist()) > MOST_BYTES:
                    raise ValueError(f"it unpacks to more than {MOST_BYTES} bytes")
                manifest = json.loads(packed.read(MANIFEST))
                _check_version(where, manifest)
                yardsticks = {
                    (str(record["role"]), str(record["case"])): str(record["sha256"])
                    for record in manifest["inputs"]
                }
                table = _read_table(packed.read(TABLE))
                made_by = str(manifest["command"]), str(manifest["version"])
                return SavedResults(name or where.stem, where, *made_by, table, yardsticks)
        except _BROKEN as error:
            why = _short(error)
    raise ResultsFileError(
        f"{where}: wanted a zip of --save-results, found a damaged one or none ({why}); save the "
        "results again"
    )


def _check_version(where: Path, manifest: dict[str, Any]) -> None:
    """Refuse what another program wrote, or another version of this one."""
    if manifest["format"] != FORMAT:
        raise ValueError(f"its {MANIFEST} is that of another program")
    found = manifest["format_version"]
    if found != FORMAT_VERSION:
        is_newer = isinstance(found, int) and found > FORMAT_VERSION
        raise ResultsFileError(
            f"{where}: wanted results of format {FORMAT_VERSION}, found {_short(shown(found))}, "
            f"written by SLAMfusion {_short(shown(manifest['version']))}; "
            + ("update SLAMfusion" if is_newer else "run its command with --save-results again")
        )


def _read_table(data: bytes) -> pd.DataFrame:
    """Return the rows of a file; ``ValueError``: missing column, bad number or double figure."""
    texts = [*KEYS, "figure"]
    table = pd.read_csv(
        io.BytesIO(data),
        dtype={**dict.fromkeys(texts, str), **dict.fromkeys(NUMBERS, float)},
        keep_default_na=False,
        na_values={name: [""] for name in NUMBERS},
        usecols=COLUMNS,
    )[COLUMNS]
    if np.isinf(table[NUMBERS]).any(axis=None):
        raise ValueError(f"{TABLE} has an infinite number")
    if table[table["at"].isna()].duplicated(texts).any():
        raise ValueError(f"{TABLE} has two rows of one case, seed, method and figure")
    return table


def _short(what: object) -> str:
    """Return the words of an error in one line, which may name anything that is in the file."""
    text = " ".join(str(what).split())
    return text if len(text) <= 150 else f"{text[:150]}..."
