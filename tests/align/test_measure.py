"""The numbers of a motion: shares of walls and of common ground, counted cell by cell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.align.answer import measure
from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from tests.align.definitions import landings, landings_back, look_up, surface_of
from tests.fusion.drawings import building, features_of, random_grid


def shares(points: np.ndarray, landed_on: GridFeatures, landed: np.ndarray) -> list[float]:
    """Walls with a wall within 1.5 cells; in free ground beyond 10 and 4 cells; in known ground."""
    cells = np.asarray(landed_on.grid.cells)
    away2 = np.rint(ndimage.distance_transform_edt(~surface_of(cells)) ** 2)
    free = cells == 0
    fields = (away2 <= 2, free & (away2 > 100), free & (away2 > 16), cells >= 0)
    return [float(look_up(field, landed).sum()) / len(points) for field in fields]


@pytest.mark.parametrize("seed", range(4))
def test_the_numbers_equal_their_definition(device: ComputeDevice, seed: int) -> None:
    ref, mov = (features_of(random_grid(seed + k, 40, 60), device) for k in (0, 70))
    rng = np.random.default_rng(seed)
    motion = np.append(np.array(ref.centre) + rng.uniform(-9, 9, 2), rng.uniform(-3, 3))
    _, found = measure(Pair(ref, mov), motion[None])
    ours, theirs = mov.wall_points / 2.0, ref.wall_points / 2.0
    on_ref = shares(ours, ref, landings(ours, motion, mov.centre))
    on_mov = shares(theirs, mov, landings_back(theirs, motion, mov.centre))
    assert found["wall_match_moving"] == pytest.approx(on_ref[0])
    assert found["wall_match_reference"] == pytest.approx(on_mov[0])
    assert found["wall_match"] == pytest.approx(min(on_ref[0], on_mov[0]))
    assert found["wall_clash"] == pytest.approx(max(on_ref[1], on_mov[1]))
    assert found["wall_clash_near"] == pytest.approx(max(on_ref[2], on_mov[2]))
    assert found["wall_known"] == pytest.approx(min(on_ref[3], on_mov[3]))
    chances = []
    for grid in (ref, mov):
        cells = np.asarray(grid.grid.cells)
        surface = surface_of(cells)
        away2 = np.rint(ndimage.distance_transform_edt(~surface) ** 2)
        chances.append(float((away2 <= 2)[surface | (cells == 0)].mean()))
    assert found["chance"] == pytest.approx(max(chances))
    is_smaller = len(ours) <= len(theirs)
    assert found["explained"] == pytest.approx((on_ref if is_smaller else on_mov)[0])
    assert found["explained_by_chance"] == pytest.approx(chances[0 if is_smaller else 1])
    a, b = np.asarray(ref.grid.cells), np.asarray(mov.grid.cells)
    row, col = np.indices(a.shape)
    middles = np.stack((col.ravel() + 0.5, row.ravel() + 0.5), axis=1)
    under = look_up(b + 1, landings_back(middles, motion, mov.centre)).reshape(a.shape) - 1
    common = ((a >= 0) & (under >= 0)).sum() / min((a >= 0).sum(), (b >= 0).sum())
    assert found["overlap"] == pytest.approx(common)
    assert found["error"] == pytest.approx(math.sqrt(((a.astype(int) - under) ** 2).sum()))


def test_a_map_on_itself_matches_itself(device: ComputeDevice) -> None:
    grid = features_of(building(1), device)
    _, found = measure(Pair(grid, grid), np.array([[*grid.centre, 0.0]]))
    assert found["wall_known"] == found["overlap"] == 1.0
    # But for cells so deep in a thick wall that no surface is within 1.5 cells.
    assert 0.95 < found["wall_match"] <= 1.0
    assert found["wall_clash"] == found["wall_clash_near"] == found["error"] == 0.0
    assert 0.0 < found["chance"] < 1.0
