"""The session: what comes is fused and goes out at its turn; requests, losses, a restart."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.fusion.live import LiveFusion, LiveInput
from slamfusion.fusion.live.outbox import Fused, Outbox
from slamfusion.fusion.live.session import Arrived, FusionSession, warm_up
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.maps import live_fusion, noise, three, touched


@dataclass
class Desk:
    """Ports of a session, its memory and its clock, on the table."""

    outbox: Outbox
    now_s: float = 100.0
    waiting: list[Arrived] = field(default_factory=list)
    went: list[Fused] = field(default_factory=list)
    agreements: int = 0
    said: list[tuple[str, bool]] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)
    is_returning: bool = False
    stamps: list[tuple[str, ...]] = field(default_factory=list)

    def put(self, *grids: OccupancyGrid) -> None:
        self.waiting += [Arrived(grid.name, grid, "", self.now_s) for grid in grids]

    # Ports.

    def take(self) -> list[Arrived]:
        taken, self.waiting = self.waiting, []
        return taken

    def has_maps(self) -> bool:
        return bool(self.waiting)

    def has_come(self, name: str) -> bool:
        return bool(name)

    def send(self, *, with_agreement: bool = True) -> None:
        fused = self.outbox.take()
        if fused is not None:
            self.outbox.count(fused)
            self.went.append(fused)
        if with_agreement and self.outbox.take_agreement() is not None:
            self.agreements += 1

    def stamp_s(self, voters: Collection[str]) -> float:
        self.stamps.append(tuple(voters))
        return 10.0 + len(voters)

    def say_vote(self, record: LiveInput) -> None:
        self.said.append((record.name, record.accepted))

    # Memory.

    def is_waiting(self, has_come: Callable[[str], bool]) -> bool:
        return self.is_returning and has_come("a")

    def confirm(self) -> None:
        self.kept.append("confirm")

    def change(self, stamp_s: float) -> None:
        self.kept.append(f"change {stamp_s:g}")

    def keep(self) -> None:
        self.kept.append("keep")

    def clear(self) -> None:
        self.kept.append("clear")


def begun(device: ComputeDevice, rate_hz: float = 1.0, **live: float) -> tuple[FusionSession, Desk]:
    desk = Desk(Outbox(rate_hz))
    desk.outbox = Outbox(rate_hz, lambda: desk.now_s)
    fusion = live_fusion(device, **live)
    return FusionSession(fusion, desk.outbox, desk, lambda: desk.now_s), desk


def started(device: ComputeDevice, **live: float) -> tuple[FusionSession, Desk]:
    """Return a session whose three inputs were fused and published."""
    session, desk = begun(device, **live)
    desk.put(*three().values())
    session.turn(desk)
    assert len(desk.went) == 1
    assert sorted(desk.said) == [("a", True), ("b", True), ("c", True)]
    return session, desk


def later(session: FusionSession, desk: Desk) -> None:
    """Let the session work when a fused map may go out again."""
    desk.now_s += 1.1
    session.turn(desk)


def test_maps_that_come_together_are_one_fused_map_with_one_agreement(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    snapshot = session.snapshot
    assert (snapshot.updates >= 1, snapshot.votes, snapshot.resets) == (True, 3, 0)
    assert snapshot.searches == 1
    assert desk.went[0].stamp_s == 13.0
    assert desk.went[0].arrived_s == 100.0
    assert desk.agreements == 1
    assert desk.kept[:2] == ["confirm", "change 13"]
    assert desk.kept[-1] == "keep"
    assert snapshot.believed.transform("b") is not None
    assert snapshot.believed.transform("z") is None
    assert snapshot.noted_s == 100.0


def test_a_snapshot_is_frozen_and_stays_as_it_was(device: ComputeDevice) -> None:
    session, desk = started(device)
    before = session.snapshot
    with pytest.raises(dataclasses.FrozenInstanceError):
        before.updates = 7
    updates, inputs = before.updates, before.believed.inputs
    desk.put(touched(three()["b"], 1))
    session.turn(desk)
    assert session.snapshot is not before
    assert (before.updates, before.believed.inputs) == (updates, inputs)
    assert session.snapshot.updates > updates


def test_a_map_waits_for_its_turn_and_the_newest_goes(device: ComputeDevice) -> None:
    session, desk = started(device, rate_hz=1.0)
    for number in range(3):
        desk.now_s += 0.1
        desk.put(touched(three()["b"], number))
        session.turn(desk)
    assert len(desk.went) == 1
    desk.now_s += 1.0
    session.turn(desk)
    assert len(desk.went) == 2
    first_s = desk.went[1].arrived_s
    assert first_s == pytest.approx(100.1), "the first that was not shown"
    assert desk.outbox.sent.maps == 2


def test_what_cannot_be_read_is_counted_and_named(device: ComputeDevice) -> None:
    session, desk = started(device)
    desk.waiting.append(Arrived("b", None, "no cells", 101.0))
    session.turn(desk)
    record = session.snapshot.believed.inputs["b"]
    assert (record.accepted, record.reason, record.rejected) == (False, "no cells", 1)
    assert desk.said[-1] == ("b", False)
    assert session.snapshot.votes == 4


def test_an_input_that_is_lost_votes_no_more_and_is_recalled_with_its_map(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    assert not session.look("z", "lost: gone", has_map=False, is_back=False), "it never came"
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    later(session, desk)
    assert session.snapshot.believed.inputs["b"].reason == "lost: gone"
    assert not session.look("b", "lost: gone", has_map=True, is_back=False), "said already"
    assert session.look("b", "", has_map=True, is_back=True)
    later(session, desk)
    assert session.snapshot.believed.inputs["b"].accepted
    # One that comes back as another process waits for its next map.
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    later(session, desk)
    assert not session.look("b", "", has_map=True, is_back=False)
    later(session, desk)
    assert not session.snapshot.believed.inputs["b"].accepted


def test_an_input_that_sends_before_its_process_is_known_to_live_is_recalled_all_the_same(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    # Before anything was updated, and after.
    assert not session.look("b", "", has_map=True, is_back=False)
    later(session, desk)
    assert not session.look("b", "", has_map=True, is_back=False)
    later(session, desk)
    assert session.look("b", "", has_map=True, is_back=True)
    later(session, desk)
    assert session.snapshot.believed.inputs["b"].accepted
    assert not session.look("b", "", has_map=True, is_back=True), "once"


def test_an_input_that_came_back_by_a_map_of_its_own_is_not_recalled(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    later(session, desk)
    for count in (1, 2):
        desk.put(touched(three()["b"], count))
        later(session, desk)
    assert session.snapshot.believed.inputs["b"].accepted
    assert not session.look("b", "", has_map=True, is_back=False)
    assert not session.look("b", "", has_map=True, is_back=True)


def test_an_input_whose_last_map_was_taken_after_it_was_lost_is_lost_again(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    session.look("b", "lost: gone", has_map=True, is_back=False)
    desk.put(touched(three()["b"], 1))
    later(session, desk)
    assert session.snapshot.believed.inputs["b"].accepted
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    later(session, desk)
    assert not session.snapshot.believed.inputs["b"].accepted


def test_requests_hold_from_the_next_turn_on(device: ComputeDevice) -> None:
    session, desk = started(device, stale_after_s=1000.0)
    session.ask_reset()
    assert session.snapshot.resets == 0
    session.turn(desk)
    assert session.snapshot.resets == 1
    assert "clear" in desk.kept
    session.turn(desk)
    assert session.snapshot.resets == 1
    session.ask_settings(LiveConfig(search_pause_s=0.0, stale_after_s=2.0))
    desk.now_s += 3.0
    desk.put(touched(three()["a"], 1), touched(three()["b"], 1))
    session.turn(desk)
    assert session.snapshot.believed.inputs["c"].reason == "no map for 3 s"


def test_after_a_restart_inputs_that_had_a_place_are_waited_for(device: ComputeDevice) -> None:
    session, desk = begun(device)
    desk.is_returning = True
    desk.put(three()["a"], three()["b"])
    session.turn(desk)
    assert session.snapshot.updates == 0
    assert desk.went == []
    desk.is_returning = False
    session.turn(desk)
    assert len(desk.went) == 1


def test_why_nothing_is_fused_is_said(device: ComputeDevice) -> None:
    session, desk = begun(device)
    assert session.snapshot.nothing_fused == "nothing is fused: no map yet"
    desk.put(three()["a"], noise().with_name("b"))
    session.turn(desk)
    assert session.snapshot.nothing_fused == (
        "nothing is fused: waits for 2 inputs that agree, has 1"
    )
    assert desk.went == []


def test_poses_that_contradict_reach_the_fusion(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[tuple[str, float, Pose2]] = []
    monkeypatch.setattr(LiveFusion, "hear", lambda _, *said: heard.append(said))
    session, _ = begun(device)
    session.hear("a", 3.0, Pose2(1.0, 2.0, 0.0))
    assert heard == [("a", 3.0, Pose2(1.0, 2.0, 0.0))]


def test_two_drawn_maps_are_fused_before_the_first_real_ones(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    fused: list[bool] = []
    update = LiveFusion.update

    def noted(self: LiveFusion, now_s: float) -> object:
        made = update(self, now_s)
        fused.append(made is not None and made.fused is not None)
        return made

    monkeypatch.setattr(LiveFusion, "update", noted)
    warm_up(RunConfig(live=LiveConfig(minimum_inputs=1)), device)
    assert fused == [True, True], "a fusion, and a map that changed"


def test_who_is_removed_is_told_at_once_and_its_name_may_come_again(device: ComputeDevice) -> None:
    session, desk = started(device)
    votes, searches = session.snapshot.votes, session.snapshot.searches
    # The same name comes with the removal: a new input, that has to be looked for.
    desk.waiting.append(Arrived("b", None, "", desk.now_s, is_removed=True))
    desk.put(three()["b"])
    later(session, desk)
    assert list(session.snapshot.believed.inputs) == ["a", "c", "b"]
    assert session.snapshot.believed.inputs["b"].maps == 1
    assert session.snapshot.searches == searches + 1

    votes = session.snapshot.votes
    desk.waiting.append(Arrived("c", None, "", desk.now_s, is_removed=True))
    went = len(desk.went)
    later(session, desk)
    assert list(session.snapshot.believed.inputs) == ["a", "b"]
    assert session.snapshot.votes == votes + 1
    assert len(desk.went) == went + 1, "the map of the other two"
    assert desk.stamps[-1] == ("a", "b")


def test_a_saved_map_comes_as_others_do_and_grows_never_stale(device: ComputeDevice) -> None:
    session, desk = begun(device, stale_after_s=5.0)
    saved = three()["c"]
    desk.waiting.append(Arrived("c", saved, "", desk.now_s, is_saved=True))
    desk.put(three()["a"], three()["b"])
    session.turn(desk)
    desk.now_s += 60.0
    desk.put(touched(three()["a"], 1))
    session.turn(desk)
    accepted = {name: item.accepted for name, item in session.snapshot.believed.inputs.items()}
    assert accepted == {"c": True, "a": True, "b": False}


def test_one_that_was_lost_and_removed_is_not_lost_under_its_name(device: ComputeDevice) -> None:
    session, desk = started(device)
    assert session.look("b", "lost: killed", has_map=True, is_back=False)
    later(session, desk)
    session.forget("b")
    desk.waiting.append(Arrived("b", None, "", desk.now_s, is_removed=True))
    desk.put(three()["b"])
    later(session, desk)
    assert not session.look("b", "", has_map=True, is_back=True), "nothing is to be recalled"
    assert session.snapshot.believed.inputs["b"].accepted
