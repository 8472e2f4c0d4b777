"""A closure is found where the robot is, every reason against one is real, and big ones wait."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import Backend, open_backend
from slamfusion.config import GraphConfig
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.slam.common.response import LEAST_SIGMA, MOST_SIGMA
from slamfusion.slam.graph.closure_search import (
    AGREEMENT_M,
    LOCAL_DRIFT_M,
    MOST_UNSEEN,
    SMALL_STEP_M,
    SMALL_STEP_RAD,
    TRUST,
    ClosureSearch,
    Found,
    How,
    Waiting,
    WaitingRoom,
)
from slamfusion.slam.graph.constraints import Constraint
from slamfusion.slam.graph.submap import Submap
from tests.slam.drives import CELL_M, draw_flat, true_poses
from tests.slam.places import NO_LASER, U8, draw_corridor, draw_regular_ring, draw_two_rooms, read

pytestmark = pytest.mark.once

F64 = npt.NDArray[np.float64]
USUAL = 0.75


@pytest.fixture(scope="module")
def backend() -> Backend:
    return open_backend()


@pytest.fixture(scope="module")
def search(backend: Backend) -> ClosureSearch:
    return ClosureSearch(GraphConfig(), backend, np.random.default_rng(0))


def vector(pose: Pose2) -> F64:
    return np.array([pose.x, pose.y, pose.yaw_rad])


def hits(cells: U8, pose: Pose2, reach_m: float = 8.0) -> F64:
    """Return (P, 2) what a laser of 181 beams hits, in the robot's frame."""
    return read(cells, [pose], reach_m, beams=181)[0].points()


def seen(backend: Backend, cells: U8, poses: list[Pose2], reach_m: float = 8.0) -> Submap:
    """Return a finished submap, in the map frame."""
    submap = Submap(backend, 0, CELL_M, 0.1)
    for scan, pose in zip(read(cells, poses, reach_m, beams=361), poses, strict=True):
        submap.insert(scan.points(), NO_LASER, pose)
    submap.finish()
    return submap


@pytest.fixture(scope="module")
def flat(backend: Backend) -> Submap:
    return seen(backend, draw_flat(), true_poses(120)[::8])


@pytest.fixture(scope="module")
def two_rooms(backend: Backend) -> Submap:
    """Two rooms that are the same, seen from within, in one submap; of the corridor nothing."""
    inside = [Pose2(x, y, yaw) for x, y in ((1.5, 3.3), (3.2, 4.2)) for yaw in (-2.0, 0.0, 2.0)]
    poses = [*inside, *(Pose2(pose.x + 5.0, pose.y, pose.yaw_rad) for pose in inside)]
    return seen(backend, draw_two_rooms(), poses, 2.2)


def is_at(found: Found | str, truth: Pose2, *, most_m: float = 0.1, most_rad: float = 0.03) -> bool:
    """Return whether a place was found, and the true one."""
    if isinstance(found, str):
        return False
    away = math.hypot(found.pose[0] - truth.x, found.pose[1] - truth.y)
    return away < most_m and abs(wrap_angle(found.pose[2] - truth.yaw_rad)) < most_rad


# -- a place that is found -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("drift_m", "wrong"),
    [
        (0.3, (0.2, -0.1, 0.03)),
        (LOCAL_DRIFT_M, (-0.3, 0.3, -0.05)),
        (LOCAL_DRIFT_M + 0.01, (0.6, -0.6, 0.1)),
        (2.5, (2.4, -2.4, 0.25)),
        (20.0, (-3.9, 3.9, 0.34)),
    ],
)
def test_a_place_is_found_as_far_off_as_it_may_be(
    search: ClosureSearch, flat: Submap, drift_m: float, wrong: tuple[float, float, float]
):
    for index in (40, 62, 80):
        truth = true_poses(120)[index]
        expected = vector(truth) + np.array(wrong)
        found = search.near(flat, hits(draw_flat(), truth), expected, drift_m, USUAL)
        assert is_at(found, truth), f"{index}: {found}"
        assert isinstance(found, Found)
        arm = np.outer([1.0, 1.0, 5.0], [1.0, 1.0, 5.0])
        values = np.linalg.eigvalsh(found.information / arm)
        assert values.min() > 0.99 * MOST_SIGMA**-2.0
        assert values.max() < 1.01 * LEAST_SIGMA**-2.0


@pytest.mark.parametrize("index", [0, 40, 80, 110])
def test_a_robot_that_may_be_anywhere_is_found(search: ClosureSearch, flat: Submap, index: int):
    truth = true_poses(120)[index]
    assert is_at(search.anywhere(flat, hits(draw_flat(), truth), USUAL), truth)


@given(
    at=st.tuples(st.floats(0.8, 8.0), st.floats(0.8, 2.6), st.floats(-math.pi, math.pi)),
    wrong=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    drift_m=st.sampled_from((0.5, 1.5, 3.0)),
)
@settings(max_examples=40, deadline=None)
def test_no_other_place_than_the_true_one_is_found(
    search: ClosureSearch,
    flat: Submap,
    at: tuple[float, float, float],
    wrong: tuple[float, float, float],
    drift_m: float,
):
    """From anywhere in the flat, also where the robot never was: few walls in common blur it."""
    truth = Pose2(*at)
    expected = vector(truth) + np.array(wrong) * (drift_m, drift_m, 0.05)
    found = search.near(flat, hits(draw_flat(), truth), expected, drift_m, USUAL)
    if not isinstance(found, str):
        assert is_at(found, truth, most_m=0.4, most_rad=0.1), found.pose - vector(truth)


# -- why one is not found --------------------------------------------------------------------------


@pytest.mark.parametrize("drift_m", [0.5, 2.0])
def test_another_place_fits_badly(search: ClosureSearch, flat: Submap, drift_m: float):
    """A round room in an L of straight walls."""
    angles = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
    ring = 0.9 * np.column_stack((np.cos(angles), np.sin(angles)))
    expected = vector(true_poses(120)[60])
    assert search.near(flat, ring, expected, drift_m, USUAL) == "low response"
    assert search.anywhere(flat, ring, USUAL) == "low response"


def test_what_is_usual_decides_what_fits_badly(search: ClosureSearch, flat: Submap):
    """A third of the hits is noise: enough where matches are usually no better."""
    truth = true_poses(120)[60]
    points, rng = hits(draw_flat(), truth), np.random.default_rng(0)
    points[::3] += rng.choice([-0.35, 0.35], points[::3].shape)
    expected = vector(truth)
    assert is_at(search.near(flat, points, expected, 0.4, 0.6), truth)
    assert search.near(flat, points, expected, 0.4, 1.0) == "low response"
    # Never below what the settings ask for.
    points[::2] = rng.uniform(-0.8, 0.8, points[::2].shape)
    assert search.near(flat, points, expected, 0.4, 0.1) == "low response"


def test_where_nothing_was_seen_there_is_little_in_common(backend: Backend, search: ClosureSearch):
    """A submap of one end of the flat, and a robot at its other end."""
    end = seen(backend, draw_flat(), [Pose2(1.2, 1.0 + 0.2 * i, 2.5) for i in range(6)], 2.0)
    truth = Pose2(7.0, 2.2, 0.3)
    points = hits(draw_flat(), truth, 3.0)
    assert search.near(end, points, vector(truth), 0.5, USUAL) == "little in common"


def test_a_share_that_is_not_seen_is_allowed(backend: Backend, search: ClosureSearch):
    """A submap without a share of what the scan hits, from behind the robot on: no hit there."""
    truth = true_poses(120)[60]
    points = hits(draw_flat(), truth)
    order = np.argsort(points[:, 0], kind="stable")
    for share, is_found in ((0.25, True), (MOST_UNSEEN - 0.1, True), (MOST_UNSEEN + 0.1, False)):
        submap = Submap(backend, 0, CELL_M, 0.1)
        submap.insert(points[order[int(share * len(points)) :]], NO_LASER, truth)
        submap.finish()
        found = search.near(submap, points, vector(truth), 0.3, USUAL)
        if is_found:
            assert is_at(found, truth), found
        else:
            assert found == "little in common"


@pytest.mark.parametrize("drift_m", [0.3, 0.7])
def test_a_bare_corridor_leaves_the_place_open(
    backend: Backend, search: ClosureSearch, drift_m: float
):
    cells = draw_corridor()
    submap = seen(backend, cells, [Pose2(9.0 + 0.3 * index, 1.5) for index in range(30)])
    reasons = []
    for index in range(10):
        truth = Pose2(12.0 + 0.2 * index, 1.5)
        found = search.near(submap, hits(cells, truth), vector(truth), drift_m, USUAL)
        reasons.append(found if isinstance(found, str) else "found")
    assert reasons.count("place left open") >= 8
    # The end of the same corridor is told.
    submap = seen(backend, cells, [Pose2(0.8 + 0.2 * index, 1.5) for index in range(12)])
    truth = Pose2(1.5, 1.5, 3.0)
    assert is_at(search.near(submap, hits(cells, truth), vector(truth), drift_m, USUAL), truth)


def test_pillars_at_every_metre_fit_twice(backend: Backend, search: ClosureSearch):
    """A robot that may have drifted by more than from one to the next."""
    cells = draw_regular_ring()
    submap = seen(backend, cells, [Pose2(3.0 + 0.4 * i, 1.5) for i in range(16)], 3.0)
    for index in range(5):
        truth = Pose2(6.0 + 0.17 * index, 1.5)
        points = hits(cells, truth, 3.0)
        assert search.near(submap, points, vector(truth), 1.2, USUAL) == "two places fit"
        assert search.anywhere(submap, points, USUAL) == "two places fit"
        # Of one that has hardly drifted it is known which.
        assert is_at(search.near(submap, points, vector(truth), 0.3, USUAL), truth)


@pytest.mark.parametrize("room", [0, 1])
def test_two_rooms_that_are_the_same_fit_twice(search: ClosureSearch, two_rooms: Submap, room: int):
    """By the search of everything; a window about one of them does not reach the other."""
    truth = Pose2(2.4 + 5.0 * room, 3.6, 0.4)
    points = hits(draw_two_rooms(), truth, 2.2)
    assert search.anywhere(two_rooms, points, USUAL) == "two places fit"
    expected = vector(truth) + np.array([0.8, -0.6, 0.1])
    assert is_at(search.near(two_rooms, points, expected, 1.5, USUAL), truth)


def test_a_rival_just_beyond_what_is_expected_counts(search: ClosureSearch, two_rooms: Submap):
    """The window reaches 3.6 m, the other room is 5 m off: it is looked for up to 4 m of either.

    One that is expected half way between both is in one window with both.
    """
    truth = Pose2(2.4, 3.6, 0.4)
    points = hits(draw_two_rooms(), truth, 2.2)
    middle = vector(truth) + np.array([2.5, 0.0, 0.0])
    assert search.near(two_rooms, points, middle, 2.6, USUAL) == "two places fit"
    nearer = vector(truth) + np.array([1.5, 0.0, 0.0])  # the other one is 3.5 m off
    assert search.near(two_rooms, points, nearer, 2.2, USUAL) == "two places fit"
    assert is_at(search.near(two_rooms, points, vector(truth), 2.2, USUAL), truth)


def test_a_room_that_looks_the_same_turned_around_fits_twice(
    backend: Backend, search: ClosureSearch
):
    """A bare oblong: half a turn away everything is the same."""
    cells = np.ones((100, 140), dtype=np.uint8)
    cells[10:90, 10:130] = 0
    poses = [Pose2(3.5 + 0.2 * i, 2.5 + 0.1 * i, 1.2 * i) for i in range(-5, 6)]
    submap = seen(backend, cells, poses)
    truth = Pose2(2.2, 3.1, 0.3)
    points = hits(cells, truth)
    assert search.anywhere(submap, points, USUAL) == "two places fit"
    # Of one that knows its heading there is one place.
    assert is_at(search.near(submap, points, vector(truth) + 0.1, 1.5, USUAL), truth)


# -- the waiting room ------------------------------------------------------------------------------


def waiting(
    number: int,
    correction: Pose2,
    *,
    start: int = 0,
    travelled_m: float | None = None,
    how: How = "known",
) -> Waiting:
    """Return a closure of a node; every node is half a metre on."""
    edge = Constraint(start, number, np.zeros(3), np.eye(3), is_closure=True)
    way_m = 0.5 * number if travelled_m is None else travelled_m
    return Waiting(edge, correction, way_m, how)


HERE = Pose2(3.0, -2.0, 0.5)
BIG = Pose2(2.0, 1.0, 0.0)


def moving(x: float, y: float, yaw_rad: float) -> Pose2:
    """Return a correction that moves a robot at ``HERE`` so, along the map's axes."""
    moved = Pose2(HERE.x + x, HERE.y + y, HERE.yaw_rad + yaw_rad)
    return moved.compose(HERE.inverse())


@pytest.mark.parametrize(
    ("step", "is_small"),
    [
        ((0.0, 0.0, 0.0), True),
        ((SMALL_STEP_M - 0.01, 0.0, 0.0), True),
        ((0.0, -SMALL_STEP_M - 0.01, 0.0), False),
        ((0.3, 0.3, 0.0), False),
        ((0.1, 0.1, SMALL_STEP_RAD - 0.01), True),
        ((0.0, 0.0, -SMALL_STEP_RAD - 0.01), False),
        ((0.0, 0.0, math.tau), True),
    ],
)
def test_a_small_step_is_believed_at_once(step: tuple[float, float, float], is_small: bool):
    room, closure = WaitingRoom(), waiting(7, moving(*step))
    assert room.confirmed(closure, HERE) == ([closure] if is_small else [])
    assert room.pending == ([] if is_small else [closure])


def test_a_big_step_waits_for_one_that_says_the_same():
    room = WaitingRoom()
    first, second = waiting(7, BIG), waiting(9, BIG)
    assert room.confirmed(first, HERE) == []
    assert room.confirmed(second, HERE) == [second, first]
    assert room.pending == []
    # The next one starts from nothing.
    assert room.confirmed(waiting(10, BIG), HERE) == []


def test_a_small_step_says_nothing_of_those_that_wait():
    room, first = WaitingRoom(), waiting(7, BIG)
    room.confirmed(first, HERE)
    small = waiting(8, moving(0.1, 0.0, 0.0))
    assert room.confirmed(small, HERE) == [small]
    assert room.pending == [first]
    last = waiting(9, BIG)
    assert room.confirmed(last, HERE) == [last, first]


@pytest.mark.parametrize(
    ("other", "agrees"),
    [
        ((2.0, 1.0, 0.5), True),
        ((2.0 + AGREEMENT_M - 0.01, 1.0, 0.5), True),
        ((2.0 + AGREEMENT_M + 0.01, 1.0, 0.5), False),
        ((2.0, 1.0, 0.5 + 0.04), True),
        ((2.0, 1.0, 0.5 - 0.06), False),
        ((2.0, 1.0, 0.5 + math.tau), True),
    ],
)
def test_what_would_move_the_robot_elsewhere_confirms_nothing(
    other: tuple[float, float, float], agrees: bool
):
    room = WaitingRoom()
    room.confirmed(waiting(7, moving(2.0, 1.0, 0.5)), HERE)
    assert len(room.confirmed(waiting(8, moving(*other)), HERE)) == (2 if agrees else 0)


def test_agreement_is_about_the_robot_of_now():
    """Two corrections that turn differently agree at the place where one was found, not far on."""
    one, other = moving(2.0, 0.0, 0.0), moving(2.0, 0.0, 0.04)
    for far_m, agrees in ((0.0, True), (20.0, False)):
        room, pose = WaitingRoom(), HERE.compose(Pose2(far_m))
        room.confirmed(waiting(7, one), HERE)
        assert len(room.confirmed(waiting(8, other), pose)) == (2 if agrees else 0)


def test_two_of_one_node_do_not_confirm_each_other():
    room = WaitingRoom()
    assert room.confirmed(waiting(7, BIG, start=1), HERE) == []
    assert room.confirmed(waiting(7, BIG, start=2), HERE) == []
    assert len(room.confirmed(waiting(8, BIG, start=1), HERE)) == 3


@pytest.mark.parametrize("confirms", [True, False])
def test_old_ones_expire(*, confirms: bool):
    later = TRUST["known"][2] + (0 if confirms else 1)
    room, second = WaitingRoom(), waiting(7 + later, BIG)
    room.confirmed(waiting(7, BIG), HERE)
    assert len(room.confirmed(second, HERE)) == (2 if confirms else 0)
    assert room.pending == ([] if confirms else [second])


def test_only_those_that_agree_are_believed():
    room, other = WaitingRoom(), moving(-5.0, 0.0, 1.0)
    first, false, last = waiting(7, BIG), waiting(8, other), waiting(9, BIG)
    for closure in (first, false):
        assert room.confirmed(closure, HERE) == []
    assert room.confirmed(last, HERE) == [last, first]


OTHER = moving(-5.0, 2.0, 1.0)
LOST: tuple[How, ...] = ("odometry",)


def told(how: How, ones: list[tuple[int, Pose2]], every_m: float = 1.0) -> list[int]:
    """Return how many closures of a lost robot were believed, after each of them."""
    room = WaitingRoom()
    return [
        len(
            room.confirmed(waiting(number, correction, travelled_m=every_m * number, how=how), HERE)
        )
        for number, correction in ones
    ]


def row(correction: Pose2, first: int, count: int) -> list[tuple[int, Pose2]]:
    """Return closures of nodes that follow each other and say the same."""
    return [(first + index, correction) for index in range(count)]


def test_a_robot_that_was_lost_needs_more_than_one_that_was_not():
    assert TRUST["known"][0] == 2
    assert TRUST["known"][0] < TRUST["odometry"][0]
    assert TRUST["known"][1] < TRUST["odometry"][1]


@pytest.mark.parametrize("how", LOST)
@pytest.mark.parametrize("correction", [BIG, moving(0.0, 0.0, 0.0)])
def test_a_lost_robot_is_found_when_enough_nodes_agree(how: How, correction: Pose2):
    """Also where it happens to be where odometry has it: no step is small then."""
    wanted = TRUST[how][0]
    assert told(how, row(correction, 7, wanted)) == [0] * (wanted - 1) + [wanted]


@pytest.mark.parametrize("how", LOST)
def test_closures_of_one_node_count_once(how: How):
    wanted = TRUST[how][0]
    twice = [one for one in row(BIG, 7, wanted - 1) for _ in range(2)]
    assert told(how, twice) == [0] * len(twice)
    assert told(how, [*twice, (30, BIG)])[-1] == (len(twice) + 1 if TRUST[how][2] >= 30 - 7 else 0)


@pytest.mark.parametrize("how", LOST)
def test_a_lost_robot_must_have_driven_between_them(how: How):
    wanted, way_m, _ = TRUST[how]
    enough = way_m / (wanted - 1)
    assert told(how, row(BIG, 7, wanted), 1.01 * enough)[-1] == wanted
    short = told(how, row(BIG, 7, wanted + 1), 0.99 * enough)
    assert short == [*[0] * wanted, wanted + 1]


@pytest.mark.parametrize("how", LOST)
def test_a_lost_robot_is_not_found_where_as_many_say_otherwise(how: How):
    """The last of six, say, has five before it that agree: five that do not are too many."""
    wanted = TRUST[how][0]
    others = [(number, moving(-5.0 - number, 2.0, 1.0)) for number in range(wanted - 1)]
    agreeing = row(BIG, wanted, wanted)
    assert told(how, [*others[1:], *agreeing])[-1] == wanted
    assert told(how, [*others, *agreeing])[-1] == 0
    assert told(how, [*others, *agreeing, (2 * wanted, BIG)])[-1] == wanted + 1


@pytest.mark.parametrize("how", ["known", *LOST])
def test_contradictions_expire_as_everything_does(how: How):
    wanted, _, nodes = TRUST[how]
    others = [(number, moving(-5.0 - number, 2.0, 1.0)) for number in range(3 * wanted)]
    last = nodes + len(others)
    found = told(how, [*others, *row(BIG, last - wanted + 1, wanted)])
    assert found[-1] == wanted
    # An agreeing one from too long ago is none.
    late = told(how, [(0, BIG), *row(BIG, nodes + 1, wanted - 1)])
    assert not any(late)


@given(
    frame=st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-3.0, 3.0)),
    ones=st.lists(
        st.tuples(
            st.integers(0, 3),
            st.sampled_from(
                [(0.1, 0.1, 0.05), (2.0, 1.0, 0.5), (2.1, 1.1, 0.52), (2.4, 1.0, 0.5), (-5, 2, 1)]
            ),
            st.sampled_from(("known", "odometry")),
        ),
        max_size=25,
    ),
)
@settings(max_examples=100, deadline=None)
def test_what_is_believed_does_not_depend_on_the_map_frame(
    frame: tuple[float, float, float],
    ones: list[tuple[int, tuple[float, float, float], How]],
):
    """And every closure is believed once at most, after it was told, within its time."""
    turn = Pose2(*frame)
    here, there = WaitingRoom(), WaitingRoom()
    pose, number, believed = HERE, 0, []
    for further, step, how in ones:
        number += further
        pose = pose.compose(Pose2(0.5 * further, 0.0, 0.1 * further))
        moved = Pose2(pose.x + step[0], pose.y + step[1], pose.yaw_rad + step[2])
        correction = moved.compose(pose.inverse())
        turned = turn.compose(correction).compose(turn.inverse())
        one = waiting(number, correction, how=how)
        found = here.confirmed(one, pose)
        same = there.confirmed(waiting(number, turned, how=how), turn.compose(pose))
        assert [c.edge.end for c in found] == [c.edge.end for c in same]
        assert not found or found[0] is one
        assert all(number - c.edge.end <= TRUST[c.how][2] for c in found)
        assert not {id(c) for c in found} & {id(c) for c in here.pending}
        believed += found
    assert len({id(one) for one in believed}) == len(believed)
