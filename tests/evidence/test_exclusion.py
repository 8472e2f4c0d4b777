"""When a path has no vote: on both sides of each threshold, and by whom it is told."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import (
    CoveredPath,
    Exclusions,
    JudgedScans,
    PathEvidence,
    PathScore,
    find_exclusions,
    judged_scans,
    score_paths,
)
from slamfusion.evidence.predictive import without_scans
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, circuit, moved, recorded

F64 = npt.NDArray[np.float64]
COUNT, STEP_S = 400, 0.25
BEAMS = 50


def way(seed: int = 0, noise_m: float = 0.0) -> F64:
    """A drive of 100 s around a block, (COUNT, 3), as one of several sees it."""
    poses = circuit(COUNT, 3.0).poses.copy()
    poses[:, :2] += np.random.default_rng(seed).normal(0.0, noise_m, (COUNT, 2))
    return poses


def aside(poses: F64, away_m: float, first: int, last: int = COUNT) -> F64:
    """Return a path that is away along x for some of the scans."""
    out = poses.copy()
    out[first:last, 0] += away_m
    return out


def told(
    paths: Mapping[str, F64], likelihoods: Mapping[str, F64 | float] | None = None
) -> PathEvidence:
    """Return evidence that says of each scan's hits what it is told to: 0 where it is told nothing.

    Values scatter a little, so that equal ones cannot be told apart.
    """
    stamps_s = STEP_S * np.arange(COUNT)
    beams = np.full(COUNT, BEAMS, dtype=np.int64)
    everywhere = np.ones(COUNT, dtype=np.bool_)
    nothing = np.zeros((0, 2))
    scans = JudgedScans(
        stamps_s, np.arange(COUNT) * 24 // COUNT, None, np.zeros((COUNT, 2)), nothing,
        np.zeros(0), np.zeros(0, dtype=np.int64), 0,
    )  # fmt: skip
    scores = {}
    for seed, (name, poses) in enumerate(paths.items()):
        mean = np.broadcast_to((likelihoods or {}).get(name, 0.0), COUNT)
        scatter = np.random.default_rng(seed).normal(0.0, 0.05, COUNT)
        covered = CoveredPath(poses, everywhere, everywhere)
        scores[name] = PathScore(name, covered, beams * (mean + scatter), beams, beams)
    return PathEvidence(scans, everywhere, scores)


def spans(found: Exclusions, name: str) -> list[tuple[float, float]]:
    return [(span.from_s, span.to_s) for span in found.spans[name]]


def sides(limit: float) -> list[tuple[float, bool]]:
    """A little below and above a limit, and whether that exceeds it."""
    return [(0.98 * limit, False), (1.02 * limit, True)]


def test_who_leaves_the_others_has_no_vote_from_there_on() -> None:
    paths = {"a": way(1, 0.02), "b": way(2, 0.02), "c": aside(way(3, 0.02), 2.0, 280)}
    found = find_exclusions(told(paths))
    assert found.names == ("c",)
    assert spans(found, "c") == [(70.0, 99.75)]
    (span,) = found.spans["c"]
    assert (span.ground, span.gap_m) == ("outvoted", pytest.approx(2.0, abs=0.15))
    assert found.excluded_share("c") == 0.3
    assert found.excluded_share("a") == 0.0
    assert found.undecided == ()
    # As at the judged scan next in time, before and after the drive too.
    assert found.votes_at("c", np.array([-5.0, 69.85, 69.9, 99.75, 200.0])).tolist() == [
        *(True, True, False, False, False)
    ]
    assert found.votes_at("a", np.array([0.0, 99.0])).all()


@given(
    x=st.floats(-1e3, 1e3),
    yaw_rad=st.floats(-math.pi, math.pi),
    turn_rad=st.sampled_from([-0.5, 0.2]),
)
def test_each_path_may_have_a_frame_of_its_own(x: float, yaw_rad: float, turn_rad: float) -> None:
    good = Trajectory(STEP_S * np.arange(COUNT), way())
    wrong = moved(good, (0.0, 0.0, turn_rad), 300)
    paths = {
        "a": good.poses,
        "b": moved(good, (x, 5.0, yaw_rad)).poses,
        "c": moved(wrong, (-3.0, x, -yaw_rad)).poses,
    }
    found = find_exclusions(told(paths))
    assert found.names == ("c",)
    assert spans(found, "c")[0][0] >= 75.0
    assert found.excluded_share("c") > 0.2


def test_good_paths_that_differ_by_a_little_all_vote() -> None:
    paths = {name: way(seed, 0.05) for seed, name in enumerate("abcd")}
    found = find_exclusions(told(paths, {"a": -1.0}))
    assert found.names == ()
    assert not any(own.any() for own in found.excluded.values())


# -- who is right ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("likelihood", "out"),
    [(0.0, "b"), (-0.3, "b"), (0.3, "ac")],
    ids=["cannot tell", "worse", "better"],
)
def test_the_odd_one_of_three_is_out_but_where_the_scans_bear_it_out(
    likelihood: float, out: str
) -> None:
    own = np.zeros(COUNT)
    own[200:300] = likelihood
    paths = {"a": way(), "b": aside(way(), 2.0, 200, 300), "c": way()}
    found = find_exclusions(told(paths, {"b": own}))
    assert "".join(found.names) == out
    for name in out:
        assert spans(found, name) == [(50.0, 75.0)]
        wanted = "outvoted" if out == "b" else "contradicted by the scans"
        assert found.spans[name][0].ground == wanted


@pytest.mark.parametrize(
    ("likelihood", "out"), [(0.0, ""), (-0.3, "b"), (0.3, "a")], ids=["equal", "worse", "better"]
)
def test_of_two_that_part_the_scans_decide_or_nobody(likelihood: float, out: str) -> None:
    own = np.zeros(COUNT)
    own[200:300] = likelihood
    found = find_exclusions(told({"a": way(), "b": aside(way(), 2.0, 200, 300)}, {"b": own}))
    assert "".join(found.names) == out
    assert [(span.from_s, span.to_s) for span in found.undecided] == [(50.0, 75.0)] * (not out)
    if out:
        assert found.spans[out][0].ground == "contradicted by the scans"


def test_of_three_that_all_part_those_are_out_that_the_scans_contradict() -> None:
    lower = {"b": np.zeros(COUNT), "c": np.zeros(COUNT)}
    lower["b"][200:300], lower["c"][200:300] = -0.3, -0.2
    paths = {"a": way(), "b": aside(way(), 2.0, 200, 300), "c": aside(way(), -2.0, 200, 300)}
    found = find_exclusions(told(paths, lower))
    assert found.names == ("b", "c")
    assert not find_exclusions(told(paths)).names
    assert len(find_exclusions(told(paths)).undecided) == 1


def test_scans_of_a_room_outvote_a_bent_path(device: ComputeDevice, scans: JudgedScans) -> None:
    truth = circuit()
    near = Trajectory(truth.stamps_s, truth.poses + np.array([0.01, 0.0, 0.002]))
    wrong = bent(truth, math.radians(15.0), 90)
    paths = {"a": truth, "b": near, "c": wrong}
    found = find_exclusions(score_paths(scans, paths, device))
    assert found.names == ("c",)
    (span,) = found.spans["c"]
    assert 22.5 <= span.from_s <= 24.0
    assert span.to_s == truth.stamps_s[-1]


def test_what_a_path_drew_while_it_was_wrong_does_not_speak_against_it_elsewhere(
    device: ComputeDevice,
) -> None:
    # Three rounds: a third path is wrong in the middle one, and the second, right, is told apart
    # from the first one in the last. Its walls of the middle one are not asked there.
    truth = circuit(216, 3.0)
    scans = judged_scans(recorded(truth))
    first, last = slice(72, 144), slice(180, 216)
    a, b = (truth.poses.copy() for _ in range(2))
    b[first, 0] += 0.5
    a[last, 0] += 0.4
    third = truth.poses.copy()
    third[last, 0] -= 3.0
    paths = {
        name: Trajectory(truth.stamps_s, poses)
        for name, poses in {"a": a, "b": b, "c": third}.items()
    }
    evidence = score_paths(scans, paths, device)
    found = find_exclusions(evidence, device)
    assert [span.ground for span in found.spans["b"]] == ["outvoted"]
    assert [span.from_s for span in found.spans["a"]] == [pytest.approx(45.0, abs=0.5)]
    # With them, the difference is smaller.
    gaps = []
    for device_or_none in (None, device):
        left_out = np.zeros(len(scans), dtype=np.bool_)
        left_out[first] = device_or_none is not None
        scored = without_scans(evidence, ("a", "b"), left_out, device)
        sums = [scored.scores[name].sums[last].sum() for name in "ab"]
        gaps.append(sums[1] - sums[0])
    assert gaps[1] > gaps[0]
