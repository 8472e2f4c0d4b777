"""What ``slamfusion slam`` and ``slamfusion run`` print with ``--json``; see ``records``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypedDict

from slamfusion.align.records import (
    PathGapJson,
)
from slamfusion.config import FusionMode
from slamfusion.evaluation.records import (
    WallThicknessJson,
)
from slamfusion.evidence.records import (
    PathEvidenceJson,
    RecommendationJson,
)
from slamfusion.jobs.records import (
    CircumstancesJson,
    EvaluationJson,
    FusedPathJson,
    FusionJson,
    JudgedPathJson,
    MeasuresJson,
    SettingsJson,
)
from slamfusion.slam.records import (
    ProducerRunJson,
)


class ProducerJson(ProducerRunJson, MeasuresJson):
    """What one producer made of a log, what it took, and the errors that could be measured."""

    map_error: EvaluationJson | None
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
    wall_thickness_m: WallThicknessJson | None
    """How thick its walls are; null when no wall is beside a free cell."""


class ExcludedSpanJson(TypedDict):
    """A part of a drive in which a producer has no vote."""

    from_s: float
    """Where it begins, seconds since the first scan."""
    to_s: float
    """Where it ends, seconds since the first scan."""
    gap_m: float
    """How far it is at most from the nearest path that votes, metres, and 2 m for a radian."""
    ground: Literal["outvoted", "contradicted by the scans"]
    """Why: most others agree with each other, or the scans bear another path out better."""


class PartialVoteJson(TypedDict):
    """A producer that has no vote for some of the drive."""

    name: str
    """The producer."""
    excluded_spans: Sequence[ExcludedSpanJson]
    """When it has none."""
    excluded_share: float
    """Share of the judged scans that lie in these times, 0 to 1."""
    left_out: str | None
    """Why it has no vote at all; null: its layer was drawn without these times and took part."""
    filled: bool
    """Whether its layer shows what was seen in these times, drawn at the fused path."""


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
    partial_votes: Sequence[PartialVoteJson]
    """Producers that have no vote for the time in which they left the others."""
    path_gaps: Sequence[PathGapJson]
    """Between every two producers' paths in the fused frame."""
    path_evidence: Sequence[PathEvidenceJson]
    """What the scans say of each path, the recommended one first; empty where they could not be
    asked."""
    recommendation: RecommendationJson | None
    """What to use, and what to check first; null if no map was made."""
    no_verdict: str | None
    """Why the scans could not be asked; null where they were."""
    fused_path: FusedPathJson | None
    """The fused path; null where nothing was fused, or fewer than two producers have a path."""
    drawn_map: DrawnMapJson | None
    """The map drawn at the fused path; null where it was not asked for, or there is no path."""
    saved_paths: Sequence[JudgedPathJson]
    """The paths that were given with saved maps, and their errors."""
    evaluations: Sequence[EvaluationJson]
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


class RunOfLogJson(TypedDict):
    """What came of one of several logs."""

    log: str
    """The log."""
    folder: str | None
    """Folder of its files; null where none were written."""
    fused: str | None
    """YAML file of the fused map; null where nothing was fused."""
    record: str | None
    """The document of this run alone, as a file; null where nothing was fused."""
    report: str | None
    """Folder of the report; null where none was written."""
    fused_count: int
    """Inputs that voted."""
    recommendation: RecommendationJson | None
    """What to use, and what to check first; null if no map was made."""
    error: str | None
    """Why nothing was fused; null where it was."""
    warnings: Sequence[str]
    """What was left out and what is doubtful, a sentence each."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    time_s: float | None
    """Wall time, seconds; null where the log could not be run."""


class RunsDocument(SettingsJson):
    """``slamfusion run`` of several logs; exit code 1 for an ``error`` or ``not_measured``."""

    runs: Sequence[RunOfLogJson]
    """The logs, in the order given."""
