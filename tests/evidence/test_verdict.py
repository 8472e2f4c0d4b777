"""The verdict names the best path, says how sure it is, and where another one left it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import JudgedScans, judged_scans, reach_verdict, score_paths
from slamfusion.evidence.beams import CHUNKS
from slamfusion.evidence.parting import PART_M, path_gap_m, path_spans
from slamfusion.evidence.verdict import CONTRADICTED
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import ROOM, bent, circuit, moved, recorded
from tests.support.examples import examples

TRUTH = circuit()
NEAR = Trajectory(TRUTH.stamps_s, TRUTH.poses + np.array([0.0, 0.0, 1e-6]))
LATE = moved(TRUTH, (0.9, 1.2, 0.0), 108)
BENT = bent(TRUTH, math.radians(15.0), 60)


def test_a_wrong_path_leaves_the_best_one_where_it_goes_wrong(
    device: ComputeDevice, scans: JudgedScans
):
    paths = {"late": LATE, "truth": TRUTH, "near": NEAR}
    verdict = reach_verdict(score_paths(scans, paths, device), ("late", "near"))
    assert verdict.best in {"truth", "near"}
    assert verdict.best_producer == "near"
    assert not verdict.sure
    assert [path.name for path in verdict.paths][2] == "late"
    late = verdict.paths[2]
    assert not late.tied
    together, apart = late.spans
    assert (together.from_s, together.to_s, together.agrees) == (0.0, 27.0, True)
    assert (apart.from_s, apart.to_s, apart.agrees) == (27.0, 35.75, False)
    assert (together.verdict, apart.verdict) == (None, "worse")
    assert apart.gap_m == pytest.approx(1.5, abs=0.01)
    assert verdict.sentence.startswith("The scans cannot tell ")
    words = f"late leaves {verdict.best} from 27 to 36 s, by up to 1.5 m: there the scans speak for"
    assert words in verdict.sentence


def test_a_clear_winner_is_sure(device: ComputeDevice, scans: JudgedScans):
    verdict = reach_verdict(score_paths(scans, {"bent": BENT, "truth": TRUTH}, device))
    assert (verdict.best, verdict.best_producer, verdict.sure) == ("truth", None, True)
    assert verdict.sentence.startswith("The scans bear out truth best: by bent a hit is ")
    best, other = verdict.paths_to_json()
    assert (best["name"], best["tied"], best["behind_best"]) == ("truth", True, 0.0)
    assert best["behind_best_95"] is None
    assert not other["tied"]
    low, high = other["behind_best_95"] or (0.0, 0.0)
    assert 0.0 < low < other["behind_best"] < high
    assert other["behind_best"] == pytest.approx(best["consistency"] - other["consistency"])
    assert sum(part["beams"] for part in other["over_time"]) == other["beams_judged"]
    assert verdict.to_json()["sentence"] == verdict.sentence


def test_one_path_alone_is_compared_with_nothing(device: ComputeDevice, scans: JudgedScans):
    verdict = reach_verdict(score_paths(scans, {"only": TRUTH}, device), ("only",))
    assert (verdict.best, verdict.sure) == ("only", False)
    assert "none to compare it with" in verdict.sentence
    (span,) = verdict.paths[0].spans
    assert span.agrees


def test_where_nothing_can_be_told_is_said(device: ComputeDevice):
    # In the room, then off through a place that is seen once, and back.
    count = 144
    poses = circuit(count, 3.0).poses.copy()
    poses[60:84, 0] += 20.0 * np.arange(1, 25)
    path = Trajectory(0.25 * np.arange(count), poses)
    scans = judged_scans(recorded(circuit(count, 3.0), odometry=False))
    verdict = reach_verdict(score_paths(scans, {"a": path, "b": path}, device))
    assert verdict.untold == ((15.0, 21.0),)
    assert "Nothing can be told of 15 to 21 s: " in verdict.sentence
    assert verdict.to_json()["untold"] == [{"from_s": 15.0, "to_s": 21.0}]
    away = np.outer(20.0 * np.arange(count), [1.0, 0.0, 0.0])
    lost = Trajectory(path.stamps_s, circuit(count, 3.0).poses + away)
    verdict = reach_verdict(score_paths(scans, {"a": lost, "b": lost}, device))
    assert verdict.untold == ((0.0, 35.75),)
    known = reach_verdict(score_paths(scans, {"a": circuit(count, 3.0)}, device))
    assert known.untold == ()
    assert "Nothing can be told" not in known.sentence


def test_paths_that_are_all_wrong_are_contradicted(device: ComputeDevice, scans: JudgedScans):
    # Every part of the drive lies elsewhere, so that its walls stand in what others saw free.
    paths = {}
    for seed, name in enumerate("ab"):
        off = np.random.default_rng(seed).normal(0.0, 2.0, (CHUNKS, 3))
        off[:, 2] *= 0.1
        paths[name] = Trajectory(TRUTH.stamps_s, TRUTH.poses + off[scans.chunks])
    verdict = reach_verdict(score_paths(scans, paths, device))
    assert verdict.contradicted
    assert verdict.to_json()["contradicted"]
    assert f"The scans contradict even {verdict.best}: of places seen twice" in verdict.sentence
    best = verdict.paths_to_json()[0]["seen_consistency"]
    assert best is not None
    assert best < CONTRADICTED
    # With one right path among them they are not, nor where nothing was seen twice.
    right = reach_verdict(score_paths(scans, {**paths, "truth": TRUTH}, device))
    assert (right.best, right.contradicted) == ("truth", False)
    assert "contradict even" not in right.sentence
    away = Trajectory(TRUTH.stamps_s, TRUTH.poses + np.outer(20.0 * np.arange(144), [1, 0, 0]))
    alone = reach_verdict(score_paths(scans, {"away": away}, device))
    assert not alone.contradicted
    assert alone.evidence.scores["away"].seen_share < 0.2


def test_what_is_seen_twice_is_scored_whatever_is_seen_once(device: ComputeDevice):
    # The same drive, and one that then goes where it never comes again.
    scores = []
    for off in (0.0, 40.0):
        poses = circuit(192, 2.0).poses.copy()
        poses[144:, 0] += off
        walls = np.concatenate((ROOM, ROOM + np.array([40.0, 0.0, 40.0, 0.0])))
        path = Trajectory(0.25 * np.arange(192), poses)
        scans = judged_scans(recorded(path, odometry=False, walls=walls))
        scores.append(score_paths(scans, {"a": path}, device).scores["a"])
    near, off = scores
    assert off.consistency < near.consistency - 0.02
    assert off.seen_consistency == pytest.approx(near.seen_consistency, abs=0.03)


def test_scans_that_a_path_has_no_pose_for_are_said(device: ComputeDevice, scans: JudgedScans):
    half = Trajectory(TRUTH.stamps_s[:72], TRUTH.poses[:72])
    verdict = reach_verdict(score_paths(scans, {"a": TRUTH, "half": half}, device))
    assert "of the scans were judged: where every path has a pose." in verdict.sentence


@settings(max_examples=examples(20), deadline=None)
@given(
    x=st.floats(-1e3, 1e3),
    yaw_rad=st.floats(-math.pi, math.pi),
    share=st.floats(0.55, 0.95),
    is_first=st.booleans(),
)
def test_a_broken_part_does_not_turn_the_rest(
    device: ComputeDevice,
    scans: JudgedScans,
    x: float,
    yaw_rad: float,
    share: float,
    is_first: bool,
):
    cut = int((1.0 - share if is_first else share) * len(TRUTH))
    broken = moved(TRUTH, (3.0, 1.0, 0.5), cut)
    path = moved(broken, (x, 7.0, yaw_rad))
    evidence = score_paths(scans, {"truth": TRUTH, "broken": path}, device)
    gap_m = path_gap_m(evidence, "broken", "truth")
    right, wrong = (gap_m[cut:], gap_m[:cut]) if is_first else (gap_m[:cut], gap_m[cut:])
    assert right.max() < 1e-6
    assert wrong.max() > 1.0


def test_spans_cover_the_drive_and_short_ones_are_none(device: ComputeDevice, scans: JudgedScans):
    poses = TRUTH.poses.copy()
    poses[40:42, 0] += 2.0 * PART_M  # half a second
    poses[80:100, 0] += 2.0 * PART_M
    path = Trajectory(TRUTH.stamps_s, poses)
    evidence = score_paths(scans, {"truth": TRUTH, "path": path}, device)
    spans = path_spans(evidence, "path", "truth")
    assert [span.agrees for span in spans] == [True, False, True]
    assert [span.from_s for span in spans] == [0.0, 20.0, 25.0]
    assert [span.to_s for span in spans] == [20.0, 25.0, 35.75]
    assert path_spans(evidence, "truth", "truth")[0].gap_m == pytest.approx(0.0, abs=1e-9)
