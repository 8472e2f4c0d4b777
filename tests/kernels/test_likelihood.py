"""Scans spread into the cells around their hits, each cell learns once a scan, on every device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.cell_means import LikelihoodRule
from slamfusion.compute.layout import BEAM_ONE, TILE
from slamfusion.geometry import I32

FALLING = np.arange(255, -1, -1).astype(np.uint8)
UNSEEN = 20
MEAN_ONE = 4112
# Squared distances of up to 255 * 2^14 / 2^20 = 4 square cells are told apart.
SHIFT = 14
ROOM = LikelihoodRule(FALLING, SHIFT, 1, 64)


class Map:
    """A map of one window of pages on a device."""

    def __init__(self, device: ComputeDevice, pages: I32) -> None:
        self.device, self.pages = device, pages
        shape = (int(pages.max()) + 1, TILE, TILE)
        self.pools = {
            "observed": device.upload(np.zeros(shape, dtype=np.uint32)),
            "states": device.upload(np.zeros(shape, dtype=np.uint32)),
            "field": device.upload(np.full(shape, UNSEEN, dtype=np.uint8)),
        }
        self.table = device.upload(pages)
        self.wanted = device.upload(np.zeros_like(pages))

    def mark(self, beams: I32, rule: LikelihoodRule = ROOM) -> npt.NDArray[np.bool_]:
        """Mark a scan; which beams met a page without a tile."""
        handle = self.device.upload(beams)
        return self.device.mark_scan(self.pools, self.table, handle, rule, self.wanted)

    def fold(self, beams: I32, rule: LikelihoodRule = ROOM) -> None:
        """Fold what was marked."""
        handle = self.device.upload(beams)
        self.device.integrate_scan(self.pools, self.table, handle, rule)

    def cells(self, name: str) -> npt.NDArray[np.int64]:
        """Return a pool as one array."""
        height, width = self.pages.shape
        pool = self.device.download(self.pools[name])[self.pages]
        return np.asarray(
            pool.transpose(0, 2, 1, 3).reshape(height * TILE, width * TILE), dtype=np.int64
        )


def own_pages(height: int, width: int) -> I32:
    """Pages that all have a tile of their own."""
    return 1 + np.arange(height * width, dtype=np.int32).reshape(height, width)


def beams_of(*beams: tuple[float, float, float, float]) -> I32:
    """Beams from x, y of their hits and of the laser in cells."""
    return np.round(np.array(beams).reshape(-1, 4) * BEAM_ONE).astype(np.int32)


def value_at(squared_cells: float) -> int:
    """Return what ``FALLING`` says of a squared distance."""
    return 255 - min(255, int(squared_cells * BEAM_ONE**2) >> SHIFT)


def test_one_beam_by_hand(device: ComputeDevice):
    """From the laser in column 26 to a hit in the middle of column 34 of row 9, over two pages."""
    built = Map(device, own_pages(1, 2))
    beams = beams_of((34.5, 9.5, 26.5, 9.5))
    assert not built.mark(beams).any()
    words = np.zeros((TILE, 2 * TILE), dtype=np.int64)
    words[9, 26:33] = 1  # passed, the laser's cell too
    words[8:11, 33:36] = value_at(2.0) << 1 | 1
    words[9, 33:36] = words[8:11, 34] = value_at(1.0) << 1 | 1
    words[9, 34] = 255 << 1 | 1
    np.testing.assert_array_equal(built.cells("observed"), words)
    built.fold(beams)
    seen = words > 0
    np.testing.assert_array_equal(built.cells("field"), np.where(seen, words >> 1, UNSEEN))
    wanted = np.where(seen, ((words >> 1) * MEAN_ONE) << 12 | 1, 0)
    np.testing.assert_array_equal(built.cells("states"), wanted)
    assert not built.cells("observed").any()
