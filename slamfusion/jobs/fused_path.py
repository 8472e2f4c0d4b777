"""The fused path of a drive: made of its producers' paths, as far as the scans bear each out.

And the map that is drawn from all scans at it. Shared by ``run_log`` and what measures it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import doubled_wall_share, wall_thickness
from slamfusion.evidence import (
    FusedPath,
    PathEvidence,
    fuse_paths,
    refine_path,
    trust_in_paths,
)
from slamfusion.evidence.drawn_map import draw_map, drawn_scans
from slamfusion.evidence.path_frames import fit_frame
from slamfusion.fusion.path_check import moved_path
from slamfusion.fusion.records import FusionResult
from slamfusion.grid import OccupancyGrid
from slamfusion.io import open_log
from slamfusion.jobs.judge import score_log_paths
from slamfusion.jobs.outputs import DRAWN
from slamfusion.jobs.run_records import (
    DrawnMapJson,
    FusedPathJson,
)
from slamfusion.jobs.trajectory import Measures
from slamfusion.slam.registry import loop_closers
from slamfusion.trajectory import Trajectory

__all__ = ["DrivePath", "draw_log_map", "drawn_document", "fuse_log_paths", "fuse_weighed_paths"]


@dataclass(frozen=True, eq=False)
class DrivePath:
    """The fused path of a drive.

    Attributes:
        fused: the path, in the frame of the fused map where there is one.
        trust: how much each producer's path was believed, by name, 0 to 1.
        not_weighed: why the scans could not say how much; empty where they did.
        measures: errors of the path.
    """

    fused: FusedPath
    trust: Mapping[str, float]
    not_weighed: str = ""
    measures: Measures = field(default_factory=Measures)

    @property
    def trajectory(self) -> Trajectory:
        """The poses at the scans."""
        return self.fused.trajectory

    def to_json(self, file: Path) -> FusedPathJson:
        """Return the path's record for a JSON document."""
        return {
            **self.measures.to_json(),
            "file": str(file),
            "poses": len(self.trajectory),
            "trust": dict(self.trust),
        }


def fuse_log_paths(
    log: Path,
    paths: Mapping[str, Trajectory],
    config: RunConfig,
    device: ComputeDevice,
    *,
    scan_odometry: Path | None = None,
    fusion: FusionResult | None = None,
    evidence: PathEvidence | None = None,
) -> DrivePath:
    """Make one path of those of several producers of a log, and lay all scans on each other by it.

    Args:
        log: the scans.
        paths: by producer, each in its map's frame.
        config: ``log`` is used.
        device: scores the paths.
        scan_odometry: what gives the scans their odometry instead of the log.
        fusion: of the maps: the path is laid into its frame; None: it stays in that of a path.
        evidence: what the scans say of these paths, where that is known; None: they are asked.

    Raises:
        TrajectoryError: the paths have no times in common.
        GraphError: the equations cannot be solved.
        OSError: the log cannot be opened.
    """
    why = ""
    try:
        if evidence is None or set(evidence.scores) != set(paths):
            evidence = score_log_paths(log, paths, config, device, scan_odometry)
    except SlamFusionError as error:
        evidence, why = None, str(error)
    fused, trust = fuse_weighed_paths(paths, evidence)
    if fusion is not None:
        fused = replace(fused, trajectory=_in_fused_frame(fused.trajectory, paths, fusion))
    return DrivePath(fused, trust, why)


def fuse_weighed_paths(
    paths: Mapping[str, Trajectory], evidence: PathEvidence | None
) -> tuple[FusedPath, dict[str, float]]:
    """Make one path of several, each believed as far as the scans bear it out.

    Then all scans are laid on each other along it.

    Args:
        paths: by producer; those that close no loops count as one over long spans.
        evidence: what the scans say of these paths; None: all count alike, and no scan is moved.

    Returns:
        The path, in the frame of one of them, and how much each was believed, by name.

    Raises:
        TrajectoryError: the paths have no times in common.
        GraphError: the equations cannot be solved.
    """
    trust = dict.fromkeys(paths, 1.0) if evidence is None else trust_in_paths(evidence)
    closers = loop_closers(paths)
    drifting = [name for name in paths if name not in closers]
    fused = fuse_paths(paths, trust, sharing_fault=drifting)
    if evidence is not None:
        fused = replace(fused, trajectory=refine_path(evidence.scans, fused.trajectory))
    return fused, trust


def draw_log_map(
    log: Path,
    path: Trajectory,
    config: RunConfig,
    device: ComputeDevice,
    like: OccupancyGrid,
    *,
    scan_odometry: Path | None = None,
) -> OccupancyGrid:
    """Draw a map from all scans of a log at the poses of a path.

    Args:
        log: the scans.
        path: in the map frame of ``like``.
        config: ``log`` is used.
        device: draws.
        like: the map is drawn on the lattice of this one, over all that was seen.
        scan_odometry: what gives the scans their odometry instead of the log.

    Raises:
        TrajectoryError: no scan has a pose.
        OSError: the log cannot be opened.
    """
    scans = drawn_scans(open_log(log, config.log, scan_odometry))
    return draw_map(scans, path, device, resolution=like.resolution, origin=like.origin, name=DRAWN)


def drawn_document(grid: OccupancyGrid, file: Path, config: RunConfig) -> DrawnMapJson:
    """Return the record of a drawn map for a JSON document.

    Args:
        grid: the map.
        file: where it was written to.
        config: its thresholds say what is a wall.
    """
    normalize = config.fusion.normalize
    thickness = wall_thickness(grid, normalize=normalize)
    return {
        "file": str(file),
        "doubled_wall_share": doubled_wall_share(grid, normalize=normalize),
        "wall_thickness_m": None if thickness is None else thickness.to_json(),
    }


def _in_fused_frame(
    path: Trajectory, paths: Mapping[str, Trajectory], fusion: FusionResult
) -> Trajectory:
    """Lay a path onto those of the producers that voted, as their maps lie in the fused one."""
    moving, still = [], []
    for record in fusion.accepted:
        if record.name not in paths:
            continue
        own = paths[record.name]
        if record.alignment is not None:
            own = moved_path(own, record.alignment.transform)
        near, meets = own.matches(path.stamps_s)
        moving.append(path.poses[meets])
        still.append(own.poses[near[meets]])
    if not sum(map(len, moving)):
        return path
    return moved_path(path, fit_frame(np.concatenate(moving), np.concatenate(still)))
