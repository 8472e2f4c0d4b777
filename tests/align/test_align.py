"""One grid aligned to another: known transforms come back, doubtful ones are rejected."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.align.align import align_pair, track_pair
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.fusion import align_grids
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.json_values import record_keys
from tests.fusion.drawings import (
    assert_right,
    building,
    degraded,
    draw,
    features_of,
    fusion_config,
    off_by,
    with_origin,
)

QUICK = fusion_config()
ROOM = "\n".join(["#" * 40, *["#" + "." * 38 + "#"] * 38, "#" * 40])

FAULTS = {
    "nothing": {},
    "turned": {"yaw_rad": 0.7, "shift_share": (0.5, -0.3)},
    "upside down": {"yaw_rad": 3.1, "shift_share": (-0.5, 0.5)},
    "flipped cells": {"yaw_rad": -2.0, "flip_share": 0.05},
    "cropped": {"yaw_rad": 1.4, "crop_share": 0.6},
    "thick walls": {"yaw_rad": -0.4, "wall_change_cells": 1},
    "speckled": {"yaw_rad": 2.2, "speckle_share": 0.2},
    "margin": {"yaw_rad": 0.3, "margin_share": 0.9},
    "finer": {"yaw_rad": 0.9, "resolution": 0.04},
    "coarser": {"yaw_rad": -0.9, "resolution": 0.125},
    "origin yaw": {"yaw_rad": 1.2, "origin_yaw_rad": -2.3},
    "moved by its origin": {"yaw_rad": -1.9, "shift_share": (0.4, 0.4), "resample": False},
    "bent": {"yaw_rad": 0.5, "bend_cells": 1.0},
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_known_transform_comes_back(device: ComputeDevice, fault: str, seed: int) -> None:
    truth = building(seed, 11.0, 9.0)
    moving, pose = degraded(truth, seed, **FAULTS[fault])
    assert_right(align_grids(truth, moving, QUICK, device), moving, pose)


@pytest.mark.parametrize("seed", range(3))
def test_a_map_on_itself_scores_one_without_error(device: ComputeDevice, seed: int) -> None:
    grid = building(seed)
    found = align_grids(grid, grid.with_name("again"), QUICK, device)
    assert_right(found, grid, Pose2(), cells=0.05, degrees=0.05)
    assert found.score == pytest.approx(1.0)
    assert found.overlap == 1.0
    assert found.error == 0.0
    assert found.statistics["wall_match"] > 0.95
    assert found.statistics["wall_clash"] == 0.0


def test_both_directions_give_inverse_transforms(device: ComputeDevice) -> None:
    truth = building(4, 11.0, 9.0)
    moving, pose = degraded(truth, 1, yaw_rad=2.0, crop_share=0.8)
    forth = align_grids(truth, moving, QUICK, device)
    back = align_grids(moving, truth, QUICK, device)
    assert_right(forth, moving, pose)
    assert_right(back, truth, pose.inverse())
    shift, turn = off_by(moving, forth.transform, back.transform.inverse())
    assert shift < 0.5
    assert turn < 0.25


def test_the_yaw_profile_is_of_the_transform(device: ComputeDevice) -> None:
    truth = building(4, 11.0, 9.0)
    moving, pose = degraded(truth, 1, yaw_rad=2.0, origin_yaw_rad=0.8)
    profile = align_grids(truth, moving, QUICK, device).yaw_profile
    assert np.all(np.diff(profile[:, 0]) > 0)
    best = float(profile[profile[:, 1].argmax(), 0])
    assert abs(wrap_angle(best - pose.yaw_rad)) < math.radians(4.0)


@pytest.mark.parametrize("flips", [0.0, 0.01])
def test_a_square_room_is_ambiguous(device: ComputeDevice, flips: float) -> None:
    """Turned by a quarter it looks the same; far from the start nothing can tell which is right."""
    room = draw(ROOM)
    away, _ = degraded(room, 1, "away", yaw_rad=0.7, shift_share=(0.5, 0.5), flip_share=flips)
    if not flips:
        away = with_origin(room.with_name("away"), Pose2(30.0, 4.0, 0.7))
    found = align_grids(room, away, QUICK, device)
    assert found.runner_up.ratio > 0.95
    turn = wrap_angle(found.runner_up.transform.yaw_rad - found.transform.yaw_rad)
    quarters = turn / (math.pi / 2)
    assert abs(quarters - round(quarters)) < 0.02
    assert round(quarters) % 4 != 0
    assert not found.accepted
    assert found.reason.startswith("ambiguous")


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_window_without_the_answer_is_rejected(device: ComputeDevice, seed: int) -> None:
    """Inside a small window there is no rival to compare with: that speaks for nothing."""
    truth = building(seed, 11.0, 9.0)
    moving, pose = degraded(truth, 1, yaw_rad=2.0)
    start = pose.compose(Pose2(0.0, 0.0, 1.5))
    config = fusion_config(window_m=0.5, window_yaw_rad=0.2)
    found = align_grids(truth, moving, config, device, start)
    shift, turn = off_by(moving, found.transform, pose)
    assert shift > 5.0 or turn > 5.0
    assert not found.accepted, found.reason


@pytest.mark.parametrize("turned_round", [False, True])
def test_a_map_without_walls_is_rejected_by_name(device: ComputeDevice, turned_round: bool) -> None:
    truth, empty = building(1), draw("....\n....", name="lawn")
    pair = (empty, truth) if turned_round else (truth, empty)
    found = align_grids(*pair, QUICK, device)
    assert (found.accepted, found.decision) == (False, "not searched")
    assert found.reason == "lawn has no occupied cell, so there is nothing to align"
    assert found.transform == Pose2()
    assert found.evidence is None
    assert found.strength is None


TINY = {
    "one wall cell": "#",
    "one free cell": ".",
    "one row": "#..#....#.##...#",
    "one column": "#\n.\n.\n#\n.\n#",
    "all occupied": "\n".join(["#" * 30] * 30),
    "all free": "\n".join(["." * 30] * 30),
    "two cells": "#.",
    "one wall": "\n".join(["." * 30] * 10 + ["#" * 30]),
    "far corners": "#" + " " * 58 + "\n" + (" " * 59 + "\n") * 40 + " " * 58 + "#",
}


@pytest.mark.parametrize("name", TINY)
def test_maps_that_fit_anywhere_are_rejected(device: ComputeDevice, name: str) -> None:
    tiny = draw(TINY[name], name="tiny")
    for pair in ((building(1), tiny), (tiny, building(1)), (tiny, tiny.with_name("twin"))):
        found = align_grids(*pair, QUICK, device)
        if pair[1].name == "twin" and name in {"one wall", "all occupied"}:
            continue  # the same square twice in the same frame: nothing speaks against it
        assert not found.accepted, (pair[0].name, pair[1].name, found.reason)
        assert found.reason
        assert all(map(math.isfinite, (found.score, found.overlap, found.error)))
        assert all(map(math.isfinite, found.statistics.values()))


@pytest.mark.parametrize("step", [4, 8])
def test_the_fixed_step_search_finds_a_small_motion(device: ComputeDevice, step: int) -> None:
    """Within a cell and a degree, its last step, and with the least error of those."""
    truth = building(1)
    middle = Pose2(*truth.origin.transform((4.5, 3.5)))
    motion = middle.compose(Pose2(0.5, -0.4, math.radians(5.0))).compose(middle.inverse())
    moving = with_origin(truth.with_name("moved"), motion.inverse().compose(truth.origin))
    config = fusion_config(step=step, window_m=1.2, window_yaw_rad=math.radians(16))
    found = align_grids(truth, moving, config, device)
    shift, turn = off_by(moving, found.transform, motion)
    assert shift <= 1.5
    assert turn <= 1.0 + 1e-6


def test_far_origins_do_not_matter(device: ComputeDevice) -> None:
    """500 m away a degree is 9 m of shift at the frame's zero, but not at the map."""
    truth = building(2, 11.0, 9.0)
    moving, pose = degraded(truth, 2, yaw_rad=1.1, flip_share=0.02, resample=False)
    near = align_grids(truth, moving, QUICK, device)
    far = Pose2(-500.0, 507.77, 2.2)
    there = with_origin(moving, far.compose(moving.origin))
    found = align_grids(truth, there, QUICK, device)
    assert_right(found, there, pose.compose(far.inverse()))
    shift, turn = off_by(moving, found.transform.compose(far), near.transform)
    assert shift < 1e-3
    assert turn < 1e-3
    both = align_grids(with_origin(truth, far.compose(truth.origin)), there, QUICK, device)
    assert_right(both, there, far.compose(pose).compose(far.inverse()))


def test_the_error_is_that_of_the_paper(device: ComputeDevice) -> None:
    """Sum of squared differences of -1 / 0 / 1 over the reference's known box, and its root."""
    grid = building(3)
    cells = grid.cells.copy()
    free = np.argwhere(cells == 0)[::97]
    cells[tuple(free.T)] = -1
    other = replace(grid, cells=cells, name="holes")
    found = align_grids(grid, other, QUICK, device)
    assert_right(found, other, Pose2(), cells=0.1)
    assert found.error == pytest.approx(math.sqrt(len(free)), rel=0.3)


def test_tracking_refines_a_known_transform(device: ComputeDevice) -> None:
    truth = building(3, 11.0, 9.0)
    moving, pose = degraded(truth, 5, yaw_rad=0.8, flip_share=0.02)
    a, b = features_of(truth, device), features_of(moving, device)
    found = track_pair(Pair(a, b), pose.compose(Pose2(0.2, -0.15, 0.03)))
    assert_right(found, moving, pose)
    assert found.runner_up is None
    assert found.yaw_profile is None


def test_tracking_a_transform_that_is_wrong_is_rejected(device: ComputeDevice) -> None:
    a, b = (features_of(building(seed, 11.0, 9.0), device) for seed in (3, 4))
    found = track_pair(Pair(a, b), Pose2(1.0, 2.0, 1.0))
    assert not found.accepted
    assert found.decision == "too little in common"


def test_a_pair_travels_small_and_is_aligned_alike(device: ComputeDevice) -> None:
    truth = building(3, 11.0, 9.0)
    moving, _ = degraded(truth, 5, yaw_rad=0.8, flip_share=0.02)
    pair = Pair(features_of(truth, device), features_of(moving, device))
    wanted, packed = align_pair(pair, QUICK.align), pickle.dumps(pair)
    assert len(packed) < 0.2 * 3 * sum(math.prod(features.shape) for features in pair)
    found = align_pair(pickle.loads(packed), QUICK.align)  # noqa: S301 - our own
    assert record_keys(found) == {**record_keys(wanted), "time_s": found.time_s}
    assert np.array_equal(found.yaw_profile, wanted.yaw_profile)
