"""Run what a page's table is made of, and keep the table as JSON.

    python -m docs.generate.record failures
    python -m docs.generate.record real-logs --datasets DIR
    python -m docs.generate.record failures --record out -- --device numpy
    python -m docs.generate.record real-logs --document r.json --commit 0123abc --date 2026-11-22

The commands of the table are run with ``--json``; words after ``--`` are given to each of them.
With ``--document`` nothing is run: the table is made of what the commands wrote before, which does
not say at which commit and when. ``python -m docs.generate`` then writes the table into its page.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from docs.generate import tables
from docs.generate.benchmarks import FOLDER, Measurement
from docs.generate.provenance import commit, cores

__all__ = ["RECIPES", "Recipe", "main"]

Documents = Sequence[Mapping[str, Any]]
CSAIL, INTEL = "{datasets}/mit-csail/mit-csail", "{datasets}/intel/intel"
LOG, RELATIONS = f"{CSAIL}.clf.gz", f"{CSAIL}.relations"
REFERENCE = f"{CSAIL}-reference-graph.log.gz"
INTEL_RELATIONS, INTEL_ODOMETRY = f"{INTEL}.relations", f"{INTEL}-odometry-13631.txt.gz"
INTEL_LOGS = (f"{INTEL}-910-raw.log.gz", f"{INTEL}-2726-raw.log.gz")
FR079 = "{datasets}/fr079/fr079"
FR079_LOG, FR079_ODOMETRY = f"{FR079}-4751-reconstructed.log.gz", f"{FR079}-odometry-4934.txt.gz"
# Logs with their relations, and the odometry between these.
RUNS = (
    f"{LOG} --relations {RELATIONS}",
    *(f"{log} --relations {INTEL_RELATIONS} --odometry {INTEL_ODOMETRY}" for log in INTEL_LOGS),
    f"{FR079_LOG} --relations {FR079}.relations --odometry {FR079_ODOMETRY}",
)
MODEL_LOGS = f"--log {LOG}:{RELATIONS} --log {INTEL_LOGS[1]}:{INTEL_RELATIONS}:{INTEL_ODOMETRY}"
ESTIMATOR_LOG = f"--log {LOG} --relations {RELATIONS} --reference {REFERENCE}"


@dataclass(frozen=True)
class Recipe:
    """How a table is made.

    Attributes:
        commands: of ``slamfusion``; ``{out}`` is a folder, ``{datasets}`` that of the recordings.
        table: of the documents that they print, in order.
    """

    commands: tuple[str, ...]
    table: Callable[[Documents], tables.TableText]


# By the name of the table.
RECIPES = {
    "ground-obstacle": Recipe(("experiment ground-obstacle -o {out}",), tables.ground_obstacle),
    "ground-obstacle-drawn": Recipe(
        ("experiment ground-obstacle --draw -o {out}",), tables.paths_and_faces
    ),
    "failures": Recipe(
        tuple(
            f"experiment failures --repetitions 2 --first-world {world} -o {{out}}"
            for world in (1, 101, 202)
        ),
        tables.failures,
    ),
    "real-logs": Recipe(("experiment real-logs --datasets {datasets} -o {out}",), tables.real_logs),
    "cell-models": Recipe(
        (f"experiment cell-models-trajectories {MODEL_LOGS} -o {{out}}",), tables.repeated_runs
    ),
    "occupancy-estimator": Recipe(
        (f"experiment occupancy-estimator {ESTIMATOR_LOG} -o {{out}}",), tables.repeated_runs
    ),
    "fused-path-recordings": Recipe(
        tuple(f"run {given} -o {{out}}" for given in RUNS), tables.fused_path
    ),
}


def main(words: Sequence[str] | None = None) -> None:
    """Read the options, make the table and keep it."""
    words = sys.argv[1:] if words is None else list(words)
    cut = words.index("--") if "--" in words else len(words)
    more = words[cut + 1 :]
    options = _parser().parse_args(words[:cut])
    recipe = RECIPES[options.name]
    if len({value is None for value in (options.document, options.commit, options.date)}) > 1:
        _end("--document, --commit and --date belong together: a document does not say these two")
    needs_datasets = any("{datasets}" in command for command in recipe.commands)
    if needs_datasets and not (options.document or options.datasets):
        folders = "mit-csail/, intel/, fr079/"
        _end(f"{options.name} is of recorded drives: wanted --datasets DIR, with {folders}")
    if options.document:
        documents = [_read(path) for path in options.document]
        note = "Made of documents that its commands had written."
        date, at, where = options.date, options.commit, ""
    else:
        date, at, where = dt.datetime.now(dt.timezone.utc).date().isoformat(), commit(), cores()
        documents = _run(recipe, options, more)
        note = "It runs " + " and ".join(f"`{text}`" for text in _shown(recipe)) + "."
    try:
        columns, rows = recipe.table(documents)
        where += f"{documents[0]['device']}, {_versions(documents[0])}"
        told = ["python", "-m", "docs.generate.record", options.name]
        told += ["--", *more] if more else []
        measured = Measurement(options.name, date, at, where, shlex.join(told), columns, rows, note)
    except (KeyError, TypeError, ValueError) as error:
        what = f"no key {error}" if isinstance(error, KeyError) else error
        _end(f"wanted what `slamfusion {recipe.commands[0]} --json` prints: {what}")
    options.record.mkdir(parents=True, exist_ok=True)
    path = options.record / measured.file_name
    path.write_text(measured.to_json(), encoding="utf-8")
    print(f"kept as {path}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m docs.generate.record",
        usage="%(prog)s NAME [options] [-- more options of the commands]",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=tuple(RECIPES), help="of the table")
    parser.add_argument("--datasets", type=Path, metavar="DIR", help="folder of the recordings")
    parser.add_argument(
        "--out", type=Path, default=Path("out/record"), help="folder that experiments write to"
    )
    parser.add_argument("--record", type=Path, default=FOLDER, help="folder for the table")
    parser.add_argument(
        "--document", type=Path, action="append", metavar="FILE", help="made before, once each"
    )
    parser.add_argument("--commit", help="at which the documents were made")
    parser.add_argument("--date", help="on which they were made, YYYY-MM-DD")
    return parser


def _run(
    recipe: Recipe, options: argparse.Namespace, more: Sequence[str]
) -> list[Mapping[str, Any]]:
    """Run the commands one after the other and return what they print."""
    documents = []
    for number, command in enumerate(recipe.commands, 1):
        # Each has a folder of its own, where an interrupted experiment goes on.
        out = options.out / f"{options.name}-{number}"
        words = [word.format(out=out, datasets=options.datasets) for word in command.split()]
        done = subprocess.run(
            [sys.executable, "-m", "slamfusion", *words, *more, "--json"],
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        if done.returncode:
            _end(f"`slamfusion {shlex.join(words)}` ended with exit code {done.returncode}")
        documents.append(json.loads(done.stdout))
    return documents


def _shown(recipe: Recipe) -> list[str]:
    """Return the commands as they are shown, without the folders of this machine."""
    return [f"slamfusion {text.format(out='DIR', datasets='DIR')}" for text in recipe.commands]


def _read(path: Path) -> Mapping[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        _end(f"{path}: {error}")
    if not isinstance(document, dict):
        _end(f"{path}: wanted a JSON document of a command; found no object")
    return document


def _versions(document: Mapping[str, Any]) -> str:
    versions = document["versions"]
    return f"Python {versions['python']}, NumPy {versions['numpy']}"


def _end(message: str) -> NoReturn:
    told = f"python -m docs.generate.record: {message}"
    raise SystemExit(told)


if __name__ == "__main__":
    main()
