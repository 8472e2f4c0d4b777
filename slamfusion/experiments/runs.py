"""The runs of an experiment; finished ones are kept in files, with the maps of an example."""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import slamfusion
from slamfusion.compute import ComputeDevice
from slamfusion.compute.opencl import kernel_folder
from slamfusion.config import RunConfig
from slamfusion.errors import FleetError, MapFileError, SlamFusionError
from slamfusion.evaluation.map_error import maps_of_differences
from slamfusion.evaluation.measured import Row, result_rows
from slamfusion.fleet import as_done, executor_for
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles
from slamfusion.jobs.inputs import Progress
from slamfusion.jobs.outputs import TRIALS
from slamfusion.jobs.records import record_bytes
from slamfusion.jobs.results import input_records

T = TypeVar("T")
# Receives the finished share of a run.
Tell = Callable[[float], None]
# Role, case and path of files that are read.
Inputs = Sequence[tuple[str, str, Path]]

# Parts of the package that do not affect results.
FACES = {"cli", "report", "ros", "web"}
# Array names in map files.
MAP, RESOLUTION = "map ", "resolution"


@dataclass(frozen=True)
class RunResult:
    """The result of one run; ``example``: its maps against the truth (``packed_maps``)."""

    rows: Sequence[Row]
    notes: Mapping[str, str] = field(default_factory=dict)
    example: bytes | None = None
    remark: str = ""


@dataclass(frozen=True, eq=False)
class Setup:
    """How the runs of an experiment are done.

    Attributes:
        config: the settings; a kept run with other settings is repeated.
        folder: finished runs are kept in its folder ``trials``.
        processes: runs at the same time; 1: in this process.
        scheduler: of a Dask cluster, whose workers do the runs; see ``executor_for``.
    """

    config: RunConfig
    device: ComputeDevice
    folder: Path
    progress: Progress | None = None
    processes: int = 1
    scheduler: str | None = None


def run_all(
    tasks: Mapping[str, T],
    work: Callable[[T, RunConfig, Tell], RunResult],
    setup: Setup,
    inputs: Inputs | None = None,
) -> list[RunResult]:
    """Do the runs that the folder does not hold yet; return all results in order.

    Args:
        tasks: by the name of their files, each another one; ``repr`` must identify it.
        work: does a run; with several processes a function of a module.
        inputs: files on which, like on the device, the results depend; None: on neither.
    """
    config, folder = setup.config, setup.folder
    facts = [] if inputs is None else [setup.device.name]
    facts += [record["sha256"] for file in inputs or () for record in input_records(*file)]
    marks = {key: _fingerprint(task, config, facts) for key, task in tasks.items()}
    done = {key: kept for key in tasks if (kept := _read(folder, key, marks[key])) is not None}
    missing = {task: key for key, task in tasks.items() if key not in done}
    kept_count = len(done)

    def tell(count: float) -> None:
        if setup.progress is not None:
            setup.progress("runs", kept_count + count, len(tasks))

    tell(0.0)
    processes = max(1, min(setup.processes, len(missing)))
    try:
        with executor_for(setup.scheduler, processes, config.device.device) as executor:
            for task, result in as_done(executor, work, missing, config, progress=tell):
                key = missing[task]
                _write(folder, key, marks[key], result)
                done[key] = result
    except FleetError as error:
        message = f"{error}; what is done stays done: start the experiment again, it goes on"
        raise SlamFusionError(message) from None
    return [done[key] for key in tasks]


@cache
def program_digest() -> str:
    """Return a hash of the sources that affect a run: of the package and its kernels."""
    package = Path(slamfusion.__file__).parent
    sources = [
        path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in FACES
    ]
    digest = hashlib.sha256()
    for path in (*sorted(sources), *sorted(kernel_folder().glob("*.[ch]*"))):
        digest.update(f"{path.name}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _fingerprint(task: object, config: RunConfig, facts: Sequence[str]) -> str:
    """Return a hash of a task, its settings, inputs and the program."""
    settings = asdict(replace(config, seed=0))
    for unrelated in ("experiment", "live", "graph_optimizer", "simulate", "report"):
        del settings[unrelated]
    text = json.dumps([repr(task), settings, *facts, program_digest()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read(folder: Path, key: str, mark: str) -> RunResult | None:
    """Return the result of an earlier run; None if missing, damaged or different."""
    try:
        kept = json.loads((folder / TRIALS / f"{key}.json").read_text(encoding="utf-8"))
        if kept["fingerprint"] != mark:
            return None
        example = _maps_file(folder, key).read_bytes() if kept["example"] else None
        rows = [
            row
            for case, seed, method, figure, value in kept["rows"]
            for row in result_rows(case, seed, method, {figure: value})
        ]
        return RunResult(rows, dict(kept["notes"]), example, str(kept["remark"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _write(folder: Path, key: str, mark: str, result: RunResult) -> None:
    record = {
        "fingerprint": mark,
        "rows": [[*row[:4], None if math.isnan(row[4]) else row[4]] for row in result.rows],
        "notes": dict(result.notes),
        "example": result.example is not None,
        "remark": result.remark,
    }
    with AtomicFiles() as files:
        files.add(folder / TRIALS / f"{key}.json", record_bytes(record))
        if result.example is not None:
            files.add(_maps_file(folder, key), result.example)


def packed_maps(differences: Mapping[str, I8], resolution: float) -> bytes:
    """Return the file of differences to the truth, (H, W) int8 by method, all on one lattice."""
    arrays: dict[str, Any] = {f"{MAP}{name}": item for name, item in differences.items()}
    arrays[RESOLUTION] = np.float64(resolution)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def kept_runs(folder: Path) -> list[str]:
    """Return the names of the runs whose maps are kept in an experiment's folder."""
    return sorted(path.stem for path in (folder / TRIALS).glob("*.npz"))


def kept_maps(folder: Path, key: str) -> tuple[OccupancyGrid, list[OccupancyGrid]]:
    """Return the truth and the maps of a run on one lattice, as ``maps_of_differences``."""
    path = _maps_file(folder, key)
    try:
        with np.load(path) as stored:
            differences = {
                name.removeprefix(MAP): np.asarray(stored[name], dtype=np.int8)
                for name in stored.files
                if name != RESOLUTION
            }
            return maps_of_differences(differences, float(stored[RESOLUTION]), Pose2())
    except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile) as error:
        message = f"{path}: cannot be read as the maps of a drive ({error}); run it again"
        raise MapFileError(message) from error


def _maps_file(folder: Path, key: str) -> Path:
    return folder / TRIALS / f"{key}.npz"
