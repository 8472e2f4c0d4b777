"""The whole fusion: who votes, who is named, and that no fused cell ever moves in the world."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slamfusion.align import normalize
from slamfusion.compute import ComputeDevice
from slamfusion.config import SMALLEST, VoteConfig
from slamfusion.errors import AlignmentError, ConfigError, MemoryBudgetError
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.pipeline import vote_again
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.io import files
from tests.fusion.drawings import assert_right, building, degraded, draw, fusion_config, padded
from tests.fusion.live.maps import mirrored, trio

pytestmark = pytest.mark.usefixtures("remembered_searches")

QUICK = fusion_config()


@cache
def place(seed: int = 1) -> OccupancyGrid:
    return building(seed, 11.0, 9.0)


@cache
def three(seed: int = 1) -> tuple[tuple[OccupancyGrid, ...], tuple[Pose2, ...]]:
    """Three faulty maps of one place, and the poses of their frames in the truth's."""
    faults = (
        {"yaw_rad": 0.02, "flip_share": 0.03},
        {"yaw_rad": -1.1, "flip_share": 0.04, "margin_share": 0.5, "shift_share": (0.3, 0.1)},
        {"yaw_rad": 2.4, "flip_share": 0.03, "origin_yaw_rad": 0.7, "speckle_share": 0.05},
    )
    made = [
        degraded(place(seed), 10 * seed + index, name, **fault)
        for index, (name, fault) in enumerate(zip("abc", faults, strict=True))
    ]
    return tuple(grid for grid, _ in made), tuple(pose for _, pose in made)


def stranger(name: str = "stranger") -> OccupancyGrid:
    return building(77, 8.0, 7.5).with_name(name)


@pytest.mark.parametrize("mode", ["majority", "consensus"])
def test_the_same_maps_vote_again_as_they_would_have_voted(
    device: ComputeDevice, mode: str
) -> None:
    grids, _ = three()
    given = [*grids, stranger()]
    first = fuse_grids(given, QUICK, device)
    config = replace(QUICK, vote=replace(QUICK.vote, mode=mode))
    again, wanted = vote_again(first, config, device), fuse_grids(given, config, device)
    assert np.array_equal(again.fused.cells, wanted.fused.cells)
    assert np.array_equal(again.agreement.cells, wanted.agreement.cells)
    assert again.weights == wanted.weights
    assert [r.accepted for r in again.inputs] == [r.accepted for r in wanted.inputs]
    assert again.pairs == first.pairs


def truth_error(grid: OccupancyGrid, truth: OccupancyGrid, pose: Pose2) -> float:
    """Share of the truth's known cells that a map calls otherwise, the map placed by ``pose``."""
    rows, cols = np.nonzero(truth.cells >= 0)
    row, col = grid.cell_indices(pose.inverse().transform(truth.cell_centres(rows, cols)))
    inside = (row >= 0) & (col >= 0) & (row < grid.height) & (col < grid.width)
    values = np.full(len(rows), -1)
    values[inside] = grid.cells[row[inside], col[inside]]
    return float(np.mean(values != truth.cells[rows, cols]))


def assert_same_world(a: OccupancyGrid, b: OccupancyGrid) -> None:
    """Both grids have the same known cells, at the same places in the world."""
    first, second = a.known_box, b.known_box
    one, other = a.crop(first), b.crop(second)
    assert np.array_equal(one.cells, other.cells)
    assert one.resolution == other.resolution
    corner = np.array([one.origin.x - other.origin.x, one.origin.y - other.origin.y])
    assert np.abs(corner).max() < 1e-6
    assert abs(math.sin(one.origin.yaw_rad - other.origin.yaw_rad)) < 1e-9


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.full)])
def test_the_fused_map_is_as_near_the_truth_as_its_inputs(device: ComputeDevice, seed: int) -> None:
    grids, poses = three(seed)
    result = fuse_grids(grids, replace(QUICK, vote=VoteConfig(extent="union")), device)
    alone = [truth_error(g, place(seed), p) for g, p in zip(grids, poses, strict=True)]
    fused = truth_error(result.fused, place(seed), poses["abc".index(result.reference)])
    assert fused <= 1.1 * min(alone)


def test_the_result_is_complete(device: ComputeDevice) -> None:
    grids, _ = three()
    steps: list[tuple[str, int, int]] = []
    result = fuse_grids(grids, QUICK, device, lambda *step: steps.append(step))
    assert [(p.reference, p.moving) for p in result.pairs if not p.accepted] == []
    assert {frozenset((p.reference, p.moving)) for p in result.pairs} == {
        frozenset(names) for names in itertools.combinations("abc", 2)
    }
    assert result.device == device.name
    assert result.time_s > 0
    assert list(result.weights) == list(result.wall_agreement) == ["a", "b", "c"]
    assert set(np.unique(result.fused.cells).tolist()) <= {-1, 0, 100}
    shape = result.fused.cells.shape
    assert result.agreement.cells.shape == shape
    assert result.agreement.origin == result.fused.origin
    for record in result.inputs:
        assert record.aligned.shape == record.dissent.shape == shape
    done = [step[1] for step in steps]
    assert done == sorted(done)
    assert set(done) == {0, 1, 2, 3}
    assert {step[2] for step in steps} == {3}


def test_good_maps_are_borne_out_by_each_other_where_the_reference_is_bent(
    device: ComputeDevice,
) -> None:
    bent, *good = (
        degraded(place(), seed, name, yaw_rad=yaw, bend_cells=bend)[0]
        for seed, (name, yaw, bend) in enumerate(
            [("bent", 0.0, 4.0), ("a", -1.1, 0.3), ("b", 0.4, 0.3)]
        )
    )
    result = fuse_grids([bent, *good], QUICK, device)
    assert result.reference == "bent"
    direct = [pair for pair in result.pairs if "bent" in {pair.reference, pair.moving}]
    assert {pair.strength for pair in direct} <= {"weak", "fair"}
    for record, other in zip(result.inputs[1:], "ba", strict=True):
        assert record.alignment.strength == "strong"
        assert record.alignment.reason.startswith(f"to {other}: walls match (strong)")
    # All results of an alignment are in the frame of the reference.
    (pair,) = (item for item in result.pairs if {item.reference, item.moving} == {"a", "b"})
    shown = {record.name: record.alignment for record in result.inputs}
    held, moved = shown[pair.reference], shown[pair.moving]
    expected = held.transform.compose(pair.runner_up.transform)
    apart = expected.inverse().compose(moved.runner_up.transform)
    assert (apart.x, apart.y, apart.yaw_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert pair.yaw_profile is not None
    best = moved.yaw_profile[moved.yaw_profile[:, 1].argmax(), 0]
    assert wrap_angle(best - moved.transform.yaw_rad) == pytest.approx(0.0, abs=0.05)


def test_an_unrelated_map_is_named_and_the_others_fused(device: ComputeDevice) -> None:
    grids, _ = three()
    result = fuse_grids([grids[0], stranger(), grids[1]], QUICK, device)
    assert [record.name for record in result.accepted] == ["a", "b"]
    (left_out,) = result.rejected
    assert left_out.name == "stranger"
    assert left_out.reason.startswith(f"to {result.reference}: ")
    assert not left_out.alignment.accepted
    assert left_out.aligned is None
    assert left_out.dissent is None
    assert result.phantom_cells == 0
    assert len(result.pairs) == 3
    assert list(result.weights) == ["a", "b"]
    alone = fuse_grids([grids[0], grids[1]], QUICK, device)
    assert np.array_equal(result.fused.cells, alone.fused.cells)


def test_two_unrelated_maps_fuse_to_nothing_and_both_are_named(device: ComputeDevice) -> None:
    with pytest.raises(AlignmentError, match="no two of the inputs stranger, a align") as error:
        fuse_grids([stranger(), three()[0][0]], QUICK, device)
    assert len(error.value.pairs) == 1
    assert {error.value.pairs[0].moving, error.value.pairs[0].reference} == {"stranger", "a"}


def test_maps_without_known_cells_are_named(device: ComputeDevice) -> None:
    cells = np.full((20, 20), -1, dtype=np.int8)
    blank = [OccupancyGrid(cells, size, name=name) for name, size in (("a", 0.05), ("b", 0.1))]
    with pytest.raises(AlignmentError, match=r"\(a: all 20 x 20 cells are unknown"):
        fuse_grids(blank, QUICK, device)


def test_maps_that_cannot_be_aligned_are_named_and_the_others_fused(device: ComputeDevice) -> None:
    grids, _ = three()
    lawn = replace(grids[0], cells=np.zeros_like(grids[0].cells)).with_name("lawn")
    fog, bare = fuse_grids([draw(" ?\n  ", name="fog"), *grids[:2], lawn], QUICK, device).rejected
    assert bare.reason == "to a: lawn has no occupied cell, so there is nothing to align"
    assert fog.alignment is None
    assert fog.reason.startswith("all 2 x 2 cells are unknown")


def test_a_mirrored_map_of_a_second_place_is_named(device: ComputeDevice) -> None:
    one, two, image = (grid.with_name(f"there {name}") for name, grid in trio().items())
    result = fuse_grids([*three()[0], one, two, mirrored(image)], QUICK, device)
    assert [record.name for record in result.others[0].accepted] == ["there a", "there b"]
    assert "a map mirrored or transposed?" in result.rejected[-1].reason


def test_nothing_to_fuse_is_refused(device: ComputeDevice) -> None:
    with pytest.raises(AlignmentError, match="at least one map"):
        fuse_grids([], QUICK, device)


def test_names_given_twice_are_refused(device: ComputeDevice) -> None:
    grids, _ = three()
    with pytest.raises(ConfigError, match=r"distinct names; given twice: a$"):
        fuse_grids([grids[0], grids[1], grids[2].with_name("a")], QUICK, device)


@pytest.mark.parametrize("order", [("part", "whole"), ("whole", "part")])
def test_nothing_that_one_map_knows_is_lost_by_default(
    device: ComputeDevice, order: tuple[str, str]
) -> None:
    """What is cut off by the box of the smaller map is measured."""
    truth = place()
    maps = {"whole": truth, "part": truth.crop(CellBox(0, 0, 90, 60))}
    grids = [maps[name].with_name(name) for name in order]
    config = replace(QUICK, align=replace(QUICK.align, shared_frame=True))
    result = fuse_grids(grids, config, device)
    assert_same_world(result.fused, truth)
    assert result.left_out_m2 == {}
    config = replace(config, reference=SMALLEST, vote=replace(QUICK.vote, extent="reference"))
    result = fuse_grids(grids, config, device)
    assert result.fused.cells.shape == (90, 60)
    outside = np.count_nonzero(truth.cells[:, 60:] >= 0) * truth.resolution**2
    assert result.left_out_m2 == pytest.approx({"whole": outside})


@pytest.mark.parametrize("which", [1])
def test_cropping_unknown_margins_moves_no_fused_cell(device: ComputeDevice, which: int) -> None:
    grids = [padded(grid, 9, 4, 13, 22) for grid in three()[0]]
    config = replace(QUICK, reference="a")
    box = grids[which].known_box
    cropped = [g.crop(box) if k == which else g for k, g in enumerate(grids)]
    wanted, result = (fuse_grids(some, config, device) for some in (grids, cropped))
    assert_same_world(result.fused, wanted.fused)


def test_union_and_reference_share_one_lattice(device: ComputeDevice) -> None:
    truth = place()
    parts = [
        replace(truth, cells=truth.cells[:, :75], name="west"),
        truth.crop(CellBox(0, 25, 90, 110)).with_name("east"),
    ]
    # Two halves of a small place: told apart only by the frame they share.
    align = replace(QUICK.align, shared_frame=True)
    config = replace(QUICK, reference="west", align=align)
    inner = fuse_grids(
        parts, replace(config, vote=VoteConfig("majority", "abstain", "reference")), device
    ).fused
    outer = fuse_grids(
        parts, replace(config, vote=VoteConfig("majority", "abstain", "union")), device
    ).fused
    assert outer.width > inner.width
    assert inner.cells.shape == parts[0].cells.shape
    offset = outer.origin.inverse().transform((inner.origin.x, inner.origin.y)) / inner.resolution
    col, row = np.rint(offset).astype(int)
    assert np.allclose(offset, (col, row), atol=1e-6)
    same = outer.cells[row : row + inner.height, col : col + inner.width]
    assert np.array_equal(same, inner.cells)
    assert_same_world(outer, truth)


def test_a_name_or_an_index_chooses_the_reference(device: ComputeDevice) -> None:
    grids, _ = three()
    for wanted, name in (("c", "c"), ("1", "b"), ("0", "a"), (SMALLEST, "a")):
        assert fuse_grids(grids, replace(QUICK, reference=wanted), device).reference == name


@pytest.mark.parametrize(
    ("wanted", "words"),
    [("nobody", "is none of them"), ("7", "is none of them"), ("stranger", "was rejected")],
)
def test_a_reference_that_cannot_be_is_refused(
    device: ComputeDevice, wanted: str, words: str
) -> None:
    grids = [three()[0][0], three()[0][1], stranger()]
    with pytest.raises(ConfigError, match=rf"reference '{wanted}' {words}.* a, b$"):
        fuse_grids(grids, replace(QUICK, reference=wanted), device)


def test_work_that_would_not_fit_into_memory_is_refused(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    grids, _ = three()
    monkeypatch.setattr(files, "available_memory", lambda: 1000)
    with pytest.raises(MemoryBudgetError, match=r"^b: .*needs .* of memory"):
        fuse_grids(grids, QUICK, device)


@pytest.mark.once
def test_coarser_copies_of_large_maps_are_aligned_and_all_their_cells_vote(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = building(1, 18.0, 14.0, 0.05)
    made = [degraded(truth, n, name, yaw_rad=0.7 * n) for n, name in enumerate("abc")]
    grids, poses = [grid for grid, _ in made], [pose for _, pose in made]
    wanted = fuse_grids(grids, QUICK, device)
    monkeypatch.setattr(normalize, "ALIGNED_CELLS", 250)
    assert normalize.coarsening(grids, 0.05) == 2
    result = fuse_grids(grids, QUICK, device)
    assert result.reference == wanted.reference
    assert result.fused.cells.shape == wanted.fused.cells.shape
    base = poses["abc".index(result.reference)]
    for record, grid, pose in zip(result.inputs, grids, poses, strict=True):
        assert_right(record.alignment, grid, base.inverse().compose(pose))
    assert (result.fused.cells != wanted.fused.cells).mean() < 0.01


def test_maps_of_three_resolutions_fuse_at_the_finest(device: ComputeDevice) -> None:
    truth = building(1, 11.0, 9.0, 0.05)
    made = [
        degraded(truth, index, name, yaw_rad=yaw, resolution=size)
        for index, (name, yaw, size) in enumerate(
            (("a", 0.3, 0.05), ("b", -2.0, 0.04), ("c", 1.0, 0.1))
        )
    ]
    result = fuse_grids([grid for grid, _ in made], QUICK, device)
    assert len(result.accepted) == 3
    assert result.fused.resolution == 0.04
    base = made["abc".index(result.reference)][1]
    for record, (grid, pose) in zip(result.inputs, made, strict=True):
        assert_right(record.alignment, grid, base.inverse().compose(pose), cells=1.25)
