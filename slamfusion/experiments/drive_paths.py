"""What the scans of one drive say of its paths, and the maps that they draw at each of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import TrajectoryConfig
from slamfusion.errors import LogError, SlamFusionError
from slamfusion.evaluation import trajectory_errors
from slamfusion.evidence import (
    Exclusions,
    JudgedScans,
    PathEvidence,
    choose_path,
    find_exclusions,
    judged_scans,
    score_paths,
)
from slamfusion.evidence.drawn_map import draw_map, drawn_scans
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.jobs.outputs import DRAWN
from slamfusion.jobs.partial import Filling, Layers, draw_layers
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import SAME_STAMP_S, Trajectory

# The producer whose path is taken (``choose_path``), in tables.
CHOICE = "evidence choice"
# The best producer of each drive, known only afterwards.
HINDSIGHT = "best in hindsight"
# The path that is made of all of them; the map that all scans draw at it is called as in ``run``.
FUSED_PATH = "fused path"


def drawn_at(name: str) -> str:
    """Return what the map is called that all scans draw at a producer's own path."""
    return f"{name}, drawn"


@dataclass(frozen=True, eq=False)
class WeighedPaths:
    """The paths of a drive, as far as its scans bear them out.

    Attributes:
        paths: of the producers, and the fused one where there is one, by name.
        choice: the producer whose path to take, see ``choose_path``; empty where the scans
            cannot tell.
        evidence: what they say of the producers' paths; None where they cannot tell.
        exclusions: when producers have no vote; None where they cannot tell.
    """

    paths: Mapping[str, Trajectory] = field(default_factory=dict)
    choice: str = ""
    evidence: PathEvidence | None = None
    exclusions: Exclusions | None = None

    def without(self, name: str, device: ComputeDevice, notes: dict[str, str]) -> WeighedPaths:
        """Return the paths of a drive on which a producer had no part.

        Args:
            name: of the producer.
            device, notes: see ``weigh_paths``.
        """
        paths = {own: path for own, path in self.paths.items() if own not in {name, FUSED_PATH}}
        if not paths:
            return WeighedPaths()
        evidence = self.evidence
        if evidence is not None:
            evidence = evidence.of_paths(paths)
        return _weigh(paths, evidence, device, notes)


def judge_scans(scans: Sequence[LogScan], notes: dict[str, str]) -> JudgedScans | None:
    """Choose what paths of a drive are scored on; None where too few scans have a hit.

    Args:
        scans: of the drive.
        notes: told, by what is missing, why.
    """
    try:
        return judged_scans(scans)
    except LogError as error:
        notes[CHOICE] = str(error)
        return None


def weigh_paths(
    judged: JudgedScans | None,
    paths: Mapping[str, Trajectory],
    device: ComputeDevice,
    notes: dict[str, str],
) -> WeighedPaths:
    """Ask the scans of a drive which path they support, and make one path of all.

    Args:
        judged: see ``judge_scans``.
        paths: of the producers, by name.
        device: scores the paths.
        notes: told, by what is missing, why.
    """
    paths = {name: path for name, path in paths.items() if len(path)}
    if not paths:
        return WeighedPaths()
    evidence = None
    if judged is not None:
        try:
            evidence = score_paths(judged, paths, device)
        except SlamFusionError as error:
            notes[CHOICE] = str(error)
    return _weigh(paths, evidence, device, notes)


def _weigh(
    paths: Mapping[str, Trajectory],
    evidence: PathEvidence | None,
    device: ComputeDevice,
    notes: dict[str, str],
) -> WeighedPaths:
    """Make one path of those of the producers; see ``weigh_paths``."""
    exclusions = None if evidence is None else find_exclusions(evidence, device)
    choice = _choice(evidence, paths)
    weighed = WeighedPaths(paths, choice, evidence, exclusions)
    if len(paths) < LEAST_FUSED:
        return weighed
    try:
        fused = fuse_weighed_paths(paths, evidence, exclusions, device)
    except SlamFusionError as error:
        notes[FUSED_PATH] = str(error)
        return weighed
    if fused.refined is not None:
        choice = _choice(fused.refined.evidence, paths, fused.trajectory.name)
    return replace(weighed, paths={**paths, FUSED_PATH: fused.trajectory}, choice=choice)


def _choice(evidence: PathEvidence | None, paths: Collection[str], fused: str | None = None) -> str:
    """Return the name of the producer whose path to take; empty where the scans cannot tell."""
    return "" if evidence is None else choose_path(evidence, paths, fused)[1]


def drive_layers(
    maps: Sequence[OccupancyGrid],
    weighed: WeighedPaths,
    recorded: Sequence[LogScan],
    fed: Mapping[str, Sequence[LogScan]],
    device: ComputeDevice,
) -> Layers:
    """Take out of producers' maps what they drew after they had left the others, as ``run`` does.

    Args:
        maps: of the producers, and of other SLAMs; one without a path takes part as it is.
        weighed: the paths.
        recorded: scans of the drive.
        fed: what each producer was fed, by name.
        device: draws.

    Raises:
        TrajectoryError: the scans of a producer are not those of its path.
    """
    names = [grid.name for grid in maps if grid.name in weighed.paths]
    paths = {name: weighed.paths[name] for name in names}
    filling = None
    if FUSED_PATH in weighed.paths:
        filling = Filling(weighed.paths[FUSED_PATH], lambda: drawn_scans(recorded))
    return draw_layers(
        maps, paths, weighed.exclusions, lambda name: drawn_scans(fed[name]), device, filling
    )


def path_errors(
    weighed: WeighedPaths, truth: Trajectory, tolerance_s: float = SAME_STAMP_S
) -> dict[str, float]:
    """Return the absolute error of each path (root mean square after a rigid fit), metres.

    Args:
        weighed: the paths.
        truth: the true path; one that meets fewer than two of its poses in time has no error.
        tolerance_s: poses this near in time belong together.
    """
    config = TrajectoryConfig(tolerance_s=tolerance_s)
    found = {}
    for name, path in weighed.paths.items():
        with suppress(SlamFusionError):
            found[name] = trajectory_errors(path, truth, config).ate.rmse
    return found


def draw_paths(
    scans: Sequence[LogScan],
    weighed: WeighedPaths,
    resolution: float,
    device: ComputeDevice,
) -> dict[str, OccupancyGrid | None]:
    """Draw the map of all scans at every path, by one sensor model.

    Args:
        scans: of the drive.
        weighed: its paths.
        resolution: metres per cell.
        device: draws.

    Returns:
        ``drawn_at`` each producer's path, and ``DRAWN`` at the fused one; None where there is no
        path.
    """
    rays = drawn_scans(scans)
    found: dict[str, OccupancyGrid | None] = {}
    others = [name for name in weighed.paths if name not in {*BUILT_IN, FUSED_PATH}]
    for name in (*BUILT_IN, *others, FUSED_PATH):
        method = DRAWN if name == FUSED_PATH else drawn_at(name)
        found[method] = None
        if name in weighed.paths:
            found[method] = draw_map(
                rays, weighed.paths[name], device, resolution=resolution, name=method
            )
    return found
