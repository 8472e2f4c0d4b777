"""The intake: what came reaches its track, what cannot be used is refused and counted."""

from __future__ import annotations

from dataclasses import replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.fusion.live.inbox import Inbox
from slamfusion.fusion.live.intake import Intake
from slamfusion.fusion.live.supervisor import InputSupervisor
from slamfusion.geometry import Pose2
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
