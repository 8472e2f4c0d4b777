"""``fuse_with_drawn``: the fused map is the one that the scans draw; saved maps vote beside it.

The producers of a drive have put all that they know of it into their paths, and the scans, drawn at
the path that these become, say the rest: their own maps say nothing more, and do not vote. They are
held against the drawn map all the same, so that what one of them shows otherwise can be seen. A
map that another SLAM saved has seen what no scan of this log has: it votes.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.normalize import NormalizedGrid, normalize_grid
from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.fusion.lattice_vote import wall_agreement_of, warp_onto, weights_of
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid
from slamfusion.vote.boxes import hull
from slamfusion.vote.tiles import GridLayer, TileVoter

I8 = npt.NDArray[np.int8]
B8 = npt.NDArray[np.bool_]


def fuse_with_drawn(
    result: FusionResult,
    drawn: OccupancyGrid,
    saved: Collection[str],
    config: FusionConfig,
    device: ComputeDevice,
) -> FusionResult:
    """Return the fusion with the drawn map in place of the producers' votes.

    The drawn map and the saved maps that fit vote as in ``consensus``. Without saved maps the drawn
    map is the fused one.

    Args:
        result: of fusing the maps of a drive: says which fit and how they lie.
        drawn: in the map frame of its fused map, cells in {-1, 0, 100}.
        saved: names of inputs that no producer of the drive made.
        config: thresholds.
        device: computes.

    Returns:
        On the lattice of ``drawn``, over all that it and the voting saved maps know. The agreement
        of a cell is the share of the maps that know it, the drawn one among them, which say what
        the fused one says; an input dissents where it knows a cell and says otherwise. ``weights``
        has those that voted.

    Raises:
        GridError: no cell of ``drawn`` is known.
    """
    layer = normalize_grid(drawn, drawn.resolution, config.normalize, device)
    inputs = {
        record.name: (
            normalize_grid(record.grid, drawn.resolution, config.normalize, device),
            record.alignment.transform,
        )
        for record in result.accepted
        if record.alignment is not None
    }
    voters = [name for name in inputs if name in saved]
    lattice, box = layer.extent.lattice, layer.extent.box
    for name in voters:
        grid, transform = inputs[name]
        box = hull(box, grid.extent.on(lattice, transform))

    def placed(grid: NormalizedGrid, transform: Pose2) -> I8:
        return warp_onto(grid, grid.cells, transform, lattice, box, device)

    own = placed(layer, Pose2())
    aligned = {name: placed(*item) for name, item in inputs.items()}
    whole = CellBox(0, 0, box.height, box.width)
    vote = replace(config.vote, mode="consensus")
    layers = {drawn.name: own, **{name: aligned[name] for name in voters}}
    voter = TileVoter(whole, vote, drawn.resolution, tuple(layers))
    shape = (box.height, box.width)
    shown = {
        name: voter.prepare(whole, GridLayer(shape, whole, cells).on)
        for name, cells in layers.items()
    }
    if voter.weighs:
        voter = voter.trusting(voter.count(whole, shown))
    voted = voter.decide(whole, shown, device)
    fused = own if voted is None else voted.fused
    frame = layer.grid.crop(box)
    cells = np.array([UNKNOWN, FREE, OCCUPIED], dtype=np.int8)[fused + 1]
    agreement = _agreement(fused, [own, *aligned.values()])
    records = tuple(
        replace(
            record,
            layer=GridLayer.of(aligned[record.name], _dissent(fused, aligned[record.name])),
        )
        if record.name in aligned
        else record
        for record in result.inputs
    )
    return replace(
        result,
        inputs=records,
        fused=OccupancyGrid(cells, frame.resolution, frame.origin, result.fused.name),
        agreement=OccupancyGrid(agreement, frame.resolution, frame.origin, result.agreement.name),
        phantom_cells=0,
        weights=weights_of(voter.names, voter.trust),
        wall_agreement=result.wall_agreement | wall_agreement_of(voter.trust),
        left_out_m2={},
    )


def _agreement(fused: I8, maps: list[I8]) -> I8:
    """Return the share of the maps that know a cell which say what the fused one says.

    Args:
        fused: (H, W) int8 in {-1, 0, 1}.
        maps: likewise, one or more.

    Returns:
        (H, W) int8, percent, rounded half up; -1 where the fused map knows nothing.
    """
    known = np.zeros(fused.shape, dtype=np.int16)
    same = np.zeros(fused.shape, dtype=np.int16)
    for cells in maps:
        known += cells >= 0
        same += (cells >= 0) & (cells == fused)
    percent = np.floor(100.0 * same / np.maximum(known, 1) + 0.5).astype(np.int8)
    return np.where(fused >= 0, percent, np.int8(-1))


def _dissent(fused: I8, cells: I8) -> B8:
    """Return where a map knows a cell that the fused one knows otherwise, (H, W) bool."""
    return np.asarray((cells >= 0) & (fused >= 0) & (cells != fused))
