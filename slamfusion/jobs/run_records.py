"""What ``slamfusion slam`` and ``slamfusion run`` print with ``--json``; see ``records``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

from slamfusion.config import FusionMode
from slamfusion.evaluation import WallThickness
from slamfusion.evidence import RankedPath, Recommendation
from slamfusion.fusion.path_check import PathGap
from slamfusion.jobs.partial import PartialVote
from slamfusion.jobs.records import (
    CircumstancesJson,
    Evaluation,
    FusedPathJson,
    FusionJson,
    JudgedPathJson,
    MeasuresJson,
    SettingsJson,
)
from slamfusion.jobs.run_many import RunOfLog
from slamfusion.slam.records import (
    ProducerRunJson,
)


class ProducerJson(ProducerRunJson, MeasuresJson):
    """What one producer made of a log, what it took, and the errors that could be measured."""

    map_error: Evaluation | None
    """Errors of its map; null without a true map."""
    files: Sequence[str]
    """The files that it was written to: map, picture, path, record."""


class SlamProducerJson(ProducerJson):
    """The producer of ``slamfusion slam``."""

    resumed_from: str | None
    """The state that it was resumed from; null: it began afresh."""
    state_file: str | None
    """The file that its state was saved to."""


class LogFilesJson(TypedDict):
    """A log, and the files that what was made of it is held against."""

    log: str
    """The log that was mapped."""
    relations: str | None
    """The file of known relations."""
    odometry_file: str | None
    """The file of raw odometry."""
    scan_odometry: str | None
    """The file that gave the scans their odometry."""
    truth: str | None
    """The file of the true trajectory."""
    truth_map: str | None
    """The true map's file."""


class SlamDocument(LogFilesJson, CircumstancesJson):
    """``slamfusion slam``; also the record OUT.json."""

    producers: Sequence[SlamProducerJson]
    """The one producer."""


class RunProducerJson(ProducerJson):
    """A producer of ``slamfusion run`` that made a map."""

    failed: None
    """Null: it made a map."""
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""


class FailedProducerJson(TypedDict):
    """A producer of ``slamfusion run`` that made no map."""

    name: str
    """The producer."""
    scans: None
    """Null: unknown."""
    scans_used: None
    """Null: unknown."""
    time_s: None
    """Null: unknown."""
    time_per_scan_ms: None
    """Null: unknown."""
    peak_memory_mb: None
    """Null: unknown."""
    health: None
    """Null: unknown."""
    map_error: None
    """Null: there is no map."""
    files: Sequence[str]
    """Empty: nothing was written."""
    failed: str
    """Why it made no map."""
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""


class DrawnMapJson(TypedDict):
    """The map that is drawn from all scans at the fused path."""

    file: str
    """Its YAML file."""
    doubled_wall_share: float
    """Share of its wall cells that have a parallel wall close by, 0 to 1."""
    wall_thickness_m: WallThickness | None
    """How thick its walls are; null when no wall is beside a free cell."""


class RunFilesJson(LogFilesJson):
    """The files that ``slamfusion run`` was given."""

    saved_maps: Sequence[str]
    """Saved maps that voted too."""


class RunRecordDocument(RunFilesJson, CircumstancesJson):
    """The record NAME.json that ``slamfusion run`` writes beside a producer's map."""

    producers: Sequence[RunProducerJson]
    """The one producer."""


class RunDocument(FusionJson, RunFilesJson, CircumstancesJson):
    """``slamfusion run``; exit code 1 where there is an ``error`` or something ``not_measured``."""

    producers: Sequence[RunProducerJson | FailedProducerJson]
    """What became of each producer."""
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
    partial_votes: Sequence[PartialVote]
    """Producers that have no vote for the time in which they left the others."""
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


class RunsDocument(SettingsJson):
    """``slamfusion run`` of several logs; exit code 1 for an ``error`` or ``not_measured``."""

    runs: Sequence[RunOfLog]
    """The logs, in the order given."""
