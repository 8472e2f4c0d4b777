"""Which inputs agree: triangles that close, and the largest group when some do not."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from slamfusion.align.records import Alignment
from slamfusion.fusion.consistency import Implied, ImpliedPairs, largest_group
from slamfusion.geometry import Pose2

SIZE = 0.05
# Where the frame of each input lies in the world; every right transform follows from them.
FRAMES = {
    name: Pose2(3.0 * index, -1.5 * index, 0.4 * index)
    for index, name in enumerate("abcdefghijklmnop")
}
CENTRES = dict.fromkeys(FRAMES, (1.0, 2.0))
ASIDE = Pose2(0.0, 2.0)
TURNED = Pose2(0.0, 0.0, math.radians(10.0))


def pair(
    moving: str,
    reference: str,
    score: float = 0.5,
    error: Pose2 | None = None,
    *,
    accepted: bool = True,
) -> Alignment:
    """An alignment that follows the frames, or is off by ``error`` at the moving centre."""
    right = FRAMES[reference].inverse().compose(FRAMES[moving])
    if error is not None:
        x, y = CENTRES[moving]
        right = right.compose(Pose2(x, y)).compose(error).compose(Pose2(-x, -y))
    return Alignment(
        reference, moving, right, accepted, "drawn by hand", score, 1.0, 0.0, None, 0.0
    )


def members(names: str, pairs: list[Alignment]) -> str:
    return "".join(largest_group(list(names), pairs, CENTRES, SIZE).members)


def all_pairs(names: str) -> list[Alignment]:
    return [pair(b, a) for a, b in itertools.combinations(names, 2)]


def test_a_triangle_that_closes_is_one_group() -> None:
    assert members("abc", all_pairs("abc")) == "abc"


def test_directions_of_the_pairs_do_not_matter() -> None:
    for order in itertools.product((False, True), repeat=3):
        pairs = [
            pair(*(names[::-1] if flip else names))
            for names, flip in zip(("ab", "bc", "ca"), order, strict=True)
        ]
        assert members("abc", pairs) == "abc"


@pytest.mark.parametrize("error", [ASIDE, TURNED, Pose2(0.6, -0.7, 0.03)])
def test_of_a_triangle_that_does_not_close_the_best_pair_stays(error: Pose2) -> None:
    pairs = [pair("b", "a", 0.5), pair("c", "a", 0.7, error), pair("c", "b", 0.6)]
    group = largest_group(list("abc"), pairs, CENTRES, SIZE)
    assert group.members == ("a", "c")
    assert group.score == 0.7


def test_one_bad_input_among_four_is_left_out() -> None:
    pairs = [
        pair("b", "a"),
        pair("c", "a"),
        pair("c", "b"),
        pair("d", "a", 0.9, ASIDE),
        pair("d", "b", 0.9, TURNED),
        pair("d", "c", 0.9),
    ]
    assert members("abcd", pairs) == "abc"


def test_of_equal_groups_the_higher_score_wins_then_the_earlier_inputs() -> None:
    assert members("abcd", [pair("b", "a", 0.4), pair("d", "c", 0.6)]) == "cd"
    assert members("abcd", [pair("d", "c", 0.5), pair("b", "a", 0.5)]) == "ab"


def test_a_chain_without_a_triangle_is_a_group() -> None:
    assert members("abcd", [pair("b", "a"), pair("c", "b"), pair("d", "c")]) == "abcd"


def test_a_rejected_side_leaves_a_triangle_open() -> None:
    pairs = [pair("b", "a"), pair("c", "a"), pair("c", "b", error=ASIDE, accepted=False)]
    assert members("abc", pairs) == "abc"


class Walls(ImpliedPairs):
    """Answers what walls say of an implied transform, and notes what was asked."""

    def __init__(self, *, stands: bool) -> None:
        super().__init__({}, 3)
        self.stands = stands

    def _look(self, still: str, moved: str, transform: Pose2) -> Implied:
        right = pair(moved, still).transform
        assert (transform.x, transform.y) == pytest.approx((right.x, right.y))
        assert transform.yaw_rad == pytest.approx(right.yaw_rad)
        return Implied(pair(moved, still), self.stands, "")


def test_a_rejected_pair_is_asked_about_where_the_others_put_it() -> None:
    walls = Walls(stands=True)
    pairs = [pair("b", "a"), pair("c", "a"), pair("c", "b", error=ASIDE, accepted=False)]
    assert largest_group(list("abc"), pairs, CENTRES, SIZE, walls).members == ("a", "b", "c")
    assert [key[:2] for key in walls.seen] == [("b", "c")]
    # Accepted pairs, and rejected ones to a map of no group, are nobody's question.
    walls.seen.clear()
    apart = [pair("b", "a"), pair("c", "a", accepted=False), pair("c", "b", accepted=False)]
    assert largest_group(list("abc"), apart, CENTRES, SIZE, walls).members == ("a", "b")
    assert not walls.seen


def test_a_group_falls_apart_over_a_rejected_pair_that_does_not_stand() -> None:
    chain = [pair(b, a, 0.5 + 0.01 * i) for i, (a, b) in enumerate(itertools.pairwise("abcd"))]
    pairs = [*chain, pair("c", "a", accepted=False)]

    def group(*, answer: bool) -> str:
        found = largest_group(list("abcd"), pairs, CENTRES, SIZE, Walls(stands=answer))
        return "".join(found.members)

    assert group(answer=True) == "abcd"
    # The two of the pair are in no group together; with b goes what hangs on c.
    assert group(answer=False) == "bcd"


@example(scores=[0.0, 1e-5, 0.5, 0.5, 1e-5, 0.25], chosen=["a", "b", "c", "d"])
@given(scores=st.lists(st.floats(0.0, 1.0), min_size=6, max_size=6), chosen=st.permutations("abcd"))
def test_a_group_does_not_depend_on_the_order_of_the_pairs(
    scores: list[float], chosen: list[str]
) -> None:
    wrong = frozenset(chosen[:2])
    pairs = [
        pair(b, a, score, ASIDE if {a, b} == wrong else None)
        for (a, b), score in zip(itertools.combinations("abcd", 2), scores, strict=True)
    ]
    assert members("abcd", pairs) == members("abcd", pairs[::-1])
