"""Narrow fits of good maps: each motion on its own, from several yaws, and what lies beside."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.align.refine import climbed, narrow_fits, settle
from slamfusion.compute import ComputeDevice
from tests.fusion.drawings import building, features_of
from tests.support.overlap import drawn, half_pairs

# About counting, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once


def centred(features: GridFeatures, *off: float) -> np.ndarray:
    """Return the motion that leaves a map where it is, and what is added to it."""
    return np.array([*features.centre, 0.0]) + np.array(off or (0.0, 0.0, 0.0))


def test_on_a_strip_a_narrow_fit_is_nearer_than_the_wide_one(device: ComputeDevice) -> None:
    """Halves of a building: the other walls of each pull a wide fit."""
    turned_deg = []
    for seed in range(8):
        drafts = half_pairs(seed, (0.2,), ("sim/building/72100",))
        (case,) = drawn(drafts[:1])
        low, high = (features_of(grid, device) for grid in (case.reference, case.moving))
        assert case.truth is not None
        right = Pair(low, high).motion_of(case.truth)
        wide = settle(Pair(low, high), (right + np.array([2.0, -2.0, math.radians(1.5)]))[None])
        narrow = narrow_fits(Pair(low, high), wide)
        turned_deg.append([abs(math.degrees(fit[0, 2] - right[2])) for fit in (wide, narrow)])
    wide_deg, narrow_deg = np.mean(turned_deg, axis=0)
    assert narrow_deg < 0.1
    assert narrow_deg < 0.5 * wide_deg


def test_maps_without_a_common_wall_are_left_where_they_are(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    motion = centred(features, 1e4, 0.0, 0.0)
    assert np.array_equal(climbed(Pair(features, features), motion), motion)


def test_a_fit_that_is_right_stays_as_it_is(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    motion = centred(features)
    assert np.array_equal(climbed(Pair(features, features), motion), motion)
