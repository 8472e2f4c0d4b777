"""What a new map of an input changed, and what is kept of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, NormalizeConfig
from slamfusion.fusion.live import limits
from slamfusion.fusion.live.track import Track
from slamfusion.grid import CellBox
from tests.fusion.drawings import padded, random_grid
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
    track, live = Track("a"), LiveConfig()
    with pytest.MonkeyPatch.context() as patch:
        # Several bands in a map of a few cells.
        patch.setattr(limits, "BAND_CELLS", 100)
        for box in boxes:
            track.follow(grid, 0.1, RULES, live, device)
            layer, known = track.layer, track.known
            assert layer is not None
            assert known is not None
            assert track.walls == np.count_nonzero(grid.cells >= 65)
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
