"""What ``run_log`` made, in files: maps, paths, records, the report and the JSON document."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, cast

from slamfusion.config import FusionMode
from slamfusion.evidence import RankedPath, Recommendation
from slamfusion.fusion.path_check import PathGap
from slamfusion.io import AtomicFiles, save_map, write_tum
from slamfusion.jobs.documents import circumstances, record_bytes
from slamfusion.jobs.fuse_documents import FusionJson, failure_document, fusion_document
from slamfusion.jobs.fused_path import DrawnMapJson, FusedPathJson, drawn_document
from slamfusion.jobs.map_log import LogFilesJson, ProducerJson, add_run
from slamfusion.jobs.outputs import (
    AGREEMENT,
    DRAWN,
    FAILED,
    FUSED,
    FUSED_PATH,
    REPORT,
    RUN_RECORD,
    earlier_results,
    failure_folder,
    map_files,
    output_files,
    possible_outputs,
    remove_empty,
    report_files,
)
from slamfusion.jobs.records import CircumstancesJson, Evaluation
from slamfusion.jobs.run import LogRun
from slamfusion.jobs.trajectory import JudgedPathJson
from slamfusion.slam.side_by_side import Outcome


class RunProducerJson(ProducerJson):
    """A producer of ``slamfusion run`` that made a map."""

    failed: None
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""


class FailedProducerJson(TypedDict):
    """A producer of ``slamfusion run`` that made no map."""

    name: str
    """The producer."""
    scans: None
    scans_used: None
    time_s: None
    time_per_scan_ms: None
    peak_memory_mb: None
    health: None
    map_error: None
    files: Sequence[str]
    """Empty: nothing was written."""
    failed: str
    """Why it made no map."""
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""


class RunFilesJson(LogFilesJson):
    """The files that ``slamfusion run`` was given."""

    saved_maps: Sequence[str]
    """Saved maps that voted too."""


class RunRecordDocument(RunFilesJson, CircumstancesJson):
    """The record NAME.json that ``slamfusion run`` writes next to a producer's map."""

    producers: Sequence[RunProducerJson]
    """The one producer."""


class RunDocument(FusionJson, RunFilesJson, CircumstancesJson):
    """``slamfusion run``; exit code 1 where there is an ``error`` or something ``not_measured``."""

    producers: Sequence[RunProducerJson | FailedProducerJson]
    """The outcome of each producer."""
    fused: str | None
    """YAML file of the fused map; null where nothing was fused."""
    fused_mode: FusionMode | None
    """How the fused map came to be: by which vote, or drawn; null where nothing was fused."""
    why_voted: str | None
    """Why the maps voted although --mode drawn was asked for; null: it was drawn, or not asked."""
    agreement: str | None
    """YAML file of the agreement map; null where nothing was fused."""
    best_founded: str | None
    """Where nothing was fused, the map of ``recommendation``; else null."""
    path_gaps: Sequence[PathGap]
    """Between every two producers' paths in the fused frame."""
    path_evidence: Sequence[RankedPath]
    """What the scans say of each path, the recommended one first; empty where they could not be
    asked."""
    recommendation: Recommendation | None
    """What to use, and what to check first; null if no map was made."""
    no_verdict: str | None
    """Why the scans could not be asked; null where they were."""
    fused_path: FusedPathJson | None
    """The fused path; null where nothing was fused, or fewer than two producers have a path."""
    drawn_map: DrawnMapJson | None
    """The map drawn at the fused path; null where it was not asked for, or there is no path."""
    saved_paths: Sequence[JudgedPathJson]
    """The paths that were given with saved maps, and their errors."""
    evaluations: Sequence[Evaluation]
    """Errors of the inputs and of the fused map, with --truth."""
    error: str | None
    """Why nothing was fused; null where it was."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    report: str
    """The page of the report."""
    stages_s: Mapping[str, float]
    """Wall time of each stage, seconds."""
    time_s: float
    """Wall time of all, seconds."""


@dataclass(frozen=True, eq=False)
class SavedRun:
    """Where the files of a run lie.

    Attributes:
        folder: of the files: the one asked for, or ``failed`` in it, where a run without a fused
            map must not replace earlier results.
        files: of each producer, of the fused map, of the agreement, of the fused path, of the
            run's record and of the report, by name.
        stages: wall time of each stage in order, the report among them, seconds.
        document: what ``slamfusion run`` prints as JSON.
    """

    folder: Path
    files: Mapping[str, Sequence[Path]]
    stages: Mapping[str, float]
    document: RunDocument


def load_report() -> None:
    """Load what draws the report: where its extra is missing or damaged, that is said at once.

    Raises:
        SlamFusionError: matplotlib is missing or damaged.
    """
    import slamfusion.jobs.run_page  # noqa: F401, PLC0415


def save_run(run: LogRun, folder: str | Path, *, probabilities: bool = False) -> SavedRun:
    """Write all files together or none; with them goes what an earlier run left beside them.

    A map of an earlier run beside those of this one would be taken for one of them. So a run that
    made a fused map replaces everything of an earlier one, and one that made none writes into a
    folder of its own where there are results already. That there was an earlier run is told by its
    report; without one nothing is removed.

    Args:
        folder: for the maps; ``report`` in it is that of the report.
        probabilities: also write the producers' maps with their probabilities.

    Returns:
        Where everything lies.

    Raises:
        SlamFusionError: a file cannot be written, or matplotlib is missing.
    """
    wanted = target = Path(folder)
    if run.usable is None:
        target = failure_folder(wanted, [*possible_outputs(wanted), *report_files(wanted / REPORT)])
    with AtomicFiles() as files:
        written = _add_producers(files, run, target, probabilities=probabilities)
        if run.usable is not None:
            save_map(run.usable.fused, target / FUSED, files=files)
            save_map(run.usable.agreement, target / AGREEMENT, mode="raw", files=files)
            written |= {name: map_files(target / name) for name in (FUSED, AGREEMENT)}
            if run.fused_path is not None:
                write_tum(target / FUSED_PATH, run.fused_path.trajectory, files=files)
                written[FUSED_PATH] = [target / FUSED_PATH]
            if run.drawn is not None:
                save_map(run.drawn, target / DRAWN, files=files)
                written[DRAWN] = map_files(target / DRAWN)
        began_s = time.perf_counter()
        from slamfusion.jobs.run_page import write_run_page  # noqa: PLC0415  (an extra)

        written[REPORT] = [write_run_page(run, target / REPORT, files)]
        stages = {**run.stages, "report": time.perf_counter() - began_s}
        document = run_document(run, written, stages, time.perf_counter() - run.begun_s)
        if run.usable is not None:
            files.add(target / RUN_RECORD, record_bytes(document))
            written[RUN_RECORD] = [target / RUN_RECORD]
        kept = {path for paths in written.values() for path in paths}
        kept |= set(report_files(target / REPORT))
        for path in earlier_results([target] if run.usable is None else [wanted, wanted / FAILED]):
            if path not in kept:
                files.remove(path)
    if run.usable is not None:
        remove_empty(wanted / FAILED / REPORT, wanted / FAILED)
    return SavedRun(target, written, stages, document)


def _add_producers(
    files: AtomicFiles, run: LogRun, folder: Path, *, probabilities: bool
) -> dict[str, list[Path]]:
    """Stage the map, the path and the record of each producer; return their files by name."""
    written = {}
    for name, result in run.results.items():
        stem = folder / name
        written[name] = output_files(stem, probabilities=probabilities)
        document: RunRecordDocument = {
            "producers": [_made(run, name, written[name])],
            **_files_read(run),
            **circumstances(run.config, result.device),
        }
        add_run(files, result.run, document, stem, run.config, probabilities=probabilities)
    return written


# --- what is said -----------------------------------------------------------------------------


def run_document(
    run: LogRun, files: Mapping[str, Sequence[Path]], stages: Mapping[str, float], time_s: float
) -> RunDocument:
    """Return what ``slamfusion run`` prints as JSON.

    Args:
        stages: wall time of each stage, seconds.
        time_s: wall time of all, seconds.
    """
    usable, failure, found = run.usable, run.failure, run.recommendation
    path = run.fused_path
    fusion = (
        failure_document(run.grids, run.fusion.pairs, str(failure))
        if usable is None or run.doubled is None
        else fusion_document(usable, run.doubled)
    )
    return {
        "producers": [
            _record(run, outcome, files.get(outcome.name, ())) for outcome in run.outcomes
        ],
        **fusion,
        "fused": None if usable is None else str(files[FUSED][0]),
        "fused_mode": run.fused_mode,
        "why_voted": run.why_voted,
        "agreement": None if usable is None else str(files[AGREEMENT][0]),
        "best_founded": None if usable is not None or found is None else found.use,
        "path_gaps": run.fusion.gaps,
        "recommendation": found,
        "path_evidence": [] if found is None else found.paths,
        "no_verdict": run.no_verdict,
        "fused_path": None if path is None else path.to_json(files[FUSED_PATH][0]),
        "drawn_map": None
        if run.drawn is None
        else drawn_document(run.drawn, files[DRAWN][0], run.config),
        "saved_paths": [path.to_json() for path in run.saved_paths.values()],
        "evaluations": run.evaluations,
        "error": None if failure is None else str(failure),
        "not_measured": run.not_measured,
        "report": str(files[REPORT][0]),
        **_files_read(run),
        **circumstances(run.config, run.device),
        "stages_s": stages,
        "time_s": time_s,
    }


def _files_read(run: LogRun) -> RunFilesJson:
    """Return the files that the run was given, for a JSON document."""
    return {**run.files.to_json(), "saved_maps": [str(path) for path in run.saved_maps]}


def _record(
    run: LogRun, outcome: Outcome, files: Sequence[Path]
) -> RunProducerJson | FailedProducerJson:
    """Return a producer's record; of one that made no map, why."""
    if outcome.name in run.results:
        return _made(run, outcome.name, files)
    unknown = cast("FailedProducerJson", dict.fromkeys(FailedProducerJson.__annotations__))
    return {
        **unknown,
        "name": outcome.name,
        "files": [],
        "failed": outcome.reason,
        "process_time_s": outcome.time_s,
        "process_cpu_s": outcome.cpu_s,
    }


def _made(run: LogRun, name: str, files: Sequence[Path]) -> RunProducerJson:
    """Return the record of a producer that made a map."""
    outcome = next(item for item in run.outcomes if item.name == name)
    return {
        **run.results[name].to_json(files),
        "failed": None,
        "process_time_s": outcome.time_s,
        "process_cpu_s": outcome.cpu_s,
    }
