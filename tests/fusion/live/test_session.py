"""The session: what comes is fused and goes out at its turn; requests, losses, a restart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.errors import GridError
from slamfusion.fusion.live import LiveFusion, LiveInput
from slamfusion.fusion.live.session import GATHER_S, FusedMap, FusionSession, warm_up
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.maps import live_fusion, noise, three, touched


@dataclass
class Desk:
    """What surrounds a session: its clock, and all that it publishes and says."""

    live: LiveFusion
    now_s: float = 100.0
    went: list[FusedMap] = field(default_factory=list)
    agreements: list[FusedMap] = field(default_factory=list)
    said: list[tuple[str, bool]] = field(default_factory=list)
    is_heard: bool = True
    stamps: list[tuple[str, ...]] = field(default_factory=list)
    # Maps that come while the first are fused, which takes this long.
    late: list[OccupancyGrid] = field(default_factory=list)
    takes_s: float = 0.0

    def put(self, *grids: OccupancyGrid) -> None:
        for grid in grids:
            self.live.put(grid.name, grid, self.now_s)

    def stamp_s(self, voters: Sequence[str]) -> float:
        self.stamps.append(tuple(voters))
        self.now_s, self.takes_s = self.now_s + self.takes_s, 0.0
        self.put(*self.late)
        self.late = []
        return 10.0 + len(voters)

    def on_vote(self, record: LiveInput) -> None:
        self.said.append((record.name, record.accepted))


def begun(device: ComputeDevice, rate_hz: float = 1.0, **live: float) -> tuple[FusionSession, Desk]:
    desk = Desk(live_fusion(device, **live))
    session = FusionSession(
        desk.live,
        rate_hz,
        publish=desk.went.append,
        publish_agreement=desk.agreements.append,
        stamp_s=desk.stamp_s,
        on_vote=desk.on_vote,
        is_heard=lambda: desk.is_heard,
        clock=lambda: desk.now_s,
    )
    return session, desk


def started(device: ComputeDevice, **live: float) -> tuple[FusionSession, Desk]:
    """Return a session whose three inputs were fused and published."""
    session, desk = begun(device, **live)
    desk.put(*three().values())
    session.turn()
    assert len(desk.went) == 1
    assert sorted(desk.said) == [("a", True), ("b", True), ("c", True)]
    return session, desk


def later(session: FusionSession, desk: Desk) -> None:
    """Let the session work when a fused map may go out again."""
    desk.now_s += 1.1
    session.turn()


def test_maps_that_come_together_are_one_fused_map_with_one_agreement(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    snapshot = session.snapshot
    assert (snapshot.updates >= 1, snapshot.votes, snapshot.resets) == (True, 3, 0)
    assert snapshot.searches == 1
    assert desk.went[0].stamp_s == 13.0
    assert desk.went[0].arrived_s == 100.0
    assert desk.agreements == desk.went
    assert (snapshot.fused_maps, snapshot.fused_stamp_s) == (1, 13.0)
    assert snapshot.transform("b") is not None
    assert snapshot.transform("z") is None


def test_a_map_waits_for_its_turn_and_the_newest_goes(device: ComputeDevice) -> None:
    session, desk = started(device, rate_hz=1.0)
    for number in range(3):
        desk.now_s += 0.1
        desk.put(touched(three()["b"], number))
        session.turn()
    assert len(desk.went) == 1
    desk.now_s += 1.0
    session.turn()
    assert len(desk.went) == 2
    first_s = desk.went[1].arrived_s
    assert first_s == pytest.approx(100.1), "the first that was not shown"
    assert session.snapshot.sent_maps == 2


def test_what_cannot_be_read_is_counted_and_named(device: ComputeDevice) -> None:
    session, desk = started(device)

    def fail() -> OccupancyGrid:
        raise GridError("b: no cells")

    desk.live.put("b", fail, 101.0)
    session.turn()
    record = session.snapshot.inputs["b"]
    assert (record.accepted, record.reason, record.messages.rejected) == (False, "no cells", 1)
    assert desk.said[-1] == ("b", False)
    assert session.snapshot.votes == 4


def test_an_input_that_is_lost_votes_no_more_and_is_recalled_with_its_map(
    device: ComputeDevice,
) -> None:
    session, desk = started(device)
    assert not session.look("z", "lost: gone", has_map=False, is_back=False), "it never came"
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    later(session, desk)
    assert session.snapshot.inputs["b"].reason == "lost: gone"
    assert not session.look("b", "lost: gone", has_map=True, is_back=False), "said already"
    assert session.look("b", "", has_map=True, is_back=True)
    later(session, desk)
    assert session.snapshot.inputs["b"].accepted
    # One that comes back as another process waits for its next map.
    assert session.look("b", "lost: gone", has_map=True, is_back=False)
    later(session, desk)
    assert not session.look("b", "", has_map=True, is_back=False)
    later(session, desk)
    assert not session.snapshot.inputs["b"].accepted


def test_a_map_of_the_frame_before_a_reset_does_not_go_out(device: ComputeDevice) -> None:
    session, desk = started(device)
    desk.put(touched(three()["a"], 1))
    session.turn()
    assert session.waiting is not None
    session.ask_reset()
    desk.now_s += 1.1
    session.send()
    assert len(desk.went) == 1
    session.turn()
    assert len(desk.went) == 2


def test_requests_hold_from_the_next_turn_on(device: ComputeDevice) -> None:
    session, desk = started(device, stale_after_s=1000.0)
    session.ask_reset()
    assert session.snapshot.resets == 0
    session.turn()
    assert session.snapshot.resets == 1
    session.turn()
    assert session.snapshot.resets == 1
    session.ask_settings(LiveConfig(search_pause_s=0.0, stale_after_s=2.0))
    desk.now_s += 3.0
    desk.put(touched(three()["a"], 1), touched(three()["b"], 1))
    session.turn()
    assert session.snapshot.inputs["c"].reason.startswith("no map for more than 2 s")


def test_why_nothing_is_fused_is_said(device: ComputeDevice) -> None:
    session, desk = begun(device)
    assert session.snapshot.nothing_fused == "nothing is fused: no map yet"
    desk.put(three()["a"], noise().with_name("b"))
    session.turn()
    state = session.snapshot
    assert state.nothing_fused == "nothing is fused: waits for 2 inputs that agree, has 1"
    assert desk.went == []
    state = replace(state, update=replace(state.update, problem=""))
    assert state.nothing_fused == "no input votes: the fused map is drawn from the scans alone"
    desk.put(three()["b"])
    session.turn()
    assert session.snapshot.nothing_fused == "the first fused map is not published yet"


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
    session.remove("b")
    desk.put(three()["b"])
    later(session, desk)
    assert list(session.snapshot.inputs) == ["a", "c", "b"]
    assert session.snapshot.inputs["b"].messages.maps == 1
    assert session.snapshot.searches == searches + 1

    votes = session.snapshot.votes
    session.remove("c")
    went = len(desk.went)
    later(session, desk)
    assert list(session.snapshot.inputs) == ["a", "b"]
    assert session.snapshot.votes == votes + 1
    assert len(desk.went) == went + 1, "the map of the other two"
    assert desk.stamps[-1] == ("a", "b")


# -- fused maps on their way out -------------------------------------------------------------------


def fused(stamp_s: float, arrived_s: float | None = None) -> FusedMap:
    return FusedMap(three()["a"], three()["b"], stamp_s, arrived_s)


def test_the_agreement_waits_for_somebody_who_listens_and_goes_once(device: ComputeDevice) -> None:
    session, desk = begun(device)
    desk.is_heard = False
    session.offer(fused(1.0))
    session.send()
    assert not session.is_due
    desk.is_heard = True
    assert session.is_due
    session.send(with_agreement=False)
    assert not desk.agreements
    session.send()
    session.send()
    assert [item.stamp_s for item in desk.agreements] == [1.0]
    assert not session.is_due


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_map_waits_a_moment_for_those_that_came_meanwhile(
    device: ComputeDevice, share: float
) -> None:
    """The map of c comes while a and b are fused."""
    session, desk = begun(device)
    desk.put(three()["a"], three()["b"])
    desk.late, desk.takes_s = [three()["c"]], share * GATHER_S
    session.turn()
    assert [item.stamp_s for item in desk.went] == [13.0 if share < 1.0 else 12.0]
