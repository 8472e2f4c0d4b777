"""What a map must not be."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.config import NormalizeConfig
from slamfusion.fusion.live.limits import odd_resolution, odd_resolutions, too_large, unusable
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


@pytest.mark.parametrize("ratio", [15.9, 16.1])
def test_cells_may_be_sixteen_times_coarser_or_finer(ratio: float) -> None:
    is_odd = ratio > 16.0
    assert (odd_resolution(0.05 * ratio, 0.05) is not None) is is_odd
    assert (odd_resolution(0.05 / ratio, 0.05) is not None) is is_odd
    found = odd_resolutions({"a": 0.05, "b": 0.05 * ratio, "c": 0.05})
    assert list(found) == (["b"] if is_odd else [])
    assert odd_resolutions({}) == {}


def test_of_two_the_coarser_is_typical() -> None:
    found = odd_resolutions({"fine": 0.01, "coarse": 1.0})
    assert list(found) == ["fine"]
    assert "finer than those of the others (1 m)" in found["fine"]


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
