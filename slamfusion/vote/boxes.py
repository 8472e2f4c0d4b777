"""Boxes of cells: joined, grown and cut."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.grid import CellBox

Scalar = TypeVar("Scalar", bound=np.generic)

# Cells between two boxes that are sooner voted on again than left out.
SPARE_CELLS = 1 << 16


def hull(a: CellBox, b: CellBox) -> CellBox:
    """Return the smallest box that holds both."""
    return CellBox(
        min(a.row0, b.row0), min(a.col0, b.col0), max(a.row1, b.row1), max(a.col1, b.col1)
    )


def joined(boxes: Sequence[CellBox]) -> list[CellBox]:
    """Return boxes that hold all the cells of some, joined where hardly any cell lies between."""
    out: list[CellBox] = []
    for box in boxes:
        grown = box
        # A box that took another in may reach a third one.
        while True:
            near = [
                other
                for other in out
                if hull(grown, other).area <= grown.area + other.area + SPARE_CELLS
            ]
            if not near:
                break
            for other in near:
                out.remove(other)
                grown = hull(grown, other)
        out.append(grown)
    return out


def moved(box: CellBox, rows: int, cols: int) -> CellBox:
    """Return the box some rows and columns further on."""
    return CellBox(box.row0 + rows, box.col0 + cols, box.row1 + rows, box.col1 + cols)


def overlap(a: CellBox, b: CellBox) -> CellBox | None:
    """Return the cells of both boxes, None without any."""
    box = CellBox(
        max(a.row0, b.row0), max(a.col0, b.col0), min(a.row1, b.row1), min(a.col1, b.col1)
    )
    return box if box.row1 > box.row0 and box.col1 > box.col0 else None


def padded(box: CellBox, cells: int) -> CellBox:
    """Return the box with some cells more on every side."""
    return CellBox(box.row0 - cells, box.col0 - cells, box.row1 + cells, box.col1 + cells)


def slices(box: CellBox, row0: int, col0: int) -> tuple[slice, slice]:
    """Return the indices of a box in an array whose first cell is (row0, col0)."""
    return (slice(box.row0 - row0, box.row1 - row0), slice(box.col0 - col0, box.col1 - col0))


def cut(
    cells: npt.NDArray[Scalar], own: CellBox, box: CellBox, otherwise: int
) -> npt.NDArray[Scalar]:
    """Return a box (H, W) of the cells of an own box; ``otherwise`` where that does not reach."""
    out = np.full((box.height, box.width), otherwise, dtype=cells.dtype)
    common = overlap(own, box)
    if common is not None:
        out[slices(common, box.row0, box.col0)] = cells[slices(common, own.row0, own.col0)]
    return out


def grown_inside(box: CellBox, cells: int, whole: CellBox) -> CellBox:
    """Return a box with some cells more on each side, cut to another one that it meets."""
    return overlap(padded(box, cells), whole) or box
