"""Three maps of one place for the live fusion, and where its walls stand in the world."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy import ndimage

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig, NormalizeConfig, RunConfig, VoteConfig
from slamfusion.fusion.live import LiveFusion, LiveInput, LiveUpdate
from slamfusion.fusion.live.inputs import Layer, lay_out
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, CellBox, OccupancyGrid
from tests.fusion.drawings import building, degraded

# Far from every frame's origin, as when a robot has been out for a while.
AWAY = Pose2(31.37, -12.71, 0.4)


@cache
def three(seed: int = 3) -> dict[str, OccupancyGrid]:
    """Return three faulty maps of one place, each in a frame of its own; ``a`` is the smallest."""
    return _faulty(building(seed, 12.0, 10.0), seed, speckle_share=0.02)


@cache
def trio(seed: int = 10) -> dict[str, OccupancyGrid]:
    """Return three faulty maps of one small place, whose mirror image fits at half its walls."""
    return _faulty(building(seed, 14.0, 6.0, 0.05), seed)


def _faulty(place: OccupancyGrid, seed: int, **of_c: float) -> dict[str, OccupancyGrid]:
    faults = {
        "a": {"flip_share": 0.002, "resample": False},
        "b": {"yaw_rad": -1.1, "flip_share": 0.01, "shift_share": (0.3, 0.1)},
        "c": {"yaw_rad": 2.4, "flip_share": 0.005, "margin_share": 0.4, **of_c},
    }
    return {
        name: degraded(place, 10 * seed + index, name, **fault)[0]
        for index, (name, fault) in enumerate(faults.items())
    }


def mirrored(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the map as a program writes it that takes the first row for the last."""
    return replace(grid, cells=np.ascontiguousarray(grid.cells[::-1]))


def transposed(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the map as a program writes it that takes rows for columns."""
    return replace(grid, cells=np.ascontiguousarray(grid.cells.T))


def noise(size: int = 300, seed: int = 0) -> OccupancyGrid:
    """Return a map of chance alone: a third each unknown, free and wall."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(np.array([-1, 0, 100], dtype=np.int8), (size, size))
    return OccupancyGrid(cells, 0.1, Pose2(), "noise")


def live_fusion(
    device: ComputeDevice, mode: str = "majority", unknown: str = "auto", **live: Any
) -> LiveFusion:
    """Return a live fusion without pauses between searches."""
    config = RunConfig(
        fusion=FusionConfig(vote=VoteConfig(mode=mode, unknown=unknown)),
        live=LiveConfig(**{"search_pause_s": 0.0, **live}),
    )
    return LiveFusion(config, device)


def layer_of(grid: OccupancyGrid, device: ComputeDevice, before: Layer | None = None) -> Layer:
    """Return a map as a layer of cells of 0.1 m, on the lattice of another one where given."""
    lattice = None if before is None else before.lattice
    return lay_out(grid, lattice, 0.1, NormalizeConfig(), device)


class Drive:
    """A live fusion and its clock: every ``step`` is a second later."""

    def __init__(self, live: LiveFusion) -> None:
        self.live = live
        self.now_s = 100.0
        self.fused: OccupancyGrid | None = None

    def step(self, *grids: OccupancyGrid) -> LiveUpdate:
        """Put the maps, update, and return the update, which must be one."""
        update = self.maybe(*grids)
        assert update is not None
        return update

    def maybe(self, *grids: OccupancyGrid) -> LiveUpdate | None:
        self.now_s += 1.0
        for grid in grids:
            self.live.put(grid.name, grid, self.now_s)
        update = self.live.update(self.now_s)
        if update is not None and update.fused is not None:
            self.fused = update.fused
        return update

    def input(self, name: str) -> LiveInput:
        return {record.name: record for record in self.live.inputs()}[name]

    def accepted(self) -> str:
        """Return the names of the voters, joined."""
        return "".join(r.name for r in self.live.inputs() if r.accepted)


def started(device: ComputeDevice, names: str = "abc", **live: Any) -> Drive:
    """Return a drive on which the three maps, or two of them, were fused."""
    drive = Drive(live_fusion(device, **live))
    update = drive.step(*(three()[name] for name in names))
    assert drive.accepted() == names, [record.reason for record in update.inputs]
    return drive


def touched(grid: OccupancyGrid, seed: int, share: float = 0.01) -> OccupancyGrid:
    """Return the map with a few known cells turned over, as every new map differs a little."""
    rng = np.random.default_rng(seed)
    cells = grid.cells.copy()
    flip = (rng.random(cells.shape) < share) & (cells >= 0)
    cells[flip] = OCCUPIED - cells[flip]
    return replace(grid, cells=cells)


def littered(grid: OccupancyGrid, seed: int, share: float = 0.5) -> OccupancyGrid:
    """Return the map with walls that are not there, all over its free space; its own stand."""
    rng = np.random.default_rng(seed)
    cells = grid.cells.copy()
    blocks = rng.random((grid.height // 4 + 1, grid.width // 4 + 1)) < share
    mask = np.kron(blocks, np.ones((4, 4), dtype=bool))[: grid.height, : grid.width]
    cells[mask & (cells == 0)] = OCCUPIED
    return replace(grid, cells=cells)


def moved_frame(grid: OccupancyGrid, motion: Pose2) -> OccupancyGrid:
    """Return the same map in another frame, as after a restart of its producer."""
    return replace(grid, origin=motion.compose(grid.origin))


def shifted(grid: OccupancyGrid, cells: int) -> OccupancyGrid:
    """Return the map with its walls moved by whole cells along x, frame and size unchanged."""
    out = np.full_like(grid.cells, -1)
    out[:, cells:] = grid.cells[:, : grid.width - cells]
    return replace(grid, cells=out)


def wall_points(grid: OccupancyGrid) -> np.ndarray:
    """Return the centres of the wall cells in the grid's map frame, (N, 2) m."""
    rows, cols = np.nonzero(grid.cells == OCCUPIED)
    return grid.cell_centres(rows, cols)


def share_standing(before: OccupancyGrid, after: OccupancyGrid, cells: float = 1.0) -> float:
    """Return the share of the walls of one fused map with a wall of the other within a cell."""
    walls = after.cells == OCCUPIED
    away = ndimage.distance_transform_edt(~np.pad(walls, 40))
    rows, cols = after.cell_indices(wall_points(before))
    inside = (rows > -40) & (rows < after.height + 40) & (cols > -40) & (cols < after.width + 40)
    distance = np.full(len(rows), math.inf)
    distance[inside] = away[rows[inside] + 40, cols[inside] + 40]
    return float((distance <= cells * math.sqrt(2.0)).mean())


def assert_same_lattice(a: OccupancyGrid, b: OccupancyGrid) -> tuple[int, int]:
    """Assert that two grids lie on one lattice of one frame; return the second's first cell."""
    own = a.origin.inverse().compose(b.origin)
    col, row = own.x / a.resolution, own.y / a.resolution
    assert a.resolution == b.resolution
    assert abs(own.yaw_rad) < 1e-9
    assert abs(col - round(col)) < 1e-6
    assert abs(row - round(row)) < 1e-6
    return round(row), round(col)


def on_lattice(grid: OccupancyGrid, base: OccupancyGrid) -> np.ndarray:
    """Return a grid's cells on the cells of another of the same lattice."""
    row, col = assert_same_lattice(base, grid)
    return grid.crop(CellBox(-row, -col, base.height - row, base.width - col)).cells
