"""Voting: layers are laid once, room is made, given back and refused by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.fusion.live.inputs import Input, Reason
from slamfusion.fusion.live.voting import SPARE_CELLS, FusedLayers, joined
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.io import files
from slamfusion.vote.lattice import Lattice
from tests.fusion.drawings import random_cells
from tests.support.examples import examples

SIZE = 0.1
# Of up to 1200 cells a side.
BOX = st.tuples(
    st.integers(-9, 40), st.integers(-9, 40), st.integers(1, 12), st.integers(1, 12)
).map(lambda n: CellBox(100 * n[0], 100 * n[1], 100 * (n[0] + n[2]), 100 * (n[1] + n[3])))


def voter(name: str, x: float, device: ComputeDevice) -> Input:
    grid = OccupancyGrid(random_cells(3, 30, 40), SIZE, Pose2(x, 0.0, 0.0), name)
    one = Input(name, FusionConfig().normalize, device, transform=Pose2())
    one.follow(grid, SIZE)
    one.turn(Reason.NEW)
    one.accept(Reason.REFERENCE)
    return one


def voting_of(device: ComputeDevice, **live: str) -> FusedLayers:
    voting = FusedLayers(FusionConfig(), LiveConfig(**live), device)
    voting.lattice = Lattice(SIZE, Pose2())
    return voting


def test_what_was_laid_is_not_laid_again_until_a_voter_leaves(device: ComputeDevice) -> None:
    voting = voting_of(device)
    inputs = [voter("a", 0.0, device), voter("b", 1.0, device)]
    box = voting.update(inputs, inputs, "a")
    fused, _ = voting.grids()
    assert box == CellBox(0, 0, fused.height, fused.width)
    assert voting.names == ("a", "b")
    assert voting.update(inputs, inputs, "a") is None
    # Without b its cells are voted on again, and the frame keeps its size.
    inputs[1].turn(Reason.GONE, why="gone")
    assert voting.update(inputs, inputs[:1], "a") == box
    assert voting.grids()[0].cells.shape == fused.cells.shape
    assert voting.update(inputs, [], "a") is None
    assert voting.names == ()


def test_what_a_majority_decided_is_kept_while_fewer_are_left_than_make_one(
    device: ComputeDevice,
) -> None:
    voting = voting_of(device)
    inputs = [voter("a", 0.0, device), voter("b", 0.5, device), voter("c", 1.0, device)]
    voting.update(inputs, inputs[:2], "a")
    assert voting.agreed is None
    voting.update(inputs, inputs, "a")
    whole = voting.grids()[0]
    assert voting.agreed is None
    for left in (inputs[:2], inputs[:1], [], inputs[1:]):
        voting.update(inputs, left, "a")
        assert np.array_equal(voting.agreed.cells, whole.cells)
    assert not np.array_equal(voting.grids()[0].cells, whole.cells)
    voting.update(inputs, inputs, "a")
    assert voting.agreed is None


def test_a_voter_that_memory_has_no_room_for_is_refused_and_the_others_vote(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    voting = voting_of(device)
    inputs = [voter("a", 0.0, device), voter("b", 5000.0, device)]
    monkeypatch.setattr(files, "available_memory", lambda: 1_000_000)
    assert voting.update(inputs, inputs, "a") is not None
    assert voting.names == ("a",)
    assert not inputs[1].votes
    assert "b: a fused map" in inputs[1].reason


@settings(max_examples=examples(60), deadline=None)
@given(boxes=st.lists(BOX, min_size=1, max_size=6))
def test_boxes_are_joined_where_hardly_a_cell_lies_between(boxes: list[CellBox]) -> None:
    out = joined(boxes)
    assert joined(out) == out
    assert all(any(box.overlap(whole) == box for whole in out) for box in boxes)
    most = sum(box.area for box in boxes) + SPARE_CELLS * len(boxes)
    assert sum(box.area for box in out) <= most
