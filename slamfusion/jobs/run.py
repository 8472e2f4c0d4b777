"""The main job: the producers on one log side by side, their fusion, and errors of everything.

``run_log`` is the whole pipeline, stage by stage; ``run_files`` writes the files of its result.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from slamfusion.align.records import FusionResult
from slamfusion.align.starts import place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionMode, RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError, TrajectoryError
from slamfusion.evaluation import on_clock
from slamfusion.evidence import (
    JudgedScans,
    PathEvidence,
    Recommendation,
    judged_scans,
    recommend,
    score_paths,
    with_path,
)
from slamfusion.evidence.drawn_map import DrawnScan, drawn_scans, fuse_with_drawn
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse import AllRequiredError
from slamfusion.jobs.fuse_documents import DoubledWalls, left_out_sentences
from slamfusion.jobs.fuse_drive import DriveFusion, fuse_drive
from slamfusion.jobs.fused_path import DrivePath, draw_like, fuse_weighed_paths
from slamfusion.jobs.inputs import (
    RUN_DEFAULTS,
    RUN_VOTE,
    PixelSizes,
    Progress,
    Warn,
    as_path,
    device_for,
    load_truth,
)
from slamfusion.jobs.map_log import LogFiles, ProducerResult, measure_run
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.jobs.records import Evaluation
from slamfusion.jobs.saved_maps import SavedMaps, SavedPath, path_at_scans
from slamfusion.jobs.trajectory import Measures, Yardsticks
from slamfusion.slam.common.odometry_check import laser_fault
from slamfusion.slam.registry import BUILT_IN, producer
from slamfusion.slam.side_by_side import Outcome, SideBySide
from slamfusion.trajectory import Trajectory

_LOG = logging.getLogger(__name__)
Result = TypeVar("Result")

# The progress of all stages together, the share of the time that the SLAMs take (of two drives on
# two cores), and the number of stages that follow, with the report, which counts as two.
WHOLE = "whole run"
SLAM_SHARE, LATE_STAGES = 0.65, 9
NO_PATH = "fewer than two producers have a path, so there is no fused path to draw at"


@dataclass(frozen=True, eq=False)
class LogRun:
    """The result of the main job.

    Attributes:
        files: where the log and what it is held against were read.
        saved_maps: files of other SLAMs' maps that voted too.
        saved_paths: the paths of these that were given, by the maps' names.
        grids: the producers' maps, then the saved ones.
        fusion: the outcome of fusing them, also where it may not be used.
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
        truth: the true path; None without one.
    """

    files: LogFiles
    saved_maps: tuple[Path, ...]
    saved_paths: Mapping[str, SavedPath]
    config: RunConfig
    outcomes: tuple[Outcome, ...]
    grids: tuple[OccupancyGrid, ...]
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

    def log_notes(self) -> list[str]:
        """Return what the log says of itself, and how its scans were deskewed."""
        logs = (item.run.log for item in self.results.values())
        return list(dict.fromkeys(note for log in logs if log is not None for note in log.notes))

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


def run_log(  # noqa: PLR0915 - one page, a heading a stage
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
    scale: PixelSizes | None = None,
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
        saved_maps: of other SLAMs, which vote too: map_server YAML files, or bare images.
        saved_paths: paths that were found with the saved maps, each in its map's frame and on the
            clock of the log, may be sparse: what the scans say of them counts as for the
            producers' own. Whose path each one is, its name tells; see ``slamfusion.jobs.cases``.
        relations, odometry, truth, truth_map, scan_odometry: see ``LogFiles``.
        scale: the true map is a floor plan with pixels of this size; see ``evaluate_maps``.
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
    config = config or RUN_DEFAULTS
    files = LogFiles(
        Path(log), *map(as_path, (relations, odometry, truth, truth_map, scan_odometry))
    )
    saved = SavedMaps.of(saved_maps, saved_paths)
    names = config.run.producers or BUILT_IN
    starts = place_starts(
        config.start, (*names, *saved.names), config.fusion.reference, drive=names
    )
    stages = _Stages(progress, names)

    # Run the SLAMs side by side. Read all else meanwhile: a bad file ends the run at once.
    with (
        stages.timed("producers"),
        SideBySide(names, files.log, config, files.scan_odometry) as work,
    ):
        config = work.config
        if prepare is not None:
            prepare()
        true_map = None
        if files.truth_map is not None:
            true_map = load_truth(
                files.truth_map, config, resolution=resolution, scale=scale, warn=warn
            )
        held = Yardsticks.read(config, files.relations, files.odometry, files.truth, warn)
        others, their_paths = saved.load(config, resolution, warn)
        device = device_for(config)
        outcomes = work.wait(stages.tell_slam)
    runs = {item.name: item.run for item in outcomes if item.run is not None}
    grids = (*(run.grid for run in runs.values()), *others)
    paths = {name: run.trajectory for name, run in runs.items() if len(run.trajectory)}
    scans = cache(lambda: drawn_scans(work.source))
    wheels = next((run.odometry for run in runs.values()), None)
    their_paths = {
        name: on_clock(path, wheels, config.trajectory.time_offset)
        for name, path in their_paths.items()
    }

    # Score the paths on the scans; those of saved maps join the producers'.
    with stages.timed("evidence"):
        evidence, no_verdict = score_all_paths(
            lambda: judged_scans(work.source),
            paths,
            their_paths,
            device,
            lambda name, why: stages.troubles.append(f"{name}: its path was not used: {why}"),
        )

    # Make one path of all.
    fused_path: DrivePath | None = None
    with stages.timed("path"):
        if len(paths) >= LEAST_FUSED:
            fused_path = stages.attempt(
                "the fused path", None, fuse_weighed_paths, paths, evidence, device
            )

    # Vote.
    with stages.timed("fusion"):
        fusion = fuse_drive(
            grids,
            paths,
            voting_config(config),
            device,
            shared_frame=not others,
            progress=progress,
            starts=starts,
        )
        failure = _why_not_fused(fusion, outcomes, len(others), config)
    usable = fusion.result if failure is None else None

    # Lay the fused path into the fused map, and say which map and path to use.
    with stages.timed("path"):
        if usable is None or fused_path is None:
            fused_path = None
        else:
            fused_path = fused_path.in_fused_frame(paths, usable)
            measures = stages.attempt(
                "the fused path", Measures(), held.measure, fused_path.trajectory, config, wheels
            )
            fused_path = replace(fused_path, measures=measures)
    with stages.timed("evidence"):
        if fused_path is not None and fused_path.refined is not None:
            evidence = fused_path.refined.evidence
        recommendation = _recommend(
            paths, evidence, fused_path, fusion, device, is_fused=usable is not None
        )
        if recommendation is not None:
            every = paths if fused_path is None else {**paths, FUSED: fused_path.trajectory}
            fault = laser_fault(wheels, every.get(recommendation.path or ""))
            recommendation = replace(recommendation, laser_fault=fault)
    if recommendation is not None and failure is not None and failure is fusion.failure:
        words = f"{failure}; the fallback map is that of {recommendation.use}"
        failure = AlignmentError(words, fusion.pairs)

    # Draw the map of all scans at the fused path, as the fused one or beside it.
    drawn, why_voted = None, None
    if usable is not None and (config.run.draw or config.fusion.vote.mode == DRAWN):
        with stages.timed("drawing"):
            # What a map with a path knows is in the fused path.
            voting = [name for name in saved.names if name not in paths]
            fusion, drawn, why_voted = draw_run(scans, fused_path, fusion, voting, config, device)

    # Measure everything by what is known.
    with stages.timed("errors"):
        doubled = None if fusion.result is None else DoubledWalls.of(fusion.result, config)
        fused = None if fusion.result is None else fusion.result.fused.with_name(FUSED)
        evaluations: tuple[Evaluation, ...] = ()
        if true_map is not None and grids:
            measured = [grid for grid in (*grids, fused, drawn) if grid is not None]
            evaluations = stages.attempt(
                "", (), evaluate_maps, measured, true_map, config, device,
                scale=scale, progress=progress,
            )  # fmt: skip
        errors = {item.name: item for item in evaluations}
        results = {
            item.name: ProducerResult(
                item.run,
                stages.attempt(item.name, Measures(), measure_run, item.run, config, held),
                errors.get(item.name),
                item.device,
            )
            for item in outcomes
            if item.run is not None
        }
        found_paths = {
            name: SavedPath(
                saved.paths[name],
                path,
                stages.attempt(name, Measures(), held.measure, path, config, wheels),
            )
            for name, path in their_paths.items()
        }
    return LogRun(
        files=files,
        saved_maps=saved.files,
        saved_paths=found_paths,
        config=config,
        outcomes=outcomes,
        grids=grids,
        fusion=fusion,
        fused_path=fused_path,
        drawn=drawn,
        why_voted=why_voted,
        results=results,
        doubled=doubled,
        evaluations=evaluations,
        recommendation=recommendation,
        evidence=evidence,
        no_verdict=no_verdict,
        failure=failure,
        not_measured=tuple(stages.troubles),
        stages=stages.times_s,
        begun_s=stages.begun_s,
        device=device.name,
        truth=held.truth,
    )


class _Stages:
    """The time of each stage, and what failed in them.

    Attributes:
        begun_s: when the run began, seconds of ``time.perf_counter``.
        slams: of each SLAM the share of the log that it has read.
        ended: the number of blocks that have ended.
    """

    def __init__(self, progress: Progress | None, slams: Sequence[str]) -> None:
        self.begun_s = time.perf_counter()
        self.progress: Progress = progress or (lambda *_: None)
        self.progress(WHOLE, 0, 1)
        self.ended = 0
        self.slams = dict.fromkeys(slams, 0.0)
        self.times_s: dict[str, float] = {}
        self.troubles: list[str] = []

    def tell_slam(self, name: str, share: float) -> None:
        """Report the share of the log that a SLAM has read."""
        self.slams[name] = share
        costs = {slam: producer(slam).cost for slam in self.slams}
        done = sum(costs[slam] * share for slam, share in self.slams.items())
        self.progress(WHOLE, SLAM_SHARE * done / sum(costs.values()), 1)
        self.progress(name, share, 1)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time of a block to that of a stage, and report that it begins and ends."""
        began_s = time.perf_counter()
        is_late = self.ended > 0  # before, each SLAM reports for itself
        if is_late:
            self.progress(name, 0, 1)
        yield
        if is_late:
            self.progress(name, 1, 1)
        self.progress(WHOLE, SLAM_SHARE + (1.0 - SLAM_SHARE) * self.ended / LATE_STAGES, 1)
        self.ended += 1
        self.times_s[name] = self.times_s.get(name, 0.0) + time.perf_counter() - began_s

    def attempt(
        self,
        what: str,
        otherwise: Result,
        function: Callable[..., Result],
        *arguments: Any,
        **named: Any,
    ) -> Result:
        """Return the result of a call; if it fails, note the error and return another value."""
        try:
            return function(*arguments, **named)
        except SlamFusionError as error:
            self.troubles.append(f"{what}: {error}" if what else str(error))
            return otherwise


def score_all_paths(
    judge: Callable[[], JudgedScans],
    paths: dict[str, Trajectory],
    saved: Mapping[str, Trajectory],
    device: ComputeDevice,
    leave_out: Callable[[str, str], None],
) -> tuple[PathEvidence | None, str | None]:
    """Score the paths on the scans; else return why that cannot be done."""
    reason, evidence = "no producer has a path", None
    if paths:
        try:
            evidence = score_paths(judge(), paths, device)
        except SlamFusionError as error:
            reason = str(error)
    for name, path in saved.items():
        try:
            if evidence is None:
                raise TrajectoryError(reason)
            at_scans = path_at_scans(path, evidence.scans)
            evidence = with_path(evidence, name, path, device)
        except SlamFusionError as error:
            leave_out(name, str(error))
        else:
            paths[name] = at_scans
    return evidence, None if evidence is not None else reason


def _why_not_fused(
    fusion: DriveFusion, outcomes: Sequence[Outcome], saved: int, config: RunConfig
) -> SlamFusionError | None:
    """Return why the fused map may not be used; None where it may."""
    failed = [item for item in outcomes if item.run is None]
    made = len(outcomes) - len(failed) + saved
    if made < LEAST_FUSED:
        reasons = "; ".join(f"{item.name}: {item.reason}" for item in failed)
        message = f"{made or 'none'} of {len(outcomes) + saved} maps was made"
        return SlamFusionError(
            f"{message}, at least {LEAST_FUSED} are needed for a vote{reasons and f' ({reasons})'}"
        )
    if fusion.result is not None and config.fusion.require_all:
        if fusion.result.rejected:
            return AllRequiredError(fusion.result.rejected, fusion.result.pairs, fusion.result)
        if failed:
            names = ", ".join(item.name for item in failed)
            return SlamFusionError(f"--require-all, but no map of {names}")
    return fusion.failure


def _recommend(
    paths: Mapping[str, Trajectory],
    evidence: PathEvidence | None,
    fused_path: DrivePath | None,
    fusion: DriveFusion,
    device: ComputeDevice,
    *,
    is_fused: bool,
) -> Recommendation | None:
    """Say which map and path to use; None if there is no map."""
    fallback = None if fusion.fallback is None else fusion.fallback.name
    if evidence is None:
        path = FUSED if fused_path is not None else fallback if fallback in paths else None
        use = FUSED if is_fused else fallback
        return None if use is None else Recommendation(use, path, fallback)
    frames = paths if fused_path is None else {**paths, FUSED: fused_path.trajectory}
    found = recommend(evidence, tuple(paths), device, fused=FUSED, frames=frames)
    is_one_map = found.path == FUSED or (is_fused and fused_path is None)
    return replace(found, use=FUSED if is_one_map else found.path)


def voting_config(config: RunConfig) -> RunConfig:
    """Return the settings under which maps vote: of ``drawn`` those of the vote in its place."""
    if config.fusion.vote.mode != DRAWN:
        return config
    vote = replace(config.fusion.vote, mode=RUN_VOTE)
    return replace(config, fusion=replace(config.fusion, vote=vote))


def draw_run(
    scans: Callable[[], Sequence[DrawnScan]],
    path: DrivePath | None,
    fusion: DriveFusion,
    saved: Collection[str],
    config: RunConfig,
    device: ComputeDevice,
) -> tuple[DriveFusion, OccupancyGrid | None, str | None]:
    """Draw the map of a log at the fused path, as the fused map or beside it, as was asked for.

    Returns:
        The fusion, with the drawn map in place of the vote where that was asked for; the drawn map
        beside it, where that was; and why the maps voted although they were not to.
    """
    is_mode = config.fusion.vote.mode == DRAWN
    result, why = fusion.result, NO_PATH
    if path is not None and result is not None:
        try:
            layer = draw_like(scans(), path.trajectory, device, result.fused)
            if is_mode:
                result = fuse_with_drawn(result, layer, saved, config.fusion, device)
            return replace(fusion, result=result), layer if config.run.draw else None, None
        except SlamFusionError as error:
            why = str(error)
    return fusion, None, why if is_mode else None
