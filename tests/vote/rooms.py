"""Small maps of one place: as it is, bent, thick, turned away; and how maps of one frame vote."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import NumpyDevice
from slamfusion.config import FusionMode, VoteConfig
from slamfusion.fusion import FusionResult
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.vote.tiles import TileVoter, Trust
from tests.fusion.test_lattice_vote import SIZE, voted

# A room, its outer walls, and one wall inside from the south up to row 30.
HEIGHT, WIDTH, EDGE, INNER = 60, 100, 5, 50


def room(*, seed: int | None = None) -> I8:
    """Return the room, (60, 100) int8 in {-1, 0, 1}; a seed makes walls jitter by a cell."""
    cells = np.full((HEIGHT, WIDTH), -1, dtype=np.int8)
    cells[EDGE:-EDGE, EDGE:-EDGE] = 0
    cells[[EDGE, -EDGE - 1], EDGE:-EDGE] = 1
    cells[EDGE:-EDGE, [EDGE, -EDGE - 1]] = 1
    cells[EDGE:30, INNER] = 1
    return cells if seed is None else moved(cells, *np.random.default_rng(seed).integers(-1, 2, 2))


def moved(cells: I8, rows: int, cols: int) -> I8:
    """Return cells some rows and columns further on; their edge is unknown."""
    return np.roll(cells, (rows, cols), (0, 1))


def bent(cells: I8, steep: float = 0.4) -> I8:
    """Return cells that lie further and further north to the east of column 20."""
    out = np.full_like(cells, -1)
    for col in range(cells.shape[1]):
        rows = round(steep * max(0, col - 20))
        out[rows:, col] = cells[: cells.shape[0] - rows, col]
    return out


def fuse(maps: Mapping[str, I8], **vote: Any) -> FusionResult:
    """Let maps of one frame vote; they are named as they are here."""
    places = [
        (OccupancyGrid(np.where(cells == 1, 100, cells).astype(np.int8), SIZE), Pose2())
        for cells in maps.values()
    ]
    return voted(places, NumpyDevice(), names=tuple(maps), **{"mode": "consensus"} | vote)


def cells_of(result: FusionResult) -> I8:
    """Return the fused cells where those of ``room`` are, in {-1, 0, 1}."""
    fused = result.fused
    out = np.full((HEIGHT, WIDTH), -1, dtype=np.int8)
    row, col = round(fused.origin.y / SIZE), round(fused.origin.x / SIZE)
    out[row : row + fused.height, col : col + fused.width] = np.sign(fused.cells)
    return out


def decide(maps: Mapping[str, I8], mode: FusionMode = "consensus") -> tuple[Trust | None, I8]:
    """Return the trust in maps, which may know nothing, and the cells that they decide."""
    whole = CellBox(0, 0, HEIGHT, WIDTH)
    voter = TileVoter(whole, VoteConfig(mode, unknown="abstain"), SIZE, tuple(maps))
    shown = shown_by(voter, whole, maps)
    if voter.weighs:
        voter = voter.trusting(voter.count(whole, shown))
    decided = voter.decide(whole, shown, NumpyDevice())
    return voter.trust, decided.fused


def shown_by(
    voter: TileVoter, tile: CellBox, maps: Mapping[str, I8]
) -> dict[str, npt.NDArray[Any]]:
    """Return what maps that cover the whole of a vote show around a tile."""

    def read(cells: I8, box: CellBox) -> I8:
        return np.ascontiguousarray(cells[box.slices(voter.whole)])

    around = voter.around(tile)
    return {name: voter.prepare(around, partial(read, cells)) for name, cells in maps.items()}
