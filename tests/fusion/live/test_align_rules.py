"""What is believed of an alignment: both sides of every limit, with answers that a test gives."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.compute import NumpyDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.fusion.accept import CLASH_MAX
from slamfusion.fusion.live.align import (
    MIRROR_SHARE,
    Aligner,
    Held,
)
from slamfusion.fusion.live.searched import CLASH_MORE, CLEAR_MATCH, LASTING_SHARE
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.vote.lattice import Lattice
from tests.fusion.live.scripted import (
    CELL_M,
    MISFIT,
    Script,
    follow_script,
    found,
    newcomer,
    scripted_aligner,
    voter,
)

LIVE = LiveConfig(
    search_share=0.5, search_pause_s=5.0, confirm_s=3.0, jump_m=0.5, jump_rad=0.125, hold_cells=0.5
)


def two(**more: object) -> tuple[Aligner, Track, Held]:
    """Return an aligner, an input b that votes, and a, which it is aligned to."""
    aligner = scripted_aligner(LIVE)
    return aligner, voter("b", **more), aligner.held(voter("a"))


# -- a tracked pair after a search -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("score", "holds"), [(0.4, True), (0.39, False), (0.41, True), (0.9, True), (0.0, False)]
)
def test_a_tracked_score_may_fall_to_a_share_of_the_search_s(
    script: Script, score: float, holds: bool
) -> None:
    aligner, track, held = two()
    aligner.note(replace(found(score=0.8), reference="a", moving="b"))
    script.tracked["ab"] = found(score=score)
    assert (aligner.fit(track, held) is not None) is holds
    assert track.mismatch == "", "the walls match, whatever the score"
    assert (track.score, track.overlap) == (score, 0.6)


@pytest.mark.parametrize(
    ("match", "clash", "tracked_match", "tracked_clash", "holds"),
    [
        # By a share of the walls that met when it was found: 0.85.
        (0.4, 0.1, 0.35, 0.1, True),
        (0.4, 0.1, LASTING_SHARE * 0.4, 0.1, True),
        (0.4, 0.1, 0.33, 0.1, False),
        (0.4, 0.1, 0.36, 0.1, True),
        # Of those in free space 0.05 more.
        (0.4, 0.1, 0.4, 0.1 + CLASH_MORE, True),
        (0.4, 0.1, 0.4, 0.147, True),
        (0.4, 0.1, 0.4, 0.153, False),
        # Walls that clearly matched must go on to match.
        (CLEAR_MATCH, 0.1, 0.5, 0.1, False),
        (0.501, 0.1, 0.501, 0.1, False),
        (0.499, 0.1, 0.499, 0.1, True),
        (0.6, CLASH_MAX, 0.6, 0.1, False),
        (0.6, 0.16, 0.6, 0.1, True),
        (0.6, 0.16, 0.4, 0.1, False),
        (0.4, 0.1, 0.9, 0.5, False),
    ],
)
def test_what_stood_out_lasts_while_about_as_many_walls_meet(
    script: Script,
    match: float,
    clash: float,
    tracked_match: float,
    tracked_clash: float,
    holds: bool,
) -> None:
    aligner, track, held = two()
    searched = found(reason="yaw stands out", wall_match=match, wall_clash=clash)
    aligner.note(replace(searched, reference="a", moving="b"))
    script.tracked["ab"] = found(accepted=False, wall_match=tracked_match, wall_clash=tracked_clash)
    fit = aligner.fit(track, held)
    assert (fit is not None) is holds
    if fit is None:
        assert track.mismatch == "to a: walls do not match"
    else:
        assert track.mismatch == ""
        assert fit[0].reason == "tracked where the search found it: yaw stands out"


@given(
    match=st.floats(0.0, 0.49),
    clash=st.floats(0.0, 0.5),
    tracked=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    better=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
)
def test_more_walls_that_meet_and_fewer_that_clash_never_end_it(
    match: float, clash: float, tracked: tuple[float, float], better: tuple[float, float]
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        script = follow_script(patch)
        aligner, track, held = two()
        searched = found(wall_match=match, wall_clash=clash)
        aligner.note(replace(searched, reference="a", moving="b"))
        answers = []
        more = (max(tracked[0], better[0]), min(tracked[1], better[1]))
        for walls, clashing in (tracked, more):
            script.tracked["ab"] = found(accepted=False, wall_match=walls, wall_clash=clashing)
            answers.append(aligner.fit(track, held) is not None)
        assert answers[1] >= answers[0]


def test_what_says_nothing_of_its_walls_does_not_last(script: Script) -> None:
    aligner, track, held = two()
    for match, clash, tracked in (
        (0.1, 0.1, {"wall_clash": 0.0}),
        (0.1, 0.86, {"wall_match": 0.4}),
    ):
        searched = found(wall_match=match, wall_clash=clash)
        aligner.note(replace(searched, reference="a", moving="b"))
        script.tracked["ab"] = found(accepted=False, **tracked)
        assert aligner.fit(track, held) is None
    # A search that says nothing of walls saw none meet and none clash.
    aligner.note(replace(found(), reference="a", moving="b"))
    script.tracked["ab"] = found(accepted=False, wall_match=0.0, wall_clash=0.04)
    assert aligner.fit(track, held) is not None
    script.tracked["ab"] = found(accepted=False, wall_match=0.0, wall_clash=0.06)
    assert aligner.fit(track, held) is None


def test_without_a_search_before_the_walls_alone_decide(script: Script) -> None:
    aligner, track, held = two()
    script.tracked["ab"] = found(score=0.06)
    fit = aligner.fit(track, held)
    assert fit is not None
    assert fit[0].reason == "walls match"
    script.tracked["ab"] = MISFIT
    assert aligner.fit(track, held) is None


# -- tracking --------------------------------------------------------------------------------------


def test_it_begins_where_it_lay_as_the_other_sees_it(script: Script) -> None:
    aligner = scripted_aligner(LIVE)
    other, own = Pose2(3.0, 1.0, 0.5), Pose2(-2.0, 4.0, 1.0)
    held = aligner.held(voter("a", other))
    assert held.transform == other
    assert aligner.held(newcomer("n")).transform == Pose2()
    fit = aligner.fit(voter("b", own), held)
    assert fit is not None
    assert script.asked[-1].start == other.inverse().compose(own)
    assert math.dist((fit[1].x, fit[1].y), (own.x, own.y)) < 1e-9
    aligner.fit(newcomer("n"), held)
    assert script.asked[-1].start == other.inverse()


def test_one_that_is_followed_votes_as_tracked(script: Script) -> None:
    aligner, track, held = two(accepted=False, mismatch="to a: no", jump=Pose2(9.0))
    track.tried = (1, "a", 1)
    assert aligner.follow(track, held)
    assert track.votes
    assert track.is_tracked
    assert (track.reason, track.mismatch, track.jump, track.tried) == (
        "walls match",
        "",
        None,
        None,
    )
    assert (track.score, track.overlap) == (0.8, 0.6)
    assert [one.cancel for one in script.asked] == [None]
    script.tracked["ab"] = MISFIT
    track.accepted = False
    assert not aligner.follow(track, held)
    assert not track.votes


def test_one_that_may_wait_is_told_whom_to_ask(script: Script) -> None:
    aligner, track, held = two()
    asked = 0

    def bell() -> bool:
        nonlocal asked
        asked += 1
        return False

    assert aligner.follow(track, held, bell)
    token = script.asked[-1].cancel
    assert token is not None
    token.check()
    assert asked == 1


@pytest.mark.parametrize(
    ("before", "score", "is_steady", "looks"),
    [
        (0.8, 0.1, True, False),
        (None, 0.8, True, False),
        (None, 0.8, False, True),
        (0.8, 0.8 * 0.95, False, False),
        (0.8, 0.8 * 0.85, False, True),
        (0.8, MIRROR_SHARE * 0.8, False, False),
        (0.8, 0.5, False, True),
    ],
)
@pytest.mark.parametrize("is_mirrored", [True, False])
def test_new_walls_that_fit_much_worse_are_held_against_their_mirror_image(
    script: Script,
    before: float | None,
    score: float,
    is_steady: bool,
    looks: bool,
    is_mirrored: bool,
) -> None:
    aligner = scripted_aligner(replace(LIVE, search_share=0.0))
    track, held = voter("b", is_steady=is_steady), aligner.held(voter("a"))
    if before is not None:
        searched = found(score=before, wall_match=0.4, wall_clash=0.1)
        aligner.note(replace(searched, reference="a", moving="b"))
    script.mirrored = {"ab"} if is_mirrored else set()
    # What lasts without matching walls is looked at as if it were accepted.
    script.tracked["ab"] = found(
        accepted=before is None, score=score, wall_match=0.4, wall_clash=0.1
    )
    refused = looks and is_mirrored
    assert aligner.follow(track, held) is not refused
    assert script.said("mirror") == (["mirror ab"] if looks else [])
    assert ("fits its mirror image" in track.mismatch) is refused
    assert track.votes is not (refused and not is_steady)


def test_a_tracked_jump_is_no_fit(script: Script) -> None:
    aligner, track, held = two()
    for x, fits in ((0.5, True), (0.51, False)):
        script.tracked["ab"] = found(x)
        assert (aligner.fit(track, held) is not None) is fits
        assert track.mismatch == ""


# -- how far ---------------------------------------------------------------------------------------


def test_what_moves_the_centre_or_turns_by_more_than_the_limit_is_a_jump(script: Script) -> None:
    del script
    aligner, track, _ = two()
    assert not aligner.is_jump(track, Pose2(), Pose2(0.5))
    assert aligner.is_jump(track, Pose2(), Pose2(0.5001))
    turned = Pose2(0.0, 0.0, 0.125)
    turn = track.apart(Pose2(), turned)[1]
    aligner.live = replace(LIVE, jump_rad=turn)
    assert not aligner.is_jump(track, Pose2(), turned)
    aligner.live = replace(LIVE, jump_rad=turn - 1e-9)
    assert aligner.is_jump(track, Pose2(), turned)


@pytest.mark.parametrize(
    ("x", "moves"), [(0.125, True), (0.1249, False), (0.0, False), (0.2, True)]
)
def test_a_transform_is_held_below_some_part_of_a_cell(
    script: Script, x: float, moves: bool
) -> None:
    del script
    aligner, track, _ = two()
    track.relay = False
    aligner.believe(track, Pose2(x), found(), is_tracked=True)
    assert track.transform == (Pose2(x) if moves else Pose2())
    assert track.relay is moves
    assert track.votes


def test_a_first_transform_is_taken_as_it_is(script: Script) -> None:
    del script
    aligner, track = scripted_aligner(LIVE), newcomer("b", relay=False)
    aligner.believe(track, Pose2(0.01), found(), is_tracked=False)
    assert track.transform == Pose2(0.01)
    assert track.relay
    assert not track.is_tracked


# -- when to search --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ago_s", "rest_s", "may"),
    [(4.9, 0.0, False), (5.0, 0.0, True), (5.0, 6.0, False), (6.0, 6.0, True), (9.0, 6.0, True)],
)
def test_searches_are_a_pause_apart_and_longer_after_a_long_one_in_vain(
    script: Script, ago_s: float, rest_s: float, may: bool
) -> None:
    del script
    aligner, track, _ = two(rest_s=rest_s)
    track.searched_s = aligner.now_s - ago_s
    assert aligner.may_search(track) is may
    aligner.has_searched = True
    assert not aligner.may_search(track)


def test_an_aligner_begins_at_rest_and_proves_nothing() -> None:
    config = FusionConfig()
    assert config.align.prove
    aligner = Aligner(config, LIVE, NumpyDevice())
    assert not aligner.config.align.prove
    assert not aligner.has_searched
    assert aligner.now_s == 0.0
    assert aligner.lattice is None
    with pytest.raises(ValueError, match="nothing was fused yet"):
        aligner.fixed()
    aligner.lattice = Lattice(CELL_M, Pose2())
    assert aligner.fixed() is aligner.lattice


# -- what a search gives ---------------------------------------------------------------------------


def test_a_search_begins_where_the_input_lay_and_counts(script: Script) -> None:
    aligner = scripted_aligner(LIVE)
    held = aligner.held(voter("a", Pose2(3.0, 1.0, 0.5)))
    track = voter("b", Pose2(2.0, 2.0, 0.1), accepted=False)
    script.searched["ab"] = found(reason="found")
    assert aligner.search(track, held)
    asked = next(one for one in script.asked if one.what == "search")
    assert asked.names == "ab"
    assert asked.start == held.transform.inverse().compose(Pose2(2.0, 2.0, 0.1))
    assert script.said() == ["search ab"]
    assert aligner.has_searched
    assert (track.searches, track.searched_s) == (1, 100.0)
    new = newcomer("n")
    aligner.search(new, held)
    assert script.asked[0].start is None


def test_a_search_in_vain_refuses_and_forgets_a_jump(script: Script) -> None:
    aligner, track, held = two(jump=Pose2(9.0))
    assert aligner.search(track, held)
    assert script.said() == ["search ab"]
    assert not track.votes
    assert track.jump is None
    assert track.reason == track.mismatch == "to a: walls do not match"
    assert (track.score, track.overlap) == (0.0, 0.6)
    assert not aligner.scores


def test_mirrored_is_not_found(script: Script) -> None:
    aligner, track, held = two()
    why = "fits its mirror image"
    script.searched["ab"] = found(accepted=False, reason=why)
    aligner.search(track, held)
    assert not track.votes
    assert track.reason == "to a: fits its mirror image"


@pytest.mark.parametrize("last", [None, Pose2(), Pose2(0.4)])
def test_what_is_found_first_or_where_it_was_votes_at_once(
    script: Script, last: Pose2 | None
) -> None:
    aligner, track, held = two(accepted=False)
    track.transform = last
    script.searched["ab"] = found(0.3, score=0.7)
    assert aligner.search(track, held)
    assert track.votes
    assert not track.is_tracked
    assert track.jump is None
    assert aligner.scores == {frozenset("ab"): 0.7}


def test_a_jump_votes_when_a_changed_map_is_found_there_again(script: Script) -> None:
    aligner, track, held = two(maps=7, confirms=3)
    script.searched["ab"] = found(9.0)
    aligner.search(track, held)
    assert not track.votes
    assert track.transform == Pose2()
    assert "jumped by 9.00 m and 0.00 rad" in track.reason
    assert (track.jump, track.jump_version, track.confirms) == (Pose2(9.0), 1, 0)
    assert (track.jump_s, track.jump_maps) == (100.0, 7)
    assert not aligner.scores
    # The same map says the same: no second witness, and the time that it is waited for goes on.
    aligner.now_s, track.maps = 101.0, 8
    script.searched["ab"] = found(9.1)
    aligner.search(track, held)
    assert not track.votes
    assert (track.jump_s, track.jump_maps, track.jump) == (100.0, 7, Pose2(9.1))
    # Another map elsewhere: it begins again.
    track.version, aligner.now_s, track.confirms = 2, 102.0, 1
    script.searched["ab"] = found(-9.0)
    aligner.search(track, held)
    assert not track.votes
    assert (track.jump_s, track.jump_maps, track.jump_version) == (102.0, 8, 2)
    assert track.confirms == 0
    # A third at the same place.
    track.version = 3
    script.searched["ab"] = found(-9.2)
    aligner.search(track, held)
    assert track.votes
    assert not track.is_tracked
    assert track.transform == Pose2(-9.2)
    assert track.jump is None
    assert aligner.scores == {frozenset("ab"): 0.8}


# -- a jump that is confirmed ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("waited_s", "messages", "may"),
    [
        (2.9, 1, False),
        (3.0, 0, True),
        (3.1, 0, True),
        (0.0, 1, False),
        (0.0, 2, True),
        (0.0, 3, True),
    ],
)
def test_a_jump_is_looked_at_again_after_a_time_or_two_messages(
    script: Script, waited_s: float, messages: int, may: bool
) -> None:
    del script
    aligner, track, _ = two(jump=Pose2(9.0), jump_version=1, maps=10)
    track.jump_s, track.jump_maps = aligner.now_s - waited_s, 10 - messages
    assert aligner.may_confirm(track) is may
    track.version = 2
    assert not aligner.may_confirm(track), "the map has changed since"
    track.version, track.jump = 1, None
    assert not aligner.may_confirm(track)


def jumped() -> tuple[Aligner, Track, list[Held]]:
    """Return an aligner, an input that jumped by 9 m, and three others, of which a found it."""
    aligner = scripted_aligner(LIVE)
    track = voter("b", accepted=False, jump=Pose2(9.0), jump_version=1)
    return aligner, track, [aligner.held(voter(name)) for name in "cda"]


def test_a_jump_is_tried_on_one_after_the_other_and_last_the_other_way_round(
    script: Script,
) -> None:
    aligner, track, others = jumped()
    script.searched["da"] = script.searched["cb"] = found(5.0)
    left, asked = [], []
    for _ in others:
        left.append(aligner.confirm(track, others))
        asked += script.said("search")
        assert not track.votes
        if left[-1]:
            assert track.jump == Pose2(9.0)
    assert left == [True, True, False]
    assert asked == ["search cb", "search db", "search ba"]
    assert track.confirms == 3
    assert track.jump is None
    assert "jumped by 9.00 m and 0.00 rad, and a second search does not find" in track.reason
    assert not aligner.confirm(track, others)
    assert not script.said(), "no jump is left"


@pytest.mark.parametrize("index", [0, 1, 2])
def test_whoever_finds_the_jump_again_confirms_it(script: Script, index: int) -> None:
    aligner, track, others = jumped()
    script.searched = {"cb": MISFIT, "db": found(9.0, accepted=False), "ba": found(-5.0)}
    names = ("cb", "db", "ba")[index]
    script.searched[names] = found(-9.1 if index == 2 else 9.1, score=0.75)
    left = [aligner.confirm(track, others) for _ in range(index + 1)]
    assert left == [True, True, False][: index + 1]
    assert track.votes, track.reason
    assert not track.is_tracked
    assert track.transform is not None
    assert track.transform.x == pytest.approx(9.1)
    assert aligner.scores == {frozenset((others[index].name, "b")): 0.75}


def test_the_last_is_tried_however_often_it_was(script: Script) -> None:
    aligner, track, others = jumped()
    track.confirms = 5
    assert not aligner.confirm(track, others[:2])
    assert script.said("search") == ["search bd"]
    track.jump, track.transform = Pose2(1.0, 2.0), None
    assert not aligner.confirm(track, others)
    assert "jumped by 2.24 m" in track.reason


def test_the_other_way_round_begins_from_the_other_side(script: Script) -> None:
    aligner = scripted_aligner(LIVE)
    at, own = Pose2(3.0, 1.0, 0.5), Pose2(-2.0, 4.0, 1.0)
    track = voter("b", own, accepted=False, jump=Pose2(9.0), jump_version=1)
    aligner.confirm(track, [aligner.held(voter("a", at))])
    start = at.inverse().compose(own).inverse()
    assert script.asked[0].names == "ba"
    assert script.asked[0].start == start
    track.jump, track.transform = Pose2(9.0), None
    aligner.confirm(track, [aligner.held(voter("a", at))])
    assert script.asked[-1].names in {"ba", "ab"}
    assert [one.start for one in script.asked if one.what == "search"][-1] is None


def test_a_confirmation_that_is_put_off_is_none(script: Script) -> None:
    aligner, track, others = jumped()
    script.takes_s, aligner.is_wanted = 5.0, lambda: True
    assert aligner.confirm(track, others)
    assert (track.confirms, track.searches, track.jump) == (0, 0, Pose2(9.0))


# -- patience and rest -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("takes_s", "is_wanted", "is_done"),
    [
        (0.5, True, True),
        (1.0, True, True),
        (1.1, True, False),
        (9.0, False, True),
        (9.0, None, True),
    ],
)
@pytest.mark.parametrize("is_voting", [True, False])
def test_a_search_is_put_off_for_maps_that_wait_longer_than_its_patience(
    script: Script,
    takes_s: float,
    is_wanted: bool | None,
    is_done: bool,
    is_voting: bool,
) -> None:
    aligner, track, held = two(accepted=is_voting)
    aligner.is_wanted = None if is_wanted is None else lambda: is_wanted
    script.takes_s, script.searched["ab"] = takes_s, found()
    assert aligner.search(track, held) is is_done
    assert aligner.has_searched
    assert track.votes is (is_voting or is_done)
    if is_done:
        assert (track.searches, track.patience_s) == (1, 1.0)
        return
    assert (track.searches, track.patience_s) == (0, 2.0)
    assert ("put off" in track.reason) is not is_voting
    # Each that is given up doubles it, and one that ends takes it back.
    script.takes_s = 2.1
    assert not aligner.search(track, held)
    assert track.patience_s == 4.0
    assert aligner.search(track, held)
    assert track.patience_s == 1.0


@pytest.mark.parametrize(
    ("takes_s", "accepted", "rest_s"),
    [
        (0.95, False, 0.0),
        (1.0, False, 4.0),
        (1.05, False, 4.2),
        (2.0, False, 8.0),
        (2.0, True, 0.0),
        (0.5, True, 0.0),
    ],
)
def test_a_long_search_in_vain_is_followed_by_four_times_its_rest(
    script: Script, takes_s: float, accepted: bool, rest_s: float
) -> None:
    aligner, track, held = two(rest_s=77.0)
    script.takes_s, script.searched["ab"] = takes_s, found(accepted=accepted)
    assert aligner.search(track, held)
    assert track.rest_s == pytest.approx(rest_s)
