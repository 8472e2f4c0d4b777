"""The record of a run, which is also its JSON document, its files, and the maps given to it."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamfusion.align.records import Alignment, FusionResult
from slamfusion.config import FusionMode, RunConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.measured import MeasuredPath
from slamfusion.evaluation.wall_faces import WallThickness, wall_thickness
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import RankedPath, Recommendation
from slamfusion.fusion.path_check import PathGap
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, read_trajectory, save_map, write_tum
from slamfusion.io.log import LogRecord
from slamfusion.jobs import outputs
from slamfusion.jobs.cases import CaseFile, files_by_case
from slamfusion.jobs.fuse_documents import DoubledWalls, Evaluation, FusionRecord
from slamfusion.jobs.fused_path import FusedPath
from slamfusion.jobs.inputs import LogFiles, Warn, distinct_names, load_maps
from slamfusion.jobs.map_log import ProducerResult, write_producer
from slamfusion.jobs.records import Circumstances, number, record_bytes
from slamfusion.json_values import FLAT
from slamfusion.slam.registry import producer_names
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True)
class SavedMaps:
    """Files of saved maps, and of the paths of some of them, by the map's name."""

    files: tuple[Path, ...]
    names: tuple[str, ...]
    paths: Mapping[str, Path]

    @classmethod
    def of(cls, maps: Sequence[str | Path], paths: Sequence[CaseFile]) -> SavedMaps:
        """Name maps and match paths to them; ``ConfigError``: a path of no map, or two of one."""
        files = tuple(map(Path, maps))
        own = distinct_names(files)
        if paths and not files:
            message = f"{paths[0].path}: the path needs its map; give it with --inputs MAP"
            raise ConfigError(message)
        found = files_by_case(own, paths, "--paths")
        return cls(
            files,
            tuple(map(free_name, own)),
            {free_name(name): file for name, file in found.items()},
        )

    def load(
        self, config: RunConfig, resolution: float | None, warn: Warn
    ) -> tuple[list[OccupancyGrid], dict[str, Trajectory]]:
        """Return the maps and the paths, named."""
        grids = load_maps(self.files, config, resolution=resolution, warn=warn)
        named = [grid.with_name(name) for grid, name in zip(grids, self.names, strict=True)]
        paths = {
            name: replace(read_trajectory(file, config.log), name=name)
            for name, file in self.paths.items()
        }
        return named, paths


def free_name(name: str, taken: Collection[str] = ()) -> str:
    """Return the name of a saved map, changed where a producer or a fused map has it."""
    is_taken = name in {*producer_names(), outputs.FUSED, outputs.DRAWN, *taken}
    return f"{name} (saved)" if is_taken else name


@dataclass(frozen=True, eq=False, kw_only=True)
class RunProducer(ProducerResult):
    """A producer of ``slamfusion run`` that made a map."""

    failed: None = None
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""

    def figures(self) -> list[tuple[str, str]]:
        """Return the run's numbers with their names, and the time of its process."""
        cpu = f"{number(self.process_time_s, 1)} s, {number(self.process_cpu_s, 1)} s of processor"
        return [*super().figures(), ("process", cpu)]


@dataclass(frozen=True, kw_only=True)
class FailedProducer:
    """A producer of ``slamfusion run`` that made no map."""

    name: str
    """The producer."""
    scans: None = None
    scans_used: None = None
    time_s: None = None
    time_per_scan_ms: None = None
    peak_memory_mb: None = None
    health: None = None
    map_error: None = None
    files: Sequence[Path] = ()
    """Empty: nothing was written."""
    failed: str
    """Why it made no map."""
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""
    detail: str = field(default="", repr=False)


@dataclass(frozen=True)
class RunFiles(LogFiles):
    """The files that ``slamfusion run`` was given."""

    saved_maps: tuple[Path, ...] = field(default=(), kw_only=True)
    """Saved maps that voted too."""


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The record NAME.json that ``slamfusion run`` writes next to a producer's map."""

    producers: Sequence[RunProducer]
    """The one producer."""
    files: RunFiles = field(metadata=FLAT)
    made_with: Circumstances = field(metadata=FLAT)


@dataclass(frozen=True, eq=False)
class DriveFusion:
    """The result of fusing the maps of one drive.

    Attributes:
        grids: what was fused: the producers' maps, then the saved ones.
        result: the fusion, also where it may not be used; None where nothing was fused.
        gaps: between the producers' paths in the fused frame.
        pairs: of the maps, where nothing was fused.
        fallback: where nothing was fused, the map to go on with: whose walls the others' fit
            best, or the only one; None where there is a fusion, or no map.
        failure: why there is no fused map that may be used; None where there is one.
        doubled: the doubled walls of the fusion; None where they were not measured.
    """

    grids: tuple[OccupancyGrid, ...] = ()
    result: FusionResult | None = None
    gaps: tuple[PathGap, ...] = ()
    pairs: tuple[Alignment, ...] = ()
    fallback: OccupancyGrid | None = None
    failure: SlamFusionError | None = None
    doubled: DoubledWalls | None = None

    @property
    def usable(self) -> FusionResult | None:
        """The fusion where it may be used."""
        return None if self.failure is not None else self.result

    def to_json(self) -> FusionRecord:
        """Return the fusion for a JSON document."""
        if self.usable is None:
            return FusionRecord.failed(self.grids, self.pairs, str(self.failure))
        return FusionRecord.of(self.usable, self.doubled)


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """The map that is drawn from all scans at the fused path."""

    grid: OccupancyGrid = field(repr=False)
    file: Path | None
    """Its YAML file."""
    doubled_wall_share: float
    """Share of its wall cells that have a parallel wall close by, 0 to 1."""
    wall_thickness_m: WallThickness | None
    """How thick its walls are; null when no wall is next to a free cell."""

    @classmethod
    def of(cls, grid: OccupancyGrid, config: RunConfig) -> DrawnMap:
        """Measure a drawn map."""
        classified = grid.classified(config.fusion.normalize)
        share = doubled_wall_share(classified.cells == 1)
        return cls(grid, None, share, wall_thickness(classified))


@dataclass(frozen=True, eq=False, kw_only=True)
class LogRun:
    """``slamfusion run``; exit code 1 where there is an ``error`` or something ``not_measured``.

    Attributes:
        evidence: what the scans say of the paths; None where they could not be asked.
        true_path: None without one.
        begun_s: when it began, seconds of ``time.perf_counter``.
        folder: of its files: the one asked for, or ``failed`` in it, where a run without a fused
            map must not replace earlier results.
    """

    producers: tuple[RunProducer | FailedProducer, ...]
    """The outcome of each producer."""
    fusion: DriveFusion = field(metadata=FLAT)
    fused: Path | None = None
    """YAML file of the fused map; null where nothing was fused."""
    fused_mode: FusionMode | None
    """How the fused map came to be: by which vote, or drawn; null where nothing was fused."""
    why_voted: str | None
    """Why the maps voted although --mode drawn was asked for; null: it was drawn, or not asked."""
    agreement: Path | None = None
    """YAML file of the agreement map; null where nothing was fused."""
    best_founded: str | None
    """Where nothing was fused, the map of ``recommendation``; else null."""
    path_gaps: Sequence[PathGap]
    """Between every two producers' paths in the fused frame."""
    recommendation: Recommendation | None
    """What to use, and what to check first; null if no map was made."""
    path_evidence: Sequence[RankedPath]
    """What the scans say of each path, the recommended one first; empty where they could not be
    asked."""
    no_verdict: str | None
    """Why the scans could not be asked; null where they were."""
    fused_path: FusedPath | None
    """The fused path; null where nothing was fused, or fewer than two producers have a path."""
    drawn_map: DrawnMap | None
    """The map drawn at the fused path; null where it was not asked for, or there is no path."""
    saved_paths: Sequence[MeasuredPath]
    """The paths that were given with saved maps, and their errors."""
    evaluations: Sequence[Evaluation]
    """Errors of the inputs and of the fused map, with --truth."""
    error: str | None
    """Why nothing was fused; null where it was."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    report: Path | None = None
    """The page of the report."""
    files: RunFiles = field(metadata=FLAT)
    made_with: Circumstances = field(metadata=FLAT)
    stages_s: Mapping[str, float]
    """Wall time of each stage, seconds."""
    time_s: float = 0.0
    """Wall time of all, seconds."""
    evidence: PathEvidence | None = field(repr=False)
    true_path: Trajectory | None = field(repr=False)
    begun_s: float = field(repr=False)
    folder: Path = field(default=Path(), repr=False)

    @property
    def results(self) -> dict[str, RunProducer]:
        """The producers that made a map, by name, with their errors."""
        made = (item for item in self.producers if isinstance(item, RunProducer))
        return {item.name: item for item in made}

    @property
    def failed(self) -> tuple[FailedProducer, ...]:
        """The producers that made no map."""
        return tuple(item for item in self.producers if isinstance(item, FailedProducer))

    @property
    def paths(self) -> dict[str, MeasuredPath]:
        """The paths of the producers and of saved maps, by name, with their errors."""
        made = {name: item.path for name, item in self.results.items()}
        return made | {item.name: item for item in self.saved_paths}

    @property
    def grids(self) -> tuple[OccupancyGrid, ...]:
        """The producers' maps, then the saved ones."""
        return self.fusion.grids

    @property
    def usable(self) -> FusionResult | None:
        """The fusion where it may be used."""
        return self.fusion.usable

    @property
    def grid(self) -> OccupancyGrid | None:
        """The fused map: cells in {-1, 0, 100}; None where there is none that may be used."""
        return None if self.usable is None else self.usable.fused

    def log_notes(self) -> list[str]:
        """Return what the log says of itself, and how its scans were deskewed."""
        return list(dict.fromkeys(note for log in self._logs() for note in log.notes))

    def log_faults(self) -> list[tuple[str, str]]:
        """Return what was left out of the log and what is odd in it, each with its place."""
        return list(dict.fromkeys(fault for log in self._logs() for fault in log.faults()))

    def _logs(self) -> list[LogRecord]:
        return [item.run.log for item in self.results.values() if item.run.log is not None]

    def remarks(self) -> list[tuple[str, str]]:
        """Return what was left out and what is doubtful, each a subject and its text.

        ``log_faults``, ``not_measured`` and ``error`` are apart.
        """
        found = [(f"{item.name} made no map:", item.failed) for item in self.failed]
        if self.fusion.result is not None:
            found += self.fusion.result.remarks
        faults = [(name, text) for name, item in self.results.items() for text in item.run.warnings]
        if self.recommendation is not None:
            known = {*self.results, outputs.FUSED}
            faults += [own for own in self.recommendation.path_faults() if own[0] not in known]
        by_sentence: dict[str, list[str]] = {}
        for name, sentence in faults:
            by_sentence.setdefault(sentence, []).append(name)
        found += [(f"{', '.join(names)}:", text) for text, names in by_sentence.items()]
        if self.no_verdict is not None:
            found.append(("the scans could not be asked about the paths:", self.no_verdict))
        if self.why_voted is not None:
            voted = f"the fused map is not drawn, the maps vote ({self.fused_mode}):"
            found.append((voted, self.why_voted))
        if self.fused_path is not None and self.fused_path.refinement is None:
            found.append(("all paths count alike in the fused path:", str(self.no_verdict)))
        return found

    def sentences(self) -> tuple[str, ...]:
        """Return the remarks as sentences."""
        return tuple(" ".join(words).strip() for words in self.remarks())


def load_report() -> None:
    """Import what draws the report, so that a missing or damaged extra is an error at once."""
    import slamfusion.jobs.run_page  # noqa: F401, PLC0415


def save_run(run: LogRun, folder: str | Path, *, probabilities: bool = False) -> LogRun:
    """Write all files or none, remove those of an earlier run, return the run with its files.

    A run with a fused map replaces everything of an earlier one (known by its report); a run
    without one writes into ``failed`` if there are results already.

    Args:
        folder: for the maps, with the report in its ``report``.
        probabilities: also write the producers' maps with their probabilities.

    Raises:
        SlamFusionError: a file cannot be written, or matplotlib is missing.
    """
    from slamfusion.jobs.run_page import run_page  # noqa: PLC0415  (an extra)
    from slamfusion.report.page import report_files, write_page  # noqa: PLC0415

    wanted = target = Path(folder)
    if run.usable is None:
        target = outputs.failure_folder(
            wanted, [*outputs.possible_outputs(wanted), *report_files(wanted / outputs.REPORT)]
        )
    with AtomicFiles() as files:
        producers = [
            item
            if isinstance(item, FailedProducer)
            else _add_producer(run, item, target, probabilities=probabilities)
            for item in run.producers
        ]
        run = replace(run, producers=tuple(producers), folder=target)
        if run.usable is not None:
            fused, _ = save_map(run.usable.fused, target / outputs.FUSED)
            agreed = run.usable.agreement
            agreement, _ = save_map(agreed, target / outputs.AGREEMENT, mode="raw")
            run = replace(run, fused=fused, agreement=agreement)
        if run.fused_path is not None:
            path = target / outputs.FUSED_PATH
            write_tum(path, run.fused_path.trajectory)
            run = replace(run, fused_path=replace(run.fused_path, file=path))
        if run.drawn_map is not None:
            drawn, _ = save_map(run.drawn_map.grid, target / outputs.DRAWN)
            run = replace(run, drawn_map=replace(run.drawn_map, file=drawn))
        began_s = time.perf_counter()
        page = write_page(run_page(run), target / outputs.REPORT)
        ended_s = time.perf_counter()
        run = replace(
            run,
            report=page,
            stages_s={**run.stages_s, "report": ended_s - began_s},
            time_s=ended_s - run.begun_s,
        )
        if run.usable is not None:
            files.add(target / outputs.RUN_RECORD, record_bytes(run))
        for place in [target] if run.usable is None else [wanted, wanted / outputs.FAILED]:
            if report := report_files(place / outputs.REPORT):
                files.remove(*outputs.possible_outputs(place), *report)
    if run.usable is not None:
        outputs.remove_empty(wanted / outputs.FAILED / outputs.REPORT, wanted / outputs.FAILED)
    return run


def _add_producer(
    run: LogRun, made: RunProducer, folder: Path, *, probabilities: bool
) -> RunProducer:
    """Stage the map, the path and the record of a producer; return it with its files."""
    stem, config = folder / made.name, run.made_with.config
    made = replace(made, files=outputs.output_files(stem, probabilities=probabilities))
    record = RunRecord((made,), run.files, Circumstances(made.device, config))
    write_producer(made.run, record, stem, config, probabilities=probabilities)
    return made
