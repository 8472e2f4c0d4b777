"""A floor plan aligned with a robot's map: its scale, and both as maps of one frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.align.records import Alignment
from slamfusion.align.scale import FACTOR, align_at_any_scale
from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig, RunConfig
from slamfusion.evaluation.distances import sample_on_lattice
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.io.files import AtomicFiles, write_atomic
from slamfusion.io.map_server import save_map
from slamfusion.jobs.inputs import PixelSizes, device_for
from slamfusion.jobs.outputs import OVERLAY, PLACED, PLAN, WORLD_FILE
from slamfusion.vote.lattice import Lattice


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
