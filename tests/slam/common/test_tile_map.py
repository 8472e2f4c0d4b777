"""The map of tiles grows where it is written, and nothing is lost when its window moves."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, NumpyDevice, open_device
from slamfusion.compute.cell_means import LikelihoodRule, ScanRule
from slamfusion.compute.layout import BEAM_ONE, TILE, UNSEEN
from slamfusion.config import CellModel
from slamfusion.errors import MemoryBudgetError
from slamfusion.slam.common.tile_map import TileMap
from slamfusion.slam.tinyslam.slam import cell_value

POOLS = {
    "observed": (np.uint32, 0),
    "valley": (np.uint32, UNSEEN),
    "published": (np.uint32, UNSEEN),
    "field": (np.uint8, 7),
}
RULE = ScanRule(
    half_blur=0,
    behind=2048,
    free=41,
    map_free=41,
    quality=1024,
    is_mean=True,
    wall_floor=367002,
    wall_gain=425,
)


@pytest.fixture(params=["numpy", "auto"])
def device(request: pytest.FixtureRequest) -> ComputeDevice:
    return open_device(request.param)


def write(tiles: TileMap, hit: tuple[float, float], rule: ScanRule = RULE) -> None:
    """Write one beam from the anchor's cell to a hit, in cells from the anchor."""
    ends = np.array([[hit[0] + 0.5, hit[1] + 0.5], [0.5, 0.5]])
    length = np.hypot(*(ends[0] - ends[1])) * BEAM_ONE
    tiles.write(ends[:1], ends[1], rule, length, 3890)


def seen(tiles: TileMap) -> set[tuple[int, int]]:
    """Return the columns and rows, from the anchor, of the cells that were observed."""
    states, first = tiles.cells("published")
    rows, cols = np.nonzero(states & 4095)
    return set(zip((cols + first[0]).tolist(), (rows + first[1]).tolist(), strict=True))


def test_cells_stay_where_they_are_while_the_window_grows(device: ComputeDevice):
    tiles = TileMap(device, POOLS)
    wanted: set[tuple[int, int]] = set()
    for hit in ((9, 0), (-200, 0), (0, 333), (0, -1000), (5000, 0)):
        write(tiles, hit)
        x, y = (np.linspace(0, end, max(map(abs, hit)) + 1).astype(int) for end in hit)
        wanted |= set(zip(x.tolist(), y.tolist(), strict=True))
        assert seen(tiles) == wanted


def test_memory_follows_the_beams_and_not_the_box(device: ComputeDevice):
    tiles = TileMap(device, POOLS)
    write(tiles, (3200, 0))
    write(tiles, (0, 3200))
    assert tiles.tiles == 1 + 2 * (3200 // TILE) + 1
    assert tiles.memory_bytes < 3e6  # the box would take 133 MB


def test_an_absurd_size_is_refused_in_words():
    tiles = TileMap(NumpyDevice(), POOLS)
    with pytest.raises(MemoryBudgetError, match="use a coarser cell"):
        tiles.cover(np.array([0.0, 0.0]), np.array([1e7, 1e7]))


@pytest.mark.parametrize(("model", "quality"), [("base", 0.2), ("mean", 1.0), ("mean", 0.3)])
def test_cells_follow_the_paper_s_models(device: ComputeDevice, model: CellModel, quality: float):
    """A cell that is hit and passed in turns holds what [H16]'s formulas say."""
    tiles = TileMap(device, POOLS)
    rule = RULE._replace(quality=round(1024 * quality), is_mean=model == "mean")
    told = []
    for hit in (True, True, False, True, False, False, False, True, False):
        write(tiles, (6, 0) if hit else (20, 0), rule)
        told.append(0.95 if hit else 0.01)
        states, first = tiles.cells("published")
        found = int(states[-first[1], 6 - first[0]] >> 12) / 2**20
        assert found == pytest.approx(cell_value(model, told, quality), abs=1e-3)


def test_a_valley_slopes_to_both_sides_of_a_hit(device: ComputeDevice):
    tiles = TileMap(device, POOLS)
    write(tiles, (20, 0), RULE._replace(half_blur=6 * BEAM_ONE, free=800))
    states, first = tiles.cells("valley")
    row = (states[-first[1], -first[0] :] >> 12).astype(float) / 2**20
    peak, free = 3890 / 4096, 800 / 4096
    assert row[20] == pytest.approx(peak, abs=1e-3)
    for away in range(1, 6):
        wanted = free + (peak - free) * (1.0 - away / 6.0)
        assert row[20 - away] == pytest.approx(wanted, abs=2e-3)
        behind = max(0.5, wanted)  # what is hardly a wall is not written there
        assert row[20 + away] == pytest.approx(behind, abs=2e-3)
    assert row[3] == pytest.approx(free, abs=1e-3)
    assert max(col for col, _ in seen(tiles)) == 20  # the published map knows nothing behind


def test_a_window_of_the_field_follows_what_is_written(device: ComputeDevice):
    tiles = TileMap(device, POOLS)
    write(tiles, (80, 9))
    low, high = [150.0, 140.0], [170.0, 190.0]
    window = tiles.window(low, high)
    write(tiles, (70, 20))
    write(tiles, (10, -9))
    assert tiles.window(low, high) is window
    cells, (x, y) = device.download(window.cells), window.first
    whole = device.field_window(tiles.pools["field"], tiles.page_tables, (0, 0), (9999, 9999))
    height, width = cells.shape
    wanted = device.download(whole.cells)[y : y + height, x : x + width]
    np.testing.assert_array_equal(cells, wanted)
    assert len(np.unique(wanted)) > 1


def test_a_likelihood_spreads_around_a_hit_and_is_nothing_where_a_beam_passed(
    device: ComputeDevice,
):
    """From the laser in column 26 to a hit in the middle of column 34 of row 9, over two pages."""
    kinds = {"observed": (np.uint32, 0), "states": (np.uint32, 0), "field": (np.uint8, 20)}
    tiles, ends = TileMap(device, kinds), np.array([(34.5, 9.5), (26.5, 9.5)])
    # A square cell is 64 steps of the table.
    rule = LikelihoodRule(np.arange(255, -1, -1).astype(np.uint8), shift=14, reach=1, most=64)
    tiles.write(ends[:1], ends[1], rule)
    values = np.full((TILE, 2 * TILE), -1)
    values[9, 26:33] = 0  # passed, the laser's cell too
    values[8:11, 33:36] = 255 - 2 * 64
    values[9, 33:36] = values[8:11, 34] = 255 - 64
    values[9, 34] = 255
    seen = values >= 0
    for name, wanted in (
        ("observed", 0 * values),
        ("states", np.where(seen, values * 4112 << 12 | 1, 0)),
        ("field", np.where(seen, values, 20)),
    ):
        np.testing.assert_array_equal(tiles.cells(name)[0], wanted)
