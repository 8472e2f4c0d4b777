"""Aligned grids on one lattice: warp them there, vote, and say what became of each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.config import FusionConfig
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import NormalizedGrid, lattice_box
from slamfusion.fusion.records import Alignment, FusionResult, InputRecord
from slamfusion.fusion.vote import (
    agreement_weights,
    double_reach_cells,
    margin_cells,
    vote_grids,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid

__all__ = ["vote_on_lattice", "warp_onto"]


def warp_onto(
    grid: NormalizedGrid,
    cells: npt.NDArray[np.int8],
    transform: Pose2,
    lattice: OccupancyGrid,
    box: CellBox,
    device: ComputeDevice,
) -> npt.NDArray[np.int8]:
    """Return cells of one grid on the box of another's lattice, nearest cell, unknown outside.

    Args:
        grid: gives the origin and resolution of ``cells``.
        cells: (H, W) int8 on the grid's lattice.
        transform: maps the grid's map frame into the lattice's, metres.
        lattice: the grid whose lattice is the target.
        box: cells of that lattice; may reach beyond it.
        device: computes.
    """
    size = lattice.resolution
    into = grid.grid.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    corner = into.transform((box.col0 * size, box.row0 * size)) / size
    pose = fixed_poses((corner[0], corner[1], into.yaw_rad))
    shape = (box.height, box.width)
    warped = device.warp(device.upload(cells), pose, shape, UNKNOWN)
    return np.asarray(device.download(warped)[0])


def vote_on_lattice(
    grids: Sequence[OccupancyGrid],
    reference: str,
    alignments: dict[str, Alignment],
    features: dict[str, GridFeatures],
    rejected: dict[str, InputRecord],
    config: FusionConfig,
    device: ComputeDevice,
) -> FusionResult:
    """Warp the accepted grids onto the fused lattice, vote, and write the records."""
    base = features[reference].grid
    box = CellBox(0, 0, *base.shape)
    if config.vote.extent == "union":
        boxes = [
            lattice_box(features[name].grid, pair.transform, base)
            for name, pair in alignments.items()
        ]
        box = CellBox(
            min(b.row0 for b in boxes),
            min(b.col0 for b in boxes),
            max(b.row1 for b in boxes),
            max(b.col1 for b in boxes),
        )
    margin = margin_cells(config.vote, len(alignments))
    box = CellBox(box.row0 - margin, box.col0 - margin, box.row1 + margin, box.col1 + margin)
    aligned, percents = [], []
    for name, pair in alignments.items():
        grid = features[name].grid
        aligned.append(warp_onto(grid, grid.cells, pair.transform, base.grid, box, device))
        if config.vote.mode == "log-odds":
            percents.append(
                warp_onto(grid, grid.grid.cells, pair.transform, base.grid, box, device)
            )
    weights = agreement_weights(aligned) if config.vote.mode == "weighted" else [1.0] * len(aligned)
    voted = vote_grids(
        aligned,
        config.vote,
        device,
        weights=weights,
        percents=percents or None,
        thresholds=config.normalize,
        reach_cells=double_reach_cells(config.vote, base.grid.resolution),
    )
    frame = base.grid.crop(box)
    cells = np.array([UNKNOWN, FREE, OCCUPIED], dtype=np.int8)[voted.fused + 1]
    fused = OccupancyGrid(cells, frame.resolution, frame.origin, "fused")
    agreement = OccupancyGrid(voted.agreement, frame.resolution, frame.origin, "agreement")
    slots = {name: index for index, name in enumerate(alignments)}
    records = []
    for given in grids:
        if given.name in slots:
            index = slots[given.name]
            pair = alignments[given.name]
            dissent = (voted.dissent >> np.array(index, voted.dissent.dtype)) & 1 != 0
            records.append(InputRecord(given, pair, True, pair.reason, aligned[index], dissent))
        else:
            records.append(rejected[given.name])
    return FusionResult(
        reference=reference,
        inputs=tuple(records),
        fused=fused,
        agreement=agreement,
        pairs=(),
        phantom_cells=voted.phantom_cells,
        weights={name: float(weights[index]) for name, index in slots.items()},
        device=device.name,
        time_s=0.0,
    )
