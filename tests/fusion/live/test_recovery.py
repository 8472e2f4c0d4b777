"""Recovery by the last fused map: who fits it comes back, and who is right is never guessed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.live.anchor import LAST_FUSED
from slamfusion.fusion.live.records import LiveUpdate
from slamfusion.fusion.live.recovery import LAST_AGREED, recover
from slamfusion.fusion.live.track import Track
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.maps import (
    AWAY,
    Drive,
    live_fusion,
    moved_frame,
    started,
    three,
    touched,
)


def doubtful(device: ComputeDevice) -> tuple[Drive, list[Track]]:
    """Return a drive on which three inputs were fused and none is believed now."""
    drive = started(device)
    tracks = list(drive.live._tracks.values())
    for track in tracks:
        track.refuse("in doubt")
    return drive, tracks


def test_all_that_fit_it_and_each_other_come_back(device: ComputeDevice) -> None:
    drive, tracks = doubtful(device)
    aligner = drive.live._supervisor._aligner
    found = recover(tracks, aligner, drive.live._voting.last_fused)
    assert all(track.votes for track in tracks)
    assert found.reference is max(tracks, key=lambda track: track.walls)
    assert found.problem is None


def test_one_that_does_not_fit_is_named_and_the_others_go_on(device: ComputeDevice) -> None:
    drive, tracks = doubtful(device)
    live = drive.live
    track = tracks[1]
    thresholds = live._config.normalize
    assert live._voting.resolution is not None
    moved = moved_frame(three()["b"], AWAY)
    track.follow(moved, live._voting.resolution, thresholds, live._live, device)
    found = recover(tracks, live._supervisor._aligner, live._voting.last_fused)
    assert [track.votes for track in tracks] == [True, False, True]
    assert track.reason == f"does not fit {LAST_FUSED}"
    assert found.reference in {tracks[0], tracks[2]}


def test_without_inputs_or_walls_nobody_votes_and_it_is_said_why(device: ComputeDevice) -> None:
    drive, tracks = doubtful(device)
    aligner = drive.live._supervisor._aligner
    assert recover([], aligner, lambda: None).problem == "no input is left"
    for track in tracks:
        track.tried = None
    found = recover(tracks, aligner, lambda: None)
    assert found.problem == f"{LAST_FUSED} has too few walls to go by"
    assert {track.reason for track in tracks} == {found.problem}


def test_what_was_tried_is_not_tried_again_and_the_map_not_asked_for(
    device: ComputeDevice,
) -> None:
    drive, tracks = doubtful(device)
    aligner = drive.live._supervisor._aligner
    for track in tracks:
        track.tried = (track.version, "a/b/c", -1)

    def fused() -> OccupancyGrid | None:
        pytest.fail("drawing the last fused map takes time")

    found = recover(tracks, aligner, fused)
    assert (found.reference, found.problem) == (None, None)
    assert not any(track.votes for track in tracks)


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
    raise AssertionError(drive.live.inputs(drive.now_s))


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
    drive = Drive(live_fusion(device))
    drive.step(three()["a"], three()["b"])
    update = bend_until(drive, lambda: drive.accepted() == "")
    assert update.problem == "a, b disagree and nobody can say who is right"
    drive.step(moved_frame(three()["c"], AWAY))
    for _ in range(3):
        if not drive.accepted():
            drive.maybe()
    assert drive.accepted() == "ac"
