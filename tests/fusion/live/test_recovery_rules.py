"""Who comes back by the last fused map, who is searched on it, and when; with given answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from slamfusion.config import LiveConfig
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.recovery import (
    IN_VAIN,
    LAST_AGREED,
    LAST_FUSED,
    WAITING,
    Recovered,
    recover,
)
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.scripted import CELL_M, MISFIT, Script, found, scripted_aligner, voter

LIVE = LiveConfig(search_pause_s=5.0, confirm_s=3.0, jump_m=0.5)


def room(name: str = "F") -> OccupancyGrid:
    """Return a fused map with enough walls to go by; the last one is called F in the script."""
    cells = np.zeros((20, 20), dtype=np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = 100
    return OccupancyGrid(cells, CELL_M, Pose2(), name)


class Last:
    """Inputs in doubt, and the last fused map, which counts how often it is asked for."""

    def __init__(self, *tracks: Track, live: LiveConfig = LIVE) -> None:
        self.tracks = tracks
        self.aligner: Aligner = scripted_aligner(live)
        self.fused: OccupancyGrid | None = room()
        self.agreed: OccupancyGrid | None = None
        self.asked = 0

    def __call__(self) -> Recovered:
        def fused() -> OccupancyGrid | None:
            self.asked += 1
            return self.fused

        self.aligner.has_searched = False
        return recover(self.tracks, self.aligner, fused, lambda: self.agreed)

    def voters(self) -> str:
        return "".join(track.name for track in self.tracks if track.votes)


def doubted(name: str, **more: Any) -> Track:
    return voter(name, **{"accepted": False, "reason": "in doubt", **more})


def disagree(script: Script, *pairs: str) -> None:
    """Let no two of these fit each other."""
    script.tracked.update(dict.fromkeys(pairs, MISFIT))


# -- who comes back --------------------------------------------------------------------------------


def test_those_that_fit_it_and_each_other_come_back_where_they_fit(script: Script) -> None:
    script.tracked["Fb"] = found(0.3, reason="b fits")
    last = Last(doubted("a"), doubted("b", walls=120))
    got = last()
    assert last.voters() == "ab"
    assert (got.reference, got.problem) == (last.tracks[1], None)
    assert last.tracks[1].transform == Pose2(0.3)
    assert last.tracks[1].reason == "b fits"
    assert all(track.is_tracked for track in last.tracks)
    assert all(track.tried is None for track in last.tracks)
    assert not script.said("search")


def test_one_that_alone_fits_it_comes_back_alone(script: Script) -> None:
    disagree(script, "Fa", "Fc")
    last = Last(doubted("a", walls=900), doubted("b"), doubted("c"))
    got = last()
    assert last.voters() == "b"
    assert (got.reference, got.problem) == (last.tracks[1], None)
    assert last.tracks[0].reason == last.tracks[2].reason == f"does not fit {LAST_FUSED}"
    assert script.said("track") == ["track Fa", "track Fb", "track Fc"]


@pytest.mark.parametrize("names", ["ab", "abc"])
def test_of_those_that_fit_it_and_not_each_other_nobody_is_right(
    script: Script, names: str
) -> None:
    disagree(script, *(one + other for one in names for other in names))
    last = Last(*map(doubted, names))
    got = last()
    assert last.voters() == ""
    assert got.reference is None
    assert got.problem == f"{', '.join(names)} disagree and nobody can say who is right"
    assert {track.reason for track in last.tracks} == {got.problem}
    # As long as nobody sends another map there is nothing to look at.
    script.said()
    last.aligner.now_s += 100.0
    assert last().problem is None
    assert (last.asked, script.said()) == (1, [])


@pytest.mark.parametrize(
    ("misfits", "voters"), [("", ""), ("a", "b"), ("b", "a"), ("ab", "")], ids=str
)
def test_of_two_that_fit_it_and_not_each_other_the_last_majority_decides(
    script: Script, misfits: str, voters: str
) -> None:
    disagree(script, "ab", "ba", *(f"M{name}" for name in misfits))
    last = Last(doubted("a"), doubted("b"))
    last.agreed = room("M")
    got = last()
    assert last.voters() == voters
    for track in last.tracks:
        if voters:
            assert got.reference is not None
            assert got.held is not None
            assert (got.reference.name, got.held.name, got.problem) == (voters, LAST_AGREED, None)
            assert track.votes or track.reason == f"does not fit {LAST_AGREED}"
        else:
            assert track.reason == "a, b disagree and nobody can say who is right"


def test_a_majority_is_asked_only_where_those_disagree_that_fit_the_last_map(
    script: Script,
) -> None:
    last = Last(doubted("a"), doubted("b"))
    last.agreed = room("M")
    last()
    assert last.voters() == "ab"
    assert not {"track Ma", "track Mb"} & set(script.said("track"))


def test_one_that_fits_nowhere_is_searched_on_those_that_disagree_twice_on_each(
    script: Script,
) -> None:
    disagree(script, "ab", "ba", "Fc")
    last = Last(doubted("a"), doubted("b"), doubted("c"))
    searches = []
    for version in range(1, 6):
        last.tracks[2].version = version
        problem = last().problem
        assert problem == "a, b disagree and nobody can say who is right"
        assert {track.reason for track in last.tracks} == {problem}
        searches += script.said("search")
        last.aligner.now_s += LIVE.search_pause_s
    assert searches == ["search ac", "search ac", "search bc", "search bc", "search ac"]
    # Where it is found both go on, and the other is held against them next.
    script.searched["ac"] = found(0.2)
    last.tracks[2].version = 9
    got = last()
    assert (last.voters(), got.reference, got.problem) == ("ac", last.tracks[0], None)
    assert last.tracks[2].transform == Pose2(0.2)


def test_one_that_jumped_onto_one_of_them_is_confirmed_by_its_next_map(script: Script) -> None:
    disagree(script, "ab", "ba", "Fc")
    script.searched["ac"] = found(7.0)
    last = Last(doubted("a"), doubted("b"), doubted("c"))
    last()
    assert last.voters() == ""
    assert last.tracks[2].reason.startswith("jumped by 7.00 m")
    last.aligner.now_s += LIVE.search_pause_s
    last.tracks[2].version = 2
    last()
    assert last.voters() == "ac"


def test_without_a_third_the_one_that_was_placed_last_is_searched_on_the_other(
    script: Script,
) -> None:
    disagree(script, "ab", "ba")
    script.searched["ab"] = found(0.3, reason="b is there")
    last = Last(doubted("a", searched_s=10.0), doubted("b", searched_s=90.0))
    got = last()
    assert script.said("search") == ["search ab"]
    assert (last.voters(), got.reference) == ("ab", last.tracks[0])
    assert last.tracks[1].reason == "b is there"


@pytest.mark.parametrize("odd", [0, 1, 2])
def test_the_most_that_agree_are_right(script: Script, odd: int) -> None:
    names = "abc"
    disagree(script, *(names[odd] + name for name in names), *(name + names[odd] for name in names))
    last = Last(*map(doubted, names))
    got = last()
    assert last.voters() == names.replace(names[odd], "")
    assert got.problem is None
    assert last.tracks[odd].reason == f"does not fit {LAST_FUSED}"


def test_of_groups_of_one_size_the_first_is_right(script: Script) -> None:
    disagree(script, *(one + other for one in "ab" for other in "cd"))
    disagree(script, *(one + other for one in "cd" for other in "ab"))
    last = Last(*map(doubted, "abcd"))
    last()
    assert last.voters() == "ab"


def test_one_that_lay_nowhere_is_not_tried_there(script: Script) -> None:
    last = Last(doubted("a"), doubted("b"))
    last.tracks[0].transform = None
    last()
    assert last.voters() == "b"
    assert script.said("track") == ["track Fb"]


def test_nobody_votes_on_what_was_believed_before(script: Script) -> None:
    disagree(script, "Fa")
    last = Last(voter("a", jump=Pose2(9.0), jump_version=0))
    last.tracks[0].searched_s = last.aligner.now_s
    assert last().problem == f"no input fits {LAST_FUSED}"
    assert last.voters() == ""


# -- when ------------------------------------------------------------------------------------------


def test_the_same_inputs_with_the_same_maps_are_tried_once(script: Script) -> None:
    disagree(script, "Fa", "Fb")
    last = Last(doubted("a"), doubted("b"))
    for _ in range(2):
        assert last().problem == f"no input fits {LAST_FUSED}"
        last.aligner.now_s += 10.0
    assert script.said("search") == ["search Fa", "search Fb"]
    assert [track.tried for track in last.tracks] == [(1, "a/b", IN_VAIN)] * 2
    got = last()
    assert (got.reference, got.problem) == (None, None)
    assert (last.asked, script.said()) == (2, [])
    # One of them sent another map: only that is searched.
    last.tracks[1].version = 2
    last()
    assert script.said() == ["track Fa", "track Fb", "search Fb"]
    last.aligner.now_s += 10.0
    last()
    assert not script.said()
    # Another input went away.
    last.tracks = last.tracks[:1]
    last()
    assert script.said("track", "search") == ["track Fa", "search Fa"]
    # What was tried in vain on another input was not tried on this map.
    for other in (None, (1, "a", 1), (1, "a", 0), (1, "a", -3), (1, "b", IN_VAIN)):
        last.tracks[0].tried = other
        last()
        assert script.said("track") == ["track Fa"]


def test_one_whose_search_must_wait_is_searched_when_it_may_be_though_no_map_comes(
    script: Script,
) -> None:
    disagree(script, "Fa")
    last = Last(doubted("a", searched_s=98.0))
    last()
    assert script.said() == ["track Fa"]
    assert last.tracks[0].tried == (1, "a", WAITING)
    # The map is not drawn for one that must wait.
    last.aligner.now_s = 102.9
    assert last().problem is None
    assert (last.asked, script.said()) == (1, [])
    last.aligner.now_s = 103.0
    script.searched["Fa"] = found(0.2)
    last()
    assert script.said("search") == ["search Fa"]
    assert last.voters() == "a"
    assert last.tracks[0].tried is None


def test_one_whose_search_was_put_off_is_searched_again_after_the_pause(script: Script) -> None:
    disagree(script, "Fa")
    last = Last(doubted("a"))
    script.takes_s, last.aligner.is_wanted = 1.5, lambda: True
    last()
    assert "put off" in last.tracks[0].reason
    last()
    assert script.said("search") == ["search Fa"]
    last.aligner.now_s += 5.0
    last()
    assert script.said("search") == ["search Fa"]
    assert last.tracks[0].tried == (1, "a", IN_VAIN)


def test_a_jump_that_may_be_confirmed_is_a_reason_to_look_again(script: Script) -> None:
    disagree(script, "Fa")
    jumped = doubted("a", jump=Pose2(9.0), jump_version=1, tried=(1, "a", -1))
    last = Last(jumped)
    jumped.jump_s = jumped.searched_s = last.aligner.now_s
    assert last().problem is None
    assert not script.said()
    last.aligner.now_s += 5.0
    script.searched["aF"] = found(-9.0)
    last()
    assert script.said("search") == ["search aF"]
    assert last.voters() == "a"
    assert jumped.transform == Pose2(9.0)


@pytest.mark.parametrize(
    ("fused", "is_held"),
    [
        (None, False),
        (room().crop(room().known_box()), True),
        (OccupancyGrid(np.zeros((20, 20), dtype=np.int8), CELL_M, Pose2(), "F"), False),
    ],
)
def test_a_last_map_without_walls_says_nothing(
    script: Script, fused: OccupancyGrid | None, is_held: bool
) -> None:
    last = Last(doubted("a"), doubted("b"))
    last.fused = fused
    got = last()
    assert last.voters() == ("ab" if is_held else "")
    words = None if is_held else f"{LAST_FUSED} has too few walls to go by"
    assert got.problem == words
    if not is_held:
        assert {track.reason for track in last.tracks} == {words}
        assert not script.said()


# -- who is searched -------------------------------------------------------------------------------


def test_the_one_that_waited_longest_is_searched_first(script: Script) -> None:
    disagree(script, "Fa", "Fb", "Fc")
    searched_s = {"a": 40.0, "b": 30.0, "c": 50.0}
    last = Last(*(doubted(name, searched_s=at_s) for name, at_s in searched_s.items()))
    asked = []
    for _ in range(4):
        assert last().reference is None
        asked += script.said("search")
        last.aligner.now_s += 1.0
    assert asked == ["search Fb", "search Fa", "search Fc"]
    assert [track.reason for track in last.tracks[:2]] == [f"does not fit {LAST_FUSED}"] * 2
    assert last.tracks[2].reason == f"to {LAST_FUSED}: walls do not match"


def test_one_that_rests_keeps_nobody_from_being_searched(script: Script) -> None:
    disagree(script, "Fa", "Fb")
    last = Last(doubted("a", searched_s=10.0, rest_s=500.0), doubted("b", searched_s=20.0))
    last()
    assert script.said("search") == ["search Fb"]


def test_one_search_a_round(script: Script) -> None:
    disagree(script, "Fa", "Fb")
    last = Last(doubted("a"), doubted("b"))
    last.aligner.has_searched = True
    recover(last.tracks, last.aligner, room)
    assert script.said() == ["track Fa", "track Fb"]
    last()
    assert script.said("search") == ["search Fa"]


def test_one_that_jumped_goes_before_those_that_waited_longer(script: Script) -> None:
    disagree(script, "Fa", "Fb", "Fc")
    jump = {"jump": Pose2(9.0), "jump_version": 1, "jump_s": 50.0}
    last = Last(
        doubted("a", searched_s=10.0),
        doubted("b", searched_s=90.0, reason="b jumped", **jump),
        doubted("c", searched_s=80.0, reason="c jumped", **jump),
    )
    last()
    assert script.said("search") == ["search cF"]
    assert last.tracks[0].reason == f"does not fit {LAST_FUSED}"
    assert last.tracks[1].reason == "b jumped"
    assert "a second search does not find it" in last.tracks[2].reason
    assert [track.tried and track.tried[2] for track in last.tracks] == [
        WAITING,
        WAITING,
        IN_VAIN,
    ]


@pytest.mark.parametrize(("ago_s", "is_searched"), [(4.9, False), (5.0, True)])
def test_searches_on_it_are_a_pause_apart(script: Script, ago_s: float, is_searched: bool) -> None:
    disagree(script, "Fa")
    last = Last(doubted("a"))
    last.tracks[0].searched_s = last.aligner.now_s - ago_s
    last()
    assert script.said("search") == ["search Fa"] * is_searched
