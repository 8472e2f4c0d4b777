"""Which inputs of a live fusion are believed: both sides of each limit, from outside.

The limits are settings; each is set just below and just above what the drawn maps do.
"""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building
from tests.fusion.live.maps import AWAY, Drive, live_fusion, moved_frame, started, three, touched

pytestmark = pytest.mark.once


def stranger(name: str = "stranger", seed: int = 99) -> OccupancyGrid:
    """Return a map of another place of the same size."""
    return building(seed, 12.0, 10.0).with_name(name)


def walls(name: str) -> int:
    return int(np.count_nonzero(three()[name].cells >= 65))


# -- the first fusion ------------------------------------------------------------------------------


def test_the_first_fusion_is_tried_for_new_maps_and_not_too_often(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device, search_pause_s=2.0))
    first = drive.step(three()["a"], stranger())
    assert first.is_full_search
    assert "no two of the inputs a, stranger align" in first.problem
    # A second later it is too early, two seconds later it is not.
    early = drive.step(three()["b"])
    assert not early.is_full_search
    assert early.fused is None
    update = drive.maybe()
    assert update.is_full_search
    assert update.fused is not None
    assert drive.accepted() == "ab"
    assert drive.input("stranger").fit.score > 0.0
    assert drive.input("stranger").reason.startswith("to a: ")


@pytest.mark.parametrize("least", [1, 2, 3])
def test_as_many_inputs_must_agree_as_are_asked_for(device: ComputeDevice, least: int) -> None:
    drive = Drive(live_fusion(device, minimum_inputs=least))
    for count, name in enumerate("abc", start=1):
        update = drive.step(three()[name])
        assert (update.fused is not None) == (count >= least)
        if count < least:
            assert update.problem == f"waits for {least} inputs that agree, has {count}"
            assert drive.input(name).reason == update.problem
            assert not update.is_full_search
    assert drive.accepted() == "abc"


def test_three_that_must_agree_are_not_fused_while_one_does_not(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device, minimum_inputs=3))
    update = drive.step(three()["a"], three()["b"], stranger("c"))
    assert update.fused is None
    assert update.problem == "2 of the 3 inputs needed agree"
    assert drive.accepted() == ""
    drive.step(three()["c"])
    assert drive.accepted() == "abc"


# -- jumps and searches ----------------------------------------------------------------------------


def test_a_jump_is_confirmed_by_a_second_message_from_there_alone(device: ComputeDevice) -> None:
    drive = started(device, confirm_s=1000.0)
    for number, motion in enumerate((AWAY, AWAY.inverse(), AWAY)):
        drive.step(touched(moved_frame(three()["b"], motion), number, 0.002))
        assert drive.accepted() == "ac"
        assert "must confirm it" in drive.input("b").reason
    drive.step(touched(moved_frame(three()["b"], AWAY), 9, 0.002))
    assert drive.accepted() == "abc"


# -- who is the reference --------------------------------------------------------------------------


def test_the_reference_hands_over_to_the_voter_with_the_most_walls(device: ComputeDevice) -> None:
    drive = started(device)
    assert walls("a") < min(walls("b"), walls("c"))
    most = max("bc", key=walls)
    drive.live.drop("a", "its producer is gone")
    update = drive.step()
    assert update.reference == most
    assert drive.input(most).reason == "the reference"
    assert drive.input("a").reason == "its producer is gone"
    # It stays the reference when the others come back.
    assert drive.step(three()["a"]).reference == most
    assert drive.accepted() == "abc"
    assert drive.input("a").reason != "the reference"


def test_without_any_input_nothing_is_published_and_the_frame_waits(device: ComputeDevice) -> None:
    drive = started(device)
    for name in "abc":
        drive.live.drop(name, f"{name} is gone")
    update = drive.step()
    assert (update.fused, update.reference) == (None, "")
    assert update.problem == "no input is left"
    assert [drive.input(name).reason for name in "abc"] == ["a is gone", "b is gone", "c is gone"]
    back = drive.step(three()["c"], three()["b"])
    assert drive.accepted() == "bc"
    assert back.reference == max("bc", key=walls)
    assert not back.is_full_search
    assert drive.input("b").fit.is_tracked
    assert drive.input("c").fit.is_tracked


def test_an_input_that_comes_back_elsewhere_alone_is_searched_on_the_last_map(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    for name in "abc":
        drive.live.drop(name, "gone")
    drive.step()
    update = drive.step(stranger("b"))
    assert update.is_full_search
    assert update.problem == "no input fits the last fused map"
    assert drive.accepted() == ""
    drive.step(three()["b"])
    assert drive.accepted() == "b"
    assert "alone" in drive.input("b").reason
