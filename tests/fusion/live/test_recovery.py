"""Recovery by the last fused map: who fits it comes back, and who is right is never guessed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.live.fusion import LiveUpdate
from slamfusion.fusion.live.recovery import LAST_AGREED
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.maps import AWAY, Drive, moved_frame, started, three, touched


def bent(grid: OccupancyGrid, aside: int) -> OccupancyGrid:
    """Return a map of which one half is drawn some cells aside, as when a SLAM slips on its way."""
    cells = grid.cells.copy()
    half = cells[:, cells.shape[1] // 2 :]
    half[:] = np.roll(half, aside, axis=0)
    return replace(grid, cells=cells)


def bend_until(drive: Drive, is_done: Callable[[], bool]) -> LiveUpdate:
    """Let b bend, a cell aside with each map, while a goes on as it was."""
    for aside in range(1, 30):
        update = drive.step(touched(three()["a"], aside, 0.002), bent(three()["b"], aside))
        if is_done():
            return update
    raise AssertionError(drive.live.inputs())


def test_of_two_that_drew_the_last_map_the_one_goes_on_that_fits_what_a_majority_decided(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    drive.live.drop("c", "lost")
    drive.maybe()
    update = bend_until(drive, lambda: drive.accepted() != "ab")
    assert drive.accepted() == "a"
    assert drive.input("b").reason == f"does not fit {LAST_AGREED}"
    assert update.fused is not None


def test_a_third_that_comes_while_two_disagree_says_who_is_right(device: ComputeDevice) -> None:
    drive = started(device, "ab")
    update = bend_until(drive, lambda: drive.accepted() == "")
    assert update.problem == "a, b disagree and no majority decides"
    drive.step(moved_frame(three()["c"], AWAY))
    for _ in range(3):
        if not drive.accepted():
            drive.maybe()
    assert drive.accepted() == "ac"
