"""Maps that share tiles hold what full copies hold, cell for cell, and copy as little as can be."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.compute.layout import TILE
from slamfusion.slam.common.tile_map import MARGIN, SharedTileMaps
from tests.support.examples import examples

POOLS = {"counts": np.uint32, "field": np.uint8}
MAPS = 4
# The full copies hold so many pages on either side of the anchor.
HALF_PAGES = 5
SIDE = 2 * HALF_PAGES * TILE


@pytest.fixture(scope="module", params=["numpy", "auto"])
def device(request: pytest.FixtureRequest) -> ComputeDevice:
    return open_device(request.param)


class Full:
    """N maps, each with arrays of its own; the tiles of page (0, 0) begin at the anchor."""

    def __init__(self, count: int = MAPS) -> None:
        self.cells = {name: np.zeros((count, SIDE, SIDE), kind) for name, kind in POOLS.items()}

    def take_over(self, parents: npt.NDArray[np.int64]) -> None:
        self.cells = {name: cells[parents].copy() for name, cells in self.cells.items()}


class Pair:
    """Shared maps and full copies that get the same orders."""

    def __init__(self, device: ComputeDevice, count: int = MAPS) -> None:
        self.device = device
        empty = {name: np.zeros((TILE, TILE), kind) for name, kind in POOLS.items()}
        self.shared = SharedTileMaps(self.device, count, empty)
        self.full = Full(count)

    def cover(self, low: tuple[int, int], high: tuple[int, int]) -> None:
        """Make room for a box of pages, counted from the anchor."""
        self.shared.cover(np.array(low) * float(TILE), (np.array(high) + 1.0) * TILE - 1.0)

    def write(self, pages: list[tuple[int, int, int]], rng: np.random.Generator) -> None:
        """Write one random cell on each of some pages: map, column and row from the anchor."""
        shared = self.shared
        places = [
            (index, row - int(shared.corner[1]), col - int(shared.corner[0]))
            for index, col, row in pages
        ]
        written = np.zeros(shared.pages.shape, dtype=np.bool_)
        for place in places:
            written[place] = True
        shared.make_writable(written)
        cells = rng.integers(0, TILE, (len(pages), 2))
        values = rng.integers(1, 256, len(pages))
        for name in POOLS:
            pool = self.device.download(shared.pools[name]).copy()
            for (index, col, row), place, (up, right), value in zip(
                pages, places, cells, values, strict=True
            ):
                tile = shared.pages[place]
                pool[tile, up, right] = value.astype(pool.dtype)
                at = ((row + HALF_PAGES) * TILE + up, (col + HALF_PAGES) * TILE + right)
                self.full.cells[name][(index, *at)] = value.astype(pool.dtype)
            shared.pools[name] = self.device.upload(pool)

    def take_over(self, parents: list[int]) -> None:
        chosen = np.array(parents)
        self.shared.take_over(chosen)
        self.full.take_over(chosen)

    def check(self) -> None:
        """Every map equals its full copy, and the books are right."""
        shared = self.shared
        for name in POOLS:
            for index, wanted in enumerate(self.full.cells[name]):
                found = np.zeros_like(wanted)
                values, (col, row) = shared.cells(name, index)
                rows, cols = np.nonzero(values)
                at = rows + int(row) + HALF_PAGES * TILE, cols + int(col) + HALF_PAGES * TILE
                found[at] = values[rows, cols]
                np.testing.assert_array_equal(found, wanted)
            assert not self.device.download(shared.pools[name])[0].any()
        users = np.bincount(shared.pages.ravel())
        assert shared.owned_and_shared == ((users[1:] == 1).sum(), (users[1:] > 1).sum())
        np.testing.assert_array_equal(self.device.download(shared.page_tables), shared.pages)
        for index, pages in enumerate(shared.pages):
            np.testing.assert_array_equal(self.device.download(shared.page_table(index)), pages)


# Pages that a program may write to, so that the window's margin stays inside the full copies.
inner = st.integers(-HALF_PAGES + MARGIN, HALF_PAGES - 1 - MARGIN)
maps = st.integers(0, MAPS - 1)
steps = st.one_of(
    st.tuples(st.just("cover"), st.tuples(inner, inner), st.tuples(inner, inner)),
    st.tuples(
        st.just("write"),
        st.lists(st.tuples(maps, inner, inner), min_size=1, max_size=12, unique=True),
    ),
    st.tuples(st.just("take over"), st.lists(maps, min_size=MAPS, max_size=MAPS)),
)


@settings(
    max_examples=examples(25),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(program=st.lists(steps, max_size=10), seed=st.integers(0, 2**32 - 1))
def test_any_program_leaves_what_full_copies_hold(
    device: ComputeDevice, program: list[tuple[Any, ...]], seed: int
):
    pair, rng = Pair(device), np.random.default_rng(seed)
    for order, *what in program:
        if order == "cover":
            first, second = what
            low, high = zip(
                *(sorted(axis) for axis in zip(first, second, strict=True)), strict=True
            )
            pair.cover(low, high)
        elif order == "write":
            columns, rows = ([page[axis] for page in what[0]] for axis in (1, 2))
            pair.cover((min(columns), min(rows)), (max(columns), max(rows)))
            pair.write(what[0], rng)
        else:
            pair.take_over(what[0])
        pair.check()


def test_the_memory_of_tiles_that_stay_unused_is_returned(device: ComputeDevice):
    if device.opencl is None or not device.opencl.shares_memory:
        pytest.skip("only memory of the host can be returned")
    pages = 64
    shared = SharedTileMaps(device, 2, {"counts": np.zeros((TILE, TILE), np.uint32)})
    shared.cover(np.zeros(2), np.full(2, pages * TILE - 1.0))
    shared.make_writable(np.ones(shared.pages.shape, dtype=np.bool_))
    device.download(shared.pools["counts"])  # all are written
    process, unused = psutil.Process(), shared.pages[1].size * TILE * TILE * 4
    before = process.memory_info().rss
    for _ in range(2):
        shared.take_over(np.zeros(2, dtype=np.int64))
    assert before - process.memory_info().rss > 0.9 * unused
