"""A vote of tiles that are decided alone is the vote in memory, bit for bit."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, NormalizeConfig, VoteConfig
from slamfusion.errors import ConfigError
from slamfusion.fleet import InProcess
from slamfusion.fusion import stored_vote
from slamfusion.fusion.groups import Members
from slamfusion.fusion.normalize import normalize_grid
from slamfusion.fusion.stored_vote import PackedCells, prepare_stored_vote
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.test_lattice_vote import SIZE, Places, aligned, placed, scattered, voted


def both_votes(
    places: Places, device: ComputeDevice, **vote: Any
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return fused cells, agreement, phantom cells and origin of a vote in memory and in tiles."""
    whole = voted(places, device, **vote)
    inputs = placed(places, device, **vote)
    ready = prepare_stored_vote(inputs.members, inputs.normalized.__getitem__, inputs.config)
    fused, agreement = np.full(ready.shape, -1, np.int8), np.full(ready.shape, -1, np.int8)
    phantom_cells = 0
    for tile, decided in ready.decide(InProcess("auto")):
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
        (5, {"mode": "log-odds"}),
    ],
)
def test_tiles_give_what_the_whole_gives(
    count: int, vote: dict[str, Any], device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_vote, "TILE", 17)
    whole, tiles = both_votes(scattered(count), device, **vote)
    assert np.array_equal(whole[0], tiles[0])
    assert np.array_equal(whole[1], tiles[1])
    assert whole[2:] == tiles[2:]
    assert (whole[1] >= 0).any()


def test_more_than_may_vote_in_a_tile_vote_in_smaller_ones(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = np.full((12, 24), 0, dtype=np.int8)
    room[[0, -1]] = room[:, [0, -1]] = 100
    places = [(OccupancyGrid(room, SIZE), Pose2(1.2 * n, 0.0)) for n in range(40)]
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
    tiles = [tile for tile, _ in ready.decide(InProcess(), lambda *words: told.append(words))]
    assert told[-1][1] == told[-1][2] > 4 * len(tiles)
    steps = [max(abs(a.row0 - b.row0), abs(a.col0 - b.col0)) for a, b in itertools.pairwise(tiles)]
    assert sorted(steps)[len(steps) // 2] == 16


def test_weights_of_whole_maps_are_refused(device: ComputeDevice) -> None:
    grid = normalize_grid(scattered(1)[0][0], SIZE, NormalizeConfig(), device)
    members = Members("map", {"map": aligned("map", Pose2())})
    with pytest.raises(ConfigError, match="mode 'weighted' weighs maps by all of their cells"):
        prepare_stored_vote(members, lambda _: grid, FusionConfig(vote=VoteConfig("weighted")))


def test_cells_that_were_laid_last_are_kept(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = stored_vote._KeptCells()
    monkeypatch.setattr(stored_vote, "KEPT_BYTES", 250)
    packed = [PackedCells.of(np.full((10, 10), n, dtype=np.int8)) for n in range(3)]
    first = kept.get(packed[0], device)
    assert np.array_equal(device.download(first), np.zeros((10, 10)))
    kept.get(packed[1], device)
    assert kept.get(packed[0], device) is first
    kept.get(packed[2], device)
    assert kept.get(packed[0], device) is first
    assert kept.get(packed[1], device) is not None
    assert len(kept._kept) == 2
