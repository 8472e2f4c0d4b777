"""The state of a live fusion: bytes and back, damage, and a restart that moves nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, NormalizeConfig, RunConfig
from slamfusion.fusion.live import LiveFusion
from slamfusion.fusion.live.state import LiveState, StateError, is_state
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, ORIGIN_MOST_M, OccupancyGrid
from slamfusion.vote.lattice import Lattice
from tests.fusion.drawings import building
from tests.fusion.live.maps import (
    AWAY,
    Drive,
    assert_same_lattice,
    live_fusion,
    moved_frame,
    share_standing,
    started,
    three,
    touched,
)

pytestmark = pytest.mark.once

NUMBERS = st.floats(-ORIGIN_MOST_M, ORIGIN_MOST_M)
POSES = st.builds(Pose2, NUMBERS, NUMBERS, st.floats(-math.pi, math.pi))
NAMES = st.text(max_size=8)


def state_of(
    lattice: Lattice,
    first: tuple[int, int],
    fused: npt.NDArray[np.int8],
    agreement: npt.NDArray[np.int8],
    *others: Any,
) -> LiveState:
    grids = (
        OccupancyGrid(cells, lattice.resolution, lattice.corner(*first))
        for cells in (fused, agreement)
    )
    return LiveState(lattice, *grids, *others)


@st.composite
def states(draw: st.DrawFn) -> LiveState:
    shape = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    return state_of(
        Lattice(draw(st.floats(1e-3, 10.0)), draw(POSES)),
        draw(st.tuples(*[st.integers(-5000, 5000)] * 2)),
        rng.choice(np.array([-1, 0, 100], dtype=np.int8), shape),
        rng.integers(-1, 101, shape).astype(np.int8),
        draw(st.dictionaries(NAMES, POSES, max_size=4)),
        draw(NAMES),
        draw(st.dictionaries(st.frozensets(NAMES, min_size=2, max_size=2), NUMBERS, max_size=3)),
        draw(NUMBERS),
    )


SMALL = state_of(
    Lattice(0.05, Pose2(1.0, 2.0, 0.3)),
    (-3, 7),
    np.array([[-1, 0, 100]], dtype=np.int8),
    np.array([[-1, 100, 67]], dtype=np.int8),
    {"a": IDENTITY, "b": Pose2(0.1, 0.2, 0.3)},
    "a",
    {frozenset(("a", "b")): 0.7},
    123.5,
)


def described(state: LiveState) -> tuple[Any, ...]:
    """Everything of a state, to be compared."""
    cells = [grid.cells.tobytes() for grid in (state.fused, state.agreement)]
    named = (state.lattice, state.box, dict(state.transforms), state.reference)
    return (*named, dict(state.scores), state.stamp_s, *cells)


@given(states())
def test_bytes_and_back_give_the_same_state(state: LiveState):
    data = state.to_bytes()
    assert is_state(data)
    assert described(LiveState.from_bytes(data)) == described(state)


@given(st.data())
def test_a_damaged_state_is_refused_in_one_line(data: st.DataObject):
    whole = SMALL.to_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    if data.draw(st.booleans()):
        damaged = whole[:place]
    else:
        flip = data.draw(st.integers(1, 255))
        damaged = whole[:place] + bytes([whole[place] ^ flip]) + whole[place + 1 :]
    with pytest.raises(StateError) as found:
        LiveState.from_bytes(damaged)
    assert "\n" not in str(found.value)


def test_another_version_is_named():
    data = SMALL.to_bytes().replace(b" 2\n", b" 3\n", 1)
    with pytest.raises(StateError, match="version 2, found '3'"):
        LiveState.from_bytes(data)


# -- a restart -------------------------------------------------------------------------------------


def restarted(drive: Drive, device: ComputeDevice, **live: Any) -> Drive:
    """A fusion that goes on from another's state, through bytes."""
    state = drive.live.state(drive.now_s)
    again = Drive(live_fusion(device, **live))
    again.live.restore(LiveState.from_bytes(state.to_bytes()))
    return again


def test_before_the_first_fusion_there_is_no_state(device: ComputeDevice):
    assert live_fusion(device).state() is None


def test_after_a_restart_the_lattice_and_the_cells_are_the_same(device: ComputeDevice):
    drive = started(device)
    drive.step(touched(three()["b"], 1))
    again = restarted(drive, device)
    # The maps of now, and not the search of everything that a new fusion needs.
    update = again.step(three()["a"], touched(three()["b"], 1), three()["c"])
    assert not update.is_full_search
    while again.maybe() is not None:
        pass
    assert again.accepted() == "abc"
    assert assert_same_lattice(drive.fused, again.fused) == (0, 0)
    assert np.array_equal(drive.fused.cells, again.fused.cells)
    for name in "abc":
        assert again.input(name).transform == drive.input(name).transform


def test_the_last_map_is_there_before_any_input_comes(device: ComputeDevice):
    drive = started(device)
    again = restarted(drive, device)
    assert again.maybe() is None
    state = again.live.state(5.0)
    fused, agreement = state.fused, state.agreement
    assert np.array_equal(fused.cells, drive.fused.cells)
    assert fused.origin == agreement.origin == drive.fused.origin
    assert state.stamp_s == 5.0
    assert {*state.transforms} == {*"abc"}


def test_an_input_that_began_elsewhere_is_searched_and_the_frame_stays(device: ComputeDevice):
    drive = started(device)
    again = restarted(drive, device)
    moved = {name: moved_frame(grid, AWAY) for name, grid in three().items()}
    for number in range(12):
        again.maybe(*(touched(grid, number, 0.002) for grid in moved.values()))
    assert again.accepted() == "abc"
    assert_same_lattice(drive.fused, again.fused)
    assert share_standing(drive.fused, again.fused) > 0.9


def test_inputs_of_another_place_abstain_and_reset_takes_them(device: ComputeDevice):
    drive = started(device)
    again = restarted(drive, device)
    other = [replace(building(71, 12.0, 10.0), name=name) for name in "ab"]
    for _ in range(3):
        assert again.step(*other).fused is None
    assert again.accepted() == ""
    state = again.live.state()
    assert np.array_equal(state.fused.cells, drive.fused.cells)
    again.live.reset()
    assert again.live.state() is None
    again.step(*other)
    assert again.accepted() == "ab"


def test_cells_of_another_size_than_asked_for_are_refused(device: ComputeDevice):
    state = started(device).live.state()
    assert state is not None
    config = RunConfig(fusion=FusionConfig(normalize=NormalizeConfig(resolution=0.5)))
    with pytest.raises(StateError, match=r"cells of .* resolution asks for 0.5 m"):
        LiveFusion(config, device).restore(state)
