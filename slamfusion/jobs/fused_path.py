"""The fused path of a drive: one path made of several SLAMs' paths, as far as the scans agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.align.records import FusionResult
from slamfusion.errors import TrajectoryError
from slamfusion.evaluation.measured import MeasuredPath
from slamfusion.evidence.beams import JudgedScans, cover_stamps
from slamfusion.evidence.fused_path import fuse_paths, trust_in_paths
from slamfusion.evidence.path_frames import moved_onto
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.refined_path import Refinement, refine_borne_out
from slamfusion.jobs.outputs import FUSED
from slamfusion.slam.registry import loop_closers
from slamfusion.trajectory import Trajectory

# All paths of a drive are scored on the scans that each has a pose for; that of a saved map must
# leave at least this share of them.
LEAST_COVERED = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class FusedPath(MeasuredPath):
    """The fused path, a TUM trajectory: one path made of those of several SLAMs, and its errors.

    Of ``run`` it is in the frame of the fused map, of ``judge`` in that of one of the paths.
    """

    trust: Mapping[str, float]
    """Weight of each path in the fused path, from the scans, 0 to 1."""
    refinement: Refinement | None = None
    """The result of aligning all scans along it; null where the scans could not be asked."""

    def in_fused_frame(self, paths: Mapping[str, Trajectory], fusion: FusionResult) -> FusedPath:
        """Return the path aligned with those of the producers that voted, in the fused frame."""
        placed = [
            paths[record.name]
            if record.alignment is None
            else paths[record.name].moved(record.alignment.transform)
            for record in fusion.accepted
            if record.name in paths
        ]
        return replace(self, trajectory=moved_onto(self.trajectory, placed))


def fuse_weighed_paths(
    paths: Mapping[str, Trajectory], evidence: PathEvidence | None
) -> tuple[FusedPath, PathEvidence | None]:
    """Fuse paths, each weighed by its support by the scans, then align all scans along the result.

    Returns:
        The path at the scans, in the frame of one of the paths; and the evidence with it as the
        last path.

    Raises:
        TrajectoryError: the paths have no times in common.
        GraphError: the equations cannot be solved.
    """
    trust = dict.fromkeys(paths, 1.0) if evidence is None else trust_in_paths(evidence)
    closers = loop_closers(paths)
    drifting = [name for name in paths if name not in closers]
    path = fuse_paths(paths, trust, sharing_fault=drifting, name=FUSED)
    refinement = None
    if evidence is not None:
        path, evidence, refinement = refine_borne_out(evidence, path)
    return FusedPath(trajectory=path, trust=trust, refinement=refinement), evidence


def path_at_scans(path: Trajectory, scans: JudgedScans) -> Trajectory:
    """Return a path's poses at the drive's scans; ``TrajectoryError`` if too few have one."""
    poses, _ = cover_stamps(path, scans)
    own = np.isfinite(poses[:, 0])
    if own.mean() < LEAST_COVERED:
        raise TrajectoryError(
            f"it has poses for {own.mean():.0%} of the scans, wanted "
            f"{LEAST_COVERED:.0%}: all paths are judged where each has one; give a longer path"
        )
    return Trajectory(scans.stamps_s[own], poses[own], path.name)
