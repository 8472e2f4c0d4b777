"""Inputs brought to one resolution: the cells that vote, and the copies that are aligned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slamfusion.align.features import FieldMemory, GridFeatures
from slamfusion.align.normalize import (
    NormalizedGrid,
    VotingGrid,
    check_resampling,
    coarsening,
    common_resolution,
    normalize_grid,
    voting_grid,
)
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.errors import GridError
from slamfusion.grid import OccupancyGrid
from slamfusion.io.memory import return_freed_memory


class PreparedInputs:
    """Inputs at the common resolution; of large ones coarser copies are aligned.

    Attributes:
        features: of the inputs that can be aligned, by name. ``release`` empties it.
        reasons: why the others cannot, by name.
    """

    def __init__(
        self,
        grids: Sequence[OccupancyGrid],
        config: FusionConfig,
        device: ComputeDevice,
        *,
        is_stored: bool = False,
    ) -> None:
        """Normalise every input.

        Args:
            grids: one or more.
            config: ``normalize`` is used.
            device: computes.
            is_stored: the inputs will vote tile by tile.

        Raises:
            MemoryBudgetError: the grids are too large for the memory that is free.
        """
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
                self.reasons[grid.name] = str(error)
                continue
            self._normalized[grid.name] = (
                normalized if self._factor == 1 else _without_percents(normalized)
            )
            if self._factor > 1:
                return_freed_memory()
        self._memory = FieldMemory(is_sparing=is_stored)
        self.features = {
            name: GridFeatures(grid, device, self._memory)
            for name, grid in self._normalized.items()
        }

    def release(self) -> None:
        """Let go of what alignments look at: several times the memory of the maps."""
        self._memory.clear()
        self.features.clear()
        if self._factor > 1:
            self._normalized.clear()
            return_freed_memory()

    def lattice(self, name: str) -> VotingGrid:
        """Return an input with the cells that vote; a large one is laid out for each call."""
        if self._factor == 1:
            return self._normalized[name]
        return voting_grid(self._grids[name], self._resolution, self._config, self._device)


def _without_percents(grid: NormalizedGrid) -> NormalizedGrid:
    """Return a grid that is aligned and does not vote: where it lies is all that is asked of it.

    What each cell is, -1, 0 or 1, stands for its percents, in the same memory.
    """
    return replace(grid, grid=replace(grid.grid, cells=grid.cells))
