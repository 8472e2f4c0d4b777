"""The stages of the main job behind its producers: fusion, evidence, path, and errors.

Each takes the drive and what came of the stages before. What a stage cannot do ends none of the
others: it is told in what the stage returns, or in the drive's ``troubles``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

from slamfusion.align.records import FusionResult
from slamfusion.align.starts import Starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.evidence import Exclusions, PathEvidence, Recommendation, recommend, with_path
from slamfusion.evidence.drawn_map import DrawnScan, drawn_scans
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.grid import OccupancyGrid
from slamfusion.io import open_log
from slamfusion.jobs.drawn import voting_config
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse import AllRequiredError
from slamfusion.jobs.fuse_drive import DriveFusion
from slamfusion.jobs.fused_path import DrivePath, fuse_weighed_paths
from slamfusion.jobs.inputs import Progress
from slamfusion.jobs.judge import score_log_paths
from slamfusion.jobs.map_log import LogFiles
from slamfusion.jobs.outputs import FUSED
from slamfusion.jobs.partial import Filling, Layers, draw_layers, fuse_layers
from slamfusion.jobs.produced import ProducerResult, measure_run
from slamfusion.jobs.records import Evaluation
from slamfusion.jobs.saved_maps import path_at_scans
from slamfusion.jobs.trajectory import Measures, Yardsticks
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.slam.side_by_side import Outcome
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Drive:
    """What the producers made of one drive, and what the stages behind them work with.

    Attributes:
        files: where the log and what it is held against were read.
        config: the settings in effect.
        outcomes: what became of each producer.
        held: what paths are measured by.
        device: computes.
        progress: told the stage and how much of it is done; None: nobody.
        saved_paths: of the saved maps, by name, at the times of the scans; ``score_drive_paths``
            adds those that take part.
        troubles: what could not be measured, a sentence each; the stages add to it.
    """

    files: LogFiles
    config: RunConfig
    outcomes: tuple[Outcome, ...]
    held: Yardsticks
    device: ComputeDevice
    progress: Progress | None
    saved_paths: dict[str, Trajectory] = field(default_factory=dict)
    troubles: list[str] = field(default_factory=list)

    @cached_property
    def runs(self) -> Mapping[str, ProducerRun]:
        """What was made, by the names of those producers that made something."""
        return {item.name: item.run for item in self.outcomes if item.run is not None}

    @property
    def paths(self) -> Mapping[str, Trajectory]:
        """The paths of these, by name, one of which may have no pose; then those of saved maps."""
        return {name: run.trajectory for name, run in self.runs.items()} | self.saved_paths

    @property
    def posed_paths(self) -> Mapping[str, Trajectory]:
        """Those of the paths that have a pose."""
        return {name: path for name, path in self.paths.items() if len(path)}

    @cached_property
    def drawn_scans(self) -> Sequence[DrawnScan]:
        """The scans of the log as they are drawn, read when they are first asked for."""
        files = self.files
        return drawn_scans(open_log(files.log, self.config.log, files.scan_odometry))

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """The producers that made nothing."""
        return tuple(item for item in self.outcomes if item.run is None)


def stage_timer(stages: dict[str, float]) -> Callable[[str], AbstractContextManager[None]]:
    """Return what adds the wall time of a block to that of the stage which it names, seconds."""

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        began_s = time.perf_counter()
        yield
        stages[name] = stages.get(name, 0.0) + time.perf_counter() - began_s

    return timed


def fuse_maps(
    drive: Drive, layers: Layers, saved: int, starts: Starts
) -> tuple[DriveFusion, SlamFusionError | None]:
    """Fuse the maps; return with the fusion why it may not be used, if so.

    Args:
        drive: what the producers made.
        layers: what takes part in the vote.
        saved: how many of the maps are saved ones.
        starts: where maps are searched for.
    """
    config = voting_config(drive.config)
    fusion = fuse_layers(
        layers,
        config,
        drive.device,
        shared_frame=not saved,
        progress=drive.progress,
        starts=starts,
    )
    made = len(layers.maps)
    if made < LEAST_FUSED:
        reasons = "; ".join(f"{outcome.name}: {outcome.reason}" for outcome in drive.failed)
        message = f"{made or 'none'} of {len(drive.outcomes) + saved} maps was made"
        return fusion, SlamFusionError(
            f"{message}, at least {LEAST_FUSED} are needed for a vote{reasons and f' ({reasons})'}"
        )
    if fusion.failure is not None:
        return fusion, fusion.failure
    if config.fusion.require_all and fusion.result is not None:
        if fusion.result.rejected:
            rejected = fusion.result.rejected
            return fusion, AllRequiredError(rejected, fusion.result.pairs, fusion.result)
        if drive.failed:
            names = ", ".join(item.name for item in drive.failed)
            return fusion, SlamFusionError(f"--require-all, but no map of {names}")
    return fusion, None


def draw_drive_layers(
    drive: Drive,
    maps: Sequence[OccupancyGrid],
    exclusions: Exclusions | None,
    path: DrivePath | None,
) -> Layers:
    """Take out of the maps what their producers drew after they had left the others.

    Args:
        drive: what the producers made; its troubles are told what cannot be done.
        maps: theirs, then the saved ones.
        exclusions: when producers have no vote; None: that is not known, and all vote.
        path: the fused one, at which their layers are filled; None: nothing is filled.
    """
    filling = None if path is None else Filling(path.trajectory, lambda: drive.drawn_scans)
    try:
        return draw_layers(
            maps, drive.paths, exclusions, lambda _: drive.drawn_scans, drive.device, filling
        )
    except SlamFusionError as error:
        drive.troubles.append(f"the layers of the vote: {error}")
        return Layers.as_made(maps, drive.paths)


def score_drive_paths(
    drive: Drive, saved: Mapping[str, Trajectory]
) -> tuple[PathEvidence | None, str | None]:
    """Ask the scans what they say of the paths; else return why they cannot tell.

    Args:
        drive: what the producers made; it is given the saved paths that take part, and its troubles
            are told why others do not.
        saved: paths of the saved maps, by name, each in its map's frame; may be sparse.
    """
    reason, evidence = "no producer has a path", None
    if paths := drive.posed_paths:
        files = drive.files
        try:
            evidence = score_log_paths(
                files.log, paths, drive.config, drive.device, files.scan_odometry
            )
        except SlamFusionError as error:
            reason = str(error)
    if evidence is None:
        drive.troubles.extend(f"{name}: its path was not used: {reason}" for name in saved)
        return None, reason
    for name, path in saved.items():
        try:
            evidence = _with_saved_path(drive, evidence, name, path)
        except SlamFusionError as error:
            drive.troubles.append(f"{name}: its path was not used: {error}")
    return evidence, None


def _with_saved_path(
    drive: Drive, evidence: PathEvidence, name: str, path: Trajectory
) -> PathEvidence:
    """Score the path of a saved map, too, and give it to the drive.

    Raises:
        TrajectoryError: it has a pose for too few of the scans, on which all paths are scored.
    """
    at_scans = path_at_scans(path, evidence.scans)
    evidence = with_path(evidence, name, path, drive.device)
    drive.saved_paths[name] = at_scans
    return evidence


def fuse_drive_paths(
    drive: Drive, evidence: PathEvidence | None, exclusions: Exclusions | None
) -> DrivePath | None:
    """Fuse the paths of the drive.

    Args:
        drive: what the producers made; its troubles are told what cannot be done.
        evidence: what the scans say of the paths; None: they could not be asked.
        exclusions: when producers have no vote; None: that is not known.

    Returns:
        The path, in the frame of one of them; None where fewer than two producers have one, or
        they cannot be fused.
    """
    paths = drive.posed_paths
    if len(paths) < LEAST_FUSED:
        return None
    try:
        return fuse_weighed_paths(paths, evidence, exclusions, drive.device)
    except SlamFusionError as error:
        drive.troubles.append(f"the fused path: {error}")
        return None


def measure_fused_path(drive: Drive, path: DrivePath, fusion: FusionResult) -> DrivePath:
    """Lay the fused path into the frame of the fused map, and measure it.

    Args:
        drive: what the producers made; its troubles are told what cannot be measured.
        path: the fused one.
        fusion: of the maps.
    """
    paths = drive.posed_paths
    found = path.in_fused_frame(paths, fusion)
    try:
        scans = drive.runs[next(iter(paths))].odometry
        measures = drive.held.measure(found.trajectory, drive.config, scans)
    except SlamFusionError as error:
        drive.troubles.append(f"the fused path: {error}")
        return found
    return replace(found, measures=measures)


def fused_evidence(
    evidence: PathEvidence | None, fused_path: DrivePath | None
) -> PathEvidence | None:
    """Return what the scans say of the producers' paths, and of the fused one, if any."""
    if fused_path is None or fused_path.refined is None:
        return evidence
    return fused_path.refined.evidence


def with_fallback(
    failure: SlamFusionError | None, fusion: DriveFusion, answer: Recommendation | None
) -> SlamFusionError | None:
    """Name the map to use instead if the maps could not be fused."""
    if answer is None or failure is None or failure is not fusion.failure:
        return failure
    words = f"{failure}; the fallback map is that of {answer.use}"
    return AlignmentError(words, fusion.pairs)


def recommend_for_drive(
    drive: Drive,
    evidence: PathEvidence | None,
    exclusions: Exclusions | None,
    fused_path: DrivePath | None,
    fusion: DriveFusion,
    *,
    is_fused: bool,
) -> Recommendation | None:
    """Say which map and path to use; None if there is no map.

    Args:
        drive: what the producers made.
        evidence: what the scans say of their paths and of the fused one; None: they could not be
            asked.
        exclusions: who votes; None: that is not known.
        fused_path: the fused path in the frame of the fused map; None: there is none.
        fusion: of the maps.
        is_fused: whether the fused map may be used.
    """
    fallback = None if fusion.fallback is None else fusion.fallback.name
    if evidence is None or exclusions is None:
        path = FUSED if fused_path is not None else fallback if fallback in drive.paths else None
        use = FUSED if is_fused else fallback
        return None if use is None else Recommendation(use, path, fallback)
    found = recommend(
        evidence,
        tuple(drive.paths),
        exclusions,
        drive.device,
        fused=FUSED,
        frames=drive.paths if fused_path is None else {**drive.paths, FUSED: fused_path.trajectory},
    )
    is_one_map = found.path == FUSED or (is_fused and fused_path is None)
    return replace(found, use=FUSED if is_one_map else found.path)


def evaluate_drive_maps(
    drive: Drive,
    grids: Sequence[OccupancyGrid],
    fusion: DriveFusion,
    drawn: OccupancyGrid | None,
    truth: OccupancyGrid | None,
) -> tuple[Evaluation, ...]:
    """Hold every map against the true one; the drive's troubles are told where that cannot be."""
    if truth is None or not grids:
        return ()
    measured = list(grids)
    if fusion.result is not None:
        measured.append(fusion.result.fused.with_name(FUSED))
    if drawn is not None:
        measured.append(drawn)
    try:
        return evaluate_maps(measured, truth, drive.config, drive.device, progress=drive.progress)
    except SlamFusionError as error:
        drive.troubles.append(str(error))
        return ()


def measure_producers(drive: Drive, evaluations: Sequence[Evaluation]) -> dict[str, ProducerResult]:
    """Measure every path; what cannot be measured does not take the rest with it."""
    by_name = {item.name: item for item in evaluations}
    results = {}
    for outcome in drive.outcomes:
        if outcome.run is None:
            continue
        measures = Measures()
        try:
            measures = measure_run(outcome.run, drive.config, drive.held)
        except SlamFusionError as error:
            drive.troubles.append(f"{outcome.name}: {error}")
        results[outcome.name] = ProducerResult(
            outcome.run, measures, by_name.get(outcome.name), outcome.device
        )
    return results


def measure_saved_paths(drive: Drive, paths: Mapping[str, Trajectory]) -> dict[str, Measures]:
    """Measure the paths of saved maps; one that cannot be measured is told in the troubles.

    Args:
        drive: what they are measured by.
        paths: as they were read, by name.
    """
    scans = next((run.odometry for run in drive.runs.values()), None)
    found = {}
    for name, path in paths.items():
        found[name] = Measures()
        try:
            found[name] = drive.held.measure(path, drive.config, scans)
        except SlamFusionError as error:
            drive.troubles.append(f"{name}: {error}")
    return found
