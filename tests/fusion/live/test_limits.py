"""What a map must not be."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.config import NormalizeConfig
from slamfusion.fusion.live.inputs import too_large, unusable
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import files
from tests.fusion.drawings import draw

RULES = NormalizeConfig()


def test_too_few_walls_say_nothing() -> None:
    assert "unknown" in (unusable(draw("   \n   "), RULES) or "")
    assert "23 of the 24" in (unusable(draw("#" * 23 + "."), RULES) or "")
    assert unusable(draw("#" * 24 + "\n" + 2 * ("." * 24 + "\n")), RULES) is None
    assert "0 of the 24" in (unusable(draw("?" * 40), RULES) or "")


def test_a_large_map_must_fit_into_memory_at_the_fused_resolution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(files, "available_memory", lambda: 10_000_000)
    grid = OccupancyGrid(np.zeros((1000, 1000), dtype=np.int8), 0.1, Pose2(), "big")
    assert too_large(grid, 0.1) is None
    assert "big" in (too_large(grid, 0.02) or "")


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
