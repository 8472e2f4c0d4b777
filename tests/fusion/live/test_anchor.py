"""The fused frame stays where the last fused map has it, though what comes back is young."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, OccupancyGrid
from tests.fusion.drawings import off_by
from tests.fusion.live.maps import (
    Drive,
    littered,
    moved_frame,
    on_lattice,
    share_standing,
    started,
    three,
)

pytestmark = pytest.mark.once

# As a young map straightens while it grows: few walls near its middle move by a cell.
TURN_RAD = 0.03


def young(grid: OccupancyGrid, half_m: float) -> OccupancyGrid:
    """Return what a map holds within a square around its middle, as when a drive begins."""
    rows, cols = np.indices(grid.cells.shape)
    row, col = np.argwhere(grid.cells >= 0).mean(axis=0)
    half = half_m / grid.resolution
    near = (abs(rows - row) <= half) & (abs(cols - col) <= half)
    return replace(grid, cells=np.where(near, grid.cells, UNKNOWN).astype(np.int8))


def turn(grid: OccupancyGrid) -> Pose2:
    """Return a small turn about a map's middle."""
    row, col = np.argwhere(grid.cells >= 0).mean(axis=0)
    about = Pose2(*grid.cell_centres(np.array([row]), np.array([col]))[0], 0.0)
    return about.compose(Pose2(0.0, 0.0, TURN_RAD)).compose(about.inverse())


def known_on(fused: OccupancyGrid | None, before: OccupancyGrid) -> np.ndarray:
    """Return which cells of a fused map of before are known now."""
    return np.asarray(on_lattice(fused, before) >= 0)


def begun_anew(device: ComputeDevice, names: str, **live: int) -> Drive:
    """Return a drive on which all were lost, and some have begun new maps."""
    drive = started(device, **live)
    for name in "abc":
        drive.live.drop(name, "its producer is gone")
    drive.step()
    drive.step(*(young(three()[name], 1.5) for name in names))
    assert drive.accepted() in names, [drive.input(name).reason for name in names]
    return drive


def grow(drive: Drive, names: str, *halves_m: float) -> None:
    """Let the maps grow, turned a little."""
    for half_m in halves_m:
        for name in names:
            grid = three()[name]
            drive.maybe(young(moved_frame(grid, turn(grid)), half_m))


def assert_in_frame(drive: Drive, name: str, grid: OccupancyGrid, before: Pose2 | None) -> None:
    """Check that a map that has turned since lies where it lay before."""
    after = drive.input(name).transform
    right = before.compose(turn(grid).inverse())
    shift, degrees = off_by(moved_frame(grid, turn(grid)), after, right)
    assert shift < 1.0, name
    assert degrees < 0.3, name


@pytest.mark.parametrize("names", ["b", "abc"])
def test_maps_that_begin_anew_grow_into_the_frame_of_before(
    device: ComputeDevice, names: str
) -> None:
    drive = begun_anew(device, names)
    old = {name: drive.input(name).transform for name in names}
    grow(drive, names, 2.5, 4.0, 9.0)
    assert drive.accepted() == names
    for name, grid in three().items():
        if name in names:
            assert_in_frame(drive, name, grid, old[name])
            assert drive.input(name).fit.score > 0.5


def test_maps_that_begin_anew_one_by_one_grow_into_the_frame_of_before(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    old = {name: drive.input(name).transform for name in "abc"}
    # Nobody is lost: whoever goes on with the old map is the reference, the last one a young one.
    for name in "cab":
        update = drive.maybe(young(three()[name], 1.5))
        assert update is None or not update.problem
    grow(drive, "abc", 2.5, 4.0, 9.0)
    assert drive.accepted() == "abc"
    for name, grid in three().items():
        assert_in_frame(drive, name, grid, old[name])


def test_two_young_maps_take_nothing_from_what_the_third_knows(device: ComputeDevice) -> None:
    drive = started(device)
    assert drive.fused is not None
    before, said = drive.fused, "what it does not know yet is no vote"
    for name in "bc":
        drive.maybe(young(three()[name], 1.5))
    assert drive.accepted() == "abc"
    assert [said in drive.input(name).reason for name in "abc"] == [False, True, True]
    alone = known_on(drive.fused, before)
    assert np.count_nonzero(alone) > 0.9 * np.count_nonzero(before.cells >= 0)
    # When they have grown two that do not know a cell outvote the third again.
    drive.step(three()["b"], three()["c"])
    assert not any(said in drive.input(name).reason for name in "abc")
    # But for cells at the rim, where a map may lie a hundredth of a cell elsewhere than before.
    assert np.count_nonzero(known_on(drive.fused, before) != (before.cells >= 0)) < 10
    assert np.count_nonzero(alone != (before.cells >= 0)) > 10


def test_a_place_that_changed_leaves_the_frame_where_it_is(device: ComputeDevice) -> None:
    drive = begun_anew(device, "b", minimum_inputs=1)
    before, fused = drive.input("b").transform, drive.fused
    changed = three()["b"]
    for _ in range(2):
        drive.step(littered(young(changed, 4.0), 1, 0.9))
    assert drive.input("b").transform == before
    assert drive.accepted() == "b"
    reason = "the reference; the place is not as it was in the last fused map"
    assert drive.input("b").reason == reason
    assert share_standing(fused, drive.fused) > 0.95
