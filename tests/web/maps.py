"""Maps for the page, and a reader of what it is told."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.web.scene import HEADER, TILE


def decode_tile(data: bytes) -> tuple[dict[str, Any], npt.NDArray[np.int8]]:
    """Return a tile's header and cells, as the page reads them."""
    (length,) = HEADER.unpack_from(data)
    header = json.loads(data[HEADER.size : HEADER.size + length])
    body = data[HEADER.size + length :]
    raw = body * (TILE * TILE) if len(body) == 1 else zlib.decompress(body)
    return header, np.frombuffer(raw, dtype=np.int8).reshape(TILE, TILE)


def noise(height: int, width: int, *, seed: int = 0, x: float = 0.0, y: float = 0.0) -> Any:
    """Return a map of walls, free and unknown cells by chance, 0.05 m each."""
    cells = np.random.default_rng(seed).choice(
        np.array([-1, 0, 100], dtype=np.int8), size=(height, width)
    )
    return OccupancyGrid(cells, 0.05, Pose2(x, y, 0.0), "noise")


def texts(messages: list[Any], kind: str) -> list[dict[str, Any]]:
    """Return the JSON messages of a kind."""
    found = [json.loads(message) for message in messages if isinstance(message, str)]
    return [message for message in found if message["type"] == kind]


def tiles(messages: list[Any], layer: str) -> dict[tuple[int, int], npt.NDArray[np.int8]]:
    """Return a map's tiles by row and column; of one that came twice, the last."""
    decoded = [decode_tile(message) for message in messages if isinstance(message, bytes)]
    return {
        (head["row"], head["column"]): cells for head, cells in decoded if head["layer"] == layer
    }


def painted(
    found: dict[tuple[int, int], npt.NDArray[np.int8]], height: int, width: int, at: tuple[int, int]
) -> npt.NDArray[np.int8]:
    """Return the cells that a page shows, (height, width) from a cell of the lattice on."""
    cells = np.full((height, width), -1, dtype=np.int8)
    for row in range(height):
        for column in range(width):
            place = at[0] + row, at[1] + column
            tile = found.get((place[0] // TILE, place[1] // TILE))
            if tile is not None:
                cells[row, column] = tile[place[0] % TILE, place[1] % TILE]
    return cells
