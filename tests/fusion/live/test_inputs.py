"""The states of an input, and what a new map of it changed."""

from __future__ import annotations

from pathlib import Path

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.live.inputs import TRANSITIONS, Event, State
from slamfusion.geometry import Pose2
from tests.fusion.live.maps import AWAY, moved_frame, started, three, touched


def test_an_input_goes_through_its_states_and_votes_in_one(device: ComputeDevice) -> None:
    drive = started(device)

    def states() -> dict[str, State]:
        records = drive.live.inputs()
        assert all(one.accepted == (one.state is State.TRACKED) for one in records)
        return {one.name: one.state for one in records}

    assert states() == dict.fromkeys("abc", State.TRACKED)
    drive.step(moved_frame(three()["b"], AWAY))
    drive.live.drop("c", "its producer is gone")
    drive.step(three()["c"].with_name("d"), three()["c"].with_name("e"))
    waiting = [name for name, state in states().items() if state is State.NEW]
    assert len(waiting) == 1
    assert drive.input(waiting[0]).reason == "waits for a full search"
    assert (states()["b"], states()["c"]) == (State.JUMPED, State.LOST)
    drive.step(touched(moved_frame(three()["b"], AWAY), 1, 0.002), three()["c"])
    drive.maybe()
    assert states() == dict.fromkeys("abcde", State.TRACKED)
    for stamp in range(15):
        for name in "abcde":
            place = drive.input(name).transform
            away_m = 7.0 if name == "b" and stamp >= 10 else 0.0
            pose = place.inverse().compose(Pose2(0.3 * stamp, away_m, 0.0))
            drive.live.hear(name, float(stamp), pose)
    drive.maybe()
    assert states() == {**dict.fromkeys("acde", State.TRACKED), "b": State.DOUBTED}


def test_the_table_of_the_docs_is_that_of_the_code() -> None:
    page = Path(__file__).parents[3] / "docs" / "concepts" / "live_fusion.md"
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in page.read_text().splitlines()
        if line.startswith("|")
    ]
    assert rows[0] == ["event", *(state.name for state in State)]
    table = {
        what: dict(zip(State, cells, strict=True)) for what, *cells in rows[2 : 2 + len(Event)]
    }
    assert table == {
        event.value: {state: TRANSITIONS[event].get(state, state).name for state in State}
        for event in Event
    }
