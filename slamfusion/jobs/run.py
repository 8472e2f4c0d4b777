"""The main job: the producers on one log side by side, their fusion, and errors of everything.

``run_log`` is the whole pipeline, stage by stage; ``save_run`` writes the files of its result.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from slamfusion.align.starts import Starts, place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError, TrajectoryError
from slamfusion.evaluation.measured import GroundTruth, MeasuredPath, Measures
from slamfusion.evaluation.trajectory_error import on_clock
from slamfusion.evidence.beams import JudgedScans, ScanHits, judged_scans, scan_hits
from slamfusion.evidence.drawn_map import draw_map, fuse_with_drawn
from slamfusion.evidence.predictive import PathEvidence, score_paths, with_path
from slamfusion.evidence.recommendation import Recommendation, recommend
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.path_check import PathsApartError, fallback_map, fuse_with_paths
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs import inputs
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse import AllRequiredError
from slamfusion.jobs.fuse_documents import DoubledWalls, Evaluation
from slamfusion.jobs.fused_path import FusedPath, fuse_weighed_paths, path_at_scans
from slamfusion.jobs.map_log import measure_run
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.jobs.records import Circumstances
from slamfusion.jobs.run_files import (
    DrawnMap,
    DriveFusion,
    FailedProducer,
    LogRun,
    RunFiles,
    RunProducer,
    SavedMaps,
)
from slamfusion.slam.common.odometry_check import laser_fault
from slamfusion.slam.registry import BUILT_IN, loop_closers, producer
from slamfusion.slam.side_by_side import Outcome, SideBySide
from slamfusion.trajectory import Trajectory

# The progress of all stages together, the share of the time that the SLAMs take (of two drives on
# two cores), and the number of stages that follow, with the report, which counts as two.
WHOLE = "whole run"
SLAM_SHARE, LATE_STAGES = 0.65, 9
NO_PATH = "fewer than two producers have a path, so there is no fused path to draw at"


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
    scale: inputs.PixelSizes | None = None,
    scan_odometry: str | Path | None = None,
    progress: inputs.Progress | None = None,
    warn: inputs.Warn = inputs.log_warning,
    prepare: Callable[[], None] = lambda: None,
) -> LogRun:
    """Map a log with several producers side by side, fuse their maps, and measure everything.

    Each producer runs in a process of its own, so the calling program needs the usual
    ``if __name__ == "__main__":``.

    Args:
        log: a CARMEN or tinySLAM log, or a ROS bag.
        saved_maps: of other SLAMs, which vote too: map_server YAML files, or bare images.
        saved_paths: the paths of saved maps, each in its map's frame and on the clock of the log;
            they may be sparse. Scored like the producers' own; matched to the maps by name, see
            ``slamfusion.jobs.cases``.
        relations, odometry, truth, truth_map, scan_odometry: see ``map_log``.
        scale: the true map is a floor plan with pixels of this size; see ``evaluate_maps``.
        prepare: called while the producers are at work; an exception from it ends the run.

    Returns:
        All results. A producer without a map, a failed fusion and failed measurements are in it
        and raise nothing.

    Raises:
        ConfigError: no producer, an unknown or a repeated one, or one alone without a saved map; or
            a path of no saved map, or two of one. ``StartError``: a start names no producer and no
            saved map, or a single start does not define the others.
        LogError: the log cannot be opened.
        TrajectoryError: relations, odometry or truth cannot be read.
        MapFileError: a map cannot be read. GridError: the true map is refused by ``load_truth``.
    """
    config = config or inputs.RUN_DEFAULTS
    saved = SavedMaps.of(saved_maps, saved_paths)
    files = RunFiles(
        Path(log),
        *map(inputs.as_path, (relations, odometry, truth, truth_map)),
        scan_odometry=inputs.as_path(scan_odometry),
        saved_maps=saved.files,
    )
    names = config.run.producers or BUILT_IN
    starts = place_starts(
        config.start, (*names, *saved.names), config.fusion.reference, drive=names
    )
    stages = _Stages(progress, names)

    # Run the SLAMs side by side. Read all else meanwhile: a bad file ends the run at once.
    with (
        stages.timed("producers"),
        SideBySide(names, Path(log), config, files.scan_odometry) as work,
    ):
        config = work.config
        inputs.check_count(*names, *saved.names)
        prepare()
        true_map = None
        if truth_map is not None:
            true_map = inputs.load_truth(
                truth_map, config, resolution=resolution, scale=scale, warn=warn, producers=names
            )
        ground_truth = GroundTruth.read(config, relations, odometry, truth, warn)
        others, their_paths = saved.load(config, resolution, warn)
        device = inputs.device_for(config)
        outcomes = work.wait(stages.tell_slam)
    runs = {item.name: item.run for item in outcomes if item.run is not None}
    grids = (*(run.grid for run in runs.values()), *others)
    paths = {name: run.trajectory for name, run in runs.items() if len(run.trajectory)}
    scans = cache(lambda: [*scan_hits(work.source)])
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
    fused_path: FusedPath | None = None
    with stages.timed("path"):
        if len(paths) >= LEAST_FUSED:
            with stages.noting("the fused path: "):
                fused_path, with_fused = fuse_weighed_paths(paths, evidence)

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
        fusion = replace(fusion, failure=failure)

    # Align the fused path with the fused map, and recommend a map and a path.
    with stages.timed("path"):
        if fusion.usable is None:
            fused_path = None
        elif fused_path is not None:
            fused_path = fused_path.in_fused_frame(paths, fusion.usable)
            own = stages.measured(
                "the fused path", ground_truth.measure, fused_path.trajectory, config, wheels
            )
            fused_path = replace(fused_path, measures=own)
    with stages.timed("evidence"):
        if fused_path is not None:
            evidence = with_fused
        answer = _recommend(paths, evidence, fused_path, fusion, wheels)
    if answer is not None and fusion.result is None and isinstance(failure, AlignmentError):
        words = f"{failure}; the fallback map is that of {answer.use}"
        fusion = replace(fusion, failure=AlignmentError(words, fusion.pairs))

    # Draw the map of all scans at the fused path, as the fused one or next to it.
    drawn, why_voted = None, None
    if fusion.usable is not None and (config.run.draw or config.fusion.vote.mode == DRAWN):
        with stages.timed("drawing"):
            # The fused path contains what a map with a path knows.
            voting = [name for name in saved.names if name not in paths]
            fusion, drawn, why_voted = draw_run(scans, fused_path, fusion, voting, config, device)

    # Measure everything by what is known.
    with stages.timed("errors"):
        result = fusion.result
        fused = None if result is None else result.fused.with_name(FUSED)
        evaluations: tuple[Evaluation, ...] = ()
        if true_map is not None and grids:
            more = (fused, None if drawn is None else drawn.grid)
            measured = [*grids, *(grid for grid in more if grid is not None)]
            with stages.noting():
                evaluations = evaluate_maps(
                    measured, true_map, config, device, scale=scale, progress=progress
                )
        if result is not None:
            known = {own.name: own.doubled_wall_share for own in evaluations[: len(grids)]}
            fusion = replace(fusion, doubled=DoubledWalls.of(result, config, known))
        measures = {
            name: stages.measured(name, measure_run, run, config, ground_truth)
            for name, run in runs.items()
        }
        found_paths = [
            MeasuredPath(
                trajectory=path,
                measures=stages.measured(name, ground_truth.measure, path, config, wheels),
                file=saved.paths[name],
            )
            for name, path in their_paths.items()
        ]
    mode = (config if why_voted is None else voting_config(config)).fusion.vote.mode
    return LogRun(
        producers=_producers(outcomes, measures, evaluations),
        fusion=fusion,
        fused_mode=None if fusion.usable is None else mode,
        why_voted=why_voted,
        best_founded=None if answer is None or fusion.usable is not None else answer.use,
        path_gaps=fusion.gaps,
        recommendation=answer,
        path_evidence=() if answer is None else answer.paths,
        no_verdict=no_verdict,
        fused_path=fused_path,
        drawn_map=drawn,
        saved_paths=found_paths,
        evaluations=evaluations,
        error=None if fusion.failure is None else str(fusion.failure),
        not_measured=tuple(stages.troubles),
        files=files,
        made_with=Circumstances(device.name, config),
        stages_s=stages.times_s,
        evidence=evidence,
        true_path=ground_truth.truth,
        begun_s=stages.begun_s,
    )


class _Stages:
    """The time of each stage, what failed in them, and the share of the log each SLAM has read."""

    def __init__(self, progress: inputs.Progress | None, slams: Sequence[str]) -> None:
        self.begun_s = time.perf_counter()
        self.progress: inputs.Progress = progress or (lambda *_: None)
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
        """Add the time of a block to that of a stage, and report its start and its end."""
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

    def measured(self, what: str, measure: Callable[..., Measures], *given: Any) -> Measures:
        """Return the errors of a path; if it cannot be measured, note why and return none."""
        with self.noting(f"{what}: "):
            return measure(*given)
        return Measures()

    @contextmanager
    def noting(self, what: str = "") -> Iterator[None]:
        """Note the error of a block that fails; the run goes on."""
        try:
            yield
        except SlamFusionError as error:
            self.troubles.append(f"{what}{error}")


def _producers(
    outcomes: Sequence[Outcome], measures: Mapping[str, Measures], evaluations: Sequence[Evaluation]
) -> tuple[RunProducer | FailedProducer, ...]:
    errors = {item.name: item for item in evaluations}
    return tuple(
        FailedProducer(
            name=item.name,
            failed=item.reason,
            process_time_s=item.time_s,
            process_cpu_s=item.cpu_s,
            detail=item.detail,
        )
        if item.run is None
        else RunProducer(
            run=item.run,
            measures=measures[item.name],
            map_error=errors.get(item.name),
            device=item.device,
            process_time_s=item.time_s,
            process_cpu_s=item.cpu_s,
        )
        for item in outcomes
    )


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
            evidence = with_path(evidence, name, path)
        except SlamFusionError as error:
            leave_out(name, str(error))
        else:
            paths[name] = at_scans
    return evidence, None if evidence is not None else reason


def fuse_drive(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    config: RunConfig,
    device: ComputeDevice,
    *,
    shared_frame: bool,
    progress: inputs.Progress | None = None,
    starts: Starts | None = None,
) -> DriveFusion:
    """Fuse the maps of a drive, or say why not, and compare the paths in the fused frame.

    All producers start in the odometry's frame. The search is full all the same: a lost producer
    must not be pulled into place. The common frame only decides between answers that fit equally
    well. Saved maps may have any frame, so with them the settings decide.
    """
    given = tuple(grids)
    if len(given) < LEAST_FUSED:
        failure = AlignmentError(f"a vote needs at least {LEAST_FUSED} maps, found {len(given)}")
        return DriveFusion(given, fallback=given[0] if given else None, failure=failure)
    fusion = config.fusion
    if shared_frame:
        fusion = replace(fusion, align=replace(fusion.align, shared_frame=True))
    try:
        result, gaps = fuse_with_paths(given, paths, fusion, device, progress, starts)
    except AlignmentError as error:
        return DriveFusion(
            given,
            gaps=error.gaps if isinstance(error, PathsApartError) else (),
            pairs=error.pairs,
            fallback=fallback_map(given, error.pairs, loop_closers(paths)),
            failure=error,
        )
    return DriveFusion(given, result, gaps)


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
    fused_path: FusedPath | None,
    fusion: DriveFusion,
    wheels: Trajectory | None,
) -> Recommendation | None:
    """Say which map and path to use; None if there is no map."""
    fallback = None if fusion.fallback is None else fusion.fallback.name
    is_fused = fusion.usable is not None
    every = paths if fused_path is None else {**paths, FUSED: fused_path.trajectory}
    if evidence is not None:
        blank = {grid.name for grid in fusion.grids if grid.known_box is None}
        slams = tuple(name for name in paths if name not in blank)
        found = recommend(evidence, slams, fused=FUSED, frames=every)
        is_one_map = found.path == FUSED or (is_fused and fused_path is None)
        return replace(found, use=FUSED if is_one_map else found.path)
    if (use := FUSED if is_fused else fallback) is None:
        return None
    path = FUSED if fused_path is not None else fallback if fallback in paths else None
    fault = laser_fault(wheels, every.get(path or ""))
    return Recommendation(use, path, fallback, laser_fault=fault)


def voting_config(config: RunConfig) -> RunConfig:
    """Return the settings under which maps vote: of ``drawn`` those of the vote in its place."""
    if config.fusion.vote.mode != DRAWN:
        return config
    vote = replace(config.fusion.vote, mode=inputs.RUN_VOTE)
    return replace(config, fusion=replace(config.fusion, vote=vote))


def draw_run(
    scans: Callable[[], Sequence[ScanHits]],
    path: FusedPath | None,
    fusion: DriveFusion,
    saved: Collection[str],
    config: RunConfig,
    device: ComputeDevice,
) -> tuple[DriveFusion, DrawnMap | None, str | None]:
    """Draw the map of a log at the fused path, instead of the vote or next to it.

    Returns:
        The fusion, its map replaced if asked for; the map next to it, if asked for; and why the
        vote was kept against the settings.
    """
    is_mode = config.fusion.vote.mode == DRAWN
    result, why = fusion.result, NO_PATH
    if path is not None and result is not None:
        try:
            like = result.fused
            layer = draw_map(
                scans(), path.trajectory, device,
                resolution=like.resolution, origin=like.origin, name=DRAWN,
            )  # fmt: skip
            if is_mode:
                result = fuse_with_drawn(result, layer, saved, config.fusion, device)
            drawn = DrawnMap.of(layer, config) if config.run.draw else None
            return replace(fusion, result=result), drawn, None
        except SlamFusionError as error:
            why = str(error)
    return fusion, None, why if is_mode else None
