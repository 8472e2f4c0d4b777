"""Starts in the live fusion: where an input is looked for until it has a place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.errors import StartError
from slamfusion.fusion.live import LiveFusion
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, degraded, draw, off_by
from tests.fusion.live.maps import Drive, moved_frame

ROOM = "\n".join(["#" * 40, *["#" + "." * 38 + "#"] * 38, "#" * 40])
Values = tuple[float, ...]


def drive(device: ComputeDevice, names: str | None = None, **starts: Values) -> Drive:
    live = LiveConfig(search_pause_s=0.0)
    return Drive(LiveFusion(RunConfig(live=live, start=starts), device, names))


def made() -> dict[str, tuple[OccupancyGrid, Pose2]]:
    """Three maps of one place, and the poses of their frames in its own."""
    truth = building(3, 11.0, 9.0)
    faults = {"a": {"resample": False}, "b": {"yaw_rad": 1.3}, "c": {"yaw_rad": -2.0}}
    return {
        name: degraded(truth, number, name, **fault)
        for number, (name, fault) in enumerate(faults.items())
    }


def told(pose: Pose2, *tolerances: float) -> Values:
    return (pose.x, pose.y, pose.yaw_rad, *tolerances)


def starts() -> dict[str, Values]:
    """The poses, near which the maps lie."""
    return {name: told(pose, 0.5, 0.1) for name, (_, pose) in made().items()}


def test_starts_decide_the_first_fusion_of_a_square_room(device: ComputeDevice) -> None:
    a, b = draw(ROOM, name="a"), draw(ROOM, name="b")
    without = drive(device)
    without.step(a, b)
    assert without.accepted() == ""
    assert "ambiguous" in without.input("a").reason
    with_starts = drive(device, "ab", a=(5.0, 5.0, 1.0), b=(5.1, 5.1, 1.1))
    with_starts.step(a, b)
    assert with_starts.accepted() == "ab"
    transforms = [with_starts.input(name).transform for name in "ab"]
    assert None not in transforms
    shift, turn = off_by(b, transforms[1] or Pose2(), transforms[0] or Pose2())
    assert shift < 0.5
    assert turn < 0.5


def test_an_input_is_looked_for_around_its_start_alone(device: ComputeDevice) -> None:
    """At the first fusion and when it comes later; others are searched everywhere."""
    grids = {name: grid for name, (grid, _) in made().items()}
    wrong = told(made()["c"][1].compose(Pose2(0.0, 0.0, 1.5)), 0.5, 0.1)
    at_once = drive(device, "abc", **(starts() | {"c": wrong}))
    at_once.step(*grids.values())
    assert at_once.accepted() == "ab"
    later = drive(device, "abc", **(starts() | {"c": wrong}))
    later.step(grids["a"], grids["b"])
    for number in range(3):
        later.step(replace(grids["c"], cells=_touched(grids["c"], number)))
    assert later.accepted() == "ab"
    right = drive(device, "abc", **starts())
    right.step(grids["a"], grids["b"])
    right.step(grids["c"])
    assert right.accepted() == "abc"
    # Without a start of its own it is searched everywhere.
    only_two = starts()
    del only_two["c"]
    everywhere = drive(device, "abc", **only_two)
    everywhere.step(grids["a"], grids["b"])
    everywhere.step(grids["c"])
    assert everywhere.accepted() == "abc"


def _touched(grid: OccupancyGrid, number: int) -> npt.NDArray[np.int8]:
    cells = grid.cells.copy()
    cells[grid.height // 2, 20 + number] = 100
    return cells


def test_an_input_that_had_a_place_is_searched_everywhere(device: ComputeDevice) -> None:
    """A SLAM that begins a new map elsewhere is found though its start says otherwise."""
    grids = {name: grid for name, (grid, _) in made().items()}
    live = drive(device, "abc", **starts())
    live.step(*grids.values())
    assert live.accepted() == "abc"
    elsewhere = Pose2(4.0, -3.0, 2.0)
    for number in range(4):
        again = replace(grids["c"], cells=_touched(grids["c"], number))
        live.step(replace(again, origin=elsewhere.compose(again.origin)))
    assert live.accepted() == "abc"
    # Where a new fused frame begins the starts count again, and this one is wrong now.
    live.live.reset()
    live.maybe()
    assert live.accepted() == "ab"


def test_starts_that_cannot_hold_are_refused(device: ComputeDevice) -> None:
    for names, given, words in (
        ("ab", {"c": (0.0, 0.0, 0.0)}, "'c', which is no input"),
        ("abc", {"a": (0.0, 0.0, 0.0)}, "'a' alone says nothing"),
    ):
        with pytest.raises(StartError, match=words):
            drive(device, names, **given)
    # Where the inputs are not known yet, any may come.
    drive(device, None, c=(0.0, 0.0, 0.0))


def tell_poses(drive: Drive, places: dict[str, Pose2], seconds: float, speed: float) -> None:
    """Drive along x of the place that map frames lie in, and tell each where the robot is."""
    for step in range(round(10.0 * seconds)):
        here = Pose2(4.0 + 0.1 * step * speed, 5.0, 0.3)
        for name, place in places.items():
            drive.live.hear(name, 0.1 * step, place.inverse().compose(here))


@pytest.mark.parametrize(("speed", "voters"), [(0.5, "ab"), (0.1, "")])
def test_poses_of_equal_stamps_decide_the_first_fusion_of_a_square_room(
    device: ComputeDevice, speed: float, voters: str
) -> None:
    """Of a robot that has hardly driven they say nothing."""
    a, b = draw(ROOM, name="a"), draw(ROOM, name="b")
    without_starts = drive(device)
    tell_poses(without_starts, {"a": Pose2(), "b": Pose2(0.0, 0.0, 0.05)}, 2.0, speed)
    without_starts.step(a, b)
    assert without_starts.accepted() == voters


@pytest.mark.parametrize(("late_s", "voters"), [(0.0, "abc"), (0.05, "ab")])
def test_an_input_that_comes_later_is_looked_for_where_its_poses_put_it(
    device: ComputeDevice, late_s: float, voters: str
) -> None:
    """A square room looks alike from four sides; poses of other stamps do not say which it is."""
    frames = {"a": Pose2(), "b": Pose2(0.1, 0.0, 0.02), "c": Pose2(4.0, 0.0, 0.5 * np.pi)}
    maps = {
        name: moved_frame(draw(ROOM, name=name), place.inverse()) for name, place in frames.items()
    }
    robot = drive(device)
    tell_poses(robot, {name: frames[name] for name in "ab"}, 2.0, 0.5)
    robot.step(maps["a"], maps["b"])
    assert robot.accepted() == "ab"
    for step in range(20):
        here = Pose2(4.0 + 0.05 * step, 5.0, 0.3)
        robot.live.hear("c", 0.1 * step + late_s, frames["c"].inverse().compose(here))
    robot.step(maps["c"])
    assert robot.accepted() == voters
    if voters == "abc":
        a, c = (robot.input(name).transform or Pose2() for name in "ac")
        shift, turn = off_by(maps["c"], c, a.compose(frames["c"]))
        assert shift < 2.0
        assert turn < 1.0
