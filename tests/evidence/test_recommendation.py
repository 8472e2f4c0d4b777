"""The recommendation names one path, one SLAM, how far both can be trusted, and what to check."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.beams import CHUNKS, JudgedScans, judged_scans
from slamfusion.evidence.displacement import find_displacements
from slamfusion.evidence.predictive import PathEvidence, score_paths
from slamfusion.evidence.recommendation import MOST_CHECKS, Recommendation, recommend
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import ROOM, bent, box, circuit, moved, recorded

TRUTH = circuit()
# Both are off by centimetres, the second one by twice as many, on each fourth scan.
OFF = np.zeros((len(TRUTH), 3))
OFF[::4, 0] = 0.01
CLOSE = Trajectory(TRUTH.stamps_s, TRUTH.poses + OFF)
LESS = Trajectory(TRUTH.stamps_s, TRUTH.poses + 2.0 * OFF)
BENT = bent(TRUTH, math.radians(15.0), 60)
PATHS = {"bent": BENT, "less": LESS, "close": CLOSE, "fused": TRUTH}
# Several rounds of the room: each part of the drive sees what others saw.
ROUNDS = circuit(288, 6.0)


def answer_of(evidence: PathEvidence, fused: str | None = None) -> Recommendation:
    slams = [name for name in evidence.scores if name != fused]
    return recommend(evidence, slams, fused=fused)


def place_at(path: Trajectory, at_s: float) -> tuple[float, float]:
    """Return where a path is at a time."""
    x, y, _ = path.poses[int(np.abs(path.stamps_s - path.stamps_s[0] - at_s).argmin())]
    return float(x), float(y)


def test_the_fused_path_is_the_answer_and_the_slam_nearest_to_it(
    device: ComputeDevice, scans: JudgedScans
):
    answer = answer_of(score_paths(scans, PATHS, device), "fused")
    assert (answer.path, answer.best_single) == ("fused", "close")
    assert answer.lines()[0] == ("Single SLAM:", "close, the nearest to the fused path")
    assert [path.name for path in answer.paths][:2] == ["fused", "close"]
    away_m = {path.name: path.from_fused_m for path in answer.paths}
    # A quarter of the poses moved by 0.02 m, but for their mean that is aligned away.
    assert away_m["less"] == pytest.approx(0.02 * math.sqrt(3) / 4, rel=0.02)
    assert away_m["close"] == pytest.approx(0.01 * math.sqrt(3) / 4, rel=0.02)
    assert away_m["fused"] is None
    # All are compared with the path that is recommended, not with the one that scores best.
    assert [path.name for path in answer.paths if path.behind_95 is None] == ["fused"]
    assert answer.paths[-1].name == "bent"
    assert not answer.paths[-1].tied


@pytest.mark.parametrize("fused", [None, "unknown"])
def test_without_a_fused_path_the_scans_choose(
    device: ComputeDevice, scans: JudgedScans, fused: str | None
):
    evidence = score_paths(scans, {"bent": BENT, "close": CLOSE}, device)
    answer = answer_of(evidence, fused)
    assert (answer.path, answer.best_single) == ("close", "close")
    assert answer.lines()[0] == ("Single SLAM:", "close")
    assert {path.from_fused_m for path in answer.paths} == {None}


def test_a_fused_path_that_the_scans_contradict_is_not_the_answer(
    device: ComputeDevice, scans: JudgedScans
):
    near_the_wrong = Trajectory(BENT.stamps_s, BENT.poses + np.array([0.01, 0.0, 0.0]))
    paths = {"bent": BENT, "right": TRUTH, "fused": near_the_wrong}
    answer = answer_of(score_paths(scans, paths, device), "fused")
    assert (answer.path, answer.best_single) == ("right", "right")


def test_a_right_path_is_green_whatever_stands_in_the_way(device: ComputeDevice):
    """What stands elsewhere each time makes hits unlikely, and displaces no wall."""
    rng = np.random.default_rng(3)
    crowded = []
    for part in np.array_split(np.arange(len(ROUNDS)), CHUNKS):
        crates: list[tuple[float, ...]] = []
        while len(crates) < 4 * 14:
            x, y = rng.uniform((0.5, 0.5), (8.2, 5.2))
            if np.hypot(*(ROUNDS.poses[part, :2] - (x, y)).T).min() > 0.6:
                crates += box(x, y, 0.4, 0.4)
        path = Trajectory(ROUNDS.stamps_s[part], ROUNDS.poses[part])
        walls = np.concatenate((ROOM, np.array(crates)))
        crowded += recorded(path, odometry=False, walls=walls)
    evidence = score_paths(judged_scans(crowded), {"a": ROUNDS}, device)
    alone = score_paths(judged_scans(recorded(ROUNDS, odometry=False)), {"a": ROUNDS}, device)
    # A hit is less likely by far than in an empty room.
    assert evidence.scores["a"].seen_consistency < 3.0 * alone.scores["a"].seen_consistency
    answer = answer_of(evidence)
    assert (answer.confidence, answer.tone, answer.check) == ("high", "good", ())
    assert answer.headline == "Use the a path: no scan contradicts it"


@pytest.mark.parametrize(("off_m", "factors"), [(2.0, (1.0, 1.0, 1.0)), (0.0, (0.5, 0.5, 1.3))])
def test_a_path_whose_map_is_elsewhere_each_time_is_red(
    device: ComputeDevice, off_m: float, factors: tuple[float, ...]
):
    """Walls stand in what others saw free, or where the path is of another drive everywhere."""
    off = np.random.default_rng(0).normal(0.0, off_m, (CHUNKS, 3))
    off[:, 2] *= 0.1
    scans = judged_scans(recorded(ROUNDS, odometry=False))
    lost = Trajectory(ROUNDS.stamps_s, ROUNDS.poses * factors + off[scans.chunks])
    evidence = score_paths(scans, {"lost": lost, "right": ROUNDS}, device)
    assert answer_of(evidence.of_paths(("lost",))).confidence == "low"
    # With a right one among them that is the answer.
    answer = answer_of(evidence)
    assert (answer.path, answer.confidence) == ("right", "high")


@pytest.mark.parametrize("away_m", [0.7, 2.5])
def test_a_map_that_shows_its_walls_twice_is_red(device: ComputeDevice, away_m: float):
    torn = moved(ROUNDS, (0.6 * away_m, 0.8 * away_m, 0.0), 144)
    evidence = score_paths(judged_scans(recorded(ROUNDS, odometry=False)), {"a": torn}, device)
    displaced = find_displacements(evidence, "a")
    assert len(displaced) > MOST_CHECKS
    assert np.median([part.away_m for part in displaced]) == pytest.approx(away_m, abs=0.1)
    answer = answer_of(evidence)
    assert (answer.confidence, answer.tone) == ("low", "bad")
    assert answer.headline == "Do not trust the a path: the scans contradict it"
    assert len(answer.check) == MOST_CHECKS
    assert list(answer.check) == sorted(answer.check, key=lambda place: place.from_s)
    first, *others = sorted(answer.check, key=lambda place: "from here on" not in place.what)
    assert first.what.startswith("from here on")
    for place in others:
        near = place_at(torn, 0.5 * (place.from_s + place.to_s))
        assert (place.x, place.y) == pytest.approx(near, abs=0.3)
        assert "away from where they were seen at other times" in place.what


@pytest.mark.parametrize("first", [60, 115, 200])
def test_a_path_torn_at_any_time_is_red(device: ComputeDevice, first: int):
    torn = moved(ROUNDS, (2.0, 1.5, 0.4), first)
    evidence = score_paths(judged_scans(recorded(ROUNDS, odometry=False)), {"a": torn}, device)
    answer = answer_of(evidence)
    assert answer.confidence == "low"
    (place,) = (place for place in answer.check if place.what.startswith("from here on"))
    assert place.from_s == pytest.approx(0.25 * first, abs=6.0)
    assert place.what.endswith("of what the robot saw was free space before")


def test_a_place_that_is_drawn_elsewhere_again_is_amber(device: ComputeDevice):
    torn = moved(ROUNDS, (-12.0, 8.0, 2.0), 144)
    evidence = score_paths(judged_scans(recorded(ROUNDS, odometry=False)), {"a": torn}, device)
    answer = answer_of(evidence)
    (place,) = answer.check
    assert answer.confidence == "medium"
    assert place.from_s == pytest.approx(36.0, abs=0.5)
    assert place.what == "a place seen before is drawn again, 26 m away"


def test_walls_displaced_in_one_part_alone_are_amber(device: ComputeDevice):
    part = moved(moved(ROUNDS, (0.3, 0.4, 0.0), 120), (-0.3, -0.4, 0.0), 150)
    evidence = score_paths(judged_scans(recorded(ROUNDS, odometry=False)), {"a": part}, device)
    answer = answer_of(evidence)
    assert (answer.confidence, answer.tone) == ("medium", "warn")
    assert answer.check
    assert all(28.0 < place.from_s < 38.0 for place in answer.check)


def test_where_two_paths_part_and_no_scan_tells_is_a_place_to_check(device: ComputeDevice):
    """In the room, then off through a place that is seen once, each its own way, and back."""
    poses = circuit(144, 3.0).poses.copy()
    poses[60:84, 0] += 20.0 * np.arange(1, 25)
    other = poses.copy()
    other[60:84, 1] += 2.0
    stamps_s = 0.25 * np.arange(144)
    scans = judged_scans(recorded(circuit(144, 3.0), odometry=False))
    paths = {"a": Trajectory(stamps_s, poses), "b": Trajectory(stamps_s, other)}
    answer = answer_of(score_paths(scans, paths, device))
    assert answer.confidence == "medium"
    (place,) = answer.check
    assert 14.0 < place.from_s < 16.0
    assert 20.0 < place.to_s < 22.0
    assert place.what.endswith("and no scan shows which is right")


def test_a_drive_that_sees_nothing_twice_is_not_confirmed(device: ComputeDevice):
    away = np.outer(20.0 * np.arange(144), [1.0, 0.0, 0.0])
    lost = Trajectory(TRUTH.stamps_s, TRUTH.poses + away)
    answer = answer_of(score_paths(judged_scans(recorded(TRUTH)), {"a": lost}, device))
    assert answer.confidence == "medium"
    (place,) = answer.check
    assert "nothing confirms the path" in place.what


def test_a_path_of_a_part_of_the_drive_is_not_recommended_for_all_of_it(device: ComputeDevice):
    short = Trajectory(ROUNDS.stamps_s[:144], ROUNDS.poses[:144])
    scans = judged_scans(recorded(ROUNDS, odometry=False))
    answer = answer_of(score_paths(scans, {"short": short, "all": ROUNDS}, device))
    assert (answer.path, answer.confidence) == ("all", "medium")
    (place,) = answer.check
    assert (place.from_s, place.to_s) == tuple(ROUNDS.stamps_s[[144, -1]] - ROUNDS.stamps_s[0])
    assert place.what == "not judged, for lack of a pose in short"


def test_a_laser_that_contradicts_the_odometry_comes_first() -> None:
    sure = Recommendation("fused", "fused", "a", "high")
    wrong = replace(sure, laser_fault="the path turns against the odometry")
    assert (sure.tone, wrong.tone) == ("good", "bad")
    assert wrong.headline.startswith("Correct the laser before you use the fused map")
    assert wrong.lines()[0] == ("Laser:", "the path turns against the odometry")


def test_the_answer_is_read_as_it_was_written(device: ComputeDevice):
    torn = moved(ROUNDS, (0.3, 0.4, 0.0), 144)
    evidence = score_paths(judged_scans(recorded(ROUNDS, odometry=False)), {"a": torn}, device)
    answer = answer_of(evidence)
    again = Recommendation.from_json(plain(answer))
    assert (again.headline, again.lines()) == (answer.headline, answer.lines())
    assert plain(again) == plain(answer)
