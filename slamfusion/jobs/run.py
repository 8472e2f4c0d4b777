"""The main job: the producers on one log side by side, their fusion, and errors of everything.

``run_log`` is the whole pipeline; ``run_files`` writes what came of it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamfusion.align.records import FusionResult
from slamfusion.align.starts import place_starts
from slamfusion.config import FusionMode, RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evidence import PathEvidence, Recommendation, find_exclusions
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.defaults import RUN_DEFAULTS
from slamfusion.jobs.drawn import DrawnRun, draw_run, is_drawn, voting_config
from slamfusion.jobs.fuse_documents import DoubledWalls, left_out_sentences
from slamfusion.jobs.fuse_drive import DriveFusion
from slamfusion.jobs.fused_path import DrivePath
from slamfusion.jobs.inputs import (
    Progress,
    Warn,
    as_path,
    device_for,
    load_maps,
)
from slamfusion.jobs.map_log import PROGRESS_STEPS, LogFiles
from slamfusion.jobs.partial import Layers
from slamfusion.jobs.produced import ProducerResult
from slamfusion.jobs.records import Evaluation
from slamfusion.jobs.run_stages import (
    Drive,
    draw_drive_layers,
    evaluate_drive_maps,
    fuse_drive_paths,
    fuse_maps,
    fused_evidence,
    measure_fused_path,
    measure_producers,
    measure_saved_paths,
    recommend_for_drive,
    score_drive_paths,
    stage_timer,
    with_fallback,
)
from slamfusion.jobs.saved_maps import SavedMaps, SavedPath
from slamfusion.jobs.trajectory import Yardsticks
from slamfusion.slam.registry import BUILT_IN
from slamfusion.slam.side_by_side import Outcome, SideBySide
from slamfusion.trajectory import Trajectory

__all__ = ["LogRun", "run_log"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LogRun:
    """What came of the main job.

    Attributes:
        files: where the log and what it is held against were read.
        saved_maps: files of other SLAMs' maps that voted too.
        saved_paths: the paths of these that were given, by the maps' names.
        config: the settings in effect.
        outcomes: what became of each producer.
        grids: the producers' maps, then the saved ones.
        layers: what took part in the vote of these, and who has none for some of the drive.
        fusion: what came of fusing them, also where it may not be used.
        fused_path: one path made of the producers' paths; None where fewer than two have one, or
            where no fused map may be used.
        drawn: the map drawn from all scans at the fused path, beside the fused map; None where it
            was not asked for, or there is no such path.
        why_voted: why the maps voted although ``drawn`` was the mode asked for; None where they did
            not, or it was not asked for.
        results: the producers that made a map, by name, with their errors.
        doubled: the doubled walls of the fusion; None where nothing was fused.
        evaluations: errors of the inputs and of the fused map; empty without a true map.
        recommendation: which map and path to use; None if no map was made.
        evidence: what the scans say of the producers' paths and of the fused one; None where they
            could not be asked.
        no_verdict: why they could not; None where they were.
        failure: why there is no fused map that may be used; None where there is one.
        not_measured: what could not be measured, a sentence each.
        stages: wall time of each stage in order, seconds.
        begun_s: when it began, seconds of ``time.perf_counter``.
        device: what computed the fusion, in words.
        truth: the true path; None without one.
    """

    files: LogFiles
    saved_maps: tuple[Path, ...]
    saved_paths: Mapping[str, SavedPath]
    config: RunConfig
    outcomes: tuple[Outcome, ...]
    grids: tuple[OccupancyGrid, ...]
    layers: Layers
    fusion: DriveFusion
    fused_path: DrivePath | None
    drawn: OccupancyGrid | None
    why_voted: str | None
    results: Mapping[str, ProducerResult]
    doubled: DoubledWalls | None
    evaluations: tuple[Evaluation, ...]
    recommendation: Recommendation | None
    evidence: PathEvidence | None
    no_verdict: str | None
    failure: SlamFusionError | None
    not_measured: tuple[str, ...]
    stages: Mapping[str, float]
    begun_s: float
    device: str
    truth: Trajectory | None

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """The producers that made no map."""
        return tuple(outcome for outcome in self.outcomes if outcome.run is None)

    @property
    def usable(self) -> FusionResult | None:
        """The fusion where it may be used."""
        return None if self.failure is not None else self.fusion.result

    @property
    def fused_mode(self) -> FusionMode | None:
        """How the fused map came to be; None where there is none that may be used."""
        if self.usable is None:
            return None
        if self.why_voted is not None:
            return voting_config(self.config).fusion.vote.mode
        return self.config.fusion.vote.mode

    @property
    def grid(self) -> OccupancyGrid | None:
        """The fused map: cells in {-1, 0, 100}; None where there is none that may be used."""
        return None if self.usable is None else self.usable.fused

    def sentences(self) -> tuple[str, ...]:
        """Return what was left out and what is doubtful; ``not_measured`` and ``failure`` apart."""
        found = [f"no map: {outcome.name}: {outcome.reason}" for outcome in self.failed]
        if self.fusion.result is not None:
            found += left_out_sentences(self.fusion.result)
        found += self.layers.sentences()
        by_sentence: dict[str, list[str]] = {}
        for name, result in self.results.items():
            for sentence in result.run.warnings():
                by_sentence.setdefault(sentence, []).append(name)
        found += [f"{', '.join(names)}: {text}" for text, names in by_sentence.items()]
        if self.no_verdict is not None:
            found.append(f"the scans could not be asked about the paths: {self.no_verdict}")
        if self.why_voted is not None:
            why = f"the maps vote ({self.fused_mode}): {self.why_voted}"
            found.append(f"the fused map is not drawn, {why}")
        if self.fused_path is not None and self.fused_path.refined is None:
            found.append(f"all paths count alike in the fused path: {self.no_verdict}")
        return tuple(found)


def run_log(
    log: str | Path,
    config: RunConfig | None = None,
    *,
    saved_maps: Sequence[str | Path] = (),
    saved_paths: Sequence[CaseFile] = (),
    resolution: float | None = None,
    relations: str | Path | None = None,
    odometry: str | Path | None = None,
    truth: str | Path | None = None,
    truth_map: str | Path | None = None,
    scan_odometry: str | Path | None = None,
    progress: Progress | None = None,
    warn: Warn = _LOG.warning,
    prepare: Callable[[], None] | None = None,
) -> LogRun:
    """Map a log with several producers side by side, fuse their maps, and measure everything.

    Each producer runs in a process of its own, so a program that calls this needs the usual
    ``if __name__ == "__main__":``.

    Args:
        log: a CARMEN or tinySLAM log, or a ROS bag.
        config: settings of everything, ``run.producers`` among them; default: ``RUN_DEFAULTS``.
        saved_maps: of other SLAMs, which vote too: map_server YAML files, or bare images.
        saved_paths: paths that were found with the saved maps, each in its map's frame and on the
            clock of the log, may be sparse: what the scans say of them counts as for the
            producers' own. Whose path each one is, its name tells; see ``slamfusion.jobs.cases``.
        resolution: metres per cell of bare images.
        relations: known motions between pairs of times: errors of the paths.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        truth: the true trajectory: errors of the paths.
        truth_map: the true map: errors of every map and of the fused one.
        scan_odometry: what gives the scans their odometry instead of the log.
        progress: told the stage, or the producer, and how much of it is done.
        warn: told in a sentence what is doubtful about a map.
        prepare: called while the producers are at work; what it raises ends the run at once.

    Returns:
        Everything that was made. A producer that made no map, a fusion that failed, and what could
        not be measured are told in it and raise nothing.

    Raises:
        ConfigError: no producer, an unknown one, or one given twice; or a path of no saved map, or
            two of one. ``StartError``: a start names no producer and no saved map, or is one alone
            that says nothing of the others.
        LogError: the log cannot be opened.
        TrajectoryError: relations, odometry or truth cannot be read.
        MapFileError: a map cannot be read.
        DeviceError: the device cannot be opened.
        OSError: a file cannot be opened.
    """
    begun_s = time.perf_counter()
    config = config or RUN_DEFAULTS
    files = LogFiles(
        Path(log), *map(as_path, (relations, odometry, truth, truth_map, scan_odometry))
    )
    saved = SavedMaps.of(saved_maps, saved_paths)
    names = config.run.producers or BUILT_IN
    starts = place_starts(
        config.start, (*names, *saved.names), config.fusion.reference, drive=names
    )
    with SideBySide(names, files.log, config, files.scan_odometry) as side_by_side:
        config = side_by_side.config
        # Prepared while the producers are at work: what is wrong ends the run at once.
        if prepare is not None:
            prepare()
        true_map = None
        if files.truth_map is not None:
            (true_map,) = load_maps([files.truth_map], resolution, config.map_files, warn)
        held = Yardsticks.read(
            config, relations=files.relations, odometry=files.odometry, truth=files.truth
        )
        maps, others = saved.load(config, resolution, warn)
        device = device_for(config)
        outcomes = side_by_side.wait(_share_teller(progress))
    made = [outcome.run.grid for outcome in outcomes if outcome.run is not None]
    grids = (*made, *maps)

    stages = {"producers": time.perf_counter() - begun_s}
    timed = stage_timer(stages)
    drive = Drive(files, config, outcomes, held, device, progress)
    with timed("evidence"):
        evidence, no_verdict = score_drive_paths(drive, others)
        exclusions = None if evidence is None else find_exclusions(evidence, device)
    with timed("path"):
        fused_path = fuse_drive_paths(drive, evidence, exclusions)
    with timed("fusion"):
        layers = draw_drive_layers(drive, grids, exclusions, fused_path)
        fusion, failure = fuse_maps(drive, layers, len(maps), starts)
    usable = fusion.result if failure is None else None
    with timed("path"):
        fused_path = (
            None
            if usable is None or fused_path is None
            else measure_fused_path(drive, fused_path, usable)
        )
    with timed("evidence"):
        evidence = fused_evidence(evidence, fused_path)
        recommendation = recommend_for_drive(
            drive, evidence, exclusions, fused_path, fusion, is_fused=usable is not None
        )
    failure = with_fallback(failure, fusion, recommendation)
    drawn = DrawnRun(fusion)
    if usable is not None and is_drawn(config):
        with timed("drawing"):
            # What a map with a path knows is in the fused path.
            voting = [name for name in saved.names if name not in drive.saved_paths]
            drawn = draw_run(lambda: drive.drawn_scans, fused_path, fusion, voting, config, device)
        fusion = drawn.fusion
    with timed("errors"):
        doubled = None if fusion.result is None else DoubledWalls.of(fusion.result, config, device)
        evaluations = evaluate_drive_maps(drive, grids, fusion, drawn.beside, true_map)
        results = measure_producers(drive, evaluations)
        measures = measure_saved_paths(drive, others)
    return LogRun(
        files=files,
        saved_maps=saved.files,
        saved_paths={
            name: SavedPath(saved.paths[name], path, measures[name])
            for name, path in others.items()
        },
        config=config,
        outcomes=outcomes,
        grids=grids,
        layers=layers,
        fusion=fusion,
        fused_path=fused_path,
        drawn=drawn.beside,
        why_voted=drawn.why_voted,
        results=results,
        doubled=doubled,
        evaluations=evaluations,
        recommendation=recommendation,
        evidence=evidence,
        no_verdict=no_verdict,
        failure=failure,
        not_measured=tuple(drive.troubles),
        stages=stages,
        begun_s=begun_s,
        device=device.name,
        truth=held.truth,
    )


def _share_teller(progress: Progress | None) -> Callable[[str, float], None] | None:
    """Return what is told a producer and the share of the log that it has read."""
    if progress is None:
        return None

    def tell(name: str, share: float) -> None:
        progress(name, round(PROGRESS_STEPS * share), PROGRESS_STEPS)

    return tell
