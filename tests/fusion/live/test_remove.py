"""An input that is removed: its vote, its place and all that was known of it go with it."""

from __future__ import annotations

import numpy as np

from slamfusion.compute import ComputeDevice
from tests.fusion.live.maps import (
    AWAY,
    assert_same_lattice,
    moved_frame,
    on_lattice,
    share_standing,
    started,
    three,
    touched,
)


def test_its_vote_goes_with_it_and_the_map_is_that_of_the_others(device: ComputeDevice) -> None:
    drive = started(device)
    all_three = drive.fused
    drive.live.remove("c")
    update = drive.step()
    assert [record.name for record in update.inputs] == ["a", "b"]
    assert drive.accepted() == "ab"

    two = started(device, "ab")
    assert_same_lattice(two.fused, drive.fused)
    # With a third map beside them two lie a few millimetres otherwise.
    assert np.mean(on_lattice(two.fused, drive.fused) == drive.fused.cells) > 0.99
    assert not np.array_equal(on_lattice(all_three, drive.fused), drive.fused.cells)
    assert drive.maybe() is None, "told once"


def test_the_reference_leaves_and_the_frame_stays(device: ComputeDevice) -> None:
    drive = started(device)
    before = drive.fused
    drive.live.remove("a")
    update = drive.step()
    assert update.reference in {"b", "c"}
    assert drive.accepted() == "bc"
    drive.step(touched(three()["b"], 1), touched(three()["c"], 2))
    assert drive.accepted() == "bc"
    assert_same_lattice(before, drive.fused)
    assert share_standing(before, drive.fused) > 0.9


def test_who_comes_back_under_its_name_is_a_new_input(device: ComputeDevice) -> None:
    drive = started(device)
    place = drive.input("b").transform
    drive.live.remove("b")
    drive.step()
    # Another robot, that calls its frame's origin elsewhere: the old place would lead astray.
    other = moved_frame(three()["b"], AWAY)
    update = drive.step(other)
    assert update.is_full_search
    assert drive.accepted() == "acb"
    record = drive.input("b")
    assert record.messages.maps == 1
    there = record.transform.compose(AWAY)
    assert np.hypot(there.x - place.x, there.y - place.y) < 0.2


def test_a_map_that_waits_leaves_too_and_the_last_leaves_its_map(device: ComputeDevice) -> None:
    drive = started(device)
    drive.live.put("b", touched(three()["b"], 1), drive.now_s)
    for name in "abc":
        drive.live.remove(name)
    update = drive.step()
    assert update.inputs == ()
    assert update.fused is None
    assert update.problem == "no input is left"
    # The frame outlives them all: who comes fits the last map that was fused.
    before = drive.fused
    drive.step(touched(three()["c"], 1))
    drive.step(touched(three()["c"], 2))
    assert drive.accepted() == "c"
    assert_same_lattice(before, drive.fused)
