"""Beams count where they pass, and the score field is what the counts say, on every device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.compute.hit_counts import BeamScan, FieldRule
from slamfusion.compute.layout import MOST_BEAMS, MOST_REACH, PAIRS, TILE
from slamfusion.geometry import I32
from tests.support.examples import examples
from tests.support.score_fields import score_field_of

Pools = list[Any]
SEEDS = st.integers(0, 2**32 - 1)
KINDS = ((np.uint32, TILE), (np.uint32, TILE), (np.uint16, PAIRS))
FALLING = np.arange(255, -1, -1).astype(np.uint8)


def scan_of(
    *ends: tuple[float, float],
    laser: tuple[float, float] = (0.0, 0.0),
    poses: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 0.0),),
    is_hit: bool = True,
) -> BeamScan:
    """A scan from beam ends, the laser and poses (x, y in cells, yaw in rad)."""
    table = np.array(poses, dtype=np.float64)
    turned = (np.cos(table[:, 2]), np.sin(table[:, 2]))
    return BeamScan(
        np.array(ends, dtype=np.float32).reshape(-1, 2),
        np.full(len(ends), is_hit, dtype=np.uint8),
        np.array(laser, dtype=np.float32),
        np.column_stack((table[:, :2], *turned)).astype(np.float32),
    )


def pools_of(device: ComputeDevice, tiles: int) -> Pools:
    """Counts, sums and field of unseen tiles."""
    return [device.upload(np.zeros((tiles, TILE, cols), dtype=kind)) for kind, cols in KINDS]


def own_pages(maps: int, height: int, width: int) -> I32:
    """Pages that all have a tile of their own."""
    return 1 + np.arange(maps * height * width, dtype=np.int32).reshape(maps, height, width)


def joined(pool: npt.NDArray[Any], pages: I32) -> npt.NDArray[Any]:
    """The cells of one map; of pairs the cells' own values."""
    height, width = pages.shape
    cells = pool[pages][..., :TILE]
    cells = cells & 255 if pool.dtype == np.uint16 else cells
    return cells.transpose(0, 2, 1, 3).reshape(height * TILE, width * TILE)


def count_into(
    device: ComputeDevice, pages: I32, *scans: BeamScan
) -> tuple[list[npt.NDArray[Any]], list[bool]]:
    """Count scans in unseen maps; counts and sums, and what each count returned."""
    pools = pools_of(device, int(pages.max()) + 1)
    table, touched = device.upload(pages), np.zeros(pages.shape, dtype=np.uint8)
    rule = FieldRule(FALLING, shift=8, reach=1, occupied=16384, least_hits=1)
    full = [
        device.count_and_settle(pools[0], pools[1], pools[2], table, touched, scan, rule)
        for scan in scans
    ]
    return [device.download(pool) for pool in pools[:2]], full


class CopiedTiles:
    """Maps that share tiles until one writes: what a user of these operations does between them."""

    def __init__(self, device: ComputeDevice, pages: I32, tiles: int) -> None:
        self.device, self.pages = device, pages
        self.pools = pools_of(device, tiles)
        self.used = int(pages.max()) + 1

    def write(self, scan: BeamScan, rule: FieldRule) -> None:
        """Give every touched page a fresh tile, count, and settle."""
        device = self.device
        touched = device.touch_pages(device.upload(self.pages), scan, rule.reach + 1)
        targets = self.used + np.arange(touched.sum())
        pairs = np.column_stack((self.pages[touched != 0], targets)).astype(np.int32)
        device.copy_tiles(tuple(self.pools), pairs)
        self.pages[touched != 0] = targets
        self.used += len(targets)
        table = device.upload(self.pages)
        counts, sums, field = self.pools
        assert not device.count_and_settle(counts, sums, field, table, touched, scan, rule)


def random_scan(rng: np.random.Generator, size: int, beams: int, maps: int) -> BeamScan:
    """A scan that stays inside a square window of ``size`` cells, and leaves its rim of a page."""
    reach = size / 2 - TILE - 5.0
    angles, ranges = rng.uniform(-math.pi, math.pi, beams), reach * rng.uniform(0.0, 1.0, beams)
    ends = ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
    yaw = rng.uniform(-math.pi, math.pi, maps)
    places = size / 2 + rng.uniform(-3.0, 3.0, (maps, 2))
    return BeamScan(
        ends.astype(np.float32),
        (rng.random(beams) < 0.8).astype(np.uint8),
        rng.uniform(-1.0, 1.0, 2).astype(np.float32),
        np.column_stack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32),
    )


def test_one_beam_by_hand(device: ComputeDevice):
    # Turned by 90 degrees: laser (1, 0) stands at (40.5, 11.5), end (5, 2) at (38.5, 15.5).
    scan = scan_of((5.0, 2.0), laser=(1.0, 0.0), poses=[(40.5, 10.5, math.pi / 2)])
    (counts, sums), full = count_into(device, own_pages(1, 1, 2), scan)
    cells = joined(counts, own_pages(1, 1, 2)[0])
    # A row down is half a column to the right, and a cell owns its left edge.
    wanted = np.zeros_like(cells)
    wanted[15, 38] = 1 << 16 | 1
    wanted[14, 39] = wanted[13, 39] = wanted[12, 40] = wanted[11, 40] = 1
    np.testing.assert_array_equal(cells, wanted)
    assert full == [False]
    assert sums[2, 15, 38 - TILE] == sums.sum() == 8 << 16 | 8


def test_nothing_flows_over_where_all_beams_of_two_scans_end(device: ComputeDevice):
    """A cell that is nearly full gets the largest scan, with the greatest offsets there are."""
    table = device.upload(own_pages(1, 1, 1))
    scan = scan_of(*[(0.49, 0.49)] * MOST_BEAMS, poses=[(20.5, 20.5, 0.0)])
    pools = pools_of(device, 2)
    rule = FieldRule(FALLING, shift=8, reach=1, occupied=16384, least_hits=1)
    touched = device.touch_pages(table, scan, rule.reach + 1)
    hits = 0
    for is_full in (False, True):
        found = device.count_and_settle(pools[0], pools[1], pools[2], table, touched, scan, rule)
        assert found is is_full
        hits += MOST_BEAMS
        counts, sums = (device.download(pool) for pool in pools[:2])
        assert counts[1, 20, 20] == counts.sum() == hits << 16 | hits
        assert sums[1, 20, 20] == sums.sum() == 15 * hits << 16 | 15 * hits
    # And its mean is still the middle of the last sixteenth of the cell: 8 + 240 of 256.
    assert device.download(pools[2])[1, 20, 20] & 255 == 255 - 2 * 120 * 120 // 256


@given(seed=SEEDS, reach=st.integers(0, 16))
@settings(max_examples=examples(25), deadline=None)
def test_touched_pages_are_those_of_the_counted_cells_and_their_surroundings(
    pocl: ComputeDevice, seed: int, reach: int
):
    rng = np.random.default_rng(seed)
    pages = own_pages(2, 6, 6)
    scan = random_scan(rng, 6 * TILE, 3, 2)
    (counts, _), _ = count_into(NumpyDevice(), pages, scan)
    wanted = np.zeros(pages.shape, dtype=np.uint8)
    for own, out in zip(pages, wanted, strict=True):
        for row, col in np.argwhere(joined(counts, own)):
            rows = slice(max(0, row - reach) // TILE, (row + reach) // TILE + 1)
            out[rows, max(0, col - reach) // TILE : (col + reach) // TILE + 1] = 1
    np.testing.assert_array_equal(pocl.touch_pages(pocl.upload(pages), scan, reach), wanted)


def settled(device: ComputeDevice, rule: FieldRule, *scans: BeamScan) -> npt.NDArray[Any]:
    """Count and settle scans in one map of two pages; its field."""
    maps = CopiedTiles(device, np.zeros((1, 1, 2), dtype=np.int32), 40)
    for scan in scans:
        maps.write(scan, rule)
    return joined(device.download(maps.pools[2]), maps.pages[0])


def test_field_of_one_hit_by_hand(device: ComputeDevice):
    # The mean of the hits lies a quarter of a cell left of the middle of cell (row 9, col 32); on
    # both axes a hit counts as in the middle of its sixteenth.
    rule = FieldRule(FALLING, shift=11, reach=1, occupied=16384, least_hits=2)
    scans = [
        scan_of((end, 0.5), laser=(-10.0, 0.5), poses=[(20.0, 9.0, 0.0)]) for end in (12.0, 12.5)
    ]
    wanted = np.zeros((TILE, 2 * TILE), dtype=np.int64)
    for row in (8, 9, 10):
        for col in (31, 32, 33):
            along, across = 256 * (9 - row) + 8, 256 * (32 - col) - 64 + 8
            wanted[row, col] = 255 - (along * along + across * across) // 2048
    assert wanted.max() == 254
    np.testing.assert_array_equal(settled(device, rule, *scans), wanted)
    # One hit is too few.
    assert not settled(device, rule, scans[0]).any()


@given(
    seed=SEEDS,
    reach=st.integers(0, MOST_REACH),
    occupied=st.sampled_from((0, 16384, 40000)),
    least_hits=st.integers(1, 2),
)
@settings(max_examples=examples(20), deadline=None)
def test_field_is_that_of_the_counts_everywhere(
    pocl: ComputeDevice, seed: int, reach: int, occupied: int, least_hits: int
):
    rng = np.random.default_rng(seed)
    rule = FieldRule(FALLING, 12, reach, occupied, least_hits)
    maps, side = 3, 6
    tiles = CopiedTiles(pocl, np.zeros((maps, side, side), dtype=np.int32), 1200)
    twin = CopiedTiles(NumpyDevice(), np.zeros((maps, side, side), dtype=np.int32), 1200)
    for _ in range(6):
        scan = random_scan(rng, side * TILE, 60, maps)
        tiles.write(scan, rule)
        twin.write(scan, rule)
        # Some particles die, others live on twice.
        parents = rng.integers(0, maps, maps)
        tiles.pages, twin.pages = tiles.pages[parents], twin.pages[parents]
    pools = [pocl.download(pool) for pool in tiles.pools]
    for own, other in zip(pools, twin.pools, strict=True):
        np.testing.assert_array_equal(own, other)
    assert pools[2].any()
    for pages in tiles.pages:
        counts, sums, field = (joined(pool, pages) for pool in pools)
        np.testing.assert_array_equal(field, score_field_of(counts, sums, rule))
        # A tile repeats the cells above it and behind it.
        more = np.pad(field, ((0, 1), (0, 1))).astype(np.uint16)
        whole = more[:-1] | more[1:] << 8
        for row, col in np.argwhere(pages):
            top, left = row * TILE, col * TILE
            np.testing.assert_array_equal(
                pools[2][pages[row, col]], whole[top : top + TILE, left : left + PAIRS]
            )
