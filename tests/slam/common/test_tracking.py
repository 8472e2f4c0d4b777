"""Where the robot may be at the next scan, when a match is doubted, and what is kept of its score.

The numbers of the limits stand here once more, on purpose: a limit that moves is to fail a test.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.compute import NumpyDevice
from slamfusion.config import MatcherConfig
from slamfusion.geometry import Pose2
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.matcher import FieldMap, Spread
from slamfusion.slam.common.matcher import PoseHypothesis as Guess
from slamfusion.slam.common.tracking import Tracker

# What the tracker calls things, each in one place.
HYPOTHESES = Tracker.hypotheses
MEAN_SCORE, STANDS = "running_mean_score", "expects_standstill"
SEARCHES_AGAIN, RESOLVES, CURVATURE = "searches_again", "resolves_degeneracy", "hessian"

F64 = npt.NDArray[np.float64]
TILE, TILES, CELL_M = 32, 16, 0.05
# Half of the drawn window, metres: the map's zero is its middle.
HALF_M = TILE * TILES * CELL_M / 2
CONFIG = MatcherConfig()
# The nearest hypothesis is worth nothing of its own: scores alone decide.
SCORES_ALONE = MatcherConfig(prior_weight_xy=0.0, prior_weight_yaw=0.0)
JUMPED = "odometry jumped by more than 5 m: not believed"


def tracker(config: MatcherConfig = CONFIG, /, **fields: Any) -> Tracker:
    return Tracker(config, NumpyDevice(), np.random.default_rng(3), Health(), **fields)


HOME, ONWARD = Pose2(), Pose2(0.2, 0.0, 0.1)


def driven(last: Pose2 = HOME, step: Pose2 = ONWARD, /, **fields: Any) -> Tracker:
    """Return a tracker whose robot came to ``last`` by ``step`` in one second, at 11 s."""
    found = tracker(**fields)
    before = last.compose(step.inverse())
    found.advance(before, before, 10.0)
    found.advance(last, last, 11.0)
    return found


def of_pose(pose: Pose2) -> F64:
    return np.array([pose.x, pose.y, pose.yaw_rad])


def assert_guess(found: Guess, pose: Pose2, spread: tuple[float, float], loss: float = 0.0) -> None:
    np.testing.assert_allclose(found.pose, of_pose(pose), atol=1e-9)
    assert (found.spread.xy_m, found.spread.yaw_rad) == pytest.approx(spread)
    assert found.loss == loss


# -- where the robot may be ------------------------------------------------------------------------


@pytest.mark.parametrize("odometry", [None, Pose2(3.0, -1.0, 0.7)])
def test_the_first_scan_lies_where_its_odometry_is(odometry: Pose2 | None) -> None:
    (found,) = HYPOTHESES(tracker(), 5.0, odometry)
    assert_guess(found, odometry or Pose2(), (0.1, 0.05))


def test_odometry_is_one_hypothesis_and_going_on_the_other() -> None:
    last, step = Pose2(1.0, 2.0, 0.5), Pose2(0.2, 0.0, 0.1)
    by_odometry, onward = HYPOTHESES(driven(last, step), 11.5, last.compose(Pose2(0.3, 0.4, -0.2)))
    assert_guess(by_odometry, last.compose(Pose2(0.3, 0.4, -0.2)), (0.1 + 0.15 * 0.5, 0.09))
    half = Pose2(0.1, 0.0, 0.05)
    assert_guess(onward, last.compose(half), (0.1 + 0.15 * 0.1, 0.05 + 0.2 * 0.05), loss=0.05)


@pytest.mark.parametrize("stands", [False, True])
def test_without_odometry_the_robot_goes_on_or_stands_as_its_mapper_says(stands: bool) -> None:
    last = Pose2(1.0, 2.0, 0.5)
    fields: dict[str, Any] = {STANDS: True} if stands else {}
    step = Pose2() if stands else Pose2(0.2, 0.0, 0.1)
    spread = (0.1 + 0.15 * step.x, 0.05 + 0.2 * step.yaw_rad)
    twice = (2.0 * spread[0], 2.0 * spread[1])
    (found,) = HYPOTHESES(driven(last, **fields), 12.0, None)
    assert_guess(found, last.compose(step), twice)
    # Odometry that comes anew has no earlier pose to be held against.
    started = driven(last, **fields)
    started.odometry = None
    (found,) = HYPOTHESES(started, 12.0, Pose2(0.0, 0.0, 0.0))
    assert_guess(found, last.compose(step), twice)


@pytest.mark.parametrize("stands", [False, True])
def test_where_scans_are_missing_a_robot_without_odometry_may_be_anywhere_on_its_way(
    stands: bool,
) -> None:
    step = Pose2(0.2, 0.0, 0.1)
    thrice = Pose2(0.6, 0.0, 0.3)
    way = [HOME, thrice, thrice.compose(thrice), thrice.compose(thrice).compose(thrice)]
    found = HYPOTHESES(driven(HOME, step, **{STANDS: stands}), 11.0 + 7.0, None)
    # The first one is where it is expected; as it went it would have come the whole way.
    order = [0, 1, 2, 3] if stands else [1, 0, 2, 3]
    for guess, index in zip(found, order, strict=True):
        loss = 0.05 * (index if stands else 3 - index) / 3
        np.testing.assert_allclose(guess.pose, of_pose(way[index]), atol=1e-9)
        assert guess.loss == pytest.approx(loss)
    assert len(HYPOTHESES(driven(HOME, step), 11.0 + 3600.0, None)) == 9
    # A turn that wraps, and one that is rounded where it does.
    for turned in (Pose2(0.1, 0.2, 1.9), Pose2(0.0196, 0.0420, 0.4422470158261755)):
        assert len(HYPOTHESES(driven(HOME, turned, **{STANDS: stands}), 11.0 + 7.0, None)) == 4
    assert len(HYPOTHESES(driven(HOME, HOME), 11.0 + 3600.0, None)) == 1


@pytest.mark.parametrize("step", [Pose2(5.001), Pose2(-3.1, 4.0), Pose2(0.0, -80.0)])
def test_odometry_that_jumps_is_named_and_not_believed(step: Pose2) -> None:
    found = driven()
    found.health.scans = 31
    (onward,) = HYPOTHESES(found, 12.0, step)
    assert_guess(onward, Pose2(0.2, 0.0, 0.1), (2.0 * 0.13, 2.0 * 0.07))
    assert found.has_jumped
    assert found.health.skips.counts == {JUMPED: 1}
    assert found.health.skips.lines == {JUMPED: [31]}
    HYPOTHESES(found, 13.0, Pose2(0.1))
    assert not found.has_jumped


@pytest.mark.parametrize(("jump_m", "step_m"), [(0.5, 0.6), (40.0, 40.1)])
def test_how_far_a_step_may_be_is_a_setting(jump_m: float, step_m: float) -> None:
    for far_m, count in ((jump_m, 2), (step_m, 1)):
        found = tracker(MatcherConfig(jump_m=jump_m))
        found.advance(Pose2(), Pose2(), 10.0)
        assert len(HYPOTHESES(found, 11.0, Pose2(0.0, far_m))) == count
        assert found.has_jumped == (count == 1)
    assert list(found.health.skips.counts) == [
        f"odometry jumped by more than {jump_m:g} m: not believed"
    ]


@given(
    near=st.floats(0.0, 1.0),
    step=st.tuples(st.floats(-3.5, 3.5), st.floats(-3.5, 3.5), st.floats(-3.0, 3.0)),
)
def test_a_shorter_step_is_never_doubted_more(
    near: float, step: tuple[float, float, float]
) -> None:
    far, short = driven(), driven()
    wide = HYPOTHESES(far, 12.0, Pose2(*step))[0].spread
    narrow = HYPOTHESES(short, 12.0, Pose2(*(near * part for part in step)))[0].spread
    assert narrow.xy_m <= wide.xy_m + 1e-12
    assert narrow.yaw_rad <= wide.yaw_rad + 1e-12


# -- a match ---------------------------------------------------------------------------------------


def drawn(values: npt.NDArray[np.uint8]) -> FieldMap:
    """Return a field of wall values, indexed by row and column, as the matcher takes it."""
    tiles = values.reshape(TILES, TILE, TILES, TILE).swapaxes(1, 2).reshape(-1, TILE, TILE)
    pages = np.arange(TILES * TILES, dtype=np.int32).reshape(TILES, TILES)
    corner = np.full(2, -HALF_M / CELL_M)
    return FieldMap(np.ascontiguousarray(tiles), pages, corner, CELL_M)


def centres() -> tuple[F64, F64]:
    """Return x and y of the cells' centres, metres."""
    along = (np.arange(TILE * TILES) + 0.5) * CELL_M - HALF_M
    x, y = np.meshgrid(along, along)
    return x, y


def ring(inside: int, outside: int) -> FieldMap:
    """Return a field of one value where a first look reaches, and another beyond 0.65 m."""
    x, y = centres()
    return drawn(np.where(np.hypot(x, y) < 0.65, inside, outside).astype(np.uint8))


POINTS = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01], [0.01, 0.01]])
HERE = Guess(np.zeros(3), Spread(0.1, 0.05), by_odometry=True)


def test_a_good_match_is_taken_and_remembered() -> None:
    found = tracker(SCORES_ALONE)
    match = found.match(ring(100, 100), POINTS, [HERE])
    assert match.score == pytest.approx(100 / 255, abs=1e-6)
    assert getattr(match, CURVATURE) is None
    health = found.health
    assert (health.match_score, health.mean_match_score) == (match.score, match.score)
    assert (getattr(found, MEAN_SCORE), health.low_scores) == (match.score, 0)


@pytest.mark.parametrize(("outside", "is_taken"), [(101, False), (125, False), (126, True)])
def test_the_second_search_must_find_a_tenth_more(outside: int, is_taken: bool) -> None:
    """By chance it finds more, too: 25.5 of 255 are a tenth."""
    found = tracker(SCORES_ALONE, **{MEAN_SCORE: 0.9})
    match = found.match(ring(100, outside), POINTS, [HERE])
    assert match.score == pytest.approx((outside if is_taken else 100) / 255, abs=1e-6)


def corridor(peak: int) -> FieldMap:
    """Return walls along x at 1 m on either side; they tell nothing of x."""
    _, y = centres()
    return drawn(np.maximum(0.0, peak * (1.0 - np.abs(np.abs(y) - 1.0) / 0.3)).astype(np.uint8))


WALLS = np.array([(x, y) for x in np.arange(-3.0, 3.0, 0.07) for y in (-1.0, 1.0)])
ELSEWHERE = Guess(np.array([0.4, 0.0, 0.0]), Spread(0.1, 0.05), loss=0.05)


@pytest.mark.parametrize("resolves", [True, False])
def test_along_a_corridor_odometry_decides_where_that_is_asked_for(resolves: bool) -> None:
    fields: dict[str, Any] = {RESOLVES: True} if resolves else {}
    found = tracker(SCORES_ALONE, **fields)
    match = found.match(corridor(250), WALLS, [HERE, ELSEWHERE])
    assert abs(match.pose[1]) < 0.03
    assert getattr(match, CURVATURE) is None
    assert (abs(match.pose[0]) < 1e-3) == resolves
    # By the same draws the place is that of the search, but for what is settled.
    again = tracker(SCORES_ALONE).match(corridor(250), WALLS, [HERE, ELSEWHERE])
    assert match.pose[1] == pytest.approx(again.pose[1], abs=1e-3)
    # Without odometry nothing settles it.
    alone = tracker(SCORES_ALONE, **{RESOLVES: True})
    beside = replace(HERE, pose=np.array([0.0, 0.1, 0.0]), by_odometry=False)
    match = alone.match(corridor(250), WALLS, [beside])
    assert abs(match.pose[0]) > 1e-3
    assert getattr(match, CURVATURE) is None


# -- what is kept of the scores --------------------------------------------------------------------


@pytest.mark.parametrize(("mean", "low"), [(0.75, 0), (0.78, 0), (0.79, 1), (0.85, 1)])
def test_low_scores_are_counted_against_the_mean(mean: float, low: int) -> None:
    found = tracker(SCORES_ALONE)
    found.health.mean_match_score = mean
    found.match(ring(100, 100), POINTS, [HERE])
    assert found.health.low_scores == low
    found.match(ring(10, 10), POINTS, [HERE])
    assert found.health.low_scores == low + 1


def test_a_pose_that_is_taken_is_where_the_next_step_starts() -> None:
    found = tracker()
    found.advance(Pose2(1.0, 0.0, math.pi / 2), Pose2(), 3.0)
    assert (found.pose, found.odometry, found.stamp_s) == (
        Pose2(1.0, 0.0, math.pi / 2),
        Pose2(),
        3.0,
    )
    assert found.step == Pose2()
    found.advance(Pose2(1.0, 0.5, math.pi / 2), None, 3.25)
    assert found.odometry is None
    assert found.step_s == 0.25
    np.testing.assert_allclose(of_pose(found.step), (0.5, 0.0, 0.0), atol=1e-12)
