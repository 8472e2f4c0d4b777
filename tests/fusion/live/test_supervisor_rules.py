"""Who is aligned when, to whom, and who is wrong: both sides of every limit, with given answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.fusion.live.lattice import Layer
from slamfusion.fusion.live.supervisor import InputSupervisor
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.vote.lattice import Lattice
from tests.fusion.live.scripted import CELL_M, MISFIT, Script, found, newcomer, voter

# Of 100 walls five may change, and 100 before an input waits no longer.
LIVE = LiveConfig(search_pause_s=5.0, confirm_s=3.0, jump_m=0.5, track_share=0.05, track_cells=1000)


def cells(count: int) -> Layer:
    """Return a layer of so many cells."""
    return Layer(np.zeros((1, count), dtype=np.int8), Lattice(CELL_M, Pose2()))


class Round:
    """A supervisor after the first fusion, and its clock; the first input is the reference."""

    def __init__(self, *tracks: Track, live: LiveConfig = LIVE) -> None:
        self.judge = InputSupervisor(FusionConfig(), live, NumpyDevice())
        self.judge.restore(Lattice(CELL_M, Pose2()), {})
        self.judge.tracks.update({track.name: track for track in tracks})
        self.judge.reference = tracks[0].name
        self.judge.problem = ""
        self.now_s = 100.0
        self.maps_asked = 0

    def __call__(
        self, *, is_idle: bool = False, is_wanted: Callable[[], bool] | None = None
    ) -> InputSupervisor:
        """Let a second pass and a round go by."""
        self.now_s += 1.0

        def fused() -> OccupancyGrid | None:
            self.maps_asked += 1
            return None

        self.judge.align(self.now_s, fused, is_idle=is_idle, is_wanted=is_wanted)
        return self.judge

    def voters(self) -> str:
        return "".join(track.name for track in self.judge.voters)


def named(script: Script, kind: str) -> list[str]:
    """Return the pairs that were asked for in one way since the last time."""
    return [line.split()[1] for line in script.said(kind)]


# -- who is due ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("drift", "is_due"), [(0, False), (5, False), (6, True)])
@pytest.mark.parametrize("is_steady", [True, False])
def test_a_believed_input_is_due_when_walls_changed_or_it_may_have_moved(
    script: Script, drift: int, is_due: bool, is_steady: bool
) -> None:
    step = Round(voter("a"), voter("b", drift=drift, is_steady=is_steady))
    judge = step()
    assert named(script, "track") == (["ab"] if is_due or not is_steady else [])
    assert step.voters() == "ab"
    assert not judge.has_searched
    assert step.maps_asked == 0


@pytest.mark.parametrize(("few", "drift"), [("a", 4), ("b", 4), ("", 5)])
def test_few_is_of_the_map_with_fewer_walls(script: Script, few: str, drift: int) -> None:
    for more in (0, 1):
        tracks = [voter(name, walls=80 if name == few else 100) for name in "ab"]
        tracks[1].drift = drift + more
        Round(*tracks)()
        assert named(script, "track") == ["ab"] * more


def test_neither_the_reference_nor_one_without_a_map_is_due(script: Script) -> None:
    step = Round(voter("a", drift=99), voter("b"), voter("c", is_live=False, drift=99))
    step.judge.tracks["c"].refuse("gone")
    step()
    assert not script.said()
    # Nor where the reference itself sent nothing of late.
    step = Round(voter("a", drift=99, is_live=False), voter("b"))
    step()
    assert not script.said()


def test_a_doubted_input_is_tried_once_for_each_map_of_it_and_of_the_reference(
    script: Script,
) -> None:
    # A long pause, so that only tracking is left to try.
    doubted = voter("b", accepted=False, tried=(1, "a", 1))
    step = Round(voter("a"), doubted, live=replace(LIVE, search_pause_s=1000.0))
    doubted.searched_s = 100.0
    script.tracked["ab"] = MISFIT
    step()
    assert not script.said()
    for tried in (None, (0, "a", 1), (1, "c", 1), (1, "a", 0)):
        doubted.tried = tried
        step()
        assert named(script, "track") == ["ab"]


def test_a_jump_of_an_unchanged_map_waits_to_be_confirmed(script: Script) -> None:
    jumped = voter("b", accepted=False, jump=Pose2(9.0), jump_version=1, jump_s=100.0)
    step = Round(voter("a"), jumped)
    script.tracked["ab"] = MISFIT
    script.searched["ba"] = found(-9.0)
    step()
    step()
    assert not script.said(), "not before 3 s"
    judge = step()
    assert script.said("track", "search") == ["track ab", "search ba"]
    assert judge.has_searched
    assert step.voters() == "ab"
    # A map that has changed since is searched at once.
    jumped = voter("b", accepted=False, jump=Pose2(9.0), jump_version=0, jump_s=100.0)
    step = Round(voter("a"), jumped)
    script.searched["ab"] = found(9.0)
    step()
    assert named(script, "search") == ["ab"]
    assert step.voters() == "ab"


def test_a_confirmation_goes_round_the_other_voters_before_it_is_given_up(script: Script) -> None:
    jumped = voter("b", accepted=False, jump=Pose2(9.0), jump_version=1, jump_s=0.0)
    step = Round(voter("a"), jumped, voter("c"), live=replace(LIVE, search_pause_s=0.0))
    script.tracked["ab"] = MISFIT
    step()
    assert named(script, "search") == ["cb"]
    assert jumped.tried is None
    step()
    assert named(script, "search") == ["ba"]
    assert jumped.tried == (1, "a", 1)
    assert jumped.jump is None
    assert not step().has_searched


# -- what may wait ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("drift", "size", "is_idle", "is_aligned"),
    [
        (6, 1000, False, True),
        (6, 1001, False, False),
        (6, 1001, True, True),
        (100, 1001, False, False),
        (101, 1001, False, True),
        (101, 1000, False, True),
    ],
)
def test_a_large_voter_waits_for_a_pause_unless_much_has_changed(
    script: Script, drift: int, size: int, is_idle: bool, is_aligned: bool
) -> None:
    step = Round(voter("a"), voter("b", drift=drift, layer=cells(size)))
    step(is_idle=is_idle)
    assert named(script, "track") == (["ab"] if is_aligned else [])
    assert step.voters() == "ab"


def test_a_large_input_that_does_not_vote_waits_for_nothing(script: Script) -> None:
    step = Round(voter("a"), newcomer("b", layer=cells(9000)), voter("c", drift=6))
    script.searched["ab"] = found()
    step()
    assert script.said("track", "search") == ["search ab"], "the voter waits, with what it adds"
    assert step.voters() == "abc"


@pytest.mark.parametrize(
    ("first", "second", "is_aligned"),
    [(600, 400, True), (600, 401, False), (None, 1000, True), (None, 1001, False)],
)
def test_cells_of_one_round_are_counted_together(
    script: Script, first: int | None, second: int, is_aligned: bool
) -> None:
    layer = None if first is None else cells(first)
    step = Round(voter("a"), voter("b", drift=9, layer=layer), voter("c", drift=8))
    step.judge.tracks["c"].layer = cells(second)
    step()
    assert named(script, "track") == ["ab", "ac"][: 2 if is_aligned else 1]


def test_what_drifted_most_is_first_and_in_a_pause_one_large_one_is_aligned(
    script: Script,
) -> None:
    drifts = {"b": 7, "c": 9, "d": 8}
    large = [voter(name, drift=drift, layer=cells(2000)) for name, drift in drifts.items()]
    step = Round(voter("a"), *large)
    for pair in ("ac", "ad", "ab"):
        step(is_idle=True)
        assert named(script, "track") == [pair]
    step(is_idle=True)
    assert not script.said()


def test_of_those_that_are_late_one_a_round_is_aligned_whatever_comes(script: Script) -> None:
    drifts = {"b": 101, "c": 103, "d": 102, "e": 100}
    large = [voter(name, drift=drift, layer=cells(2000)) for name, drift in drifts.items()]
    step = Round(voter("a"), *large)
    for pair in ("ac", "ad", "ab"):
        step()
        assert named(script, "track") == [pair]
    step()
    assert not script.said(), "the last one is not late yet, and waits for a pause"
    # One without a vote, that is tried whatever comes, takes nobody's turn.
    step = Round(voter("a"), *large, newcomer("z", layer=cells(9000)))
    for name in "bc":
        step.judge.tracks[name].drift = 101
    script.searched["az"] = found()
    step()
    assert script.said("track", "search") == ["search az", "track ab"]


def test_what_waits_is_given_up_for_a_map_and_what_cannot_wait_is_not(script: Script) -> None:
    asked = 0

    def bell() -> bool:
        nonlocal asked
        asked += 1
        return False

    step = Round(voter("a"), voter("b", drift=6, layer=cells(2000)))
    step(is_idle=True, is_wanted=bell)
    token = script.asked[-1].cancel
    assert token is not None
    token.check()
    assert asked == 1
    step = Round(voter("a"), voter("b", drift=101, layer=cells(2000)))
    step(is_idle=True, is_wanted=bell)
    assert script.asked[-1].cancel is None


# -- what cannot be aligned ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "words"),
    [(MemoryBudgetError("b: too large"), "b: too large"), (MemoryError(), "MemoryError")],
)
def test_one_that_cannot_be_aligned_is_refused_once_and_the_others_go_on(
    script: Script, error: Exception, words: str
) -> None:
    step = Round(voter("a"), voter("b", drift=9), voter("c", drift=8))
    script.tracked["ab"] = error
    step()
    assert named(script, "track") == ["ab", "ac"]
    assert step.voters() == "ac"
    assert step.judge.tracks["b"].reason == f"cannot be aligned: {words}"
    step()
    assert not script.said(), "the same map is not tried again"


# -- searches --------------------------------------------------------------------------------------


def test_a_newcomer_is_searched_on_the_reference_then_on_each_voter_and_left_alone(
    script: Script,
) -> None:
    new = newcomer("n")
    step = Round(voter("a"), voter("b"), new, voter("c"), live=replace(LIVE, search_pause_s=0.0))
    asked = []
    for _ in range(5):
        step()
        asked.append(named(script, "search"))
        assert (new.tried is None) == (len(asked) < 3)
    assert asked == [["an"], ["bn"], ["cn"], [], []]
    assert step.voters() == "abc"
    assert new.reason.startswith("to c: ")
    # Its next map is searched again, from the reference on.
    new.version, script.searched["an"] = 2, found(3.0)
    step()
    assert named(script, "search") == ["an"]
    assert step.voters() == "abnc"
    assert new.tried is None


def test_a_newcomer_that_must_wait_says_so(script: Script) -> None:
    new = newcomer("n", searched_s=100.0, mismatch="to a: no")
    step = Round(voter("a"), new)
    step()
    assert new.reason == "to a: no; waits for a full search"
    new.mismatch = ""
    step()
    assert new.reason == "waits for a full search"
    assert not script.said("search", "track")
    step()
    step()
    step()
    assert named(script, "search") == ["an"]


def test_a_search_that_is_put_off_is_taken_up_in_the_next_round(script: Script) -> None:
    new = newcomer("n", tried=(0, "a", 1))
    step = Round(voter("a"), new, live=replace(LIVE, search_pause_s=0.0))
    script.takes_s = 3.0
    for searches in (0, 0):
        step(is_wanted=lambda: True)
        assert named(script, "search") == ["an"]
        assert new.tried is None
        assert new.searches == searches
    step(is_wanted=lambda: True)
    assert new.searches == 1, "its patience has grown to 4 s"
    assert new.tried == (1, "a", 1)


def test_a_voter_is_searched_on_the_reference_alone(script: Script) -> None:
    lost = voter("b", is_steady=True, drift=9, searches=1)
    step = Round(voter("a"), lost, voter("c"))
    script.tracked["ab"] = MISFIT
    script.searched["ab"] = found(0.1)
    judge = step()
    assert script.said("track", "search") == ["track ab", "search ab"]
    assert judge.has_searched
    assert step.voters() == "abc"
    assert lost.tried is None
    assert judge.scores == {frozenset("ab"): 0.8}


# -- who is wrong ----------------------------------------------------------------------------------


def fallen(*, pause_s: float = 0.0, others: Iterable[Track] = ()) -> Round:
    """Return a round in which b has changed; a, the reference, comes first."""
    step = Round(
        voter("a"), voter("b", drift=9), *others, live=replace(LIVE, search_pause_s=pause_s)
    )
    step.judge.tracks["b"].searched_s = 100.0
    return step


def test_a_score_that_fell_waits_for_a_search_and_votes_meanwhile(script: Script) -> None:
    step = fallen(pause_s=50.0)
    step.judge.restore(Lattice(CELL_M, Pose2()), {frozenset("ab"): 0.9})
    script.tracked["ab"] = found(score=0.5)
    step()
    assert script.said() == ["track ab"]
    assert step.voters() == "ab"


@pytest.mark.parametrize("pause_s", [0.0, 50.0])
def test_where_no_third_votes_both_are_doubted_and_the_last_map_decides(
    script: Script, pause_s: float
) -> None:
    step = fallen(pause_s=pause_s)
    script.tracked["ab"] = MISFIT
    judge = step()
    assert named(script, "search") == (["ab"] if pause_s == 0.0 else [])
    assert step.voters() == ""
    assert step.maps_asked == 1
    assert judge.problem == "the last fused map has too few walls to go by"
    assert [judge.tracks[name].reason for name in "ab"] == [judge.problem] * 2
    assert judge.reference == "a"


def test_both_are_doubted_also_where_the_last_map_has_nothing_more_to_say(script: Script) -> None:
    step = fallen(pause_s=50.0)
    script.tracked["ab"] = MISFIT
    for track in step.judge.tracks.values():
        track.tried = (1, "a/b", -1)
    step()
    assert step.voters() == ""
    assert step.maps_asked == 0


@pytest.mark.parametrize("pause_s", [0.0, 50.0])
def test_a_third_that_one_fits_and_the_reference_does_not_becomes_the_reference(
    script: Script, pause_s: float
) -> None:
    step = fallen(pause_s=pause_s, others=[voter("c", drift=8)])
    script.tracked.update({"ab": MISFIT, "ca": MISFIT})
    judge = step()
    asked = script.said("track", "search")
    assert asked == ["track ab", *["search ab"][: pause_s == 0.0], "track cb", "track ca"]
    assert step.voters() == "bc"
    assert judge.reference == "c"
    assert judge.tracks["c"].reason == "the reference"
    assert judge.tracks["a"].reason == "c and b agree with each other and not with it"
    assert step.maps_asked == 0


def test_a_third_that_both_fit_leaves_both_as_they_are(script: Script) -> None:
    step = fallen(others=[voter("c")])
    script.tracked["ab"] = MISFIT
    judge = step()
    assert script.said("track") == ["track ab", "track cb", "track ca"]
    assert (step.voters(), judge.reference) == ("abc", "a")


def test_one_that_no_third_fits_is_refused_alone(script: Script) -> None:
    step = fallen(others=[voter("c"), voter("d")])
    script.tracked.update({"ab": MISFIT, "cb": MISFIT, "db": MISFIT})
    judge = step()
    assert script.said("track") == ["track ab", "track cb", "track db"]
    assert (step.voters(), judge.reference) == ("acd", "a")
    assert judge.tracks["b"].reason.startswith("to a: ")
    # The first of the others that it fits decides.
    step = fallen(others=[voter("c"), voter("d")])
    del script.tracked["db"]
    script.tracked["da"] = MISFIT
    judge = step()
    assert script.said("track") == ["track ab", "track cb", "track db", "track da"]
    assert (step.voters(), judge.reference) == ("bcd", "d")


def test_one_that_did_not_vote_accuses_nobody(script: Script) -> None:
    step = Round(voter("a"), voter("b", accepted=False), voter("c"))
    script.tracked["ab"] = MISFIT
    judge = step()
    assert script.said("track", "search") == ["track ab", "search ab"]
    assert (step.voters(), judge.reference) == ("ac", "a")
    assert step.maps_asked == 0


# -- the reference ---------------------------------------------------------------------------------


def test_a_reference_that_votes_stays_and_one_that_does_not_hands_over(script: Script) -> None:
    step = Round(voter("a", walls=50), voter("b", walls=70), voter("c", walls=90))
    assert step().reference == "a"
    step.judge.tracks["a"].refuse("gone")
    step.judge.tracks["a"].is_live = False
    step.judge.tracks["c"].drift = 99
    assert step().reference == "c"
    assert step.judge.tracks["c"].reason == "the reference"
    assert step.judge.tracks["c"].drift == 0
    assert not script.said()


def test_without_a_reference_there_is_none(script: Script) -> None:
    step = Round(voter("a", is_live=False, accepted=False))
    judge = step()
    assert judge.reference == ""
    assert judge.problem == "no input is left"
    assert step.maps_asked == 0
    assert not script.said()


def test_where_all_poses_contradict_each_other_the_frame_holds(script: Script) -> None:
    step = Round(
        voter("a", contradiction="a says one"),
        voter("b", contradiction="b says two"),
        voter("c", contradiction="c says three"),
    )
    judge = step()
    assert judge.reference == "a"
    assert judge.problem == "a says one, and nobody can say who is right"
    assert step.maps_asked == 0
    # One that votes is right, and the frame is its own from now on.
    judge.tracks["c"].contradiction = judge.problem = ""
    assert step().reference == "c"
    assert judge.problem == ""
    assert not script.said()


def test_the_last_round_s_search_is_forgotten(script: Script) -> None:
    new = newcomer("n")
    step = Round(voter("a"), new)
    assert step().has_searched
    assert new.searches == 1
    script.said()
    assert not step().has_searched
