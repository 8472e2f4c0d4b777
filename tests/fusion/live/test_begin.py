"""The first fusion: who can take part, how many must agree, and what is fixed by it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig, NormalizeConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion.live import begin
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.begin import align_first, believe_first, fusable
from slamfusion.fusion.live.track import Track
from slamfusion.grid import OccupancyGrid
from slamfusion.io import memory
from tests.fusion.drawings import building
from tests.fusion.live.maps import three


def track(grid: OccupancyGrid) -> Track:
    return Track(grid.name, grid=grid, is_live=True)


def test_a_map_of_other_cells_than_the_others_cannot_take_part() -> None:
    odd = replace(three()["c"], resolution=40.0 * three()["a"].resolution)
    tracks = [track(three()["a"]), track(three()["b"]), track(odd), Track("d")]
    usable = fusable(tracks, NormalizeConfig())
    assert [found.name for found in usable] == ["a", "b"]
    assert "coarser than those of the others" in tracks[2].reason
    assert tracks[3].reason == "no map yet"


def test_a_map_that_memory_cannot_hold_cannot_take_part(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks = [track(three()["a"]), track(three()["b"])]
    monkeypatch.setattr(memory, "available_memory", lambda: 1000)
    assert len(fusable(tracks, NormalizeConfig())) == 2, "small maps are not worth a look"
    fine = NormalizeConfig(resolution=0.001)
    assert fusable(tracks, fine) == []
    assert "a: " in tracks[0].reason


def test_too_few_that_agree_begin_nothing(device: ComputeDevice) -> None:
    aligner = Aligner(FusionConfig(), LiveConfig(), device)
    tracks = [track(three()["a"]), track(three()["b"])]
    group, lattice = align_first(tracks, 2, aligner)
    assert group.reference == "a", "the smallest"
    assert lattice.resolution == three()["a"].resolution
    with pytest.raises(AlignmentError, match="2 of the 3 inputs needed agree"):
        align_first(tracks, 3, aligner)


def test_what_agrees_votes_in_the_frame_of_its_reference_and_the_rest_is_told_why(
    device: ComputeDevice,
) -> None:
    aligner = Aligner(FusionConfig(), LiveConfig(), device)
    tracks = {name: track(grid) for name, grid in three().items()}
    group, lattice = align_first(list(tracks.values()), 2, aligner)
    late = track(replace(three()["a"], resolution=20.0 * lattice.resolution, name="late"))
    believe_first(group, lattice, {**tracks, "late": late, "none": Track("none")}, aligner)
    assert aligner.fixed() == lattice
    assert all(found.votes and found.layer is not None for found in tracks.values())
    assert not any(found.is_tracked for found in tracks.values())
    assert frozenset("ab") in aligner.scores
    assert not late.is_live
    assert late.layer is None
    assert "20 times coarser" in late.reason


def test_what_does_not_agree_is_told_why_and_by_how_much(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    aligner = Aligner(FusionConfig(), LiveConfig(), device)
    stranger = building(99, 12.0, 10.0).with_name("stranger")
    tracks = {grid.name: track(grid) for grid in (three()["a"], three()["b"], stranger)}
    group, lattice = align_first(list(tracks.values()), 2, aligner)
    assert [name for name in tracks if name in group.left_out] == ["stranger"]
    assert any(not pair.accepted for pair in group.pairs)
    # One that is gone keeps its own reason; one that memory cannot hold is told that.
    gone, large = track(stranger.with_name("gone")), track(stranger.with_name("large"))
    gone.is_live, gone.reason = False, "its producer is gone"
    monkeypatch.setattr(
        begin, "too_large", lambda grid, _: "too large" if grid.name in {"gone", "large"} else None
    )
    believe_first(group, lattice, {**tracks, "gone": gone, "large": large}, aligner)
    assert [found.votes for found in tracks.values()] == [True, True, False]
    assert set(aligner.scores) == {frozenset("ab")}
    left = tracks["stranger"]
    shown = group.left_out["stranger"][1]
    assert shown is not None
    assert left.reason == group.left_out["stranger"][0]
    assert (left.score, left.overlap) == (shown.score, shown.overlap)
    assert left.overlap > 0.0
    assert gone.reason == "its producer is gone"
    assert (large.is_live, large.reason) == (False, "too large")
