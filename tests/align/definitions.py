"""The evidence of walls by its definition: slow, plain, and with nothing of the code it judges."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from slamfusion.align.features import GridFeatures


def surface_of(cells: np.ndarray) -> np.ndarray:
    """Walls of trinary cells with one to six free cells among their eight neighbours."""
    free = ndimage.convolve((cells == 0).astype(int), np.ones((3, 3), int), mode="constant")
    return np.asarray((cells == 1) & (free > 0) & (free < 7))


def likeness_of(walls: np.ndarray, sigma: float) -> np.ndarray:
    """``exp(-d^2 / 2)`` of each cell, d in widths of a wall; no more than 64 cells are told."""
    d = np.minimum(ndimage.distance_transform_edt(~walls), 64.0) / sigma
    return np.asarray(np.exp(-0.5 * d * d))


@dataclass(frozen=True, eq=False)
class Side:
    """One map at one cell size: what its cells are worth to the walls of the other.

    Attributes:
        walls: (H, W) bool. nats: (H, W) L. unit: nats a value. value: (H, W) int, L in units.
        centre: of the full-resolution grid, x and y in these cells.
    """

    walls: np.ndarray
    nats: np.ndarray
    unit: float
    value: np.ndarray
    centre: tuple[float, float]

    @property
    def points(self) -> np.ndarray:
        """(N, 2) x and y of the walls, cells."""
        row, col = np.nonzero(self.walls)
        return np.stack((col + 0.5, row + 0.5), axis=1)


def side_of(features: GridFeatures, sigma: float, top: int, doubt: float = 0.0) -> Side:
    """L = log((0.75 like + 0.04) / (0.75 c + 0.04)); nothing speaks against in the unknown.

    Less doubt times what L lacks of that on a wall.
    """
    cells = np.asarray(features.grid.cells)
    walls, free = surface_of(cells), cells == 0
    like = likeness_of(walls, sigma)
    chance = max(0.02, like[walls | free].mean())
    nats = np.log((0.75 * like + 0.04) / (0.75 * chance + 0.04))
    nats -= doubt * (np.log(0.79 / (0.75 * chance + 0.04)) - nats)
    nats = np.where(free, nats, np.maximum(nats, 0.0))
    unit = (1.0 + doubt) * math.log(0.79 / 0.04) / top
    centre = cells.shape[1] / 2.0, cells.shape[0] / 2.0
    return Side(walls, nats, unit, np.rint(nats / unit).astype(int), centre)


def level_side(features: GridFeatures, step: int, sigma: float, top: int) -> Side:
    """What the device holds of a level: walls and field, which other tests judge."""
    table, field = features.field(step, sigma, top, 0.0)
    fetch = features.device.download
    walls = fetch(features.level(step).wall) != 0
    value = fetch(field).astype(int) - table.base
    height, width = features.shape
    centre = width / 2.0 / step, height / 2.0 / step
    return Side(walls, value * table.unit, table.unit, value, centre)


def landings(points: np.ndarray, motion: np.ndarray, centre: tuple[float, float]) -> np.ndarray:
    """Where points (N, 2) of the moving grid land on the reference, cells."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    x, y = points[:, 0] - centre[0], points[:, 1] - centre[1]
    return np.stack((cos * x - sin * y + motion[0], sin * x + cos * y + motion[1]), axis=1)


def landings_back(
    points: np.ndarray, motion: np.ndarray, centre: tuple[float, float]
) -> np.ndarray:
    """Where points (N, 2) of the reference land on the moving grid, cells."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    x, y = points[:, 0] - motion[0], points[:, 1] - motion[1]
    return np.stack((cos * x + sin * y + centre[0], -sin * x + cos * y + centre[1]), axis=1)


def look_up(field: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The field in the cells under positions (N, 2); 0 outside."""
    col, row = np.floor(positions).astype(int).T
    inside = (row >= 0) & (col >= 0) & (row < field.shape[0]) & (col < field.shape[1])
    found = np.zeros(len(positions), dtype=field.dtype)
    found[inside] = field[row[inside], col[inside]]
    return found


def evidence_of(ref: Side, mov: Side, motion: np.ndarray, *, exact: bool = False) -> float:
    """Both maps' walls on the other, nats; of whole units, or as the formula has it."""
    there = landings(mov.points, motion, mov.centre)
    back = landings_back(ref.points, motion, mov.centre)
    if exact:
        return float(look_up(ref.nats, there).sum() + look_up(mov.nats, back).sum())
    values = look_up(ref.value, there).sum() + look_up(mov.value, back).sum()
    return float(values * ref.unit)
