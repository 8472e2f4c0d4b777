"""Each threshold of the graph SLAM's settings decides what its help says, on both of its sides."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import (
    GraphClosureConfig,
    GraphConfig,
    GraphRelocalizationConfig,
    GraphTrackingConfig,
    field_infos,
)
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.slam.common.matcher import Match
from slamfusion.slam.graph import GraphSlam
from slamfusion.slam.graph.closure_search import ClosureSearch, Found
from slamfusion.slam.graph.constraints import Constraint
from slamfusion.slam.graph.health import GraphHealth
from slamfusion.slam.graph.hypotheses import RelocalizationHypotheses
from slamfusion.slam.graph.local_map import LocalMap
from slamfusion.slam.graph.loop_candidates import LoopCandidate
from slamfusion.slam.graph.loop_closure import LoopClosure
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.pending_closures import How, PendingClosure, PendingClosures
from slamfusion.slam.graph.relocalization import Relocalization
from slamfusion.slam.graph.submap import Submap
from slamfusion.slam.graph.tracking_quality import TrackingQuality
from tests.slam.drives import CELL_M, draw_flat, true_poses
from tests.slam.places import NO_LASER, draw_regular_ring, log_of, read, run

pytestmark = pytest.mark.once

F64 = npt.NDArray[np.float64]
SECTIONS = {
    "tracking": GraphTrackingConfig,
    "closure": GraphClosureConfig,
    "relocalization": GraphRelocalizationConfig,
}
HERE = Pose2(3.0, -2.0, 0.5)
FAR = (2.0, 1.0, 0.5)


@functools.cache
def device() -> ComputeDevice:
    return open_device()


def row(pose: Pose2) -> F64:
    return np.array([pose.x, pose.y, pose.yaw_rad])


# -- tracking --------------------------------------------------------------------------------------


def judged(
    *fits: float, is_sure: bool = True, has_jumped: bool = False
) -> Callable[[GraphConfig], str]:
    """Return what is said of the last of some scans."""

    def decide(config: GraphConfig) -> str:
        quality = TrackingQuality()
        for number, fit in enumerate(fits):
            said = quality.judge(
                number, fit, config.tracking, is_sure=is_sure, has_jumped=has_jumped
            )
        return said

    return decide


def is_bad(config: GraphConfig) -> bool:
    """Whether a scan half of whose hits were never seen counts as bad."""
    seen = np.column_stack((np.full(40, 2.0), np.linspace(-1.0, 1.0, 40))).astype(np.float32)
    local_map = LocalMap(config, device(), GraphHealth())
    local_map.begin(0, Node(seen, np.zeros(2, dtype=np.float32), 0.0, None), component=0)
    points = np.concatenate((seen, seen + np.array([30.0, 0.0]))).astype(np.float64)
    match = Match(np.zeros(3), score=0.2, objective=0.2, moved=0.0)
    return local_map.fit(points, match, 0.9) < 1.0


# -- a scan in a submap ----------------------------------------------------------------------------


def hits(index: int = 60) -> tuple[Pose2, F64]:
    """Return a pose in the flat and what is hit from there, (P, 2) in the robot's frame."""
    truth = true_poses(120)[index]
    return truth, read(draw_flat(), [truth], 8.0, beams=181)[0].points()


def noisy_hits() -> tuple[Pose2, F64]:
    """Return the same with noise in a third of the hits."""
    truth, points = hits()
    rng = np.random.default_rng(0)
    points[::3] += rng.choice([-0.35, 0.35], points[::3].shape)
    return truth, points


@functools.cache
def flat() -> Submap:
    submap = Submap(device(), 0, CELL_M, 0.1)
    poses = true_poses(120)[::8]
    for scan, pose in zip(read(draw_flat(), poses, 8.0, beams=361), poses, strict=True):
        submap.insert(scan.points(), NO_LASER, pose)
    submap.finish()
    return submap


def in_part(share: float, index: int) -> tuple[Submap, Pose2, F64]:
    """Return a submap that lacks a share of what a scan hits, and the scan."""
    truth, points = hits(index)
    order = np.argsort(points[:, 0], kind="stable")
    submap = Submap(device(), 0, CELL_M, 0.1)
    submap.insert(points[order[int(share * len(points)) :]], NO_LASER, truth)
    submap.finish()
    return submap, truth, points


def search(config: GraphConfig) -> ClosureSearch:
    return ClosureSearch(config, device(), np.random.default_rng(0))


def word(found: Found | str) -> str:
    return "found" if isinstance(found, Found) else found


def carried_on(step: Pose2) -> Callable[[GraphConfig], bool]:
    """Whether a robot is found that was moved by a step from where it is expected."""

    def decide(config: GraphConfig) -> bool:
        truth, points = hits()
        expected = row(truth.compose(step))
        return search(config).around(flat(), points, expected, 0.75, by_odometry=True)[1]

    return decide


def in_a_changed_world(step: Pose2) -> Callable[[GraphConfig], bool]:
    """Whether a scan that fits badly is believed to lie where odometry has it."""

    def decide(config: GraphConfig) -> bool:
        truth, points = noisy_hits()
        expected = row(truth.compose(step))
        return search(config).around(flat(), points, expected, 1.0, by_odometry=True)[1]

    return decide


def among_pillars(config: GraphConfig) -> str:
    """A robot that has drifted by half of the way between pillars that are all the same."""
    cells, truth = draw_regular_ring(), Pose2(6.0, 1.5)
    submap = Submap(device(), 0, CELL_M, 0.1)
    poses = [Pose2(3.0 + 0.4 * step, 1.5) for step in range(16)]
    for scan, pose in zip(read(cells, poses, 3.0, beams=361), poses, strict=True):
        submap.insert(scan.points(), NO_LASER, pose)
    submap.finish()
    points = read(cells, [truth], 3.0, beams=181)[0].points()
    return word(search(config).near(submap, points, row(truth), 0.5, 0.75))


def that_fits_badly(config: GraphConfig) -> str:
    truth, points = noisy_hits()
    return word(search(config).near(flat(), points, row(truth), 0.4, 1.0))


def that_fits_badly_anywhere(config: GraphConfig) -> str:
    return word(search(config).anywhere(flat(), noisy_hits()[1], 1.0))


def of_which_most_is_unseen(config: GraphConfig) -> str:
    submap, truth, points = in_part(0.7, 60)
    return word(search(config).near(submap, points, row(truth), 0.3, 0.75))


def of_which_some_is_unseen_anywhere(config: GraphConfig) -> str:
    submap, _, points = in_part(0.45, 80)
    return word(search(config).anywhere(submap, points, 0.75))


def with_another_place(config: GraphConfig) -> str:
    truth, points = hits()
    return word(search(config).near(flat(), points, row(truth), 2.0, 0.75))


# -- closures that wait ----------------------------------------------------------------------------


def closure_of(node: int, step: tuple[float, float, float], how: How = "known") -> PendingClosure:
    """Return a closure of a node that moves a robot at ``HERE`` so, half a metre a node."""
    moved = Pose2(HERE.x + step[0], HERE.y + step[1], HERE.yaw_rad + step[2])
    edge = Constraint(0, node, np.zeros(3), np.eye(3), is_closure=True)
    return PendingClosure(edge, moved.compose(HERE.inverse()), 0.5 * node, how)


def believed(
    *steps: tuple[float, float, float], how: How = "known", every: int = 1
) -> Callable[[GraphConfig], int]:
    """Return how many closures are believed with the last of some, ``every`` nodes apart."""

    def decide(config: GraphConfig) -> int:
        pending = PendingClosures(config)
        told = [
            pending.confirmed(closure_of(every * node, step, how), HERE)
            for node, step in enumerate(steps)
        ]
        return len(told[-1])

    return decide


def winner(best: int, twin: int, misses: int = 0) -> Callable[[GraphConfig], bool]:
    """Whether a hypothesis is believed, by its hits, its twin's, and that one's misses."""

    def decide(config: GraphConfig) -> bool:
        hypotheses = RelocalizationHypotheses(config)
        for node in range(best):
            hypotheses.add(closure_of(node, (4.0, 1.0, 1.0), "anywhere"), HERE)
        for node in range(twin):
            other = hypotheses.add(closure_of(node, (-6.0, 2.0, -2.0), "anywhere"), HERE)
        for _ in range(misses):
            hypotheses.miss(other)
        return hypotheses.winner() is not None

    return decide


# -- where to search -------------------------------------------------------------------------------


@functools.cache
def driven() -> GraphSlam:
    """A drive through the flat, with a small submap every few scans."""
    truth = true_poses(120)
    log = log_of(read(draw_flat(), truth, 8.0, beams=121), truth)
    settings: dict[str, Any] = {"scan_buffer_size": 4, "loop_match_minimum_chain_size": 1}
    return run(device(), log, do_loop_closing=False, **settings)


def candidates(config: GraphConfig, *, again: int = 0) -> list[LoopCandidate]:
    """Return the submaps searched at the last node of the drive, or once more nodes later."""
    slam = driven()
    small = replace(config, scan_buffer_size=4, loop_match_minimum_chain_size=1)
    graph, local_map = slam._graph, slam._local_map
    loops = LoopClosure(small, graph, local_map, search(config), GraphHealth())
    number = len(graph.nodes) - 1
    if again:
        loops._last_searched = dict.fromkeys(range(len(local_map.submaps)), number - again)
    return loops._candidates(number, graph.pose(number))


def drifts(config: GraphConfig) -> tuple[float, float]:
    """Return how far off the robot may be in the submap just left, and in the first, metres."""
    every = replace(config, closure=replace(config.closure, tries_per_node=1000))
    found = [one.drift_m for one in candidates(every)]
    return min(found), max(found)


def near(*values: float) -> Any:
    """Return what equals about these values, metres."""
    return pytest.approx(values, abs=0.03)


def lost(config: GraphConfig, *, away_m: float | None = None) -> list[LoopCandidate]:
    """Return what is searched at the first node for a robot kidnapped into the last submap.

    Args:
        config: of the search.
        away_m: how far outside of where the robot was a hypothesis has it; None: there is none.
    """
    slam = driven()
    graph, local_map = slam._graph, LocalMap(GraphConfig(), device(), GraphHealth())
    local_map.restore(slam._local_map.to_state())
    local_map.components = [0] * local_map.active + [1] * (
        len(local_map.submaps) - local_map.active
    )
    relocalization = Relocalization(config)
    relocalization.begin(graph.travelled_m)
    pose = graph.pose(len(graph.nodes) - 1)
    if away_m is not None:
        far = Pose2(min(graph.poses[:, 0]) - away_m, graph.poses[0, 1], 0.0)
        nearest = local_map.distances_m(far, graph.poses)[local_map.in_other_components()].min()
        far = Pose2(far.x + float(nearest) - away_m, far.y, 0.0)
        edge = Constraint(0, 1, np.zeros(3), np.eye(3), is_closure=True)
        hit = PendingClosure(edge, far.compose(pose.inverse()), 1.0, "anywhere")
        relocalization.hypotheses.add(hit, pose)
    return relocalization.candidates(graph, local_map, pose)


def is_tested(config: GraphConfig) -> bool:
    """Whether a hypothesis 0.8 m outside is tested."""
    none_local = replace(config, relocalization=replace(config.relocalization, local_searches=0))
    return any(one.hypothesis is not None for one in lost(none_local, away_m=0.8))


def drift_of_hypothesis(config: GraphConfig) -> float:
    """How far off a hypothesis may be, metres."""
    none_local = replace(config, relocalization=replace(config.relocalization, local_searches=0))
    (one,) = (one for one in lost(none_local, away_m=0.2) if one.hypothesis is not None)
    return one.drift_m


# Of every field: another value, what decides, and what it decides by default and by that value.
Case = tuple[Any, Callable[[GraphConfig], Any], Any, Any]
CASES: dict[str, Case] = {
    "tracking.bad_share": (0.4, judged(0.5, 0.5, 0.5), "failed", "tracked"),
    "tracking.reset_share": (0.6, judged(0.7, has_jumped=True), "kidnapped", "tracked"),
    "tracking.lost_scans": (5, judged(*[0.5] * 4, is_sure=False), "kidnapped", "unsure"),
    "tracking.failed_bad": (4, judged(0.5, 0.5, 0.5), "failed", "tracked"),
    "tracking.failed_scans": (4, judged(0.5, 1.0, 0.5, 1.0, 0.5), "failed", "tracked"),
    "tracking.most_unseen": (0.3, is_bad, True, False),
    "tracking.search_m": (3.0, carried_on(Pose2(2.0, 0.0, 0.0)), False, True),
    "tracking.search_rad": (1.4, carried_on(Pose2(0.0, 0.0, 1.1)), False, True),
    "tracking.expected_m": (0.7, in_a_changed_world(Pose2(0.5, 0.0, 0.0)), False, True),
    "tracking.expected_rad": (0.4, in_a_changed_world(Pose2(0.0, 0.0, 0.25)), False, True),
    "closure.least_drift_m": (0.5, drifts, near(0.3, 0.38), near(0.5, 0.6)),
    "closure.drift_share": (0.1, drifts, near(0.3, 0.38), near(0.3, 0.78)),
    "closure.local_drift_m": (0.4, among_pillars, "found", "two places fit"),
    "closure.retry_nodes": (3, lambda c: len(candidates(c, again=2)), 2, 0),
    "closure.tries_per_node": (3, lambda c: len(candidates(c)), 2, 3),
    "closure.mean_share": (0.4, that_fits_badly, "low response", "found"),
    "closure.mean_share_anywhere": (0.4, that_fits_badly_anywhere, "low response", "found"),
    "closure.most_unseen": (0.8, of_which_most_is_unseen, "little in common", "found"),
    "closure.most_unseen_anywhere": (
        0.6,
        of_which_some_is_unseen_anywhere,
        "little in common",
        "found",
    ),
    "closure.rival_share": (0.3, with_another_place, "found", "two places fit"),
    "closure.small_step_m": (0.6, believed((0.5, 0.0, 0.0)), 0, 1),
    "closure.small_step_rad": (0.2, believed((0.0, 0.0, 0.15)), 0, 1),
    "closure.agreement_m": (0.5, believed((2.0, 1.0, 0.5), (2.4, 1.0, 0.5)), 0, 2),
    "closure.agreement_rad": (0.1, believed((2.0, 1.0, 0.5), (2.0, 1.0, 0.57)), 0, 2),
    "closure.agreeing_nodes": (3, believed(FAR, FAR), 2, 0),
    "closure.wait_nodes": (15, believed(FAR, FAR, every=14), 0, 2),
    "relocalization.odometry_nodes": (4, believed(FAR, FAR, FAR, how="odometry"), 3, 0),
    "relocalization.odometry_m": (1.2, believed(FAR, FAR, FAR, how="odometry"), 3, 0),
    "relocalization.kidnapped_drift_m": (2.0, lambda c: lost(c)[0].drift_m, 1.2, 2.0),
    "relocalization.local_searches": (0, lambda c: len(lost(c)) > 1, False, True),
    "relocalization.inside_m": (1.0, is_tested, False, True),
    "relocalization.hypothesis_drift_m": (0.9, drift_of_hypothesis, 0.6, 0.9),
    "relocalization.borne_out_nodes": (20, winner(16, 0), True, False),
    "relocalization.borne_out_m": (10.0, winner(16, 0), True, False),
    "relocalization.misses": (2, winner(16, 16, misses=2), False, True),
    "relocalization.rival_hits": (20, winner(16, 8), False, True),
    "relocalization.rival_share": (0.7, winner(16, 8), False, True),
}


def test_every_threshold_is_an_expert_field_with_a_case_here():
    infos = {
        f"{section}.{info.name}": info
        for section, kind in SECTIONS.items()
        for info in field_infos(kind)
    }
    assert infos.keys() == CASES.keys()
    for name, info in infos.items():
        assert info.level == "expert", name
        assert info.low is not None, name
        assert info.high is not None, name
        assert info.low < info.high, name
        assert info.unit == {"m": "m", "rad": "rad"}.get(name.rpartition("_")[2], info.unit), name


@pytest.mark.parametrize("name", CASES)
def test_a_changed_threshold_changes_what_it_decides(name: str):
    value, decide, by_default, changed = CASES[name]
    config = GraphConfig()
    section, _, field = name.partition(".")
    other = replace(config, **{section: replace(getattr(config, section), **{field: value})})
    assert decide(config) == by_default
    assert decide(other) == changed


def test_a_failure_that_needs_more_bad_scans_than_are_looked_at_is_refused():
    assert GraphTrackingConfig(failed_bad=10).failed_bad == 10
    with pytest.raises(ConfigError, match=r"failed_bad \(11\) must not be above failed_scans"):
        GraphTrackingConfig(failed_bad=11)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"tracking": GraphTrackingConfig(lost_scans=5)}, "tracking.lost_scans = 4, found 5"),
        ({"closure": GraphClosureConfig(mean_share=0.8)}, "closure.mean_share = 0.75, found 0.8"),
        (
            {"relocalization": GraphRelocalizationConfig(misses=2)},
            "relocalization.misses = 3, found 2",
        ),
        ({"matcher": replace(GraphConfig().matcher, jump_m=8.0)}, "matcher.jump_m = 5.0, found 8"),
    ],
)
def test_a_saved_graph_goes_on_with_the_thresholds_that_it_was_made_with(
    tmp_path: Path, changed: dict[str, Any], words: str
):
    path = tmp_path / "state.npz"
    GraphSlam(GraphConfig(), device()).save_state(path)
    with pytest.raises(SlamFusionError, match=f"was made with {re.escape(words)}"):
        GraphSlam.load_state(path, GraphConfig(**changed), device())
    assert GraphSlam.load_state(path, GraphConfig(), device()).health.nodes == 0
