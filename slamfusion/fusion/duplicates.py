"""Inputs that are one map given twice: a copy bears nothing out, and has no vote of its own."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from slamfusion.grid import OccupancyGrid, row_parts


def find_copies(grids: Sequence[OccupancyGrid], preferred: Collection[str] = ()) -> dict[str, str]:
    """Return which inputs are copies, each with the name of the one that votes for all of them.

    Copies have equal cells, resolution and origin.

    Args:
        grids: of distinct names.
        preferred: names that something else is known of: of several copies the first of these
            votes, or else the first.
    """
    copies: dict[str, str] = {}
    for index, grid in enumerate(grids):
        if grid.name in copies:
            continue
        alike = [grid, *(other for other in grids[index + 1 :] if _is_same(grid, other))]
        voter = next((same for same in alike if same.name in preferred), grid)
        copies |= {same.name: voter.name for same in alike if same is not voter}
    return {grid.name: copies[grid.name] for grid in grids if grid.name in copies}


def copy_words(voter: str) -> str:
    """Return what is said of a copy of an input."""
    return f"the same map as {voter} (equal cells, resolution and origin): one voter"


def _is_same(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    is_alike = (a.resolution, a.origin, a.cells.shape) == (b.resolution, b.origin, b.cells.shape)
    return is_alike and all(
        np.array_equal(a.cells[rows], b.cells[rows]) for rows in row_parts(a.cells.shape)
    )
