"""The drawn map as the fused one: who votes beside it, on which cells, and what the others say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.align.records import FusionResult, InputRecord
from slamfusion.compute import NumpyDevice
from slamfusion.config import FusionConfig, VoteConfig
from slamfusion.errors import GridError
from slamfusion.evidence.drawn_map import fuse_with_drawn
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, OccupancyGrid
from tests.support.written_maps import CELL, MEANING, fits, written_map

DRAW = FusionConfig(vote=VoteConfig(mode="drawn"))


def cells(made: OccupancyGrid) -> list[str]:
    marks = {value: mark for mark, value in MEANING.items()}
    return ["".join(marks[int(cell)] for cell in row) for row in made.cells]


def dissent(result: FusionResult, name: str) -> npt.NDArray[np.bool_]:
    (record,) = (item for item in result.inputs if item.name == name)
    assert record.dissent is not None
    return record.dissent


DRAWN = written_map("drawn", "|#..#|\n|#..#|\n|####|")


def test_without_saved_maps_it_is_the_drawn_map_and_the_others_are_held_against_it() -> None:
    a = written_map("a", "|#..#|\n|##.#|\n|####|")
    b = written_map("b", "|#.. |\n|#.. |\n|    |")
    made = fuse_with_drawn(fits(a, b), DRAWN, (), DRAW, NumpyDevice())
    assert cells(made.fused) == cells(DRAWN)
    assert made.fused.origin == DRAWN.origin
    assert (made.phantom_cells, made.weights) == (0, {"drawn": 1.0})
    # Of the three that know the cell a has it otherwise; where b knows nothing two are asked.
    assert made.agreement.cells.tolist() == [[100] * 4, [100, 67, 100, 100], [100] * 4]
    assert np.argwhere(dissent(made, "a")).tolist() == [[1, 1]]
    assert not dissent(made, "b").any()
    for record in made.inputs:
        assert record.aligned.shape == made.fused.cells.shape


SIDES, POST, SOUTH = "#............#", "#.....#......#", "##############"
WIDE = written_map("drawn", "\n".join(f"|{row}|" for row in [*[SIDES] * 9, SOUTH]))
WITH_A_POST = WIDE.cells.copy()
WITH_A_POST[2, 6] = 100


def test_saved_maps_vote_beside_it_and_widen_it() -> None:
    rows = [SIDES, SIDES, POST, *[SIDES] * 6, SOUTH]
    saved = written_map("lab", "\n".join(f"|{row}..|" for row in rows))
    made = fuse_with_drawn(fits(WIDE.with_name("a"), saved), WIDE, {"lab"}, DRAW, NumpyDevice())
    # A tie of the two is occupied; where the drawn map knows nothing the saved one decides.
    assert cells(made.fused) == [f"{row}.." for row in rows]
    assert made.weights == {"drawn": 1.0, "lab": 1.0}
    # Of drawn, a and lab, lab alone says that there is a post.
    assert made.agreement.cells[2, 6] == 33
    assert np.argwhere(dissent(made, "a")).tolist() == [[2, 6]]
    assert made.phantom_cells == 0


def test_one_map_that_knows_better_outvotes_nobody_but_two_do() -> None:
    first = replace(WIDE, cells=WITH_A_POST, name="first")
    maps = (first, first.with_name("second"))
    alone = fuse_with_drawn(fits(*maps), WIDE, {"nobody"}, DRAW, NumpyDevice())
    assert cells(alone.fused) == cells(WIDE)
    both = fuse_with_drawn(fits(*maps), WIDE, {"first", "second"}, DRAW, NumpyDevice())
    assert cells(both.fused) == cells(first)


def test_a_saved_map_is_laid_where_its_alignment_says() -> None:
    # Its own frame is turned by 90 degrees and lies elsewhere.
    at = Pose2(0.4, 0.0, np.pi / 2)
    saved = written_map("lab", "|#.|\n|..|\n|##|")
    made = fuse_with_drawn(
        fits(DRAWN.with_name("a"), saved, lab=at), DRAWN, {"lab"}, DRAW, NumpyDevice()
    )
    record = made.inputs[1]
    # The row of its frame runs up a column of the fused map.
    assert record.aligned.tolist() == [[-1, 1, 0, 1], [-1, 1, 0, 0], [-1, -1, -1, -1]]


def test_rejected_inputs_stay_as_they_were() -> None:
    result = fits(DRAWN.with_name("a"))
    lone = InputRecord(written_map("lone", "|#.|"), None, False, "fits nowhere")
    with_lone = replace(result, inputs=(*result.inputs, lone))
    made = fuse_with_drawn(with_lone, DRAWN, {"lone"}, DRAW, NumpyDevice())
    assert made.inputs[1] is lone
    assert made.weights == {"drawn": 1.0}


def test_a_drawing_of_nothing_is_refused() -> None:
    nothing = OccupancyGrid(np.full((3, 3), UNKNOWN, dtype=np.int8), CELL, Pose2(), "drawn")
    with pytest.raises(GridError, match="drawn: all 3 x 3 cells are unknown"):
        fuse_with_drawn(fits(DRAWN), nothing, (), DRAW, NumpyDevice())
