"""The drawn building: seeded, closed, free inside, unlike itself under any turn."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.grid import FREE, OCCUPIED, UNKNOWN
from slamfusion.sim import draw_building


@pytest.mark.parametrize("resolution", [0.04, 0.05, 0.1])
def test_size_is_the_asked_one_in_metres(resolution: float) -> None:
    grid = draw_building(np.random.default_rng(0), 14.0, 9.0, resolution)
    assert grid.width == pytest.approx(14.0 / resolution, abs=1)
    assert grid.height == pytest.approx(9.0 / resolution, abs=1)


def test_has_free_rooms_walls_and_an_unknown_outside() -> None:
    grid = draw_building(np.random.default_rng(1), 16.0, 11.0)
    share = {value: float(np.mean(grid.cells == value)) for value in (FREE, OCCUPIED, UNKNOWN)}
    assert share[FREE] > 0.6
    assert 0.02 < share[OCCUPIED] < 0.2
    assert share[UNKNOWN] > 0.03
    row, col = grid.cell_indices(np.zeros(2))
    assert grid.cells[row, col] == FREE, "the map frame's zero is a free place in the corridor"


@pytest.mark.parametrize("seed", range(5))
def test_free_cells_never_touch_the_outside(seed: int) -> None:
    cells = np.pad(draw_building(np.random.default_rng(seed), 18.0, 12.0).cells, 1, mode="edge")
    assert not np.any(cells[[0, -1]] == FREE)
    assert not np.any(cells[:, [0, -1]] == FREE)
