"""The states of an input, what a new map of it changed, and what a map must not be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig
from slamfusion.fusion.live.inputs import TRANSITIONS, Event, State, too_large, unusable
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import files
from tests.fusion.drawings import draw
from tests.fusion.live.maps import AWAY, moved_frame, started, three, touched

RULES = NormalizeConfig()


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


def test_too_few_walls_say_nothing() -> None:
    assert "unknown" in (unusable(draw("   \n   "), RULES) or "")
    assert "23 of the 24" in (unusable(draw("#" * 23 + "."), RULES) or "")
    assert unusable(draw("#" * 24 + "\n" + 2 * ("." * 24 + "\n")), RULES) is None
    assert "0 of the 24" in (unusable(draw("?" * 40), RULES) or "")


def test_a_large_map_must_fit_into_memory_at_the_fused_resolution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(files, "available_memory", lambda: 10_000_000)
    grid = OccupancyGrid(np.zeros((1000, 1000), dtype=np.int8), 0.1, Pose2(), "big")
    assert too_large(grid, 0.1) is None
    assert "big" in (too_large(grid, 0.02) or "")


def map_of(cells: np.ndarray) -> OccupancyGrid:
    return OccupancyGrid(cells.astype(np.int8), 0.1, Pose2(), "map")


def test_a_wall_is_what_the_thresholds_say() -> None:
    lines = np.zeros((9, 24))
    for percent, words in ((65, None), (64, "0 of the 24")):
        lines[4] = percent
        found = unusable(map_of(lines), RULES)
        assert found is None if words is None else words in (found or "")
    lines[4] = 64
    assert unusable(map_of(lines), NormalizeConfig(occupied_percent=63.5)) is None
    assert "too few walls" in (unusable(map_of(np.zeros((9, 24))), RULES) or "")
    assert "are unknown" in (unusable(map_of(np.full((9, 24), -1)), RULES) or "")
