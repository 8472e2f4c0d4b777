"""Boxes of cells: joined where hardly a cell lies between."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.config import NormalizeConfig
from slamfusion.grid import CellBox
from slamfusion.vote import boxes as cell_boxes
from slamfusion.vote.boxes import joined, overlap
from tests.support.examples import examples

RULES = NormalizeConfig()
BOX = st.tuples(
    st.integers(-9, 40), st.integers(-9, 40), st.integers(1, 12), st.integers(1, 12)
).map(lambda box: CellBox(box[0], box[1], box[0] + box[2], box[1] + box[3]))


@settings(max_examples=examples(60), deadline=None)
@given(boxes=st.lists(BOX, min_size=1, max_size=6), spare=st.sampled_from((0, 30)))
def test_boxes_are_joined_where_hardly_a_cell_lies_between(
    boxes: list[CellBox], spare: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell_boxes, "SPARE_CELLS", spare)
        out = joined(boxes)
        assert joined(out) == out
    assert all(any(overlap(box, whole) == box for whole in out) for box in boxes)
    assert sum(box.area for box in out) <= sum(box.area for box in boxes) + spare * len(boxes)
