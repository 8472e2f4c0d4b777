"""Aligning one input: tracked where it lay, searched where it must be, a jump confirmed."""

from __future__ import annotations

import math

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.fusion.live import align as live_align
from slamfusion.fusion.live.align import MIRROR_SHARE, Aligner
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.vote.lattice import Lattice
from tests.fusion.live.maps import AWAY, littered, moved_frame, three, touched

LIVE = LiveConfig(search_pause_s=5.0, confirm_s=3.0)


def two(device: ComputeDevice) -> tuple[Aligner, Track, Track]:
    """Return an aligner, a reference that votes, and an input that was not aligned yet."""
    config = FusionConfig()
    aligner = Aligner(config, LIVE, device)
    reference = three()["a"]
    aligner.lattice = Lattice(reference.resolution, reference.origin)
    tracks = []
    for name in "ab":
        track = Track(name)
        track.follow(three()[name], reference.resolution, config.normalize, LIVE, device)
        track.place(reference.resolution, config.normalize, device)
        tracks.append(track)
    held, new = tracks
    held.transform, held.accepted, held.is_steady = Pose2(), True, True
    aligner.now_s = 100.0
    return aligner, held, new


def searched(device: ComputeDevice) -> tuple[Aligner, Track, Track]:
    aligner, held, new = two(device)
    assert aligner.search(new, aligner.held(held))
    assert new.votes, new.reason
    return aligner, held, new


def follow(aligner: Aligner, track: Track, motion: Pose2, device: ComputeDevice) -> None:
    grid = moved_frame(three()["b"], motion)
    thresholds = aligner.config.normalize
    track.follow(grid, aligner.fixed().resolution, thresholds, LIVE, device)


def test_a_search_finds_what_tracking_from_elsewhere_does_not(device: ComputeDevice) -> None:
    aligner, held, new = two(device)
    assert aligner.fit(new, aligner.held(held)) is None
    assert new.mismatch.startswith("to a: ")
    assert aligner.search(new, aligner.held(held))
    assert new.votes
    assert new.mismatch == ""
    assert not new.is_tracked
    assert set(aligner.scores) == {frozenset("ab")}
    found = new.transform
    assert aligner.follow(new, aligner.held(held))
    assert new.is_tracked
    assert new.transform == found, "a better fit by a fraction of a cell moves nothing"


def test_one_input_is_searched_in_a_round_and_each_after_a_pause(device: ComputeDevice) -> None:
    aligner, _, new = searched(device)
    assert aligner.has_searched
    assert not aligner.may_search(Track("c"))
    aligner.has_searched = False
    assert aligner.may_search(Track("c"))
    assert not aligner.may_search(new)
    aligner.now_s += LIVE.search_pause_s
    assert aligner.may_search(new)
    new.rest_s = 20.0
    assert not aligner.may_search(new)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_jump_is_what_exceeds_either_limit(device: ComputeDevice, share: float) -> None:
    aligner, _, new = searched(device)
    at = Pose2()
    x, y = new.centre()
    moved = Pose2(share * LIVE.jump_m, 0.0, 0.0)
    assert aligner.is_jump(new, at, moved) is (share > 1.0)
    yaw = share * LIVE.jump_rad
    # Turned about its own centre.
    turned = Pose2(
        x - math.cos(yaw) * x + math.sin(yaw) * y, y - math.sin(yaw) * x - math.cos(yaw) * y, yaw
    )
    assert aligner.is_jump(new, at, turned) is (share > 1.0)


def test_a_jump_waits_and_is_confirmed_the_other_way_round(device: ComputeDevice) -> None:
    aligner, held, new = searched(device)
    before = new.transform
    follow(aligner, new, AWAY, device)
    assert aligner.search(new, aligner.held(held))
    assert not new.votes
    assert new.transform == before
    assert "jumped" in new.reason
    assert not aligner.may_confirm(new)
    aligner.now_s += LIVE.confirm_s
    assert aligner.may_confirm(new)
    assert not aligner.confirm(new, [aligner.held(held)])
    assert new.votes
    assert new.transform is not None
    assert new.apart(new.transform, Pose2())[0] > LIVE.jump_m


def test_a_search_that_is_not_waited_for_is_put_off_and_given_twice_the_time(
    device: ComputeDevice,
) -> None:
    aligner, held, new = two(device)
    aligner.is_wanted = lambda: True
    new.patience_s = 0.0
    assert not aligner.search(new, aligner.held(held))
    assert "put off" in new.reason
    assert new.searches == 0
    new.patience_s = 1e-9
    assert not aligner.search(new, aligner.held(held))
    assert new.patience_s == 2e-9
    new.patience_s = 1000.0
    assert aligner.search(new, aligner.held(held))
    assert new.votes


def test_scores_of_an_earlier_run_are_held_against_what_is_tracked(device: ComputeDevice) -> None:
    aligner, held, new = searched(device)
    lattice, score = aligner.fixed(), aligner.scores[frozenset("ab")]
    for kept, fits in ((score, True), (score / LIVE.search_share * 1.05, False)):
        aligner.restore(lattice, {frozenset("ab"): kept})
        follow_grid = touched(three()["b"], 1, 0.0005)
        new.follow(follow_grid, lattice.resolution, aligner.config.normalize, LIVE, device)
        assert (aligner.fit(new, aligner.held(held)) is not None) is fits


def worn(aligner: Aligner, held: Track, new: Track, share: float, device: ComputeDevice) -> float:
    """Give a tracked input new walls with litter, which wait to be aligned; return their score."""
    grid = littered(three()["b"], 1, share)
    new.follow(grid, aligner.fixed().resolution, aligner.config.normalize, LIVE, device)
    new.is_steady = False
    fit = aligner.fit(new, aligner.held(held))
    assert fit is not None, new.mismatch
    return fit[0].score


@pytest.mark.parametrize("gain", [0.899, 0.901])
def test_new_walls_that_fit_much_worse_are_held_against_their_mirror_image(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, gain: float
) -> None:
    aligner, held, new = searched(device)
    score = worn(aligner, held, new, 0.06, device)
    monkeypatch.setattr(live_align, "mirror_gain", lambda *_, **__: gain)
    worse = score / MIRROR_SHARE + 1e-6
    aligner.restore(aligner.fixed(), {frozenset("ab"): worse})
    assert aligner.follow(new, aligner.held(held)) is (gain < 0.9)
    assert ("fits its mirror image" in new.mismatch) is (gain > 0.9)
    assert new.mismatch.startswith("to a: ") is (gain > 0.9)


@pytest.mark.parametrize(("share", "worse"), [(0.06, -1e-6), (0.0, 0.05)])
def test_new_walls_that_fit_as_before_or_surely_need_no_look_at_a_mirror_image(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, share: float, worse: float
) -> None:
    aligner, held, new = searched(device)
    score = worn(aligner, held, new, share, device)
    monkeypatch.setattr(live_align, "mirror_gain", lambda *_, **__: pytest.fail("a look"))
    aligner.restore(aligner.fixed(), {frozenset("ab"): score / MIRROR_SHARE + worse})
    assert aligner.follow(new, aligner.held(held))


def test_without_a_frame_nothing_is_aligned(device: ComputeDevice) -> None:
    with pytest.raises(ValueError, match="nothing was fused yet"):
        Aligner(FusionConfig(), LIVE, device).fixed()
