"""The maps of one drive: of each producer, fused in every way, and drawn at every path.

Same stages as ``run``: producers, evidence of the scans, fused path; then every vote.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import get_args

import numpy as np

from slamfusion.align.align import align_grids
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, RunConfig, TrajectoryConfig, VoteMode
from slamfusion.errors import GridError, SlamFusionError
from slamfusion.evaluation.map_error import MapError, compare_to_truth
from slamfusion.evaluation.trajectory_error import trajectory_errors
from slamfusion.evidence.beams import judged_scans, scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import choose_path
from slamfusion.experiments.runs import Tell
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.pipeline import vote_again
from slamfusion.geometry import wrap_angle
from slamfusion.grid import IDENTITY, UNKNOWN, OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.jobs.outputs import DRAWN
from slamfusion.jobs.run import fuse_drive, score_all_paths
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.registry import BUILT_IN, make_producer, producer
from slamfusion.trajectory import SAME_STAMP_S, Trajectory

FUSIONS: tuple[VoteMode, ...] = get_args(VoteMode)
PLAIN: VoteMode = "majority"
# Method name: the producer whose path is chosen (``choose_path``).
CHOICE = "evidence choice"
# The best producer of each drive, known only afterwards.
HINDSIGHT = "best in hindsight"
# Method name: the fused path. The map drawn at it has the same name as in ``run``.
FUSED_PATH = "fused path"
# With equal headings, a map rotated by more against the true one is misaligned, radians.
MOST_TURN_RAD = 0.5 * math.pi


def drawn_at(name: str) -> str:
    """Return the method name of the map drawn at a producer's own path."""
    return f"{name}, drawn"


def alone(fusion: str) -> str:
    """Return the method name of a vote without the harmed producer."""
    return f"{fusion}, others alone"


@dataclass(frozen=True, eq=False)
class DriveMaps:
    """The maps and paths of one drive.

    Attributes:
        maps: by method; None: no map.
        choice: the producer whose path to take (``choose_path``); empty if undecided.
    """

    maps: Mapping[str, OccupancyGrid | None]
    paths: Mapping[str, Trajectory]
    notes: Mapping[str, str] = field(default_factory=dict)
    choice: str = ""

    def path_errors(self, truth: Trajectory, tolerance_s: float = SAME_STAMP_S) -> dict[str, float]:
        """Return each path's RMSE after a rigid fit, metres, if it has two poses in common."""
        config, found = TrajectoryConfig(tolerance_s=tolerance_s), {}
        for name, path in self.paths.items():
            with suppress(SlamFusionError):
                found[name] = trajectory_errors(path, truth, config).ate.rmse
        return found


def produce_maps(
    scans: Mapping[str, Sequence[LogScan]],
    config: RunConfig,
    device: ComputeDevice,
    tell: Tell | None = None,
) -> DriveMaps:
    """Run producers, by their names, on scans in memory in turn; a failure becomes a note."""
    maps: dict[str, OccupancyGrid | None] = dict.fromkeys(scans)
    paths, notes = {}, {}
    costs = {name: producer(name).cost for name in scans}
    before = 0.0
    for name, items in scans.items():

        def progress(
            done: int, before: float = before, cost: float = costs[name], total: int = len(items)
        ) -> None:
            if tell is not None:
                tell((before + cost * done / total) / sum(costs.values()))

        try:
            run = run_producer(make_producer(name, config, device), items, progress=progress)
        except SlamFusionError as error:
            notes[name] = str(error)
        else:
            maps[name], paths[name] = run.grid, run.trajectory
        before += costs[name]
    return DriveMaps(maps, paths, notes)


def fuse_in_every_way(
    made: DriveMaps,
    scans: Sequence[LogScan],
    config: RunConfig,
    device: ComputeDevice,
    *,
    saved: Sequence[OccupancyGrid] = (),
    saved_paths: Mapping[str, Trajectory] = MappingProxyType({}),
    harmed: str = "",
    drawn_cell_m: float | None = None,
) -> DriveMaps:
    """Fuse the maps and paths of producers as ``run`` does, with every way to vote.

    Args:
        saved: maps of other SLAMs, in any frame; ``saved_paths``: of some of them, by name.
        harmed: a producer; the others are also fused without it.
        drawn_cell_m: metres per cell of maps drawn at every path; None: none.
    """
    notes, paths = dict(made.notes), {name: path for name, path in made.paths.items() if len(path)}
    grids = [*(grid for grid in made.maps.values() if grid is not None), *saved]
    evidence, reason = score_all_paths(
        lambda: judged_scans(scans),
        paths,
        saved_paths,
        device,
        lambda name, why: notes.update({f"{name}, path": why}),
    )
    if reason is not None and paths:
        notes[CHOICE] = reason

    votes, fused, choice = _fuse(grids, paths, evidence, config, device, notes)
    maps = {**made.maps, **{grid.name: grid for grid in saved}, **votes}
    if harmed:
        rest = [grid for grid in grids if grid.name != harmed]
        others = {name: path for name, path in paths.items() if name != harmed}
        theirs = None if evidence is None or not others else evidence.of_paths(others)
        own_notes: dict[str, str] = {}
        votes, _, _ = _fuse(rest, others, theirs, config, device, own_notes)
        maps |= {alone(mode): votes[mode] for mode in FUSIONS}
        notes |= {alone(name): reason for name, reason in own_notes.items()}
    if fused is not None:
        paths[FUSED_PATH] = fused
    if drawn_cell_m is not None:
        rays = [*scan_hits(scans)]
        for name in (*BUILT_IN, *saved_paths, FUSED_PATH):
            method = DRAWN if name == FUSED_PATH else drawn_at(name)
            if name in paths:
                path = paths[name]
                maps[method] = draw_map(rays, path, device, resolution=drawn_cell_m, name=method)
            elif name not in saved_paths:
                maps[method] = None
    return DriveMaps(maps, paths, notes, choice)


def _fuse(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    evidence: PathEvidence | None,
    config: RunConfig,
    device: ComputeDevice,
    notes: dict[str, str],
) -> tuple[dict[str, OccupancyGrid | None], Trajectory | None, str]:
    """Return every vote on maps, their fused path, and the name of the path to take."""
    choice = "" if evidence is None else choose_path(evidence, paths)[1]
    fused = None
    if len(paths) >= LEAST_FUSED:
        try:
            found, with_fused = fuse_weighed_paths(paths, evidence)
        except SlamFusionError as error:
            notes[FUSED_PATH] = str(error)
        else:
            fused = found.trajectory
            if with_fused is not None:
                choice = choose_path(with_fused, paths, fused.name)[1]
    return vote_every_way(grids, paths, config, device, notes), fused, choice


def vote_every_way(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    config: RunConfig,
    device: ComputeDevice,
    notes: dict[str, str],
) -> dict[str, OccupancyGrid | None]:
    """Return the fused map of the same voters by way to vote; failures are added to ``notes``."""
    # Producers of a drive share its frame; saved maps (with other names) may not.
    shared_frame = {grid.name for grid in grids} <= set(BUILT_IN)
    plain = replace(config, fusion=_voting(config.fusion, PLAIN))
    drive = fuse_drive(grids, paths, plain, device, shared_frame=shared_frame)
    if drive.result is None:
        alone_there = "" if drive.fallback is None else f"{drive.fallback.name} alone: "
        notes[PLAIN] = f"{alone_there}{drive.failure}"
        return dict.fromkeys(FUSIONS, drive.fallback)
    for record in drive.result.rejected:
        notes[f"{PLAIN} without {record.name}"] = record.reason
    return {
        mode: vote_again(drive.result, _voting(config.fusion, mode), device).fused
        for mode in FUSIONS
    }


def _voting(config: FusionConfig, mode: VoteMode) -> FusionConfig:
    """Return the settings with a way to vote, and never the fixed-step search."""
    align, vote = replace(config.align, step=None), replace(config.vote, mode=mode)
    return replace(config, align=align, vote=vote)


def against_truth(
    grid: OccupancyGrid | None,
    truth: OccupancyGrid,
    config: RunConfig,
    device: ComputeDevice,
    *,
    same_heading: bool = False,
) -> MapError:
    """Measure a map at its best place: in the truth's frame, or aligned (best or next best).

    Args:
        grid: None is an unknown map.
        truth: gives lattice and box.
        config: thresholds, search (never the fixed-step one) and tolerance.
        same_heading: reject alignments of more than a quarter turn (simulated drives): in a nearly
            symmetric room a wrong one can have the smaller error.
    """
    nothing = np.full((1, 1), UNKNOWN, dtype=np.int8)
    known = grid or OccupancyGrid(nothing, truth.resolution, truth.origin, "nothing")
    transforms = [IDENTITY]
    if grid is not None:
        with suppress(GridError):  # without known cells
            found = align_grids(truth, grid, _voting(config.fusion, PLAIN), device)
            transforms.append(found.transform)
            # A map in two pieces has two places with nearly equal scores.
            if found.runner_up is not None:
                transforms.append(found.runner_up.transform)
    if same_heading:
        transforms = [item for item in transforms if abs(wrap_angle(item.yaw_rad)) <= MOST_TURN_RAD]
    errors = [compare_to_truth(known, truth, transform, config) for transform in transforms]
    return min(errors, key=lambda item: item.error)
