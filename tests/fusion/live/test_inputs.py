"""The states of an input, and what a new map of it changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig
from slamfusion.fusion.live import limits
from slamfusion.fusion.live.inputs import TRANSITIONS, Event, Input, State
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox
from tests.fusion.drawings import padded, random_grid
from tests.fusion.live.maps import AWAY, moved_frame, started, three, touched
from tests.support.examples import examples

RULES = NormalizeConfig()

BOX = st.tuples(
    st.integers(-9, 40), st.integers(-9, 40), st.integers(1, 12), st.integers(1, 12)
).map(lambda box: CellBox(box[0], box[1], box[0] + box[2], box[1] + box[3]))


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 999), boxes=st.lists(BOX, min_size=1, max_size=5))
def test_what_is_kept_of_a_map_is_as_if_all_of_it_had_been_looked_at(
    device: ComputeDevice, seed: int, boxes: list[CellBox]
) -> None:
    rng = np.random.default_rng(seed)
    grid = replace(random_grid(seed), resolution=0.1)
    one = Input("a")
    with pytest.MonkeyPatch.context() as patch:
        # Several bands in a map of a few cells.
        patch.setattr(limits, "BAND_CELLS", 100)
        for box in boxes:
            one.follow(grid, 0.1, RULES, device)
            layer = one.layer
            assert layer is not None
            known = layer.known
            assert known is not None
            assert one.walls == np.count_nonzero(grid.cells >= 65)
            found = grid.known_box()
            assert found is not None
            moved = CellBox(
                *(
                    corner - first
                    for corner, first in zip(
                        (known.row0, known.col0, known.row1, known.col1),
                        (layer.row, layer.col) * 2,
                        strict=True,
                    )
                )
            )
            assert moved == found
            cells = grid.cells.copy()
            part = cells[max(0, box.row0) : box.row1, max(0, box.col0) : box.col1]
            part[:] = rng.choice([-1, 0, 40, 100], part.shape, p=rng.dirichlet(np.ones(4)))
            grid = replace(grid, cells=cells)
            if rng.random() < 0.3:
                grid = padded(grid, *rng.integers(0, 4, 4).tolist())
            if rng.random() < 0.3:
                rows, cols = rng.integers(0, 4, 2).tolist()
                grid = grid.crop(CellBox(rows, cols, grid.height, grid.width))


def test_an_input_goes_through_its_states_and_votes_in_one(device: ComputeDevice) -> None:
    drive = started(device)

    def states() -> dict[str, State]:
        records = drive.live.inputs(drive.now_s)
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
            assert place is not None
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
