"""Paths against maps: a producer whose walls fit and whose path does not has no vote."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.errors import AlignmentError
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.grouping import PATH_GAP
from slamfusion.fusion.path_check import (
    PathsApartError,
    agreeing,
    fallback_map,
    fit_paths,
    fuse_with_paths,
    path_gaps,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.fusion.drawings import building, degraded, fusion_config

QUICK = fusion_config()
TRUE_PATH = Trajectory(
    np.arange(50.0), np.column_stack((np.linspace(2, 7, 50), np.full(50, 3.0), np.zeros(50))), "way"
)


def shifted(x: float, y: float = 0.0, yaw_rad: float = 0.0) -> Trajectory:
    return TRUE_PATH.moved(Pose2(x, y, yaw_rad))


def producers() -> tuple[list[OccupancyGrid], dict[str, Trajectory]]:
    """Three faulty maps of one place in frames of their own, each with the true path in it."""
    grids, paths = [], {}
    for seed, (name, yaw_rad) in enumerate({"a": 0.02, "b": -0.8, "c": 1.9}.items()):
        grid, pose = degraded(building(1, 11.0, 9.0), seed, name, yaw_rad=yaw_rad, flip_share=0.03)
        grids.append(grid)
        paths[name] = TRUE_PATH.moved(pose.inverse())
    return grids, paths


def test_gaps_are_measured_between_the_poses_of_one_moment() -> None:
    (gap,) = path_gaps({"a": TRUE_PATH, "b": shifted(3.0, 4.0)})
    assert (gap.a, gap.b) == ("a", "b")
    assert gap.median_m == pytest.approx(5.0)
    assert gap.max_m == pytest.approx(5.0)
    assert gap.median_yaw_rad == 0.0
    assert plain(gap) == {
        "a": "a", "b": "b", "median_m": pytest.approx(5.0), "max_m": pytest.approx(5.0),
        "start_m": pytest.approx(5.0), "median_yaw_rad": 0.0,
    }  # fmt: skip


# A robot that drives 1 m/s along x, and turns on its way.
MOVING_S = 0.08 * np.arange(400)
MOVING = Trajectory(
    MOVING_S, np.stack((MOVING_S, np.zeros(400), np.linspace(-4.0, 4.0, 400)), axis=1), "moving"
)


def test_where_a_path_was_between_its_poses_is_known() -> None:
    few = Trajectory(MOVING.stamps_s[3::19], MOVING.poses[3::19], "few")
    for paths in ({"a": MOVING, "b": few}, {"a": few, "b": MOVING}):
        (gap,) = path_gaps(paths)
        assert gap.max_m < 0.11
        assert gap.median_yaw_rad < 1e-6
    assert len(path_gaps({"a": MOVING, "b": few})[0].gaps_m) == 383


def test_the_largest_group_that_agrees_is_kept() -> None:
    paths = {"a": TRUE_PATH, "b": shifted(4.0), "c": shifted(0.3), "d": shifted(0.4)}
    members, reasons = agreeing(tuple(paths), path_gaps(paths))
    assert members == ("a", "c", "d")
    assert set(reasons) == {"b"}
    assert "4.00 m from that of a and 3.70 m from that of c" in reasons["b"]


def test_of_two_that_disagree_neither_is_believed() -> None:
    paths = {"a": TRUE_PATH, "b": shifted(4.0)}
    members, reasons = agreeing(("a", "b"), path_gaps(paths))
    assert members == ()
    assert set(reasons) == {"a", "b"}


def test_maps_whose_paths_agree_all_vote(device: ComputeDevice) -> None:
    grids, paths = producers()
    result, gaps = fuse_with_paths(grids, paths, QUICK, device)
    assert [record.name for record in result.accepted] == ["a", "b", "c"]
    assert len(gaps) == 3
    assert max(gap.max_m for gap in gaps) < 0.2


def test_a_producer_that_was_elsewhere_is_left_out_though_its_walls_fit(
    device: ComputeDevice,
) -> None:
    grids, paths = producers()
    paths["b"] = paths["b"].moved(Pose2(0.0, 2.0))
    result, gaps = fuse_with_paths(grids, paths, QUICK, device)
    assert [record.name for record in result.accepted] == ["a", "c"]
    (rejected,) = result.rejected
    assert rejected.name == "b"
    assert "its path lies 2." in rejected.reason
    assert rejected.alignment.accepted
    assert [grid.name for grid in grids] == [record.name for record in result.inputs]
    assert len(gaps) == 3
    assert len(result.pairs) == 3
    # The vote is that of the other two alone.
    without, _ = fuse_with_paths([grids[0], grids[2]], paths, QUICK, device)
    assert np.array_equal(result.fused.cells, without.fused.cells)


def test_a_saved_map_has_no_path_and_votes(device: ComputeDevice) -> None:
    grids, paths = producers()
    del paths["b"]
    result, gaps = fuse_with_paths(grids, paths, QUICK, device)
    assert len(result.accepted) == 3
    assert [(gap.a, gap.b) for gap in gaps] == [("a", "c")]


def test_two_producers_that_were_apart_are_not_fused(device: ComputeDevice) -> None:
    grids, paths = producers()
    paths["b"] = paths["b"].moved(Pose2(0.0, 2.0))
    with pytest.raises(PathsApartError, match="the paths do not") as caught:
        fuse_with_paths(grids[:2], paths, QUICK, device)
    assert len(caught.value.pairs) == 1
    (gap,) = caught.value.gaps
    assert gap.median_m == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize("is_turning", [False, True])
def test_the_fit_of_paths_is_the_motion_between_their_frames(*, is_turning: bool) -> None:
    path = TRUE_PATH
    if is_turning:  # on the spot: its places say nothing of the turn
        poses = np.column_stack((np.full(50, 2.0), np.full(50, 3.0), np.linspace(0.0, 5.0, 50)))
        path = Trajectory(TRUE_PATH.stamps_s, poses, "turn")
    motion = Pose2(3.0, -2.0, 2.5)
    found = fit_paths(path, path.moved(motion))
    assert (found.x, found.y, found.yaw_rad) == pytest.approx((3.0, -2.0, 2.5))


def square(name: str) -> OccupancyGrid:
    """A room that looks the same under four turns; its frame begins in its middle."""
    cells = np.zeros((61, 61), dtype=np.int8)
    cells[[0, 1, -2, -1], :] = cells[:, [0, 1, -2, -1]] = 100
    return OccupancyGrid(cells, 0.1, Pose2(-3.05, -3.05), name)


@pytest.mark.parametrize("turns", [0, 1, 2])
def test_a_map_that_walls_leave_open_is_placed_by_its_path(
    device: ComputeDevice, turns: int
) -> None:
    grids, config = [square("a"), square("b")], replace(QUICK, keep_duplicates=True)
    with pytest.raises(AlignmentError, match="ambiguous"):
        fuse_grids(grids, config, device)
    turn = Pose2(0.0, 0.0, turns * math.pi / 2.0)
    path = TRUE_PATH.moved(Pose2(-4.0, -3.0))
    result, _ = fuse_with_paths(grids, {"a": path, "b": path.moved(turn.inverse())}, config, device)
    assert len(result.accepted) == 2
    (pair,) = result.pairs
    assert pair.reason.startswith("placed by its path: 0.0")
    assert pair.statistics[PATH_GAP] < 0.1
    wanted = turn if pair.moving == "b" else turn.inverse()
    off = pair.transform.inverse().compose(wanted)
    assert math.hypot(off.x, off.y) < 0.1
    assert abs(off.yaw_rad) < 0.02


def test_without_walls_that_meet_no_path_places_a_map(device: ComputeDevice) -> None:
    grids, _ = producers()
    stranger = building(77, 8.0, 7.5).with_name("b")
    empty = replace(stranger, cells=np.zeros_like(stranger.cells))
    for other, reason in ((stranger, "no two of the inputs"), (empty, "b has no occupied cell")):
        with pytest.raises(AlignmentError, match=reason):
            fuse_with_paths([grids[0], other], {"a": TRUE_PATH, "b": TRUE_PATH}, QUICK, device)


def test_a_producer_that_is_lost_on_its_way_is_left_out_where_two_are_not() -> None:
    poses = TRUE_PATH.poses.copy()
    poses[30:, 1] += 8.0
    lost = Trajectory(TRUE_PATH.stamps_s, poses, "lost")
    paths = {"a": TRUE_PATH, "b": lost, "c": shifted(0.2)}
    gaps = path_gaps(paths)
    assert gaps[0].median_m == 0.0
    members, reasons = agreeing(tuple(paths), gaps)
    assert members == ("a", "c")
    assert "more than 8.00 m for a quarter of the time" in reasons["b"]
    # Of two that were together half of the time neither is known to be lost.
    del paths["c"]
    assert agreeing(("a", "b"), path_gaps(paths)) == (("a", "b"), {})


def test_the_fallback_map_is_the_one_that_others_bear_out(device: ComputeDevice) -> None:
    grids, _ = producers()
    pairs = fuse_grids(grids, QUICK, device).pairs
    lost = building(77, 8.0, 7.5).with_name("lost")
    with_lost = fuse_grids([*grids[:2], lost], QUICK, device)
    assert fallback_map([lost, *grids[:2]], with_lost.pairs).name in {"a", "b"}
    assert fallback_map(grids[1:2], pairs).name == "b"
    # The one that closes loops is taken where it is nearly as well borne out, and only there.
    named = {"a": "tinyslam", "b": "graph", "lost": "gmapping"}
    scores = {"tinyslam": 0.45, "graph": 0.44, "gmapping": 0.5}
    for graph_score, wanted in ((0.4, "gmapping"), (0.46, "graph")):
        made = [grid.with_name(named[grid.name]) for grid in (lost, *grids[:2])]
        pair = replace(pairs[0], score=0.0, accepted=False)
        alone = [
            replace(pair, reference=name, moving="another", score=score)
            for name, score in (scores | {"graph": graph_score}).items()
        ]
        assert fallback_map(made, alone, ["graph"]).name == wanted
        assert fallback_map(made, alone).name == "gmapping"
    # Nothing was aligned: the one that knows most.
    small = lost.crop(CellBox(0, 0, 20, 20))
    assert fallback_map([small, lost], ()) is lost
