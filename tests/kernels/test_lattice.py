"""Fixed-point motions of 32 bit read what those of 64 bit read; shifts that need no look."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.compute import NumpyDevice
from slamfusion.compute.lattice import (
    fixed_cells,
    fixed_poses,
    grouped,
    narrow_motions,
    narrowed,
    point_planes,
    shift_spans,
)
from slamfusion.compute.layout import FIXED_TO_CELL_SHIFT, SHIFT_POINTS
from slamfusion.compute.search import ShiftedSide

# Cells; a lattice position is twice as long.
SIDES = st.integers(1, 16_000)


def narrowed_motions(points: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Points about their middle (N, 2), motions in 32 bits (P, 4), and their bits below a cell."""
    device = NumpyDevice()
    planes = point_planes(points, device)
    moved, drop = narrow_motions(planes, poses.T.astype(np.float64))
    near = device.download(planes.planes)[:, : planes.count]
    return near.T, narrowed(moved, drop).T, FIXED_TO_CELL_SHIFT - drop


@given(SIDES, st.integers(0, 2**32 - 1))
def test_narrow_motions_fit_and_read_the_same_place(side: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 2 * side, (64, 2)).astype(np.int32)
    poses = fixed_poses(rng.uniform((-side, -side, -4.0), (2 * side, 2 * side, 4.0), (16, 3)))
    near, narrow, shift = narrowed_motions(points, poses)
    assert narrow.dtype == np.int32
    x2, y2 = points.astype(np.int64).T
    near_x, near_y = near.astype(np.int64).T
    # Half a unit for each number of a pose.
    allowed = (side + 1.5) * 2.0**-shift
    assert allowed <= 1e-3 * max(1.0, side / 500.0) ** 2
    for pose, (cos, sin, x, y) in zip(poses, narrow.astype(np.int64), strict=True):
        col, row = cos * near_x - sin * near_y + x, sin * near_x + cos * near_y + y
        assert max(np.abs(col).max(), np.abs(row).max()) < 2**31
        # The nearest cell centre is half a cell away: compare places, not cells.
        wide_x = (pose[0] * x2 - pose[1] * y2 + pose[2]) / 2.0**31
        wide_y = (pose[1] * x2 + pose[0] * y2 + pose[3]) / 2.0**31
        assert np.abs(col / 2.0**shift - wide_x).max() <= allowed
        assert np.abs(row / 2.0**shift - wide_y).max() <= allowed


def test_narrow_motions_keep_the_cells_of_a_small_map() -> None:
    """Where no point comes near a cell's edge both read the same cells."""
    side = 200
    points = (2 * np.stack(np.indices((side, side)), axis=-1).reshape(-1, 2) + 1).astype(np.int32)
    poses = fixed_poses([(0.0, 0.0, 0.0), (3.0, -7.0, np.pi / 2.0), (50.25, 20.25, np.pi)])
    near, narrow, shift = narrowed_motions(points, poses)
    x2, y2 = points.astype(np.int64).T
    near_x, near_y = near.astype(np.int64).T
    for pose, (cos, sin, x, y) in zip(poses, narrow.astype(np.int64), strict=True):
        row, col = fixed_cells(pose, x2, y2)
        np.testing.assert_array_equal((cos * near_x - sin * near_y + x) >> shift, col)
        np.testing.assert_array_equal((sin * near_x + cos * near_y + y) >> shift, row)


BASE = 6


def test_scores_with_spans_are_those_without():
    rng = np.random.default_rng(3)
    box = (20, 31, 40, 62)
    field = np.full((1, 70, 140), BASE, dtype=np.uint8)
    field[:, box[0] : box[1], box[2] : box[3]] = rng.integers(0, 16, (11, 22))
    rows, cols = rng.integers(0, 50, (2, 3, 37)).astype(np.int32)
    offsets = rows * field.shape[2] + cols
    spans = shift_spans(rows, cols, np.array([box]))
    everywhere = np.full_like(spans, (0, 19, 0, 63))
    found = [
        NumpyDevice().best_shifts(side, side, (20, 64))
        for side in (ShiftedSide(field, offsets, given, BASE) for given in (everywhere, spans))
    ]
    assert np.array_equal(*found)
    assert len(np.unique(found[0][0])) > 10


def test_spans_hold_the_shifts_at_which_a_point_meets_the_box_and_no_others():
    rows, cols = np.array([[5]], dtype=np.int32), np.array([[70]], dtype=np.int32)
    spans = shift_spans(rows, cols, np.array([(20, 31, 40, 62)]))
    assert spans.tolist() == [[[15, 25, -30, -9]]]


def test_grouped_points_lie_closer_together_than_rows_of_a_map():
    side = np.arange(40) * 2 + 1
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    order = grouped(points)
    assert np.array_equal(np.sort(order), np.arange(len(points)))

    def extent(chosen: np.ndarray) -> float:
        groups = chosen.reshape(-1, SHIFT_POINTS, 2)
        return float((groups.max(axis=1) - groups.min(axis=1)).max(axis=1).mean())

    assert extent(points[order]) < 0.7 * extent(points)
