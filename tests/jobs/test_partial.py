"""Producers that go wrong half-way: what they vote with, and the main job on such a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from slamfusion.compute import ComputeDevice
from slamfusion.config import MatcherConfig
from slamfusion.evaluation.distances import wall_centres
from slamfusion.evidence import PathEvidence, find_exclusions, judged_scans, score_paths
from slamfusion.evidence.drawn_map import DrawnScan, draw_map, drawn_scans
from slamfusion.geometry import Pose2, compose_poses
from slamfusion.grid import OccupancyGrid, trinary_cells
from slamfusion.io import LogScan, load_map, write_carmen
from slamfusion.jobs.fuse_drive import LEAST_SHARE, Filling, Layers, draw_layers, fuse_layers
from slamfusion.jobs.inputs import RUN_DEFAULTS
from slamfusion.jobs.run import run_log
from slamfusion.jobs.run_files import save_run
from slamfusion.json_values import plain
from slamfusion.slam.registry import with_settings
from slamfusion.trajectory import Trajectory
from tests.slam.drives import drive
from tests.support.documents import check_document

pytestmark = pytest.mark.once

COUNT = 120
RESOLUTION = 0.05
VOTE = replace(RUN_DEFAULTS.fusion.vote, mode="consensus")
CONFIG = replace(RUN_DEFAULTS, fusion=replace(RUN_DEFAULTS.fusion, vote=VOTE))


@cache
def recorded() -> tuple[list[LogScan], Trajectory]:
    scans, truth = drive(COUNT)
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    return scans, Trajectory(stamps_s, np.array([(p.x, p.y, p.yaw_rad) for p in truth]), "truth")


@cache
def drawn() -> list[DrawnScan]:
    return drawn_scans(recorded()[0])


def off_from(first: int, *motion: float) -> Trajectory:
    """The true path, moved by a motion in the frame of the map from one scan on."""
    _, truth = recorded()
    poses = truth.poses.copy()
    poses[first:] += np.array(motion)
    return Trajectory(truth.stamps_s, poses)


def running_away(first: int) -> Trajectory:
    """The true path, which from one scan on leaves ever faster, so that no two of its poses fit."""
    _, truth = recorded()
    poses = truth.poses.copy()
    poses[first:, 0] += 0.5 * np.arange(1, COUNT - first + 1) ** 1.5
    return Trajectory(truth.stamps_s, poses)


def drawn_by(
    paths: Mapping[str, Trajectory], device: ComputeDevice
) -> tuple[list[OccupancyGrid], PathEvidence]:
    """Return the map that each path draws, and what the scans say of the paths."""
    scans, _ = recorded()
    maps = [
        draw_map(drawn(), path, device, resolution=RESOLUTION, origin=Pose2(0.01, 0.02), name=name)
        for name, path in paths.items()
    ]
    return maps, score_paths(judged_scans(scans), paths, device)


def layers_of(paths: Mapping[str, Trajectory], device: ComputeDevice) -> Layers:
    maps, evidence = drawn_by(paths, device)
    return draw_layers(maps, paths, find_exclusions(evidence), lambda _: drawn(), device)


def far_share(grid: OccupancyGrid, like: OccupancyGrid) -> float:
    """Share of a map's walls that are more than 0.15 m from any of another's."""
    thresholds = CONFIG.fusion.normalize
    walls, others = (
        wall_centres(trinary_cells(item.cells, thresholds), item) for item in (grid, like)
    )
    return float(np.mean(KDTree(others).query(walls)[0] > 0.15))


def test_a_layer_is_drawn_anew_without_the_time_in_which_its_producer_had_left(
    device: ComputeDevice,
) -> None:
    _, truth = recorded()
    paths = {"a": truth, "b": off_from(0, 0.0, 0.0, 0.001), "c": off_from(70, 0.6, 0.4, 0.3)}
    maps, evidence = drawn_by(paths, device)
    asked: list[str] = []

    def scans_of(name: str) -> Sequence[DrawnScan]:
        asked.append(name)
        return drawn()

    saved = maps[0].with_name("saved")
    layers = draw_layers([*maps, saved], paths, find_exclusions(evidence), scans_of, device)
    assert asked == ["c"]
    a, b, c, unchanged = layers.grids
    assert (a, b, unchanged) == (maps[0], maps[1], saved)
    assert layers.maps == (*maps, saved), "the producers' own maps stay as they are"
    assert (c.name, c.resolution) == ("c", RESOLUTION)
    # On the lattice of its own map.
    corner = maps[2].origin.inverse().compose(c.origin)
    cells = np.array((corner.x, corner.y)) / RESOLUTION
    assert cells == pytest.approx(np.rint(cells), abs=1e-6)
    assert far_share(maps[2], a) > 0.1
    assert far_share(c, a) == 0.0
    assert layers.votes["c"].tolist() == [True] * 70 + [False] * 50
    assert set(layers.votes) == {"c"}
    (vote,) = layers.partial
    assert (vote.name, vote.left_out) == ("c", None)
    assert vote.excluded_share == pytest.approx(50 / COUNT)
    (span,) = vote.excluded_spans
    assert (span.from_s, span.to_s) == (7.0, pytest.approx(11.9))
    (words,) = layers.sentences()
    assert words == (
        f"c has no vote from 7 to 12 s, up to {span.gap_m:.1f} m away, where the others agree; its "
        "layer is redrawn from its other scans."
    )
    assert plain(vote)["excluded_spans"] == [
        {"from_s": 7.0, "to_s": span.to_s, "gap_m": span.gap_m, "ground": "outvoted"}
    ]


def test_what_was_drawn_wrong_is_not_in_the_fused_map(device: ComputeDevice) -> None:
    _, truth = recorded()
    paths = {"a": truth, "c": off_from(70, 0.6, 0.4, 0.3)}
    maps, _ = drawn_by(paths, device)
    layers = layers_of(paths, device)
    assert [vote.name for vote in layers.partial] == ["c"]
    shares = [
        far_share(result.fused, maps[0])
        for item in (Layers.as_made(maps, paths), layers)
        if (result := fuse_layers(item, CONFIG, device, shared_frame=True).result)
    ]
    before, after = shares
    assert before > 0.05
    assert after < 0.01
    # The fused map has the box of a map that shows all, though that of the layer is smaller.
    found = fuse_layers(layers, CONFIG, device, shared_frame=True)
    assert found.result is not None
    assert found.result.reference == "a"
    # The gap between the paths is told of all of the drive, and apart while both vote.
    (gap,) = found.gaps
    assert gap.stamps_s.tolist() == truth.stamps_s.tolist()
    assert gap.gaps_m[70:].min() > 0.5
    assert gap.max_m > 0.5
    assert gap.voting is not None
    assert gap.voting.max_m < 0.1


@pytest.mark.parametrize("kept", [int(LEAST_SHARE * COUNT) - 2, int(LEAST_SHARE * COUNT) + 2])
def test_who_was_hardly_with_the_others_is_left_out(device: ComputeDevice, kept: int) -> None:
    _, truth = recorded()
    paths = {"a": truth, "b": off_from(0, 0.0, 0.0, 0.001), "c": running_away(kept)}
    layers = layers_of(paths, device)
    (vote,) = layers.partial
    if kept > LEAST_SHARE * COUNT:
        assert vote.excluded_share == pytest.approx(1.0 - kept / COUNT, abs=0.5 / COUNT)
        assert [grid.name for grid in layers.grids] == ["a", "b", "c"]
        return
    assert [grid.name for grid in layers.grids] == ["a", "b"]
    assert "less than 10% of the drive is left" in vote.left_out
    assert vote.left_out in vote.sentence()
    result = fuse_layers(layers, CONFIG, device, shared_frame=True).result
    assert result is not None
    record = result.inputs[2]
    assert (record.name, record.accepted, record.reason) == ("c", False, vote.left_out)
    assert len(result.accepted) == 2


def test_where_nothing_tells_who_is_right_all_vote_and_it_is_said(device: ComputeDevice) -> None:
    # For 1.2 s of 12 the scans are asked too little.
    _, truth = recorded()
    poses = truth.poses.copy()
    poses[60:64, 1] += 0.5
    # Three times as slow.
    stamps_s = 3.0 * truth.stamps_s
    paths = {"a": Trajectory(stamps_s, truth.poses), "c": Trajectory(stamps_s, poses)}
    scans = [
        replace(item, scan=replace(item.scan, stamp_s=float(stamp_s)))
        for item, stamp_s in zip(recorded()[0], stamps_s, strict=True)
    ]
    evidence = score_paths(judged_scans(scans), paths, device)
    maps = [OccupancyGrid(np.zeros((1, 1), dtype=np.int8), 0.05, Pose2(), name) for name in "ac"]
    found = find_exclusions(evidence)
    layers = draw_layers(maps, paths, found, lambda _: drawn_scans(scans), device)
    assert layers.grids == tuple(maps)
    assert layers.sentences() == (
        (
            "The paths have parted from 18 to 19 s; the scans of that time alone do not tell which "
            "is right, and all of them vote."
        ),
    )


def test_a_layer_shows_the_time_without_a_vote_at_the_fused_path(device: ComputeDevice) -> None:
    _, truth = recorded()
    paths = {"a": truth, "c": off_from(70, 0.6, 0.4, 0.3)}
    maps, evidence = drawn_by(paths, device)
    # In a frame of its own, and with scans that are its own: those of the first half are not asked.
    turned = Trajectory(truth.stamps_s, compose_poses((5.0, -2.0, 0.7), truth.poses), "fused")
    filling = Filling(turned, lambda: drawn()[60:])
    found = find_exclusions(evidence)
    bare = draw_layers(maps, paths, found, lambda _: drawn(), device)
    layers = draw_layers(maps, paths, found, lambda _: drawn(), device, filling)
    (vote,) = layers.partial
    assert vote.filled
    assert vote.filled
    assert not bare.partial[0].filled
    assert vote.sentence().endswith("and from those of that time at the fused path.")
    assert far_share(layers.grids[1], maps[0]) == 0.0
    # It shows all that the true path draws, and the other one does not.
    assert far_share(maps[0], layers.grids[1]) == 0.0
    assert far_share(maps[0], bare.grids[1]) > 0.02
    assert layers.votes["c"].sum() == 70


def test_the_main_job_on_a_drive_on_which_one_producer_goes_wrong(tmp_path: Path) -> None:
    # From half of the drive on the odometry turns too much with every step; one follows it.
    scans, _ = recorded()
    fed, before, read = [], None, Pose2()
    for number, item in enumerate(scans):
        now = item.odometry or Pose2()
        step = now if before is None else before.inverse().compose(now)
        wrong = 0.03 if number > COUNT // 2 else 0.0
        read, before = read.compose(Pose2(step.x, step.y, step.yaw_rad + wrong)), now
        fed.append(replace(item, odometry=read))
    write_carmen(tmp_path / "bent.log", fed)
    trusting = MatcherConfig(
        sigma_m=1e-3, sigma_rad=1e-3, sigma_m_per_m=0.0, sigma_rad_per_rad=0.0,
        prior_weight_xy=1.0, prior_weight_yaw=1.0,
    )  # fmt: skip
    config = with_settings(CONFIG, "tinyslam", matcher=trusting)
    config = replace(config, run=replace(config.run, producers=("tinyslam", "graph")))
    run = run_log(tmp_path / "bent.log", config)
    assert run.failure is None
    (vote,) = run.layers.partial
    assert (vote.name, vote.left_out) == ("tinyslam", None)
    assert vote.excluded_spans[-1].ground == "contradicted by the scans"
    assert 6.0 <= vote.excluded_spans[0].from_s <= 9.0
    assert vote.excluded_spans[-1].to_s == pytest.approx(11.9)

    saved = save_run(run, tmp_path / "out")
    check_document(plain(saved.document), "run")
    assert plain(saved.document)["partial_votes"] == [plain(vote)]
    page = (tmp_path / "out" / "report" / "report.html").read_text(encoding="utf-8")
    assert "Who was off when" in page
    # Its own map is kept as it was made; the layer that voted is another one.
    own, layer = run.grids[0], run.layers.grids[0]
    kept = load_map(tmp_path / "out" / "tinyslam.yaml")
    thresholds = CONFIG.fusion.normalize
    saved_cells, own_cells = (trinary_cells(item.cells, thresholds) for item in (kept, own))
    assert np.array_equal(saved_cells, own_cells)
    assert run.usable is not None
    assert run.usable.inputs[0].grid is layer
    assert far_share(own, run.grids[1]) > 2.0 * far_share(layer, run.grids[1])
