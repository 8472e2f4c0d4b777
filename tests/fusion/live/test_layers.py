"""The fused layers: boxes voted on one by one are one vote, and how they grow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig, NormalizeConfig, VoteConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.fusion.live.inputs import Layer
from slamfusion.fusion.live.voting import FusedLayers
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, trinary_cells
from slamfusion.io import files
from slamfusion.vote.lattice import Lattice
from slamfusion.vote.tiles import TileVoter
from tests.fusion.drawings import random_cells

RULES = NormalizeConfig()


@pytest.mark.parametrize(
    ("mode", "unknown"),
    [("majority", "auto"), ("majority", "value"), ("majority", "abstain"), ("consensus", "auto")],
)
def test_boxes_voted_on_one_by_one_are_one_vote(
    device: ComputeDevice, mode: str, unknown: str
) -> None:
    config = FusionConfig(vote=VoteConfig(mode=mode, unknown=unknown))
    stack = [random_cells(seed, 40, 40) for seed in (1, 2, 3)]
    size = tuple(max(cells.shape[axis] for cells in stack) for axis in (0, 1))
    full = [np.full(size, -1, dtype=np.int8) for _ in stack]
    for out, cells in zip(full, stack, strict=True):
        out[: cells.shape[0], : cells.shape[1]] = cells
    layers = FusedLayers(config, LiveConfig(), device)
    layers.lattice = Lattice(0.1, Pose2(1.0, 2.0, 0.2))
    box = CellBox(0, 0, *size)
    layers.grow(box, "all")
    for name, cells in zip("abc", full, strict=True):
        layers.lay(name, Layer(cells, layers.lattice, box, box, 0), Pose2(), None)
    for row in range(0, size[0], 13):
        for col in range(0, size[1], 17):
            part = CellBox(row, col, min(row + 13, size[0]), min(col + 17, size[1]))
            layers.vote("abc", part)
    assert_voted_anew(layers, config, full, device)
    fused, _ = layers.grids()
    assert fused.origin == Pose2(1.0, 2.0, 0.2)
    # A part of one map changes, and nothing else is laid or counted again.
    changed = CellBox(20, 5, 27, 15)
    full[1][changed.slices()] = random_cells(4, 40, 40)[:7, :10]
    touched = layers.lay("b", Layer(full[1], layers.lattice, box, box, 0), Pose2(), changed)
    assert touched is not None
    layers.vote("abc", touched)
    assert_voted_anew(layers, config, full, device)


def assert_voted_anew(
    layers: FusedLayers,
    config: FusionConfig,
    full: Sequence[npt.NDArray[np.int8]],
    device: ComputeDevice,
) -> None:
    """Check that the fused cells are those of a vote of all cells at once."""
    box = CellBox(0, 0, *full[0].shape)
    voter = TileVoter(box, config.vote, 0.1, ("a", "b", "c"))
    cells = {name: trinary_cells(own, RULES) for name, own in zip("abc", full, strict=True)}
    shown = {name: voter.prepare(box, lambda _, own=own: own) for name, own in cells.items()}
    if voter.weighs:
        voter = voter.trusting(voter.count(box, shown))
    wanted = voter.decide(box, shown, device)
    fused, agreement = layers.grids()
    assert np.array_equal(trinary_cells(fused.cells, RULES), wanted.fused)
    assert np.array_equal(agreement.cells, wanted.agreement)


def test_fused_layers_grow_by_whole_cells_and_never_beyond_memory(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    layers = FusedLayers(FusionConfig(), LiveConfig(), device)
    layers.lattice = Lattice(0.1, Pose2(1.0, 2.0, 0.2))
    layer = Layer.of(random_cells(1), layers.lattice, RULES)
    layers.grow(layer.box, "a")
    layers.lay("a", layer, Pose2(), None)
    layers.vote("a", layer.box)
    before = layers.grids()[0]
    assert not layers.grow(CellBox(1, 1, 3, 3), "a")
    assert layers.grow(CellBox(-5, -7, 3, 3), "b")
    grown = layers.box
    assert (grown.row0, grown.col0) == (-5, -7)
    after = layers.grids()[0]
    assert np.array_equal(after.crop(CellBox(5, 7, after.height, after.width)).cells, before.cells)
    corner = after.origin.transform((0.7, 0.5))
    assert np.allclose(corner, (before.origin.x, before.origin.y))
    monkeypatch.setattr(files, "available_memory", lambda: 10_000)
    with pytest.raises(MemoryBudgetError, match="b: a fused map"):
        layers.grow(CellBox(0, 0, 5000, 5000), "b")
    assert layers.box == grown
