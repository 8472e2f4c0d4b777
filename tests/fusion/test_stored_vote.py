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
from slamfusion.fusion import stored_vote
from slamfusion.fusion.groups import Members
from slamfusion.fusion.stored_vote import PackedBlocks, prepare_stored_vote
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid
from tests.fusion.test_lattice_vote import SIZE, Places, aligned, placed, scattered, voted


def known_cells(height: int, width: int) -> npt.NDArray[np.int8]:
    """Return cells that are free or occupied by chance."""
    return np.random.default_rng(0).choice(np.array([0, 100], dtype=np.int8), (height, width))


def both_votes(
    places: Places, device: ComputeDevice, **vote: Any
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return fused cells, agreement, phantom cells and origin of a vote in memory and in tiles."""
    whole = voted(places, device, **vote)
    inputs = placed(places, device, **vote)
    ready = prepare_stored_vote(inputs.members, inputs.normalized.__getitem__, inputs.config)
    fused, agreement = np.full(ready.shape, -1, np.int8), np.full(ready.shape, -1, np.int8)
    phantom_cells = 0
    ready = ready.trusting(device, None)
    for tile, decided in ready.decide(device, None):
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
    monkeypatch.setattr(stored_vote, "TILE", 17)
    monkeypatch.setattr(stored_vote, "BLOCK", 7)
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
    monkeypatch.setattr(stored_vote, "SMALL_TILE", 32)
    whole, tiles = both_votes(places, device, mode="consensus")
    assert np.array_equal(whole[0], tiles[0])
    assert np.array_equal(whole[1], tiles[1])
    assert whole[2:] == tiles[2:]


def test_tiles_follow_each_other_where_they_are_near_and_those_without_maps_are_left_out(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_vote, "TILE", 16)
    grid = scattered(1)[0][0]
    far = [(grid, Pose2()), (grid, Pose2(30.0, 30.0, 0.0))]
    normalized = normalize_grid(grid.with_name("map 0"), SIZE, NormalizeConfig(), device)
    members = Members("map 0", {"map 0": aligned("map 0", Pose2()), "b": aligned("b", far[1][1])})
    config = FusionConfig(vote=VoteConfig("consensus", extent="union"))
    ready = prepare_stored_vote(members, lambda _: normalized, config)
    told: list[tuple[str, int, int]] = []
    ready = ready.trusting(device, None)
    decided = ready.decide(device, None, lambda *words: told.append(words))
    tiles = [tile for tile, _ in decided]
    assert told[-1][1] == told[-1][2] > 4 * len(tiles)
    steps = [max(abs(a.row0 - b.row0), abs(a.col0 - b.col0)) for a, b in itertools.pairwise(tiles)]
    assert sorted(steps)[len(steps) // 2] == 16


def test_blocks_hold_the_cells_and_none_that_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_vote, "BLOCK", 7)
    cells = known_cells(30, 40)
    cells[:14, :21] = UNKNOWN
    packed = PackedBlocks.of(cells)
    assert len(packed.blocks) == 5 * 6 - 2 * 3
    window = CellBox(10, 3, 23, 40)
    part = packed.under(window)
    assert set(part.blocks) == {(r, c) for r in (1, 2, 3) for c in range(6) if r > 1 or c > 2}
    assert np.array_equal(part.unpack(window), cells[10:23, 3:40])
    assert np.array_equal(packed.unpack(CellBox(0, 0, 30, 40)), cells)
    assert not packed.under(None).blocks


class Weighing(Executor):
    """Notes what travels with each tile."""

    def __init__(self) -> None:
        self.blocks: list[int] = []

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        self.blocks.append(sum(len(voter.cells.blocks) for voter in arguments[2]))
        future: Future[Any] = Future()
        future.set_result(function(*arguments))
        return future


def test_of_a_large_map_travels_what_lies_under_a_tile(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_vote, "TILE", 16)
    monkeypatch.setattr(stored_vote, "BLOCK", 8)
    cells = known_cells(120, 150)
    places = [(OccupancyGrid(cells, SIZE), Pose2()), (OccupancyGrid(cells, SIZE), Pose2(1, 2, 0.7))]
    inputs = placed(places, device, mode="consensus")
    ready = prepare_stored_vote(inputs.members, inputs.normalized.__getitem__, inputs.config)
    ready = ready.trusting(device, None)
    executor = Weighing()
    assert len(list(ready.decide(device, executor))) > 50
    assert max(executor.blocks) < 0.5 * sum(len(voter.cells.blocks) for voter in ready.inputs)
