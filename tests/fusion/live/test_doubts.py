"""Live fusion: maps that jump, lie far away, say nothing, are mirrored or contradict the others."""

from __future__ import annotations

import itertools
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, OccupancyGrid
from tests.fusion.drawings import off_by
from tests.fusion.live.maps import (
    AWAY,
    Drive,
    assert_same_lattice,
    littered,
    live_fusion,
    mirrored,
    moved_frame,
    share_standing,
    started,
    three,
    touched,
    transposed,
    trio,
)

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

MEGABYTE = 1 << 20


def wait(drive: Drive, seconds: float) -> float:
    """Let time pass without a map; return after how many seconds all three vote."""
    for second in range(1, math.ceil(seconds) + 1):
        drive.maybe()
        if drive.accepted() == "abc":
            return float(second)
    return math.inf


# -- a map that jumped and then stays as it is -----------------------------------------------------


@pytest.mark.parametrize(("name", "pause_s"), [("a", 0.0), ("b", 2.0)])
def test_a_jump_is_confirmed_within_seconds_though_no_map_comes(
    device: ComputeDevice, name: str, pause_s: float
) -> None:
    drive = started(device, search_pause_s=pause_s)
    first, last = drive.fused, drive.input(name).transform
    again = moved_frame(three()[name], AWAY)
    drive.step(again)
    assert "jumped by" in drive.input(name).reason
    assert drive.accepted() == "abc".replace(name, "")
    assert wait(drive, 2.0) == math.inf, "not at once"
    assert wait(drive, 2.0) <= 2.0, drive.input(name).reason
    found = drive.input(name).transform
    shift, turn = off_by(again, found, last.compose(AWAY.inverse()))
    assert shift < 1.0
    assert turn < 0.5
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97


def test_a_jump_of_the_only_input_left_is_confirmed_by_the_last_fused_map(
    device: ComputeDevice,
) -> None:
    drive = started(device, "ab")
    first = drive.fused
    drive.live.drop("a", "its producer is gone")
    drive.step(moved_frame(three()["b"], AWAY))
    assert drive.accepted() == ""
    for _ in range(5):
        drive.maybe()
    assert drive.accepted() == "b", drive.input("b").reason
    assert share_standing(drive.fused, first) > 0.97


def test_a_map_that_jumps_and_goes_back_within_the_time_stays_where_it_was(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    before = drive.input("b").transform
    drive.step(moved_frame(three()["b"], AWAY))
    drive.maybe()
    drive.step(three()["b"])
    assert drive.accepted() == "abc"
    for _ in range(6):
        drive.maybe()
    assert drive.input("b").transform == before
    assert drive.accepted() == "abc"


# -- far away and tiny -----------------------------------------------------------------------------

FINE = replace(three()["b"], resolution=1e-9)
COARSE = replace(three()["b"], resolution=5.0)
FAR = replace(three()["b"], origin=Pose2(1e12, 0.0, 0.0))
ENDLESS = OccupancyGrid(np.tile(np.array([[0], [100]], dtype=np.int8), (8000, 4)), 90.0, name="b")


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (FINE, "resolution must lie in"),
        (FAR, "x of the origin must lie"),
        (ENDLESS, "at most 1e+06 m long"),
        (COARSE, "50 times coarser"),
        (replace(FINE, resolution=0.001), "100 times finer"),
    ],
)
def test_implausible_numbers_are_refused_by_name_and_the_others_go_on(
    device: ComputeDevice, bad: OccupancyGrid, words: str
) -> None:
    drive = started(device)
    first = drive.fused
    tracemalloc.start()
    update = drive.step(bad, touched(three()["a"], 1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert words in drive.input("b").reason
    assert drive.accepted() == "ac"
    assert drive.input("b").messages.rejected == 1
    assert update.fused.cells.shape == first.cells.shape
    assert update.fused.origin == first.origin
    assert peak < 20 * MEGABYTE
    drive.step(three()["b"])
    assert drive.accepted() == "abc"
    # From the start, beside two that are well.
    drive = Drive(live_fusion(device))
    drive.step(three()["a"], bad, three()["c"])
    assert drive.accepted() == "ac"
    assert words in drive.input("b").reason


def test_an_origin_that_jumps_by_10_km_takes_no_memory_and_is_followed(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    first = drive.fused
    tracemalloc.start()
    drive.step(moved_frame(three()["b"], Pose2(10_000.0, -7_000.0, 0.0)), touched(three()["a"], 1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 30 * MEGABYTE
    assert drive.accepted() == "ac"
    assert wait(drive, 5.0) <= 4.0
    assert drive.fused.cells.shape == first.cells.shape
    assert drive.fused.origin == first.origin
    assert share_standing(first, drive.fused) > 0.97


# -- mirrored --------------------------------------------------------------------------------------


def test_a_map_that_is_transposed_from_the_start_does_not_vote(device: ComputeDevice) -> None:
    name = "b"
    drive = Drive(live_fusion(device))
    drive.step(*(transposed(grid) if grid.name == name else grid for grid in trio().values()))
    assert drive.accepted() == "abc".replace(name, "")
    assert "mirrored or transposed" in drive.input(name).reason
    # Also when it comes to a fusion that is under way, and comes again and again.
    drive = Drive(live_fusion(device))
    well = [grid for grid in trio().values() if grid.name != name]
    drive.step(*well)
    for number in range(3):
        drive.step(touched(transposed(trio()[name]), number, 0.001))
        assert drive.accepted() == "abc".replace(name, "")
    assert "mirrored or transposed" in drive.input(name).reason
    for number in range(30):
        drive.maybe(touched(trio()[name], number, 0.001))
        if len(drive.accepted()) > 2:  # else: a search that took long, on a busy machine, rests
            break
    assert sorted(drive.accepted()) == ["a", "b", "c"]


def test_of_two_maps_one_is_mirrored_and_nobody_can_say_which(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device))
    update = drive.step(trio()["a"], mirrored(trio()["b"]))
    assert update.fused is None
    assert "a map mirrored or transposed?" in update.problem
    drive.step(trio()["c"])
    assert drive.accepted() == "ac"


def test_a_map_that_turns_into_its_mirror_image_loses_its_vote(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device))
    drive.step(*trio().values())
    assert drive.accepted() == "abc"
    for number in range(3):
        drive.step(touched(mirrored(trio()["b"]), number, 0.001))
        assert drive.accepted() == "ac", drive.input("b").reason


# -- walls that match no more ----------------------------------------------------------------------


def is_contradicted(reason: str) -> bool:
    """Whether a reason says that walls are not where others have them."""
    words = ("maybe the same", "do not show the same place", "ambiguous", "too little in common")
    return any(word in reason for word in words)


@pytest.mark.parametrize(("share", "pause_s"), [(0.2, 1000.0), (0.3, 0.0)])
def test_a_tracked_map_whose_walls_do_not_match_loses_its_vote_while_that_lasts(
    device: ComputeDevice, share: float, pause_s: float
) -> None:
    drive = started(device, search_pause_s=pause_s)
    worse = littered(three()["b"], 1, share)
    for number in range(3):
        well = (touched(three()[name], number, 0.001) for name in "ac")
        drive.step(touched(worse, number, 0.001), *well)
        assert drive.accepted() == "ac", drive.input("b").reason
        assert is_contradicted(drive.input("b").reason), drive.input("b").reason
    drive.step(three()["b"])
    assert drive.accepted() == "abc"
    # A little litter is no contradiction.
    drive.step(littered(three()["b"], 1, 0.04))
    assert drive.accepted() == "abc"


# -- poses -----------------------------------------------------------------------------------------


def tell(drive: Drive, stamps: range, **off_m: float) -> None:
    """Let inputs say where the robot is on its way along x, each off by some metres along y."""
    for stamp, record in itertools.product(stamps, drive.live.inputs()):
        if record.name in off_m and record.transform is not None:
            there = Pose2(0.3 * stamp, off_m[record.name], 0.0)
            drive.live.hear(record.name, float(stamp), record.transform.inverse().compose(there))


def test_poses_that_contradict_the_others_take_the_vote_while_that_lasts(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    tell(drive, range(10), a=0.0, b=0.1, c=-0.1)
    assert drive.maybe() is None
    tell(drive, range(10, 15), a=0.0, b=7.0, c=-0.1)
    update = drive.maybe()
    assert drive.accepted() == "ac"
    assert "poses contradict those of a, c: 7.0 m" in drive.input("b").reason
    assert update.fused is not None
    # Its map goes on to be followed, and the votes come back when the poses do.
    drive.step(touched(three()["b"], 1, 0.001))
    assert drive.accepted() == "ac"
    tell(drive, range(15, 20), a=0.0, b=0.1, c=-0.1)
    drive.step()
    assert drive.accepted() == "abc"


def test_who_goes_wrong_half_way_leaves_nothing_in_the_fused_map_while_it_lasts(
    device: ComputeDevice,
) -> None:
    # Its walls stand; those of one half it draws again from now on, 0.8 m aside.
    good = three()["b"]
    cells = good.cells.copy()
    half = cells[:, cells.shape[1] // 2 :]
    again = np.roll(half, round(0.8 / good.resolution), axis=0)
    half[again == OCCUPIED] = OCCUPIED
    drive = started(device)
    tell(drive, range(10), a=0.0, b=0.1, c=-0.1)
    tell(drive, range(10, 15), a=0.0, b=1.5, c=-0.1)
    drive.step(replace(good, cells=cells))
    assert drive.accepted() == "ac"
    assert "poses contradict those of a, c" in drive.input("b").reason
    alone = started(device)
    alone.live.drop("b", "it is left out")
    alone.step()
    assert np.array_equal(drive.fused.cells, alone.fused.cells)
    # It has its vote again when it is right again.
    tell(drive, range(15, 20), a=0.0, b=0.1, c=-0.1)
    drive.step(good)
    assert drive.accepted() == "abc"


def test_of_two_whose_poses_contradict_neither_votes_and_the_last_map_stays(
    device: ComputeDevice,
) -> None:
    drive = started(device, "ab")
    first = drive.fused
    tell(drive, range(10), a=0.0, b=0.1)
    tell(drive, range(10, 15), a=0.0, b=3.0)
    update = drive.step(touched(three()["a"], 1), touched(three()["b"], 1))
    assert drive.accepted() == ""
    assert update.fused is None
    assert "no majority decides" in update.problem
    assert all("poses contradict" in record.reason for record in update.inputs)
    tell(drive, range(15, 20), a=0.0, b=0.1)
    update = drive.step()
    assert drive.accepted() == "ab"
    assert_same_lattice(first, update.fused)
    # When one of two that contradict each other is lost, the other goes on.
    tell(drive, range(20, 25), a=0.0, b=3.0)
    drive.step()
    assert drive.accepted() == ""
    drive.live.drop("b", "its producer is gone")
    for _ in range(3):
        drive.maybe()
    assert drive.accepted() == "a"
