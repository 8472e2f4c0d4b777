"""The rigid motion from one map to another; of a floor plan also its scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamfusion.align.records import Alignment
from slamfusion.align.scale import FACTOR, align_at_any_scale, explained
from slamfusion.align.starts import StartPose, place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig, RunConfig
from slamfusion.evaluation.distances import sample_on_lattice
from slamfusion.fusion import align_grids
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.io.files import AtomicFiles, write_atomic
from slamfusion.io.map_server import save_map
from slamfusion.jobs.inputs import MapInput, PixelSizes, Warn, device_for, load_maps, log_warning
from slamfusion.jobs.outputs import OVERLAY, PLACED, PLAN, WORLD_FILE
from slamfusion.jobs.records import Circumstances
from slamfusion.json_values import FLAT
from slamfusion.vote.lattice import Lattice

# Of a start without tolerances: x, y, yaw.
POSE_NUMBERS = 3


@dataclass(frozen=True, eq=False)
class AlignDocument:
    """``slamfusion align``; exit code 1 where the alignment is not accepted."""

    alignment: Alignment = field(metadata=FLAT)
    circumstances: Circumstances = field(metadata=FLAT)
    resolution: float
    """Metres per cell of the moving map; with --scale as it was found."""
    scale: float | None = None
    """By which that is larger than the map says; null: without --scale."""


def align_maps(
    reference: MapInput,
    moving: MapInput,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    start: Pose2 | StartPose | None = None,
    resolution: float | None = None,
    warn: Warn = log_warning,
) -> Alignment:
    """Align a map with another one.

    Args:
        reference: the fixed map: in memory, a map_server YAML file, or a bare image.
        moving: the map that is moved, likewise.
        start: expected pose of the frame of ``moving`` in that of ``reference``. Only its
            tolerances are searched; a bare pose shifts the windows of the settings. Default: from
            ``config.start`` by the names of the two maps. A single start there is in the other
            map's frame; without tolerances it gets windows from the settings.
        resolution: metres per cell of bare images.
        warn: receives a sentence for each doubtful property of a map.

    Returns:
        The alignment; its ``transform`` maps points from the frame of ``moving`` to that of
        ``reference``. Use it only if it is ``accepted``.

    Raises:
        MapFileError: a map cannot be read.
        GridError: a map has no known cell.
        StartError: ``config.start`` names another map.
    """
    config = config or RunConfig()
    still, moved = load_maps((reference, moving), config, resolution=resolution, warn=warn)
    if start is None:
        start = _expected(config, still.name, moved.name)
    device = device_for(config, device)
    found = align_grids(still, moved, config.fusion, device, start)
    return explained(found, still, moved, config.fusion, device)


def _expected(config: RunConfig, reference: str, moving: str) -> Pose2 | StartPose | None:
    """Return what the settings say of where the moving map is expected in the reference's frame."""
    starts = place_starts(config.start, (reference, moving))
    found, align = starts.between(reference, moving), config.fusion.align
    has_window = align.window_m is not None or align.window_yaw_rad < math.pi
    has_tolerances = any(len(values) > POSE_NUMBERS for values in config.start.values())
    if found is not None and has_window and not has_tolerances:
        return found.pose
    return found


@dataclass(frozen=True, eq=False)
class AlignedPlan:
    """A floor plan on a map.

    Attributes:
        reference: the robot's map.
        plan: with the resolution that was found.
        scale: by which that is larger than the plan said.
        alignment: of the plan with the map; the rest may be used only where it is accepted.
    """

    reference: OccupancyGrid
    plan: OccupancyGrid
    scale: float
    alignment: Alignment

    @property
    def of_map(self) -> Alignment:
        """The same alignment, of the map with the plan."""
        return replace(
            self.alignment,
            reference=self.plan.name,
            moving=self.reference.name,
            transform=self.alignment.transform.inverse(),
        )

    def save(self, folder: Path, normalize: NormalizeConfig) -> None:
        """Save plan, map in the plan's frame, world file and overlay; see ``plan_files``."""
        from slamfusion.report.maps import input_colours, pair_overlay  # noqa: PLC0415 - an extra

        with AtomicFiles():
            save_map(self.plan, folder / PLAN, image_format="png")
            save_map(self.in_plan(), folder / PLACED, image_format="png")
            lines = world_file(self.plan, self.alignment.transform)
            write_atomic(folder / WORLD_FILE, lines.encode())
            colours = input_colours((self.plan.name, self.reference.name))
            plan, reference = (grid.classified(normalize) for grid in (self.plan, self.reference))
            picture = pair_overlay(plan, reference, self.of_map, colours)
            if picture is not None:
                write_atomic(folder / OVERLAY, picture.png)

    def in_plan(self) -> OccupancyGrid:
        """Return the robot's map with its axes along the plan's, in the plan's frame."""
        grid, transform = self.reference, self.of_map.transform
        own, along = Lattice(grid.resolution, grid.origin), Lattice(grid.resolution, Pose2())
        box = along.box_of(CellBox(0, 0, grid.height, grid.width), own, transform)
        lattice = replace(grid, origin=along.origin)
        cells = sample_on_lattice(grid, lattice, box, transform)
        return replace(grid, cells=cells, origin=along.corner(box.row0, box.col0))


def align_plan(
    reference: OccupancyGrid,
    plan: OccupancyGrid,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    scale: PixelSizes = "free",
) -> AlignedPlan:
    """Align a floor plan of unknown scale with a robot's map; the result may be rejected.

    Args:
        plan: its resolution is a first guess.
        scale: least and greatest metres per pixel of the plan.

    Raises:
        ConfigError: ``scale`` is not positive or not in order.
        GridError: a map has no known cell.
    """
    config = config or RunConfig()
    scales = (1.0 / FACTOR, FACTOR)
    if scale != "free":
        scales = (scale[0] / plan.resolution, scale[1] / plan.resolution)
    factor, alignment = align_at_any_scale(
        reference, plan, config.fusion, device_for(config, device), scales
    )
    sized = replace(plan, resolution=plan.resolution * factor)
    return AlignedPlan(reference, sized, factor, alignment)


def world_file(plan: OccupancyGrid, transform: Pose2) -> str:
    """Return the ESRI world file of the plan's picture (top row first) in the transform's frame."""
    pose = transform.compose(plan.origin)
    along, across = (plan.resolution * f(pose.yaw_rad) for f in (math.cos, math.sin))
    x, y = pose.transform(np.array((0.5, plan.height - 0.5)) * plan.resolution)
    return "".join(f"{value:.9f}\n" for value in (along, across, across, -along, x, y))
