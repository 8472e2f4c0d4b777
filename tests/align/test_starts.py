"""Starts: what they say of a pair, and that a pair is searched there and nowhere else."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from slamfusion.align.align import align_grids
from slamfusion.align.starts import StartPose, Starts, place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.errors import AlignmentError, StartError
from slamfusion.fusion import fuse_grids
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import (
    assert_right,
    building,
    degraded,
    draw,
    fusion_config,
    off_by,
    with_origin,
)

QUICK = fusion_config()
# Equal rooms, of which starts choose a turn, are two maps here.
ALIKE = replace(QUICK, keep_duplicates=True)
ROOM = "\n".join(["#" * 40, *["#" + "." * 38 + "#"] * 38, "#" * 40])
A, B = StartPose(Pose2(1.0, 2.0, 0.5), 0.5, 0.1), StartPose(Pose2(-3.0, 4.0, -1.0), 1.0, 0.2)


def quarter_turned(quarter: int) -> Pose2:
    """The pose of the room's frame, turned about its middle."""
    centre = Pose2(2.0, 2.0)
    return centre.compose(Pose2(0.0, 0.0, quarter * math.pi / 2)).compose(centre.inverse())


# -- what starts say of a pair ---------------------------------------------------------------------


def test_two_starts_give_the_motion_between_two_frames_and_the_sum_of_tolerances() -> None:
    starts = Starts({"a": A, "b": B})
    found = starts.between("a", "b")
    point = (2.0, -1.0)
    in_world = B.pose.transform(point)
    assert tuple(A.pose.transform(found.pose.transform(point))) == pytest.approx(tuple(in_world))
    assert (found.metres, found.radians) == pytest.approx((1.5, 0.3))
    back = starts.between("b", "a")
    assert back.pose.compose(found.pose).x == pytest.approx(0.0)
    assert back.pose.yaw_rad == pytest.approx(-found.pose.yaw_rad)
    assert (back.metres, back.radians) == (found.metres, found.radians)
    assert found.inverse().pose.x == pytest.approx(back.pose.x)


def test_of_a_pair_in_which_one_has_no_start_nothing_is_known() -> None:
    starts = place_starts({"a": (1.0, 2.0, 0.5), "b": (0.0, 0.0, 0.0)}, ["a", "b", "c"])
    assert starts.between("a", "b") is not None
    assert starts.between("a", "c") is None
    assert starts.between("c", "b") is None


def test_a_start_has_default_tolerances_and_refuses_others_that_are_none() -> None:
    assert StartPose.of((1.0, 2.0, 3.0)) == StartPose(Pose2(1.0, 2.0, 3.0), 2.0, 0.35)
    assert StartPose.of((1.0, 2.0, 3.0, 0.0, 4.0)).reach == "0 m and 4 rad"
    for metres, radians in ((-1.0, 0.1), (0.1, -1.0), (math.nan, 0.1), (0.1, math.inf)):
        with pytest.raises(StartError, match="finite and at least 0"):
            StartPose(Pose2(), metres, radians)


# Inputs, the reference that is named, the drive; then who gives the frame of a's start.
SINGLE = {
    "the only other": ("ab", None, "", "b"),
    "the reference by name": ("abc", "c", "", "c"),
    "the reference by index": ("abc", "1", "", "b"),
    "the drive": ("bca", None, "bc", "bc"),
    "the others of its own drive": ("abc", None, "abc", "bc"),
    "a reference of the drive": ("bca", "b", "bc", "bc"),
    "a reference beside the drive": ("bcad", "d", "bc", "d"),
    "itself named as the reference of two": ("ab", "a", "", "b"),
    "nobody: a map alone": ("a", None, "", ""),
}


@pytest.mark.parametrize("case", SINGLE)
def test_a_single_start_is_told_in_the_frame_of_the_output(case: str) -> None:
    inputs, reference, drive, frame = SINGLE[case]
    starts = place_starts({"a": (1.0, 2.0, 0.5, 3.0, 0.25)}, list(inputs), reference, list(drive))
    assert starts.frame == set(frame)
    for name in inputs.replace("a", ""):
        found = starts.between(name, "a")
        assert found == (StartPose(Pose2(1.0, 2.0, 0.5), 3.0, 0.25) if name in frame else None)
    # Those that give the frame are searched everywhere among each other.
    assert all(starts.between(one, other) is None for one in frame for other in frame)


@pytest.mark.parametrize("reference", [None, "a"])
def test_a_single_start_that_says_nothing_is_refused(reference: str | None) -> None:
    with pytest.raises(StartError, match=r"'a' alone says nothing .* other 2 inputs; give one"):
        place_starts({"a": (0.0, 0.0, 0.0)}, ["a", "b", "c"], reference)


def test_a_start_that_names_no_input_is_refused_where_these_are_known() -> None:
    with pytest.raises(StartError, match="'d', which is no input; the inputs are a, b"):
        place_starts({"a": (0.0, 0.0, 0.0), "d": (0.0, 0.0, 0.0)}, ["a", "b"])
    assert set(place_starts({"d": (0.0, 0.0, 0.0)}, None).given) == {"d"}


# -- where a pair is searched ----------------------------------------------------------------------


@pytest.mark.parametrize("quarter", range(4))
def test_starts_choose_among_the_turns_of_a_square_room(
    device: ComputeDevice, quarter: int
) -> None:
    """Without them the four are alike; so they are told in the world, one frame of which is far."""
    room, wanted = draw(ROOM, name="room"), quarter_turned(quarter)
    again = room.with_name("again")
    with pytest.raises(AlignmentError, match=r"ambiguous: the same place twice"):
        fuse_grids([room, with_origin(again, Pose2(30.0, 4.0, 0.7))], ALIKE, device)
    world = Pose2(40.0, -7.0, 1.1)
    told = world.compose(wanted).compose(Pose2(0.2, -0.1, 0.1))
    starts = Starts({"room": StartPose(world, 0.0, 0.0), "again": StartPose(told, 1.0, 0.3)})
    result = fuse_grids([room, again], ALIKE, device, starts=starts)
    (pair,) = result.pairs
    # Of maps of one size the first is the reference.
    assert (pair.reference, pair.moving) == ("room", "again")
    assert_right(pair, again, wanted, cells=0.5)


def shifted(pose: Pose2, grid: OccupancyGrid, metres: float, radians: float) -> Pose2:
    """Return the pose by which a map's middle is moved along x, and the map turned about it."""
    middle = grid.origin.transform((grid.width * 0.05, grid.height * 0.05))
    there = pose.transform(middle)
    turned = Pose2(there[0] + metres, there[1], pose.yaw_rad + radians)
    return turned.compose(Pose2(-middle[0], -middle[1]))


# What the start is off by, its tolerances, and whether the truth lies within them.
OFF = {
    "right": (0.0, 0.0, 2.0, 0.35, True),
    "within metres": (1.5, 0.0, 2.0, 0.35, True),
    "within radians": (0.0, 0.3, 2.0, 0.35, True),
    "within both, backwards": (-1.2, -0.25, 2.0, 0.35, True),
    "beyond metres": (2.6, 0.0, 2.0, 0.35, False),
    "beyond radians": (0.0, 0.5, 2.0, 0.35, False),
    "a small tolerance": (0.8, 0.0, 0.3, 0.35, False),
    "a wide one": (5.0, 1.2, 8.0, 2.0, True),
    "anywhere": (7.0, 2.0, 1e9, 7.0, True),
}


@pytest.mark.parametrize("case", OFF)
def test_a_pair_is_searched_within_the_tolerances(device: ComputeDevice, case: str) -> None:
    metres, radians, reach_m, reach_rad, is_within = OFF[case]
    truth = building(3, 11.0, 9.0)
    moving, pose = degraded(truth, 1, yaw_rad=2.0, shift_share=(0.2, 0.1))
    start = StartPose(shifted(pose, moving, metres, radians), reach_m, reach_rad)
    found = align_grids(truth, moving, QUICK, device, start)
    if is_within:
        assert_right(found, moving, pose)
        return
    assert not found.accepted
    shift, turn = off_by(moving, found.transform, start.pose)
    assert f"within {start.reach} of the start" in found.reason
    if not found.reason.startswith("no fit"):
        # Cells of 0.1 m; what lies within is that far along each axis, and a little more.
        assert shift <= math.sqrt(2.0) * (10.0 * reach_m + 8.0)
        assert turn <= math.degrees(reach_rad) + 10.0


def test_a_start_where_the_maps_cannot_meet_is_refused_at_once(device: ComputeDevice) -> None:
    truth = building(3)
    for far in (Pose2(60.0, 0.0), Pose2(0.0, -60.0, 1.0), Pose2(1e6, 1e6), Pose2(1e300, 0.0)):
        found = align_grids(truth, truth.with_name("again"), QUICK, device, StartPose(far))
        assert not found.accepted
        assert found.reason == "the maps do not meet within 2 m and 0.35 rad of the start"


def test_only_pairs_that_both_have_a_start_are_searched_there(device: ComputeDevice) -> None:
    """Two wrong starts part two maps; a third map without a start finds both and joins them."""
    truth = building(1, 11.0, 9.0)
    made = [degraded(truth, number, name, yaw_rad=number) for number, name in enumerate("abc")]
    grids, poses = [grid for grid, _ in made], [pose for _, pose in made]
    wrong = shifted(poses[1], grids[1], 4.0, 1.5)
    starts = place_starts({"a": _values(poses[0]), "b": _values(wrong)}, "abc")
    result = fuse_grids(grids, QUICK, device, starts=starts)
    found = {frozenset((pair.reference, pair.moving)): pair for pair in result.pairs}
    assert all(pair.accepted for pair in found.values())
    assert found[frozenset("ab")].reason.startswith("accepted over others: as a pair with a, b was")
    assert len(fuse_grids(grids, QUICK, device).accepted) == 3
    with pytest.raises(AlignmentError, match=r"a to b|b to a"):
        fuse_grids(grids[:2], QUICK, device, starts=starts)


def _values(pose: Pose2) -> tuple[float, ...]:
    return (pose.x, pose.y, wrap_angle(pose.yaw_rad), 0.5, 0.2)
