"""What a map must not be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.config import NormalizeConfig
from slamfusion.fusion.live import limits
from slamfusion.fusion.live.limits import too_large, unusable
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import memory
from tests.fusion.drawings import draw
from tests.fusion.live.maps import noise, three

RULES = NormalizeConfig()


def test_too_few_walls_say_nothing() -> None:
    assert "unknown" in (unusable(draw("   \n   "), RULES) or "")
    assert "23 of the 24" in (unusable(draw("#" * 23 + "."), RULES) or "")
    assert unusable(draw("#" * 24 + "\n" + 2 * ("." * 24 + "\n")), RULES) is None
    assert "0 of the 24" in (unusable(draw("?" * 40), RULES) or "")


def test_a_map_is_at_most_a_thousand_kilometres_long() -> None:
    room = np.zeros((40, 40), dtype=np.int8)
    room[[0, -1], :] = room[:, [0, -1]] = 100
    assert unusable(OccupancyGrid(room, 0.1, Pose2(), "room"), RULES) is None
    far = OccupancyGrid(room, 0.1, Pose2(1e12, 0.0, 0.0), "far")
    assert unusable(far, RULES) is not None
    large = np.zeros((1, 20000), dtype=np.int8)
    assert "at most 1e+06 m long" in (
        unusable(OccupancyGrid(large, 99.0, Pose2(), "x"), RULES) or ""
    )


def test_noise_and_a_map_all_occupied_say_nothing_of_a_place() -> None:
    assert "is it noise?" in (unusable(noise(), RULES) or "")
    full = OccupancyGrid(np.full((80, 80), 100, dtype=np.int8), 0.1, Pose2(), "full")
    assert "all occupied" in (unusable(full, RULES) or "")
    assert unusable(three()["a"], RULES) is None


def test_a_large_map_must_fit_into_memory_at_the_fused_resolution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 10_000_000)
    grid = OccupancyGrid(np.zeros((1000, 1000), dtype=np.int8), 0.1, Pose2(), "big")
    assert too_large(grid, 0.1) is None
    assert "big" in (too_large(grid, 0.02) or "")


# -- both sides of each limit ----------------------------------------------------------------------


def map_of(cells: np.ndarray, resolution: float = 0.1) -> OccupancyGrid:
    return OccupancyGrid(cells.astype(np.int8), resolution, Pose2(), "map")


def test_a_wall_is_what_the_thresholds_say() -> None:
    lines = np.zeros((9, 24))
    for percent, words in ((65, None), (64, "0 of the 24")):
        lines[4] = percent
        found = unusable(map_of(lines), RULES)
        assert found is None if words is None else words in (found or "")
    lines[4] = 64
    assert unusable(map_of(lines), NormalizeConfig(occupied_percent=63.5)) is None
    assert "too few walls" in (unusable(map_of(np.zeros((9, 24))), RULES) or "")
    assert "are unknown" in (unusable(map_of(np.full((9, 24), -1)), RULES) or "")


def test_a_map_is_as_long_as_its_diagonal(monkeypatch: pytest.MonkeyPatch) -> None:
    for width, is_long in ((9_999, False), (10_001, True)):
        found = unusable(map_of(np.zeros((1, width)), 100.0), RULES)
        assert ("at most 1e+06 m long" in (found or "")) is is_long
    monkeypatch.setattr(limits, "LENGTH_MAX_M", 500.0)
    assert "m long" not in (unusable(map_of(np.zeros((30, 40)), 10.0), RULES) or "")
    assert "m long" in (unusable(map_of(np.zeros((30, 41)), 10.0), RULES) or "")


@given(height=st.integers(1, 3000), width=st.integers(1, 1 << 20))
def test_bands_are_all_rows_once_and_fit_the_cache(height: int, width: int) -> None:
    found = limits.bands(height, width)
    assert [row for band in found for row in range(height)[band]] == list(range(height))
    assert all((band.stop - band.start) * width <= max(1 << 18, width) for band in found)


def test_bands_are_as_high_as_the_cache_allows() -> None:
    assert limits.bands(600, 1024) == [slice(0, 256), slice(256, 512), slice(512, 600)]
    assert limits.bands(2, 1 << 19) == [slice(0, 1), slice(1, 2)]


@pytest.mark.parametrize(
    ("rows", "sampled"), [(1, []), (4, []), (5, [3]), (8, [4]), (10, [4]), (12, [4]), (13, [4])]
)
def test_of_a_large_map_four_bands_are_looked_at_before_all_are(
    monkeypatch: pytest.MonkeyPatch, rows: int, sampled: list[int]
) -> None:
    looked: list[int] = []
    count = limits._count

    def counted(cells: np.ndarray, bands: list[slice], thresholds: NormalizeConfig) -> object:
        looked.append(len(bands))
        return count(cells, bands, thresholds)

    monkeypatch.setattr(limits, "_count", counted)
    monkeypatch.setattr(limits, "BAND_CELLS", 1)
    posts = np.zeros((rows, 400))
    posts[:, ::8] = 100
    assert unusable(map_of(posts), RULES) is None
    assert looked == (sampled or [rows])
    looked.clear()
    # All are asked where the sample speaks against it.
    posts[:, ::2] = 100
    assert "noise" in (unusable(map_of(posts), RULES) or "")
    assert looked == [*sampled, rows]


def test_a_sample_that_happens_to_say_nothing_is_overruled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "BAND_CELLS", 400)
    lines = np.zeros((16, 400))
    lines[::4, ::2] = 100
    assert unusable(map_of(lines), RULES) is None


CELLS = st.lists(
    st.lists(st.sampled_from((-1, 0, 1, 25, 26, 50, 64, 65, 66, 100)), min_size=4, max_size=4),
    min_size=1,
    max_size=6,
)


@given(rows=CELLS)
def test_cells_and_steps_are_counted_one_by_one(rows: list[list[int]]) -> None:
    cells = np.array(rows, dtype=np.int8)
    walls = {(r, c) for r, c in np.ndindex(cells.shape) if cells[r, c] >= 65}
    free = {(r, c) for r, c in np.ndindex(cells.shape) if 0 <= cells[r, c] <= 25}
    pairs = [((r, c), (r + 1, c)) for r in range(len(rows) - 1) for c in range(4)]
    pairs += [((r, c), (r, c + 1)) for r in range(len(rows)) for c in range(3)]
    steps = [pair for pair in pairs if len(walls & {*pair}) == 1]
    found = limits._count(cells, [slice(0, len(rows))], RULES)
    assert found == limits._Texture(
        walls=len(walls),
        free=len(free),
        cells=cells.size,
        steps=len(steps),
        steps_to_free=sum(len(free & {*pair}) == 1 for pair in steps),
    )
    assert limits._count(cells, [], RULES) == limits._Texture(0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("walls", "free", "steps_to_free", "steps", "words"),
    [
        # Fewer steps than the fewest walls, or than a thousandth of the walls.
        (1000, 9000, 24, 0, None),
        (1000, 9000, 23, 9000, "all occupied"),
        (100_000, 900_000, 100, 0, None),
        (100_000, 900_000, 99, 9000, "all occupied"),
        # More than two steps for five known cells.
        (300, 700, 400, 0, None),
        (300, 700, 401, 0, "0.40 steps"),
        # Less free than a hundredth of the walls: unknown stands for it; of 500 000 cells.
        (100_000, 1000, 0, 5000, "all occupied"),
        (100_000, 999, 0, 5000, None),
        (100_000, 999, 50_000, 99, "all occupied"),
        (100_000, 999, 0, 200_000, None),
        (100_000, 999, 0, 200_001, "noise"),
        (100_000, 1000, 40_401, 0, "noise"),
        (100_000, 1000, 40_400, 0, None),
    ],
)
def test_what_the_counts_of_a_place_may_be(
    walls: int, free: int, steps_to_free: int, steps: int, words: str | None
) -> None:
    found = limits._verdict(limits._Texture(walls, free, 500_000, steps_to_free, steps))
    assert found is None if words is None else words in (found or "")


@given(
    walls=st.integers(24, 10_000),
    free=st.integers(0, 100_000),
    steps=st.integers(24, 9000),
    more=st.integers(0, 1000),
)
def test_more_free_cells_never_make_noise_of_a_place(
    walls: int, free: int, steps: int, more: int
) -> None:
    def is_noise(count: int) -> bool:
        found = limits._Texture(walls, count, walls + count, steps, steps)
        return "noise" in (limits._verdict(found) or "")

    assert is_noise(free) >= is_noise(free + more)


@pytest.mark.parametrize(
    ("shape", "resolution", "cells"),
    [
        ((2048, 2048), 0.1, None),
        ((2048, 2049), 0.1, 2048 * 2049),
        # Brought to coarser cells it is still held as it came.
        ((2048, 2048), 0.4, None),
        ((2048, 2049), 0.4, 2048 * 2049),
        ((1024, 1024), 0.05, None),
        ((1024, 1025), 0.05, 4 * 1024 * 1025),
    ],
)
def test_a_map_of_more_than_four_million_cells_must_fit_into_memory(
    monkeypatch: pytest.MonkeyPatch,
    shape: tuple[int, int],
    resolution: float,
    cells: int | None,
) -> None:
    grid = map_of(np.zeros(shape))
    room = 0 if cells is None else 12 * cells
    monkeypatch.setattr(memory, "available_memory", lambda: room)
    assert too_large(grid, resolution) is None
    monkeypatch.setattr(memory, "available_memory", lambda: room - 1)
    assert (too_large(grid, resolution) is None) is (cells is None)
