"""The fused canvas and what a new map of an input changed: cells, boxes, lattices."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig, NormalizeConfig, VoteConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.fusion import live_canvas, live_limits
from slamfusion.fusion.live_canvas import Canvas, Lattice, Sheet, carry, joined, lay_out, overlap
from slamfusion.fusion.live_input import Track, compare
from slamfusion.fusion.live_limits import unusable
from slamfusion.fusion.vote import double_reach_cells, vote_grids
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid, trinary_cells
from slamfusion.io import memory
from tests.fusion.drawings import draw, padded, random_cells, random_grid

RULES = NormalizeConfig()
POSES = st.builds(
    Pose2, st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.floats(-math.pi, math.pi)
)


def sheet_of(grid: OccupancyGrid, device: ComputeDevice, before: Sheet | None = None) -> Sheet:
    lattice = None if before is None else before.lattice
    return lay_out(grid, lattice, 0.1, RULES, device)


@settings(max_examples=40, deadline=None)
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
    sheet = sheet_of(grid, device)
    grown = sheet_of(padded(grid, *margins), device, sheet)
    assert grown.lattice == sheet.lattice
    lattice = Lattice(0.1, Pose2(2.0, -1.0, 0.3))
    box = lattice.box_of(sheet.box, sheet.lattice, transform)
    whole = carry(sheet, transform, lattice, box, device)
    part = CellBox(
        box.row0 + inner[0], box.col0 + inner[1], box.row1 - inner[2], box.col1 - inner[3]
    )
    if part.height > 0 and part.width > 0:
        alone = carry(grown, transform, lattice, part, twins)
        rows = slice(inner[0], inner[0] + part.height)
        cols = slice(inner[1], inner[1] + part.width)
        assert np.array_equal(alone, whole[rows, cols])
    assert (whole >= 0).sum() > 0.8 * (grid.cells >= 0).sum()


@pytest.mark.parametrize("size", [0.05, 0.04, 0.2, 0.25])
def test_cells_of_another_size_keep_their_phase_while_the_map_grows(
    device: ComputeDevice, size: float
) -> None:
    grid = OccupancyGrid(random_cells(5), size, Pose2(4.0, 2.0, 0.6))
    first = sheet_of(grid, device)
    assert first.lattice.resolution == 0.1
    for south, west in ((1, 0), (3, 7), (10, 5)):
        grown = sheet_of(padded(grid, south, west, 2, 9), device, first)
        assert grown.lattice == first.lattice
        assert np.array_equal(grown.window(first.box), first.cells)
    walls = grid.cells >= 65
    if size < 0.1:
        # No wall is lost where cells are joined.
        rows, cols = np.nonzero(walls)
        place = grid.origin.inverse().transform(grid.cell_centres(rows, cols)) / 0.1
        found = first.cells[
            np.floor(place[:, 1]).astype(int) - first.row,
            np.floor(place[:, 0]).astype(int) - first.col,
        ]
        assert (found >= 65).all()


def test_a_map_beside_the_lattice_begins_its_own(device: ComputeDevice) -> None:
    grid = random_grid(3)
    first = sheet_of(grid, device)
    beside = replace(grid, origin=Pose2(0.03, 0.0, 0.0))
    assert sheet_of(beside, device, first).lattice != first.lattice
    turned = replace(grid, origin=Pose2(0.0, 0.0, 0.01))
    assert sheet_of(turned, device, first).lattice != first.lattice
    whole = replace(grid, origin=Pose2(-0.3, 0.5, 0.0))
    again = sheet_of(whole, device, first)
    assert (again.row, again.col) == (5, -3)
    assert again.lattice == first.lattice


PLACE = """
##########
#        #
#..      #
#..      #
##########
"""


def test_what_changed_is_boxed_and_counted(device: ComputeDevice) -> None:
    old = sheet_of(draw(PLACE), device)
    walls = int((old.cells == 100).sum())
    same = compare(old, old, walls, RULES, device)
    assert same.box is None
    assert same.standing == walls

    cells = old.cells.copy()
    cells[2, 5] = 100
    cells[0, 3:7] = 0
    change = compare(old, Sheet(cells, old.lattice), walls, RULES, device)
    assert change.box == CellBox(0, 3, 3, 7)
    assert change.walls == 5
    # The two in the middle of the gap have no wall beside them; the outer two have.
    assert change.contradicted == 2
    assert change.standing == walls - 2


def test_what_is_cut_off_changed_and_contradicts_nothing(device: ComputeDevice) -> None:
    grid = draw(PLACE)
    old = sheet_of(grid, device)
    walls = int((old.cells == 100).sum())
    cut = sheet_of(grid.crop(CellBox(0, 0, 5, 6)), device, old)
    change = compare(old, cut, walls, RULES, device)
    assert change.box == CellBox(0, 6, 5, 10)
    assert change.contradicted == 0
    margin = sheet_of(padded(grid, 4, 4, 4, 4), device, old)
    assert compare(old, margin, walls, RULES, device).box is None


BOX = st.tuples(
    st.integers(-9, 40), st.integers(-9, 40), st.integers(1, 12), st.integers(1, 12)
).map(lambda box: CellBox(box[0], box[1], box[0] + box[2], box[1] + box[3]))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 999), boxes=st.lists(BOX, min_size=1, max_size=5))
def test_what_is_kept_of_a_map_is_as_if_all_of_it_had_been_looked_at(
    device: ComputeDevice, seed: int, boxes: list[CellBox]
) -> None:
    rng = np.random.default_rng(seed)
    grid = replace(random_grid(seed), resolution=0.1)
    track, live = Track("a"), LiveConfig()
    with pytest.MonkeyPatch.context() as patch:
        # Several bands in a map of a few cells.
        patch.setattr(live_limits, "BAND_CELLS", 100)
        for box in boxes:
            track.follow(grid, 0.1, RULES, live, device)
            sheet, known = track.sheet, track.known
            assert sheet is not None
            assert known is not None
            assert track.walls == np.count_nonzero(grid.cells >= 65)
            found = grid.known_box()
            assert found is not None
            moved = CellBox(
                *(
                    corner - first
                    for corner, first in zip(
                        (known.row0, known.col0, known.row1, known.col1),
                        (sheet.row, sheet.col) * 2,
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


@settings(max_examples=60, deadline=None)
@given(boxes=st.lists(BOX, min_size=1, max_size=6), spare=st.sampled_from((0, 30)))
def test_boxes_are_joined_where_hardly_a_cell_lies_between(
    boxes: list[CellBox], spare: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_canvas, "SPARE_CELLS", spare)
        out = joined(boxes)
        assert joined(out) == out
    assert all(any(overlap(box, whole) == box for whole in out) for box in boxes)
    assert sum(box.area for box in out) <= sum(box.area for box in boxes) + spare * len(boxes)


def test_a_map_on_another_lattice_is_compared_where_it_lies(device: ComputeDevice) -> None:
    grid = random_grid(11)
    old = sheet_of(grid, device)
    walls = int((old.cells >= 65).sum())
    turned = replace(grid, origin=Pose2(0.0, 0.0, 0.004))
    near = compare(old, sheet_of(turned, device, old), walls, RULES, device)
    assert near.is_steady(0.75)
    away = replace(grid, origin=Pose2(0.83, 0.61, 0.9))
    far = compare(old, sheet_of(away, device, old), walls, RULES, device)
    assert not far.is_steady(0.75)


def test_too_few_walls_say_nothing(device: ComputeDevice) -> None:
    assert "unknown" in (unusable(draw("   \n   "), RULES) or "")
    assert "23 of the 24" in (unusable(draw("#" * 23 + "."), RULES) or "")
    assert unusable(draw("#" * 24 + "\n" + 2 * ("." * 24 + "\n")), RULES) is None
    assert "0 of the 24" in (unusable(draw("?" * 40), RULES) or "")
    assert device.name


@pytest.mark.parametrize(
    ("mode", "unknown"),
    [
        ("majority", "auto"),
        ("majority", "value"),
        ("majority", "abstain"),
        ("consensus", "auto"),
        ("log-odds", "auto"),
    ],
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
    canvas = Canvas(Lattice(0.1, Pose2(1.0, 2.0, 0.2)), config, device)
    box = CellBox(0, 0, *size)
    canvas.grow(box, "all")
    for name, cells in zip("abc", full, strict=True):
        sheet = Sheet(cells, canvas.lattice)
        canvas.lay(name, sheet, box, Pose2(), None)
    for row in range(0, size[0], 13):
        for col in range(0, size[1], 17):
            part = CellBox(row, col, min(row + 13, size[0]), min(col + 17, size[1]))
            canvas.vote("abc", part)
    reach = double_reach_cells(config.vote, 0.1)
    stack = [trinary_cells(cells, RULES) for cells in full]
    wanted = vote_grids(stack, config.vote, device, percents=full, reach_cells=reach)
    fused, agreement = canvas.grids()
    assert np.array_equal(trinary_cells(fused.cells, RULES), wanted.fused)
    assert np.array_equal(agreement.cells, wanted.agreement)
    assert canvas.phantom_cells == wanted.phantom_cells
    assert fused.origin == Pose2(1.0, 2.0, 0.2)


def test_a_canvas_grows_by_whole_cells_and_never_beyond_memory(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    canvas = Canvas(Lattice(0.1, Pose2(1.0, 2.0, 0.2)), FusionConfig(), device)
    sheet = Sheet(random_cells(1), canvas.lattice)
    canvas.grow(sheet.box, "a")
    canvas.lay("a", sheet, sheet.box, Pose2(), None)
    canvas.vote("a", sheet.box)
    before = canvas.grids()[0]
    assert canvas.grow(CellBox(1, 1, 3, 3), "a") is None
    grown = canvas.grow(CellBox(-5, -7, 3, 3), "b")
    assert grown is not None
    assert (grown.row0, grown.col0) == (-5, -7)
    after = canvas.grids()[0]
    assert np.array_equal(after.crop(CellBox(5, 7, after.height, after.width)).cells, before.cells)
    corner = after.origin.transform((0.7, 0.5))
    assert np.allclose(corner, (before.origin.x, before.origin.y))
    monkeypatch.setattr(memory, "available_memory", lambda: 10_000)
    with pytest.raises(MemoryBudgetError, match="b: a fused map"):
        canvas.grow(CellBox(0, 0, 5000, 5000), "b")
    assert canvas.box == grown
