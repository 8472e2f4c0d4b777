"""Which inputs fit together: loops that close, and what is taken back when some do not."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from slamfusion.align.decide import MatchEvidence
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.fusion.grouping import FusionSetup, GroupSearch, Implied
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import features_of

SIZE = 0.05
# Where the frame of each input lies in the world; every right transform follows from them.
FRAMES = {
    name: Pose2(0.1 * index, -0.05 * index, 0.4 * index) for index, name in enumerate("abcdef")
}
CENTRE = (1.0, 1.0)
ASIDE = Pose2(0.0, 1.0)
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
        x, y = CENTRE
        right = right.compose(Pose2(x, y)).compose(error).compose(Pose2(-x, -y))
    better = 100.0 * score
    evidence = MatchEvidence("good", better, better, "another pose", 1.0, 0.9, 30.0, 0.1, 1e-6)
    return Alignment(
        reference=reference, moving=moving, accepted=accepted, reason="drawn by hand",
        transform=right, score=score, overlap=1.0, error=0.0, runner_up=None, time_s=0.0,
        evidence=evidence,
    )  # fmt: skip


class Search(GroupSearch):
    """Groups maps of one square room by alignments that are given."""

    def __init__(self, names: str, pairs: list[Alignment], against: str = "") -> None:
        """Take the pairs, and the two maps of which the walls contradict where others put them."""
        cells = np.zeros((40, 40), dtype=np.int8)
        cells[[0, -1]] = cells[:, [0, -1]] = 100
        grid = OccupancyGrid(cells, SIZE)
        self.given = {frozenset((one.reference, one.moving)): one for one in pairs}
        features = {name: features_of(grid.with_name(name), Search.device) for name in names}
        super().__init__(features, FusionSetup(FusionConfig(), Search.device))
        self.candidates = [item for item in self.candidates if item.key in self.given]
        self.against, self.asked = set(against), list[str]()

    device: ComputeDevice

    def align(self, a: str, b: str) -> Alignment:
        """Return the pair that was given."""
        return self.given[frozenset((a, b))]

    def ahead(self, coming: Iterable[tuple[str, str]]) -> None:
        """Start nothing in advance."""

    def look(self, reference: str, moving: str, transform: Pose2) -> Implied:
        """Say whether the walls of a pair contradict others, and note what was asked."""
        self.asked.append(reference + moving)
        right = pair(moving, reference).transform
        assert (transform.x, transform.y) == pytest.approx((right.x, right.y))
        assert transform.yaw_rad == pytest.approx(right.yaw_rad)
        stands = {reference, moving} != self.against
        return Implied(pair(moving, reference), stands, "little")


@pytest.fixture(autouse=True)
def _on_a_device(device: ComputeDevice) -> None:
    Search.device = device


def members(names: str, pairs: list[Alignment], against: str = "") -> str:
    return "".join(Search(names, pairs, against).run()[0][0])


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
    groups, told = Search("abc", pairs).run()
    assert list(groups[0]) == ["a", "c"]
    assert [one.score for one in told if one.accepted] == [0.7]
    false = [one for one in told if not one.accepted]
    assert len(false) == 2
    assert all(one.reason.startswith("taken back: ") for one in false)


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


def test_a_rejected_pair_is_asked_about_where_the_others_put_it() -> None:
    pairs = [pair("b", "a"), pair("c", "a"), pair("c", "b", error=ASIDE, accepted=False)]
    search = Search("abc", pairs)
    assert list(search.run()[0][0]) == ["a", "b", "c"]
    assert search.asked == ["bc"]
    # Rejected pairs to a map of no group are no question.
    apart = [pair("b", "a"), pair("c", "a", accepted=False), pair("c", "b", accepted=False)]
    search = Search("abc", apart)
    assert list(search.run()[0][0]) == ["a", "b"]
    assert not search.asked


def test_links_are_taken_back_over_a_rejected_pair_that_walls_contradict() -> None:
    chain = [pair(b, a, 0.5 + 0.01 * i) for i, (a, b) in enumerate(itertools.pairwise("abcd"))]
    pairs = [*chain, pair("c", "a", accepted=False)]
    assert members("abcd", pairs) == "abcd"
    # Either link between a and c may be the false one.
    assert members("abcd", pairs, against="ac") == "cd"
    # A link that is far stronger than the other is not.
    strong = [pair("b", "a"), pair("c", "b", 0.2), pair("c", "a", accepted=False)]
    assert members("abc", strong, against="ac") == "ab"


def test_a_contradicted_bridge_between_closed_loops_is_taken_back() -> None:
    pairs = [pair(b, a) for a, b in ("ab", "bc", "ac", "cd", "de", "ef", "df")]
    groups, told = Search("abcdef", [*pairs, pair("e", "b", accepted=False)], "be").run()
    assert [list(group) for group in groups] == [["a", "b", "c"], ["d", "e", "f"]]
    (false,) = (one for one in told if one.reason.startswith("taken back: "))
    assert {false.reference, false.moving} == {"c", "d"}


LOOPS = [pair(b, a) for a, b in ("ab", "bc", "ac", "cd", "bd")]


def test_walls_that_contradict_closed_loops_take_nothing_back() -> None:
    assert members("abcd", [*LOOPS, pair("d", "a", accepted=False)], against="ad") == "abcd"


def test_a_weak_pair_that_contradicts_loops_is_the_false_one() -> None:
    assert members("abcd", [*LOOPS, pair("d", "a", 0.4, ASIDE)]) == "abcd"
    triangle = [pair("b", "a", 0.6), pair("c", "b", 0.5), pair("c", "a", 0.06, ASIDE)]
    assert members("abc", triangle) == "abc"


@example(scores=[0.0, 1e-5, 0.5, 0.5, 1e-5, 0.25], chosen=["a", "b", "c", "d"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
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
