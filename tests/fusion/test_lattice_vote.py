"""A vote tile by tile is the vote of everything at once, and more may vote than fit one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from slamfusion.align.normalize import NormalizedGrid, normalize_grid
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, NormalizeConfig, VoteConfig
from slamfusion.errors import GridError
from slamfusion.fusion import FusionResult, lattice_vote
from slamfusion.fusion.groups import Members
from slamfusion.fusion.lattice_vote import vote_in_memory
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, OccupancyGrid
from tests.fusion.drawings import random_cells

SIZE = 0.1
Places = list[tuple[OccupancyGrid, Pose2]]


def aligned(name: str, transform: Pose2) -> Alignment:
    return Alignment(
        reference="map 0", moving=name, accepted=True, reason="", transform=transform, score=1.0,
        overlap=1.0, error=0.0, runner_up=None, time_s=0.0,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Placed:
    """Maps that lie at given places in the first one's frame, and how they vote."""

    grids: list[OccupancyGrid]
    members: Members
    normalized: dict[str, NormalizedGrid]
    config: FusionConfig


def placed(places: Places, device: ComputeDevice, names: Sequence[str] = (), **vote: Any) -> Placed:
    """Prepare maps for a vote."""
    names = names or [f"map {n}" for n in range(len(places))]
    grids = [grid.with_name(name) for name, (grid, _) in zip(names, places, strict=True)]
    normalized = {
        grid.name: normalize_grid(grid, SIZE, NormalizeConfig(), device) for grid in grids
    }
    alignments = {
        grid.name: aligned(grid.name, pose) for grid, (_, pose) in zip(grids, places, strict=True)
    }
    config = FusionConfig(vote=replace(VoteConfig(extent="union"), **vote))
    members = Members(grids[0].name, alignments)
    return Placed(grids, members, normalized, config)


def voted(
    places: Places, device: ComputeDevice, names: Sequence[str] = (), **vote: Any
) -> FusionResult:
    """Return the vote of maps that lie at given places in the first one's frame."""
    ready = placed(places, device, names, **vote)
    return vote_in_memory(
        ready.grids, [ready.members], ready.normalized.__getitem__, {}, ready.config, device
    )


def scattered(count: int) -> Places:
    """Return small maps at overlapping places, turned by any angle."""
    rng = np.random.default_rng(count)
    return [
        (
            OccupancyGrid(random_cells(seed, 30, 40), SIZE),
            Pose2() if seed == 0 else Pose2(*(float(v) for v in rng.uniform(-4.0, 4.0, 3))),
        )
        for seed in range(count)
    ]


@pytest.mark.parametrize("count", [2, 5])
@pytest.mark.parametrize(
    "vote",
    [
        {"mode": "majority"},
        {"mode": "majority", "unknown": "value"},
        {"mode": "majority", "unknown": "abstain", "extent": "reference"},
        {"mode": "consensus"},
    ],
)
def test_tiles_change_nothing(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, count: int, vote: dict[str, Any]
) -> None:
    wanted = voted(scattered(count), device, **vote)
    monkeypatch.setattr(lattice_vote, "TILE", 17)
    found = voted(scattered(count), device, **vote)
    assert np.array_equal(found.fused.cells, wanted.fused.cells)
    assert np.array_equal(found.agreement.cells, wanted.agreement.cells)
    assert found.phantom_cells == wanted.phantom_cells
    assert (found.weights, found.bent) == (wanted.weights, wanted.bent)
    assert found.wall_agreement == wanted.wall_agreement
    for one, other in zip(found.inputs, wanted.inputs, strict=True):
        assert np.array_equal(one.aligned, other.aligned)
        assert np.array_equal(one.dissent, other.dissent)


def test_more_maps_vote_than_in_one_place(device: ComputeDevice) -> None:
    """A row of forty rooms, each of which is seen by two neighbours."""
    room = np.full((12, 24), 0, dtype=np.int8)
    room[[0, -1]] = room[:, [0, -1]] = 100
    places = [(OccupancyGrid(room, SIZE), Pose2(1.2 * n, 0.0)) for n in range(40)]
    result = voted(places, device, mode="majority")
    assert result.fused.cells.shape == (12, 12 * 39 + 24)
    assert (result.fused.cells != UNKNOWN).all()
    assert len(result.accepted) == 40
    for record in result.inputs:
        assert record.layer.codes.size < 1000
    # One over the other they are too many.
    with pytest.raises(GridError, match="a vote takes up to 32"):
        voted([(OccupancyGrid(room, SIZE), Pose2()) for _ in range(33)], device, mode="majority")
