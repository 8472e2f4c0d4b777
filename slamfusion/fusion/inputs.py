"""Prepare inputs: leave out copies and odd cell sizes, bring the rest to one resolution."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from slamfusion.align.features import FieldMemory, GridFeatures
from slamfusion.align.normalize import (
    NormalizedGrid,
    check_resampling,
    coarsening,
    common_resolution,
    normalize_grid,
    odd_resolution,
)
from slamfusion.errors import GridError
from slamfusion.fusion.grouping import FusionSetup
from slamfusion.grid import OccupancyGrid, row_parts
from slamfusion.io.files import return_freed_memory


class PreparedInputs:
    """Inputs at the common resolution; of large ones coarser copies are aligned.

    Attributes:
        features: of the inputs that can be aligned, by name. ``release`` empties it.
        reasons: why the others cannot, by name.
    """

    def __init__(self, grids: Sequence[OccupancyGrid], setup: FusionSetup) -> None:
        """Normalise every input; MemoryBudgetError: they are too large for the free memory."""
        config, device, is_stored = setup.config, setup.device, setup.is_stored
        check_resampling(grids, config.normalize, "fusing", is_stored=is_stored)
        self._grids = {grid.name: grid for grid in grids}
        self._config, self._device = config.normalize, device
        self._resolution = common_resolution(list(grids), config.normalize)
        self._factor = coarsening(grids, self._resolution, is_sparing=is_stored)
        self._normalized: dict[str, NormalizedGrid] = {}
        self.reasons: dict[str, str] = {}
        for grid in grids:
            try:
                normalized = normalize_grid(
                    grid, self._factor * self._resolution, config.normalize, device
                )
            except GridError as error:
                self.reasons[grid.name] = str(error).removeprefix(f"{grid.name}: ")
                continue
            if self._factor > 1:
                # For alignment only, so its trinary cells stand for percentages.
                cells = replace(normalized.grid, cells=normalized.cells)
                normalized = replace(normalized, grid=cells)
                return_freed_memory()
            self._normalized[grid.name] = normalized
        self._memory = FieldMemory(is_sparing=is_stored)
        self.features = {
            name: GridFeatures(grid, device, self._memory)
            for name, grid in self._normalized.items()
        }

    def release(self) -> None:
        """Release what alignments use: several times the memory of the maps."""
        self._memory.clear()
        self.features.clear()
        if self._factor > 1:
            self._normalized.clear()
            return_freed_memory()

    def lattice(self, name: str) -> NormalizedGrid:
        """Return an input with the cells that vote; a large one is resampled at each call."""
        if self._factor == 1:
            return self._normalized[name]
        return normalize_grid(self._grids[name], self._resolution, self._config, self._device)


def find_copies(grids: Sequence[OccupancyGrid], preferred: Collection[str] = ()) -> dict[str, str]:
    """Return which inputs are copies, each with the name of the one that votes for all of them.

    Copies have equal cells, resolution and origin.

    Args:
        preferred: of several copies the first of these votes, else the first.
    """
    copies: dict[str, str] = {}
    for index, grid in enumerate(grids):
        if grid.name in copies:
            continue
        alike = [grid, *(other for other in grids[index + 1 :] if is_same(grid, other))]
        voter = next((same for same in alike if same.name in preferred), grid)
        copies |= {same.name: voter.name for same in alike if same is not voter}
    return {grid.name: copies[grid.name] for grid in grids if grid.name in copies}


def is_same(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    """Whether two maps are equal in all but their names."""
    is_alike = (a.resolution, a.origin, a.cells.shape) == (b.resolution, b.origin, b.cells.shape)
    return is_alike and all(
        np.array_equal(a.cells[rows], b.cells[rows]) for rows in row_parts(a.cells.shape)
    )


def odd_resolutions(resolutions: Mapping[str, float]) -> dict[str, str]:
    """Return, in words, the inputs whose cells are too coarse or too fine for the others.

    The typical resolution is the median, of an even number the coarser one.
    """
    if not resolutions:
        return {}
    typical = sorted(resolutions.values())[len(resolutions) // 2]
    reasons = {name: odd_resolution(size, typical) for name, size in resolutions.items()}
    return {name: reason for name, reason in reasons.items() if reason is not None}
