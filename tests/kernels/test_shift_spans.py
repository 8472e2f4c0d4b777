"""Shifts that need no look: what is left out says nothing, and points that go together are near."""

from __future__ import annotations

import numpy as np

from slamfusion.compute import NumpyDevice
from slamfusion.compute.lattice import grouped, shift_spans
from slamfusion.compute.layout import SHIFT_POINTS
from slamfusion.compute.search import ShiftedSide

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
