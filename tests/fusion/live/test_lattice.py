"""The lattice: a cell is the same in whatever box, and keeps its phase while a map grows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.live.inputs import carry
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox
from slamfusion.vote.lattice import Lattice
from tests.fusion.drawings import padded, random_grid
from tests.fusion.live.maps import layer_of
from tests.support.examples import examples

POSES = st.builds(
    Pose2, st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.floats(-math.pi, math.pi)
)


@settings(max_examples=examples(40), deadline=None)
@given(
    seed=st.integers(0, 999),
    transform=POSES,
    origin=POSES,
    margins=st.tuples(*[st.integers(0, 90)] * 4),
    inner=st.tuples(*[st.integers(0, 30)] * 4),
)
def test_a_cell_is_the_same_in_whatever_box_and_however_the_map_grew(
    device: ComputeDevice,
    twins: ComputeDevice,
    seed: int,
    transform: Pose2,
    origin: Pose2,
    margins: tuple[int, int, int, int],
    inner: tuple[int, int, int, int],
) -> None:
    grid = replace(random_grid(seed), origin=origin)
    layer = layer_of(grid, device)
    grown = layer_of(padded(grid, *margins), device, layer)
    assert grown.lattice == layer.lattice
    lattice = Lattice(0.1, Pose2(2.0, -1.0, 0.3))
    box = lattice.box_of(layer.box, layer.lattice, transform)
    whole = carry(layer, transform, lattice, box, device)
    part = CellBox(
        box.row0 + inner[0], box.col0 + inner[1], box.row1 - inner[2], box.col1 - inner[3]
    )
    if part.height > 0 and part.width > 0:
        alone = carry(grown, transform, lattice, part, twins)
        rows = slice(inner[0], inner[0] + part.height)
        cols = slice(inner[1], inner[1] + part.width)
        assert np.array_equal(alone, whole[rows, cols])
    assert (whole >= 0).sum() > 0.8 * (grid.cells >= 0).sum()


def test_a_map_beside_the_lattice_begins_its_own(device: ComputeDevice) -> None:
    grid = random_grid(3)
    first = layer_of(grid, device)
    beside = replace(grid, origin=Pose2(0.03, 0.0, 0.0))
    assert layer_of(beside, device, first).lattice != first.lattice
    turned = replace(grid, origin=Pose2(0.0, 0.0, 0.01))
    assert layer_of(turned, device, first).lattice != first.lattice
    whole = replace(grid, origin=Pose2(-0.3, 0.5, 0.0))
    again = layer_of(whole, device, first)
    assert (again.box.row0, again.box.col0) == (5, -3)
    assert again.lattice == first.lattice
