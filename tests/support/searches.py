"""Searches that a test process has made are not made again: hundreds of tests lay the same maps."""

from __future__ import annotations

import hashlib
from typing import Any

from slamfusion.align import hypotheses
from slamfusion.align import search as searching
from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.align.search import COARSE_CHANCE_MAX, search
from slamfusion.align.shifts import SearchWindow
from slamfusion.config import AlignConfig

# Modules that ask for a search by its name.
CALLERS = (searching, hypotheses)


class RememberedSearches:
    """``search``, with the answers to what was asked before.

    A search goes by the cells of two maps on their lattices, and not by where the lattices lie.
    """

    def __init__(self) -> None:
        self._answers: dict[tuple[bytes, bytes, str], tuple[Any, ...]] = {}
        self.made = 0

    def __call__(
        self,
        pair: Pair,
        config: AlignConfig,
        window: SearchWindow,
        chance: float = COARSE_CHANCE_MAX,
    ) -> tuple[Any, ...]:
        """Return what ``search`` returns."""
        asked = f"{config!r} {window!r} {pair.device.name} {chance!r}"
        key = (_cells(pair.reference), _cells(pair.moving), asked)
        if key not in self._answers:
            self.made += 1
            self._answers[key] = search(pair, config, window, chance)
        coarse, motions = self._answers[key]
        return coarse, motions.copy()

    def forget(self) -> None:
        """Make every search anew."""
        self._answers.clear()


def _cells(features: GridFeatures) -> bytes:
    """Return what tells the cells of a prepared map from those of another."""
    grid = features.grid
    digest = hashlib.sha256(f"{grid.grid.resolution!r} {grid.shape}".encode())
    for cells in (grid.grid.cells, grid.cells, grid.solid):
        digest.update(cells.tobytes())
    return digest.digest()
