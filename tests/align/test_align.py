"""One grid aligned to another: known transforms come back, doubtful ones are rejected."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from slamfusion.align.align import align_features, track_features
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig
from slamfusion.errors import ConfigError, GridError
from slamfusion.fusion import align_grids
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.sim import draw_building
from tests.fusion.drawings import (
    assert_right,
    building,
    degraded,
    draw,
    features_of,
    fusion_config,
    off_by,
    padded,
    with_origin,
)
from tests.support.examples import examples

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


def without_time(alignment: Alignment) -> dict[str, object]:
    return {key: value for key, value in alignment.to_json().items() if key != "time_s"}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_known_transform_comes_back(device: ComputeDevice, fault: str, seed: int) -> None:
    truth = building(seed, 11.0, 9.0)
    moving, pose = degraded(truth, seed, **FAULTS[fault])
    assert_right(align_grids(truth, moving, QUICK, device), moving, pose)


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 1000),
    yaw=st.floats(-math.pi, math.pi),
    x=st.floats(-0.5, 0.5),
    y=st.floats(-0.5, 0.5),
    crop=st.floats(0.7, 1.0),
    flips=st.floats(0.0, 0.03),
)
def test_any_drawn_transform_comes_back_or_is_rejected(
    device: ComputeDevice, seed: int, yaw: float, x: float, y: float, crop: float, flips: float
) -> None:
    truth = building(seed, 11.0, 9.0)
    moving, pose = degraded(
        truth, seed, yaw_rad=yaw, shift_share=(x, y), crop_share=crop, flip_share=flips
    )
    found = align_grids(truth, moving, QUICK, device)
    if found.accepted:
        assert_right(found, moving, pose)


@pytest.mark.once
def test_nine_in_ten_drawn_transforms_are_accepted_and_right(device: ComputeDevice) -> None:
    rng = np.random.default_rng(4)
    accepted = 0
    for seed in range(30):
        truth = building(seed, 11.0, 9.0)
        moving, pose = degraded(
            truth,
            seed,
            yaw_rad=float(rng.uniform(-math.pi, math.pi)),
            crop_share=float(rng.uniform(0.7, 1.0)),
            flip_share=float(rng.uniform(0.0, 0.03)),
        )
        found = align_grids(truth, moving, QUICK, device)
        if found.accepted:
            assert_right(found, moving, pose)
        accepted += found.accepted
    assert accepted >= 27


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
    assert profile is not None
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
    assert found.runner_up is not None
    assert found.runner_up.ratio > 0.95
    turn = wrap_angle(found.runner_up.transform.yaw_rad - found.transform.yaw_rad)
    quarters = turn / (math.pi / 2)
    assert abs(quarters - round(quarters)) < 0.02
    assert round(quarters) % 4 != 0
    assert not found.accepted
    assert found.reason.startswith("ambiguous")


@pytest.mark.parametrize("seed", range(12))
def test_unrelated_buildings_are_rejected(device: ComputeDevice, seed: int) -> None:
    first, second = building(seed, 11.0, 9.0, 0.05), building(seed + 50, 9.0, 7.5, 0.05)
    # Drawn buildings have their zero in the corridor; that they share it must not speak for them.
    second = with_origin(second, Pose2(30.0, -20.0, 1.3).compose(second.origin))
    found = align_grids(first, second, QUICK, device)
    assert not found.accepted, found.reason
    assert found.reason


def test_one_straight_wall_is_not_enough(device: ComputeDevice) -> None:
    """6.6 m of the outer walls of two buildings, whose ends happen to lie as far apart."""
    halves = []
    for seed, *sides, width in ((282335, 6.1414, 7.7383, 26), (112951, 8.2474, 8.0503, 34)):
        whole = draw_building(np.random.default_rng(seed), *sides, 0.1)
        halves.append(whole.crop(CellBox(0, 0, whole.height, width)).with_name(f"half {seed}"))
    found = align_grids(*halves, QUICK, device)
    assert found.decision == "too little in common", found.reason
    assert "run one way" in found.reason
    assert found.evidence is not None
    assert found.evidence.better > 2.9, "enough by the pieces alone"
    assert found.evidence.held_m is not None
    assert found.evidence.held_m < 0.7


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
    assert not found.accepted
    assert "lawn has no occupied cell" in found.reason
    assert found.transform == Pose2()


def test_a_map_without_a_known_cell_is_an_error(device: ComputeDevice) -> None:
    with pytest.raises(GridError, match="fog: all 1 x 2 cells are unknown"):
        align_grids(building(1), draw(" ?", name="fog"), QUICK, device)


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


@pytest.mark.parametrize("name", TINY)
def test_the_fixed_step_search_takes_any_map(device: ComputeDevice, name: str) -> None:
    tiny = draw(TINY[name], name="tiny")
    config = fusion_config(step=8, window_m=1.0, window_yaw_rad=0.2)
    for pair in ((building(1), tiny), (tiny, building(1))):
        assert not align_grids(*pair, config, device).accepted


def test_same_input_same_answer_to_the_last_bit(device: ComputeDevice) -> None:
    truth = building(5, 11.0, 9.0)
    moving, _ = degraded(truth, 2, yaw_rad=1.0, flip_share=0.03, crop_share=0.7)
    first, second = (align_grids(truth, moving, QUICK, device) for _ in range(2))
    assert without_time(first) == without_time(second)
    assert first.yaw_profile is not None
    assert second.yaw_profile is not None
    assert first.yaw_profile.tobytes() == second.yaw_profile.tobytes()


def test_a_start_chooses_among_the_turns_of_a_square_room(device: ComputeDevice) -> None:
    room = draw(ROOM)
    centre = Pose2(2.0, 2.0)
    for quarter in range(4):
        start = centre.compose(Pose2(0.0, 0.0, quarter * math.pi / 2)).compose(centre.inverse())
        near = start.compose(Pose2(0.15, -0.1, 0.05))
        config = fusion_config(window_m=1.0, window_yaw_rad=0.3)
        found = align_grids(room, room.with_name("again"), config, device, near)
        assert_right(found, room, start, cells=0.5, degrees=0.5)


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_answer_lies_near_the_window(device: ComputeDevice, seed: int) -> None:
    """The right transform is outside; refinement moves what is found instead by little."""
    truth = building(seed, 11.0, 9.0)
    moving, pose = degraded(truth, 1, yaw_rad=2.0)
    start = pose.compose(Pose2(0.0, 0.0, 1.5))
    config = fusion_config(window_m=0.5, window_yaw_rad=0.2)
    found = align_grids(truth, moving, config, device, start)
    if "no fit inside the window" in found.reason:
        assert not found.accepted
        return
    shift, turn = off_by(moving, found.transform, start)
    assert shift < 5 * math.sqrt(2) + 8
    assert turn < math.degrees(0.2) + 10


def test_a_window_around_the_answer_finds_it(device: ComputeDevice) -> None:
    truth = building(1, 11.0, 9.0)
    moving, pose = degraded(truth, 1, yaw_rad=2.0, origin_yaw_rad=0.4, shift_share=(0.5, 0.1))
    centre = moving.origin.transform((moving.width * 0.05, moving.height * 0.05))
    nudge = Pose2(*centre, 0.1).compose(Pose2(*(-centre)))
    config = fusion_config(window_m=0.6, window_yaw_rad=0.3)
    found = align_grids(truth, moving, config, device, pose.compose(nudge))
    assert_right(found, moving, pose)


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


def test_a_step_that_would_take_days_is_refused(device: ComputeDevice) -> None:
    """In words that hold for the command line and for the node's parameters."""
    grid = building(1)
    with pytest.raises(ConfigError, match="poses to try; choose a larger step, or a narr") as told:
        align_grids(grid, grid.with_name("again"), fusion_config(step=1, window_m=20.0), device)
    assert "--" not in str(told.value)


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


def test_an_unknown_margin_changes_nothing(device: ComputeDevice) -> None:
    truth = building(2, 11.0, 9.0)
    moving, _ = degraded(truth, 2, yaw_rad=1.1, origin_yaw_rad=0.6)
    plain = align_grids(truth, moving, QUICK, device)
    grown = align_grids(padded(truth, 5, 0, 31, 8), padded(moving, 40, 3, 0, 77), QUICK, device)
    shift, turn = off_by(moving, grown.transform, plain.transform)
    assert shift < 1e-6
    assert turn < 1e-6
    assert (grown.score, grown.error) == (plain.score, plain.error)


def test_thin_and_thick_walls_align_centred(device: ComputeDevice) -> None:
    """Walls of one cell against walls of three."""
    truth = building(3, 11.0, 9.0)
    walls = ndimage.binary_dilation(truth.cells == 100, np.ones((3, 3)))
    thick = replace(truth, cells=np.where(walls, np.int8(100), truth.cells), name="thick")
    turned, pose = degraded(thick, 1, yaw_rad=0.8)
    assert_right(align_grids(truth, turned, QUICK, device), turned, pose)


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


def test_thresholds_reach_the_alignment(device: ComputeDevice) -> None:
    """Walls at 60 % are unknown by default and walls when asked for."""
    truth = building(3)
    faint = replace(
        truth, cells=np.where(truth.cells == 100, np.int8(60), truth.cells), name="faint"
    )
    assert not align_grids(truth, faint, QUICK, device).accepted
    asked = replace(QUICK, normalize=NormalizeConfig(occupied_percent=60.0))
    assert_right(align_grids(truth, faint, asked, device), faint, Pose2())


def test_tracking_refines_a_known_transform(device: ComputeDevice) -> None:
    truth = building(3, 11.0, 9.0)
    moving, pose = degraded(truth, 5, yaw_rad=0.8, flip_share=0.02)
    a, b = features_of(truth, device), features_of(moving, device)
    found = track_features(a, b, device, pose.compose(Pose2(0.2, -0.15, 0.03)))
    assert_right(found, moving, pose)
    assert found.runner_up is None
    assert found.yaw_profile is None


def test_tracking_a_transform_that_is_wrong_is_rejected(device: ComputeDevice) -> None:
    a, b = (features_of(building(seed, 11.0, 9.0), device) for seed in (3, 4))
    found = track_features(a, b, device, Pose2(1.0, 2.0, 1.0))
    assert not found.accepted
    assert "do not match" in found.reason


def test_prepared_grids_align_as_given_ones(device: ComputeDevice) -> None:
    truth = building(2)
    moving, _ = degraded(truth, 2, yaw_rad=1.1)
    a, b = features_of(truth, device), features_of(moving, device)
    prepared = align_features(a, b, QUICK.align, device)
    assert without_time(prepared) == without_time(align_grids(truth, moving, QUICK, device))


def test_an_alignment_as_json_has_the_keys_that_programs_rely_on(device: ComputeDevice) -> None:
    found = align_grids(building(1), building(1).with_name("again"), QUICK, device)
    assert list(found.to_json()) == [
        "name",
        "reference",
        "accepted",
        "reason",
        "dx_m",
        "dy_m",
        "yaw_rad",
        "score",
        "overlap",
        "error",
        "runner_up",
        "time_s",
        "statistics",
        "match_evidence",
        "match_decision",
        "strength",
    ]
    assert found.to_json()["strength"] == "strong"
    assert found.to_json()["name"] == "again"


def test_a_map_of_two_resolutions_aligns_either_way(device: ComputeDevice) -> None:
    truth = building(2, 11.0, 9.0)
    for resolution in (0.05, 0.0875, 0.15):
        moving, pose = degraded(truth, 2, yaw_rad=1.1, resolution=resolution)
        assert_right(align_grids(truth, moving, QUICK, device), moving, pose)
        assert_right(align_grids(moving, truth, QUICK, device), truth, pose.inverse())


def test_a_given_resolution_is_used(device: ComputeDevice) -> None:
    truth = building(2, 11.0, 9.0, 0.05)
    moving, pose = degraded(truth, 2, yaw_rad=1.1)
    coarse = replace(QUICK, normalize=NormalizeConfig(resolution=0.1))
    found = align_grids(truth, moving, coarse, device)
    assert_right(found, moving, pose, cells=2.0)
    assert isinstance(truth, OccupancyGrid)
