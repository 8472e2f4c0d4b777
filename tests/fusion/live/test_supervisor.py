"""Which inputs of a live fusion are believed: both sides of each limit, from outside.

The limits are settings; each is set just below and just above what the drawn maps do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, OccupancyGrid
from tests.fusion.drawings import building
from tests.fusion.live.maps import (
    AWAY,
    Drive,
    live_fusion,
    moved_frame,
    started,
    three,
    touched,
)

pytestmark = pytest.mark.once


def stranger(name: str = "stranger", seed: int = 99) -> OccupancyGrid:
    """Return a map of another place of the same size."""
    return building(seed, 12.0, 10.0).with_name(name)


def walls(name: str) -> int:
    return int(np.count_nonzero(three()[name].cells >= 65))


def grown(name: str, count: int) -> OccupancyGrid:
    """Return the map with so many free cells turned into walls."""
    grid = three()[name]
    cells = grid.cells.copy()
    free = np.flatnonzero(cells == 0)
    cells.flat[free[:: len(free) // count][:count]] = OCCUPIED
    assert int(np.count_nonzero(cells >= 65)) == walls(name) + count
    return replace(grid, cells=cells)


def about_middle(grid: OccupancyGrid, motion: Pose2) -> OccupancyGrid:
    """Return the map in a frame that is moved and turned about the middle of what is known."""
    box = grid.known_box()
    assert box is not None
    size = grid.resolution
    middle = grid.origin.compose(
        Pose2((box.col0 + box.col1) / 2 * size, (box.row0 + box.row1) / 2 * size)
    )
    to_middle = Pose2(middle.x, middle.y)
    return moved_frame(grid, to_middle.compose(motion).compose(to_middle.inverse()))


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
    assert update is not None
    assert update.is_full_search
    assert update.fused is not None
    assert drive.accepted() == "ab"
    assert drive.input("stranger").score > 0.0
    assert drive.input("stranger").reason.startswith("to a: ")


def test_maps_that_were_tried_are_not_tried_again(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device))
    assert drive.step(three()["a"], stranger()).is_full_search
    assert drive.maybe() is None
    assert not drive.step(three()["a"]).is_full_search
    assert drive.step(touched(three()["a"], 1)).is_full_search


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


def test_a_single_map_is_searched_nowhere(device: ComputeDevice) -> None:
    update = Drive(live_fusion(device, minimum_inputs=1)).step(three()["a"])
    assert update.fused is not None
    assert not update.is_full_search


# -- held transforms -------------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "more"), [(0.05, 0), (0.05, 1), (0.2, 0), (0.2, 1)])
def test_a_share_of_the_walls_must_change_before_it_is_aligned_again(
    device: ComputeDevice, share: float, more: int
) -> None:
    """The share is that of the map with fewer walls: the reference, here."""
    drive = started(device, track_share=share, steady_share=0.0)
    assert walls("a") < walls("b")
    drive.step(grown("b", int(share * walls("a")) + more))
    assert drive.input("b").is_tracked == (more > 0)
    assert drive.accepted() == "abc"


@pytest.mark.parametrize(("shift_m", "is_held"), [(0.0, True), (0.03, True), (0.09, False)])
def test_a_transform_moves_only_by_more_than_half_a_cell(
    device: ComputeDevice, shift_m: float, is_held: bool
) -> None:
    drive = started(device)
    before = drive.input("b").transform
    drive.step(touched(moved_frame(three()["b"], Pose2(shift_m, 0.0)), 1, 0.003))
    assert drive.accepted() == "abc"
    after = drive.input("b").transform
    assert after is not None
    assert before is not None
    assert (after == before) == is_held
    wanted = before if is_held else before.compose(Pose2(-shift_m, 0.0))
    assert abs(after.x - wanted.x) < 0.03
    assert abs(after.y - wanted.y) < 0.03


@pytest.mark.parametrize(("share", "is_searched"), [(0.5, False), (1.0, True)])
def test_a_score_below_a_share_of_the_search_s_calls_for_another(
    device: ComputeDevice, share: float, is_searched: bool
) -> None:
    drive = started(device, search_share=share, steady_share=0.0)
    update = drive.step(grown("b", walls("b") // 4))
    assert update.is_full_search == is_searched
    assert drive.input("b").is_tracked != is_searched


# -- jumps and searches ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motion", "limits"),
    [
        (Pose2(0.24, -0.18), {"jump_m": 0.33}),
        (Pose2(0.0, 0.0, -0.06), {"jump_rad": 0.07}),
    ],
)
def test_a_jump_is_believed_at_once_up_to_its_limit(
    device: ComputeDevice, motion: Pose2, limits: dict[str, float]
) -> None:
    moved = about_middle(three()["b"], motion)
    within = started(device, **limits)
    within.step(moved)
    assert within.accepted() == "abc"
    beyond = started(device, **{name: 0.8 * limit for name, limit in limits.items()})
    beyond.step(moved)
    assert beyond.accepted() == "ac"
    assert "must confirm it" in beyond.input("b").reason
    words = f"{np.hypot(motion.x, motion.y):.1f}"
    assert f"jumped by {words}" in beyond.input("b").reason
    beyond.step(touched(moved, 1, 0.002))
    assert beyond.accepted() == "abc"


def test_a_second_jump_elsewhere_confirms_nothing(device: ComputeDevice) -> None:
    drive = started(device)
    for number, motion in enumerate((AWAY, AWAY.inverse(), AWAY)):
        drive.step(touched(moved_frame(three()["b"], motion), number, 0.002))
        assert drive.accepted() == "ac"
        assert "must confirm it" in drive.input("b").reason
    drive.step(touched(moved_frame(three()["b"], AWAY), 9, 0.002))
    assert drive.accepted() == "abc"


def test_searches_of_one_input_are_a_pause_apart(device: ComputeDevice) -> None:
    drive = started(device, search_pause_s=2.0)
    drive.now_s += 10.0
    searched = [drive.step(stranger("b", 60 + number)).is_full_search for number in range(5)]
    assert searched == [True, False, True, False, True]
    assert drive.accepted() == "ac"
    assert drive.input("b").reason.startswith("to ")
    drive.step(stranger("b", 70))
    assert drive.input("b").reason.endswith("waits for a full search")


def test_one_input_is_searched_in_an_update(device: ComputeDevice) -> None:
    drive = started(device)
    update = drive.step(three()["c"].with_name("d"), three()["b"].with_name("e"))
    assert update.is_full_search
    assert sorted(drive.input(name).accepted for name in "de") == [False, True]
    waiting = next(name for name in "de" if not drive.input(name).accepted)
    assert drive.input(waiting).reason == "waits for a full search"
    drive.maybe()
    assert drive.accepted() == "abcde"
    assert not drive.step(touched(three()["a"], 1, 0.0005)).is_full_search


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
    assert drive.input("b").is_tracked
    assert drive.input("c").is_tracked


def test_one_input_that_comes_back_goes_on_where_it_was(device: ComputeDevice) -> None:
    drive = started(device)
    before = drive.input("b").transform
    for name in "abc":
        drive.live.drop(name, "gone")
    drive.step()
    update = drive.step(three()["b"])
    assert (drive.accepted(), update.reference) == ("b", "b")
    assert not update.is_full_search
    assert drive.input("b").transform == before


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


def test_a_map_that_came_too_soon_to_be_searched_is_searched_though_no_other_comes(
    device: ComputeDevice,
) -> None:
    drive = started(device, search_pause_s=20.0)
    for name in "ac":
        drive.live.drop(name, "gone")
    assert drive.step(stranger("b")).is_full_search
    assert not drive.step(moved_frame(three()["b"], AWAY)).is_full_search
    for _ in range(50):
        drive.maybe()
    assert drive.accepted() == "b", drive.input("b").reason
