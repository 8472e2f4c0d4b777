"""Scans spread into the cells around their hits, each cell learns once a scan, on every device."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.compute.cell_means import LikelihoodRule
from slamfusion.compute.layout import BEAM_ONE, MOST_OBSERVATIONS, TILE
from tests.support.examples import examples

I32 = npt.NDArray[np.int32]
SEEDS = st.integers(0, 2**32 - 1)
FALLING = np.arange(255, -1, -1).astype(np.uint8)
UNSEEN = 20
MEAN_ONE = 4112
# Squared distances of up to 255 * 2^14 / 2^20 = 4 square cells are told apart.
SHIFT = 14
ROOM = LikelihoodRule(FALLING, SHIFT, 1, 64)
KINDS = ("observed", "states", "field")


class Map:
    """A map of one window of pages on a device."""

    def __init__(self, device: ComputeDevice, pages: I32) -> None:
        self.device, self.pages = device, pages
        shape = (int(pages.max()) + 1, TILE, TILE)
        self.observed = device.upload(np.zeros(shape, dtype=np.uint32))
        self.states = device.upload(np.zeros(shape, dtype=np.uint32))
        self.field = device.upload(np.full(shape, UNSEEN, dtype=np.uint8))
        self.table = device.upload(pages)
        self.wanted = device.upload(np.zeros(1 + pages.size, dtype=np.int32))

    def mark(self, beams: I32, rule: LikelihoodRule = ROOM) -> bool:
        """Mark a scan; whether a page was missing."""
        handle = self.device.upload(beams)
        return self.device.mark_likelihood(self.observed, self.table, handle, rule, self.wanted)

    def fold(self, beams: I32, rule: LikelihoodRule = ROOM) -> None:
        """Fold what was marked."""
        handle = self.device.upload(beams)
        self.device.update_likelihood(
            self.observed, self.states, self.field, self.table, handle, rule
        )

    def cells(self, name: str) -> npt.NDArray[np.int64]:
        """Return a pool as one array."""
        height, width = self.pages.shape
        pool = self.device.download(getattr(self, name))[self.pages]
        return np.asarray(
            pool.transpose(0, 2, 1, 3).reshape(height * TILE, width * TILE), dtype=np.int64
        )

    def pools(self) -> list[npt.NDArray[Any]]:
        """Return all that there is."""
        names = (*KINDS, "wanted")
        return [self.device.download(getattr(self, name)) for name in names]


def own_pages(height: int, width: int) -> I32:
    """Pages that all have a tile of their own."""
    return 1 + np.arange(height * width, dtype=np.int32).reshape(height, width)


def beams_of(*beams: tuple[float, float, float, float]) -> I32:
    """Beams from x, y of their hits and of the laser in cells."""
    return np.round(np.array(beams).reshape(-1, 4) * BEAM_ONE).astype(np.int32)


def random_beams(rng: np.random.Generator, pages: I32, count: int, margin: int) -> I32:
    """Beams that keep ``margin`` cells off the window's border; some hit the laser's own cell."""
    size = np.array(pages.shape[::-1]) * TILE
    ends = margin + rng.random((count, 2)) * (size - 2 * margin)
    laser = margin + rng.random(2) * (size - 2 * margin)
    near = rng.random(count) < 0.1
    ends[near] = np.floor(laser) + rng.random((int(near.sum()), 2))
    # Several beams end in one cell, and some at a cell's very corner.
    ends[rng.random(count) < 0.2] = ends[0]
    ends[rng.random(count) < 0.1] = np.floor(ends[-1])
    return beams_of(*np.column_stack((ends, np.broadcast_to(laser, ends.shape))).tolist())


def value_at(squared_cells: float) -> int:
    """Return what ``FALLING`` says of a squared distance."""
    return 255 - min(255, int(squared_cells * BEAM_ONE**2) >> SHIFT)


def test_one_beam_by_hand(device: ComputeDevice):
    """From the laser in column 26 to a hit in the middle of column 34 of row 9, over two pages."""
    built = Map(device, own_pages(1, 2))
    beams = beams_of((34.5, 9.5, 26.5, 9.5))
    assert not built.mark(beams)
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


def follow_both(
    device: ComputeDevice, seed: int, rule: LikelihoodRule, count: int, scans: int
) -> None:
    """Write scans on a device and with the twins, and compare all there is after each step."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(side) for side in rng.integers(1, 5, 2))
    pages = np.where(rng.random(shape) < 0.8, own_pages(*shape), 0).astype(np.int32)
    pages.flat[0] = pages.size
    ours, twin = Map(device, pages), Map(NumpyDevice(), pages)
    for _ in range(scans):
        beams = random_beams(rng, pages, count, rule.reach + 1)
        assert ours.mark(beams, rule) is twin.mark(beams, rule)
        for a, b in zip(ours.pools(), twin.pools(), strict=True):
            np.testing.assert_array_equal(a, b)
        ours.fold(beams, rule)
        twin.fold(beams, rule)
        for a, b in zip(ours.pools(), twin.pools(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert (twin.states > 0).any()


@given(
    seed=SEEDS,
    shift=st.integers(8, 20),
    reach=st.integers(0, 6),
    most=st.sampled_from((1, 2, 3, 64, MOST_OBSERVATIONS)),
    count=st.integers(1, 80),
)
@settings(max_examples=examples(40), deadline=None)
def test_kernels_equal_their_twins(
    pocl: ComputeDevice, seed: int, shift: int, reach: int, most: int, count: int
):
    follow_both(pocl, seed, LikelihoodRule(FALLING, shift, reach, most), count, 3)


@pytest.mark.parametrize("seed", range(3))
def test_kernels_equal_their_twins_on_every_device(device: ComputeDevice, seed: int):
    follow_both(device, seed, LikelihoodRule(FALLING, 15, 1 + seed, 2 + seed), 12, 2)
