"""The intake: what came reaches its track, what cannot be used is refused and counted."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.errors import GridError, MemoryBudgetError
from slamfusion.fusion.live import intake as live_intake
from slamfusion.fusion.live.inbox import Inbox
from slamfusion.fusion.live.intake import Intake
from slamfusion.fusion.live.supervisor import InputSupervisor
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.maps import noise, three, touched

LIVE = LiveConfig(stale_after_s=5.0)


def intake_of(device: ComputeDevice) -> tuple[Inbox, Intake, InputSupervisor]:
    inbox, config = Inbox(), FusionConfig()
    intake = Intake(inbox, config.normalize, LIVE, device)
    return inbox, intake, InputSupervisor(config, LIVE, device)


def test_inputs_come_in_order_and_an_earlier_run_says_where_they_lay(device: ComputeDevice) -> None:
    inbox, intake, supervisor = intake_of(device)
    assert not intake.collect(supervisor, {}, None, 1.0)
    for name in "ba":
        inbox.put(name, three()[name], 1.0, is_saved=False)
    place = Pose2(1.0, 2.0, 0.3)
    assert intake.collect(supervisor, {"a": place}, None, 1.0)
    assert list(supervisor.tracks) == ["b", "a"]
    assert supervisor.tracks["a"].transform == place
    assert supervisor.tracks["b"].transform is None
    assert all(t.is_live and not t.votes for t in supervisor.tracks.values())
    assert not intake.collect(supervisor, {}, None, 1.1)


def test_what_cannot_be_used_is_counted_and_says_why(device: ComputeDevice) -> None:
    inbox, intake, supervisor = intake_of(device)
    inbox.put("x", noise(), 1.0, is_saved=False)
    inbox.put("y", replace(three()["a"], resolution=40 * 0.05), 1.0, is_saved=False)
    inbox.reject("z", "cannot be read", 1.0)
    intake.collect(supervisor, {}, 0.05, 1.0)
    tracks = supervisor.tracks
    assert "is it noise?" in tracks["x"].reason
    assert "coarser" in tracks["y"].reason
    assert tracks["z"].reason == "cannot be read"
    assert not any(track.is_live for track in tracks.values())
    assert [item.rejected for item in inbox.counts().values()] == [1, 1, 1]


def test_an_input_is_stale_only_against_another_and_a_saved_one_never(
    device: ComputeDevice,
) -> None:
    inbox, intake, supervisor = intake_of(device)
    for name in "abc":
        inbox.put(name, three()[name], 1.0, is_saved=name == "c")
    intake.collect(supervisor, {}, None, 100.0)
    assert all(track.is_live for track in supervisor.tracks.values())
    inbox.put("a", three()["a"], 6.0, is_saved=False)
    intake.collect(supervisor, {}, None, 6.0)
    assert supervisor.tracks["b"].is_live
    inbox.put("a", three()["a"], 6.1, is_saved=False)
    intake.collect(supervisor, {}, None, 7.0)
    assert not supervisor.tracks["b"].is_live
    assert supervisor.tracks["b"].reason == "no map for 6 s"
    assert supervisor.tracks["c"].is_live


def test_walls_that_the_reference_changed_count_for_the_others(device: ComputeDevice) -> None:
    inbox, intake, supervisor = intake_of(device)
    supervisor.reference = "a"
    for grid in (three()["a"], touched(three()["a"], 1, 0.01)):
        for name in "ab":
            inbox.put(name, grid if name == "a" else three()["b"], 1.0, is_saved=False)
        intake.collect(supervisor, {}, 0.05, 1.0)
    assert supervisor.tracks["b"].drift > 0
    assert supervisor.tracks["b"].drift == supervisor.tracks["a"].drift


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (GridError("a: no known cells"), "a: no known cells"),
        (MemoryBudgetError("a: too large"), "a: too large"),
        (MemoryError(), "no memory is left for a map of"),
    ],
)
def test_a_map_that_cannot_be_followed_is_refused_and_the_next_is_new(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    inbox, intake, supervisor = intake_of(device)

    def fail(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(Track, "follow", fail)
        inbox.put("a", three()["a"], 1.0, is_saved=False)
        assert intake.collect(supervisor, {}, None, 1.0)
    track = supervisor.tracks["a"]
    assert track.reason.startswith(words)
    assert not track.is_live
    assert inbox.counts()["a"].rejected == 1
    track.tried = (1, "b", 1)
    inbox.put("a", three()["a"], 2.0, is_saved=False)
    intake.collect(supervisor, {}, None, 2.0)
    assert (track.is_live, track.reason, track.tried) == (True, "new; not aligned yet", None)
    assert inbox.counts()["a"].rejected == 1
    # One that is live keeps what is said of it.
    track.reason, track.tried = "votes", (1, "b", 1)
    inbox.put("a", three()["a"], 3.0, is_saved=False)
    intake.collect(supervisor, {}, None, 3.0)
    assert (track.is_live, track.reason, track.tried) == (True, "votes", (1, "b", 1))


def test_one_that_is_lost_or_too_large_is_told_so_and_the_others_stay(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    inbox, intake, supervisor = intake_of(device)
    supervisor.reference = "a"
    for name in "abc":
        inbox.put(name, three()[name], 1.0, is_saved=False)
    intake.collect(supervisor, {}, 0.1, 1.0)
    tracks = supervisor.tracks
    inbox.drop("b", "its producer is gone")
    inbox.put("c", touched(three()["c"], 1), 1.0, is_saved=False)
    asked: list[float] = []

    def too_large(_: OccupancyGrid, resolution: float) -> str | None:
        asked.append(resolution)
        return "c: too large" if len(asked) == 1 else None

    monkeypatch.setattr(live_intake, "too_large", too_large)
    assert intake.collect(supervisor, {}, 0.05, 1.0)
    assert [tracks[name].is_live for name in "abc"] == [True, False, False]
    assert [tracks[name].reason for name in "bc"] == ["its producer is gone", "c: too large"]
    # What another than the reference changes counts for itself; before the first fusion a map is
    # held at its own resolution.
    for name in "bc":
        inbox.put(name, touched(three()[name], 2), 1.0, is_saved=False)
    intake.collect(supervisor, {}, 0.1, 1.0)
    assert tracks["b"].drift > 0
    assert tracks["a"].drift == 0
    inbox.put("d", replace(three()["a"], resolution=0.25), 1.0, is_saved=False)
    intake.collect(supervisor, {}, None, 1.0)
    assert asked == [0.05, 0.1, 0.1, 0.25]


def test_one_that_comes_back_before_it_had_a_map_waits_for_it(device: ComputeDevice) -> None:
    inbox, intake, supervisor = intake_of(device)
    inbox.drop("a", "its producer is gone")
    inbox.recall("a", None)
    assert intake.collect(supervisor, {}, None, 1.0)
    assert supervisor.tracks["a"].reason == "no map yet"
    assert not supervisor.tracks["a"].is_live
