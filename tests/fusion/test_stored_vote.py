"""A vote of tiles that are decided alone is the vote in memory, bit for bit."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.align.normalize import normalize_grid
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, NormalizeConfig, VoteConfig
from slamfusion.fusion import lattice_vote
from slamfusion.fusion.groups import Members
from slamfusion.fusion.lattice_vote import (
    LatticeVote,
    PackedLayer,
    decide_tile,
    prepare_votes,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.test_lattice_vote import (
    SIZE,
    Placed,
    Places,
    aligned,
    placed,
    scattered,
    voted,
)


def known_cells(height: int, width: int) -> npt.NDArray[np.int8]:
    """Return cells that are free or occupied by chance."""
    return np.random.default_rng(0).choice(np.array([0, 100], dtype=np.int8), (height, width))


def packed(inputs: Placed, device: ComputeDevice) -> LatticeVote:
    """Return the vote of packed maps."""
    (vote,) = prepare_votes(
        [inputs.members], inputs.normalized.__getitem__, inputs.config, device, is_stored=True
    )
    return vote


def both_votes(
    places: Places, device: ComputeDevice, **vote: Any
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return fused cells, agreement, phantom cells and origin of a vote in memory and in tiles."""
    whole = voted(places, device, **vote)
    inputs = placed(places, device, **vote)
    ready = packed(inputs, device)
    shape = ready.extent.shape
    fused, agreement = np.full(shape, -1, np.int8), np.full(shape, -1, np.int8)
    phantom_cells = 0
    for tile, decided in ready.each(decide_tile, "vote", device):
        if decided is None:
            continue
        window = np.s_[tile.row0 : tile.row1, tile.col0 : tile.col1]
        fused[window], agreement[window] = decided.fused, decided.agreement
        phantom_cells += decided.phantom_cells
    fused[fused == 1] = 100
    in_memory = whole.fused.cells, whole.agreement.cells, whole.phantom_cells, whole.fused.origin
    return in_memory, (fused, agreement, phantom_cells, ready.origin)


@pytest.mark.parametrize(
    ("count", "vote"),
    [
        (1, {}),
        (2, {"mode": "consensus"}),
        (3, {"mode": "majority"}),  # unknown is a vote too
        (3, {"mode": "majority", "extent": "reference"}),
        (4, {"mode": "majority", "unknown": "value"}),
        (5, {"mode": "consensus"}),
    ],
)
def test_tiles_give_what_the_whole_gives(
    count: int, vote: dict[str, Any], device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lattice_vote, "TILE", 17)
    monkeypatch.setattr(lattice_vote, "BLOCK", 7)
    whole, tiles = both_votes(scattered(count), device, **vote)
    assert np.array_equal(whole[0], tiles[0])
    assert np.array_equal(whole[1], tiles[1])
    assert whole[2:] == tiles[2:]
    assert (whole[1] >= 0).any()


def test_more_than_may_vote_in_a_tile_vote_in_smaller_ones(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    hall = np.full((12, 24 + 12 * 39), 0, dtype=np.int8)
    hall[[0, -1]] = hall[6:, ::9] = 100
    places = [
        (OccupancyGrid(hall[:, 12 * n : 12 * n + 24], SIZE), Pose2(1.2 * n, 0.0)) for n in range(40)
    ]
    monkeypatch.setattr(lattice_vote, "SMALL_TILE", 32)
    whole, tiles = both_votes(places, device, mode="consensus")
    assert np.array_equal(whole[0], tiles[0])
    assert np.array_equal(whole[1], tiles[1])
    assert whole[2:] == tiles[2:]


def test_tiles_follow_each_other_where_they_are_near_and_those_without_maps_are_left_out(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lattice_vote, "TILE", 16)
    grid = scattered(1)[0][0]
    far = [(grid, Pose2()), (grid, Pose2(30.0, 30.0, 0.0))]
    normalized = normalize_grid(grid.with_name("map 0"), SIZE, NormalizeConfig(), device)
    members = Members("map 0", {"map 0": aligned("map 0", Pose2()), "b": aligned("b", far[1][1])})
    config = FusionConfig(vote=VoteConfig("consensus", extent="union"))
    (ready,) = prepare_votes([members], lambda _: normalized, config, device, is_stored=True)
    told: list[tuple[str, int, int]] = []
    tiles = [
        tile
        for tile, decided in ready.each(
            decide_tile, "vote", device, progress=lambda *words: told.append(words)
        )
        if decided is not None
    ]
    assert told[-1][1] == told[-1][2] > 4 * len(tiles)
    steps = [max(abs(a.row0 - b.row0), abs(a.col0 - b.col0)) for a, b in itertools.pairwise(tiles)]
    assert sorted(steps)[len(steps) // 2] == 16


class Weighing(Executor):
    """Notes what travels with each tile."""

    def __init__(self) -> None:
        self.blocks: list[int] = []

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        self.blocks.append(sum(len(layer.cells.blocks) for layer in arguments[2].values()))
        future: Future[Any] = Future()
        future.set_result(function(*arguments))
        return future


def test_of_a_large_map_travels_what_lies_under_a_tile(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lattice_vote, "TILE", 16)
    monkeypatch.setattr(lattice_vote, "BLOCK", 8)
    cells = known_cells(120, 150)
    places = [(OccupancyGrid(cells, SIZE), Pose2()), (OccupancyGrid(cells, SIZE), Pose2(1, 2, 0.7))]
    inputs = placed(places, device, mode="consensus")
    ready = packed(inputs, device)
    executor = Weighing()
    assert len(list(ready.each(decide_tile, "vote", device, executor))) > 50
    whole = [layer for layer in ready.layers.values() if isinstance(layer, PackedLayer)]
    assert max(executor.blocks) < 0.5 * sum(len(layer.cells.blocks) for layer in whole)
