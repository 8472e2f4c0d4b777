"""Fields of many maps: released where they are too many, and the same when they are made again."""

from __future__ import annotations

import weakref

import pytest

from slamfusion.align.features import FieldMemory, GridFeatures
from slamfusion.align.normalize import NormalizedGrid, normalize_grid
from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig
from tests.fusion.drawings import building

SIZE = 0.1


def maps(count: int, device: ComputeDevice) -> list[NormalizedGrid]:
    grids = (building(seed, 8.0, 7.0, SIZE) for seed in range(count))
    return [normalize_grid(grid, SIZE, NormalizeConfig(), device) for grid in grids]


@pytest.mark.parametrize(("share", "kept"), [(0.0, [2, 3, 4, 5]), (5.5 / 6, [1, 2, 3, 4, 5])])
def test_maps_looked_at_last_keep_their_fields(
    device: ComputeDevice, share: float, kept: list[int]
) -> None:
    grids = maps(6, device)
    cells = sum(grid.cells.size for grid in grids)
    memory = FieldMemory(int(share * cells))
    features = [GridFeatures(grid, device, memory) for grid in grids]
    fields = [weakref.ref(item.level(1)) for item in features]
    # Room is made before a map is looked at, and it is one of those that stay.
    assert [n for n, field in enumerate(fields) if field() is not None] == kept
    features[3].level(1)
    features[0].level(2)
    features[1].level(2)
    assert fields[3]() is not None
    memory.clear()
    assert not any(field() for field in fields)


def test_a_map_that_was_let_go_of_takes_no_other_map_s_room(device: ComputeDevice) -> None:
    grids = maps(6, device)
    memory = FieldMemory(sum(grid.cells.size for grid in grids) - grids[4].cells.size)
    features = [GridFeatures(grid, device, memory) for grid in grids]
    fields = [weakref.ref(item.level(1)) for item in features[:-1]]
    features[4].release()
    fields.append(weakref.ref(features[5].level(1)))
    assert [n for n, field in enumerate(fields) if field() is not None] == [0, 1, 2, 3, 5]


def test_what_is_made_again_is_the_same(device: ComputeDevice) -> None:
    (grid,) = maps(1, device)
    features, whole = GridFeatures(grid, device), GridFeatures(grid, device)

    def looked_at(item: GridFeatures) -> list[object]:
        arrays = (
            item.cells, item.distances(1, solid=True, everywhere=False),
            item.distances(2, solid=False, everywhere=True), item.field(2, 0.75, 191, 0.0)[1],
            item.piece_words(1.5)[1],
            *item.pieces(0.1, 500), item.wall_places(2, 40), item.wall_planes(2, 40).planes,
        )  # fmt: skip
        own = (item.level(2).points, item.wall_points)
        return [*(device.download(array).tolist() for array in arrays), *(a.tolist() for a in own)]

    before = looked_at(features)
    features.release()
    assert looked_at(features) == before == looked_at(whole)
