"""The runs of an experiment: each one that is done is kept as a file, and is not run again."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import slamfusion
from slamfusion.compute import ComputeDevice
from slamfusion.compute.program import kernel_folder
from slamfusion.config import RunConfig, to_mapping
from slamfusion.errors import FleetError, SlamFusionError
from slamfusion.evaluation import Row, result_rows
from slamfusion.experiments.examples import FOLDER, example_file
from slamfusion.fleet import as_done, executor_for
from slamfusion.io import AtomicFiles
from slamfusion.jobs.documents import record_bytes

T = TypeVar("T")
Progress = Callable[[str, int, int], None]

# Parts of the package that do not change a result.
FACES = {"cli", "page", "report", "ros", "viewer"}


@dataclass(frozen=True)
class RunResult:
    """The result of one run.

    Attributes:
        rows: its rows of the table of results.
        notes: what went wrong, by method.
        example: its maps against the truth (``Example.packed``), of a run that is shown.
        remark: a sentence about it.
    """

    rows: Sequence[Row]
    notes: Mapping[str, str] = field(default_factory=dict)
    example: bytes | None = None
    remark: str = ""


@dataclass(frozen=True, eq=False)
class Setup:
    """Where and how the runs of an experiment are done.

    Attributes:
        config: the settings; a kept run that was made with others is done again.
        device: computes, in this process.
        folder: each run that is done is at once a JSON file in its folder ``trials``.
        progress: called with the stage, the steps that are done and all steps; None: not called.
        processes: runs at the same time; 1: one after the other in this process.
        scheduler: of a Dask cluster, whose workers do the runs instead; see ``executor_for``.
    """

    config: RunConfig
    device: ComputeDevice
    folder: Path
    progress: Progress | None = None
    processes: int = 1
    scheduler: str | None = None


def run_all(
    tasks: Mapping[str, T],
    work: Callable[[T, RunConfig], RunResult],
    setup: Setup,
    facts: Sequence[str] = (),
) -> list[RunResult]:
    """Do the runs that the folder does not hold yet.

    Args:
        tasks: the runs by the name of their files; the text of a task tells all of it.
        work: does a run. With several processes it must be a function of a module.
        setup: where and how.
        facts: what else a run depends on, e.g. the digests of files.

    Returns:
        The results in the order of the tasks.

    Raises:
        SlamFusionError: a run failed, or a process died. Started again, only the rest is run.
    """
    config, folder = setup.config, setup.folder
    marks = {key: _fingerprint(task, config, facts) for key, task in tasks.items()}
    done = {key: kept for key in tasks if (kept := _read(folder, key, marks[key])) is not None}
    missing = {key: task for key, task in tasks.items() if key not in done}

    def tell() -> None:
        if setup.progress is not None:
            setup.progress("runs", len(done), len(tasks))

    tell()
    processes = max(1, min(setup.processes, len(missing)))
    try:
        with executor_for(setup.scheduler, processes, config.device.device) as executor:
            for (key, _), result in as_done(executor, _work, missing.items(), work, config):
                _write(folder, key, marks[key], result)
                done[key] = result
                tell()
    except FleetError as error:
        message = f"{error}; what is done stays done: start the experiment again, it goes on"
        raise SlamFusionError(message) from None
    return [done[key] for key in tasks]


def _work(
    task: tuple[str, T], work: Callable[[T, RunConfig], RunResult], config: RunConfig
) -> RunResult:
    return work(task[1], config)


@cache
def _program() -> str:
    """Return a hash of the sources that a run depends on: of the package and of its kernels."""
    package = Path(slamfusion.__file__).parent
    sources = [
        path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in FACES
    ]
    digest = hashlib.sha256()
    for path in (*sorted(sources), *sorted(kernel_folder().glob("*.[ch]*"))):
        digest.update(f"{path.name}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _fingerprint(task: object, config: RunConfig, facts: Iterable[str]) -> str:
    """Return what tells runs apart that have one name but other settings or another program."""
    settings = to_mapping(replace(config, seed=0))
    for unrelated in ("experiment", "live", "graph_optimizer", "simulate", "report"):
        del settings[unrelated]
    text = json.dumps([repr(task), settings, *facts, _program()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read(folder: Path, key: str, mark: str) -> RunResult | None:
    """Return the result of an earlier run; None where it is missing, damaged or another."""
    try:
        kept = json.loads((folder / FOLDER / f"{key}.json").read_text(encoding="utf-8"))
        if kept["fingerprint"] != mark:
            return None
        example = example_file(folder, key).read_bytes() if kept["example"] else None
        rows = [
            row
            for case, seed, method, figure, value in kept["rows"]
            for row in result_rows(case, seed, method, {figure: value})
        ]
        return RunResult(rows, dict(kept["notes"]), example, str(kept["remark"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _write(folder: Path, key: str, mark: str, result: RunResult) -> None:
    """Write the result of a run, whole or not at all; the same run gives the same bytes."""
    record = {
        "fingerprint": mark,
        "rows": [[*row[:4], None if math.isnan(row[4]) else row[4]] for row in result.rows],
        "notes": dict(result.notes),
        "example": result.example is not None,
        "remark": result.remark,
    }
    with AtomicFiles() as files:
        files.add(folder / FOLDER / f"{key}.json", record_bytes(record))
        if result.example is not None:
            files.add(example_file(folder, key), result.example)
