"""What other SLAMs made of a drive: their saved maps, and the paths that they found with them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.errors import ConfigError, TrajectoryError
from slamfusion.evidence.beams import JudgedScans, cover_stamps
from slamfusion.grid import OccupancyGrid
from slamfusion.io import read_trajectory
from slamfusion.jobs.cases import CaseFile, files_by_case
from slamfusion.jobs.inputs import Warn, distinct_names, load_maps
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.slam.registry import producer_names
from slamfusion.trajectory import Trajectory

# All paths of a drive are scored on the scans that each has a pose for; that of a saved map must
# leave at least this share of them.
LEAST_COVERED = 0.5


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
        names = [free_name(name) for name in own]
        found = files_by_case(own, paths, "--paths")
        return cls(
            files,
            tuple(names),
            {name: found[key] for key, name in zip(own, names, strict=True) if key in found},
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
    return f"{name} (saved)" if name in {*producer_names(), FUSED, DRAWN, *taken} else name


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
