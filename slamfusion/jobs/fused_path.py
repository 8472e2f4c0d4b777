"""The fused path of a drive: made of several SLAMs' paths, as far as the scans bear each out.

And the map that is drawn from all scans at it. Shared by ``run_log``, ``judge_paths`` and what
measures it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict

from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.evaluation import WallThickness, doubled_wall_share, wall_thickness
from slamfusion.evidence import (
    FusedPath,
    PathEvidence,
    RefinedPath,
    fuse_paths,
    refine_borne_out,
    trust_in_paths,
)
from slamfusion.evidence.drawn_map import DrawnScan, draw_map
from slamfusion.evidence.path_frames import fit_onto
from slamfusion.fusion.path_check import moved_path
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.jobs.trajectory import Measures, MeasuresJson
from slamfusion.slam.registry import loop_closers
from slamfusion.trajectory import Trajectory


class FusedPathJson(MeasuresJson):
    """The fused path: one path made of those of several SLAMs, and its errors."""

    file: str
    """Its file, a TUM trajectory, of ``run`` in the frame of the fused map, of ``judge`` in that of
    one of the paths."""
    poses: int
    """Its poses."""
    trust: Mapping[str, float]
    """Weight of each path in the fused path, from the scans, 0 to 1."""
    refinement: RefinedPath | None
    """What laying all scans on each other made of it; null where the scans could not be asked."""


class DrawnMapJson(TypedDict):
    """The map that is drawn from all scans at the fused path."""

    file: str
    """Its YAML file."""
    doubled_wall_share: float
    """Share of its wall cells that have a parallel wall close by, 0 to 1."""
    wall_thickness_m: WallThickness | None
    """How thick its walls are; null when no wall is next to a free cell."""


@dataclass(frozen=True, eq=False)
class DrivePath:
    """The fused path of a drive.

    Attributes:
        fused: the path, in the frame of one of the producers' paths, or after ``in_fused_frame`` in
            that of the fused map.
        trust: how much each producer's path was believed, by name, 0 to 1.
        refined: what laying all scans on each other made of it; None where there was no evidence.
    """

    fused: FusedPath
    trust: Mapping[str, float]
    refined: RefinedPath | None = None
    measures: Measures = field(default_factory=Measures)

    @property
    def trajectory(self) -> Trajectory:
        """The poses at the scans."""
        return self.fused.trajectory

    def in_fused_frame(self, paths: Mapping[str, Trajectory], fusion: FusionResult) -> DrivePath:
        """Return the path laid onto those of the producers that voted, as their maps lie."""
        placed = [
            paths[record.name]
            if record.alignment is None
            else moved_path(paths[record.name], record.alignment.transform)
            for record in fusion.accepted
            if record.name in paths
        ]
        motion = fit_onto(self.trajectory, placed)
        if motion is None:
            return self
        laid = moved_path(self.trajectory, motion)
        return replace(self, fused=replace(self.fused, trajectory=laid))

    def to_json(self, file: Path) -> FusedPathJson:
        """Return the path's record for a JSON document."""
        return {
            **self.measures.to_json(),
            "file": str(file),
            "poses": len(self.trajectory),
            "trust": dict(self.trust),
            "refinement": self.refined,
        }


def fuse_weighed_paths(
    paths: Mapping[str, Trajectory], evidence: PathEvidence | None, device: ComputeDevice
) -> DrivePath:
    """Make one path of several, each believed as far as the scans bear it out.

    Then all scans are laid on each other along it, where they do not contradict what comes.

    Raises:
        TrajectoryError: the paths have no times in common.
        GraphError: the equations cannot be solved.
    """
    trust = dict.fromkeys(paths, 1.0) if evidence is None else trust_in_paths(evidence)
    closers = loop_closers(paths)
    drifting = [name for name in paths if name not in closers]
    fused = fuse_paths(paths, trust, sharing_fault=drifting, name=FUSED)
    refined = None
    if evidence is not None:
        refined = refine_borne_out(evidence, fused.trajectory, device)
        fused = replace(fused, trajectory=refined.path)
    return DrivePath(fused, trust, refined)


def draw_like(
    scans: Sequence[DrawnScan], path: Trajectory, device: ComputeDevice, like: OccupancyGrid
) -> OccupancyGrid:
    """Draw a map from scans at the poses of a path.

    Raises:
        TrajectoryError: no scan has a pose.
    """
    return draw_map(scans, path, device, resolution=like.resolution, origin=like.origin, name=DRAWN)


def drawn_document(grid: OccupancyGrid, file: Path, config: RunConfig) -> DrawnMapJson:
    """Return the record of a drawn map for a JSON document."""
    normalize = config.fusion.normalize
    thickness = wall_thickness(grid, normalize=normalize)
    return {
        "file": str(file),
        "doubled_wall_share": doubled_wall_share(grid, normalize=normalize),
        "wall_thickness_m": thickness,
    }
