"""A vote of tiles that are decided alone is the vote in memory, bit for bit."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.fusion import lattice_vote
from slamfusion.fusion.grouping import FusionSetup
from slamfusion.fusion.lattice_vote import LatticeVote, decide_tile, prepare_votes
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.test_lattice_vote import SIZE, Placed, Places, placed, scattered, voted


def packed(inputs: Placed, device: ComputeDevice) -> LatticeVote:
    """Return the vote of packed maps."""
    setup = FusionSetup(inputs.config, device, is_stored=True)
    (vote,) = prepare_votes([inputs.members], inputs.normalized.__getitem__, setup)
    return vote


def assert_same_votes(places: Places, device: ComputeDevice, **vote: Any) -> I8:
    """Check a vote in tiles against the one in memory; return the agreement."""
    whole = voted(places, device, **vote)
    inputs = placed(places, device, **vote)
    ready, setup = packed(inputs, device), FusionSetup(inputs.config, device)
    shape = ready.voter.whole.shape
    fused, agreement = np.full(shape, -1, np.int8), np.full(shape, -1, np.int8)
    phantom_cells = 0
    for tile, decided in ready.each(partial(decide_tile, device=device), "vote", setup):
        if decided is None:
            continue
        window = np.s_[tile.row0 : tile.row1, tile.col0 : tile.col1]
        fused[window], agreement[window] = decided.fused, decided.agreement
        phantom_cells += decided.phantom_cells
    fused[fused == 1] = 100
    assert np.array_equal(whole.fused.cells, fused)
    assert np.array_equal(whole.agreement.cells, agreement)
    assert (whole.phantom_cells, whole.fused.origin) == (phantom_cells, ready.lattice.origin)
    return agreement


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
    assert (assert_same_votes(scattered(count), device, **vote) >= 0).any()


def test_more_than_may_vote_in_a_tile_vote_in_smaller_ones(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    hall = np.full((12, 24 + 12 * 39), 0, dtype=np.int8)
    hall[[0, -1]] = hall[6:, ::9] = 100
    places = [
        (OccupancyGrid(hall[:, 12 * n : 12 * n + 24], SIZE), Pose2(1.2 * n, 0.0)) for n in range(40)
    ]
    monkeypatch.setattr(lattice_vote, "SMALL_TILE", 32)
    assert_same_votes(places, device, mode="consensus")
