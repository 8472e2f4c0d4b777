"""Narrow fits of good maps: each motion on its own, from several yaws, and what lies beside."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from slamfusion.align.features import GridFeatures
from slamfusion.align.frames import motion_of
from slamfusion.align.narrow_fit import climbed, narrow_fits
from slamfusion.align.refine import settle
from slamfusion.compute import ComputeDevice
from slamfusion.fusion import narrow_fit
from tests.fusion.drawings import building, features_of
from tests.support.overlap import drawn, half_pairs

# About counting, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once


def centred(features: GridFeatures, *off: float) -> np.ndarray:
    """Return the motion that leaves a map where it is, and what is added to it."""
    return np.array([*features.centre, 0.0]) + np.array(off or (0.0, 0.0, 0.0))


@pytest.mark.parametrize(("off_deg", "rounds"), [(0.0, 1), (1.2, 2), (3.0, 4), (9.0, 4)])
def test_a_fit_goes_on_while_it_turns(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, off_deg: float, rounds: int
) -> None:
    features = features_of(building(1), device)
    right = math.radians(off_deg)
    asked: list[int] = []

    def polish(_: object, __: object, begun: np.ndarray, *___: object) -> np.ndarray:
        asked.append(len(begun))
        return begun

    def scores(
        _: object, __: object, motions: np.ndarray, *___: object, **____: object
    ) -> np.ndarray:
        return -abs(motions[:, 2] - right)

    monkeypatch.setattr(narrow_fit, "polish", polish)
    monkeypatch.setattr(narrow_fit, "score_motions", scores)
    (fitted,) = narrow_fits(features, features, centred(features)[None], device)
    assert asked == [5] * rounds
    assert abs(fitted[2] - min(right, math.radians(4 * 1.2))) < math.radians(0.31)


def test_each_motion_is_fitted_on_its_own(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    begun = np.array(
        [centred(features, 1.0, 0.5, 0.02), centred(features, -2.0, 1.0, 0.05), [9.0, 4.0, 2.0]]
    )
    alone = np.array([narrow_fits(features, features, one[None], device)[0] for one in begun])
    assert np.array_equal(narrow_fits(features, features, begun, device), alone)
    assert np.abs(alone[:2] - centred(features)).max() < 0.02
    assert narrow_fits(features, features, begun[:0], device).shape == (0, 3)


def test_on_a_strip_a_narrow_fit_is_nearer_than_the_wide_one(device: ComputeDevice) -> None:
    """Halves of a building: the other walls of each pull a wide fit."""
    turned_deg = []
    for seed in range(8):
        drafts = half_pairs(seed, (0.2,), ("sim/building/72100",))
        (case,) = drawn(drafts[:1])
        low, high = (features_of(grid, device) for grid in (case.reference, case.moving))
        assert case.truth is not None
        right = motion_of(low, high, case.truth)
        wide = settle(low, high, (right + np.array([2.0, -2.0, math.radians(1.5)]))[None], device)
        narrow = narrow_fits(low, high, wide, device)
        turned_deg.append([abs(math.degrees(fit[0, 2] - right[2])) for fit in (wide, narrow)])
    wide_deg, narrow_deg = np.mean(turned_deg, axis=0)
    assert narrow_deg < 0.1
    assert narrow_deg < 0.5 * wide_deg


@pytest.mark.parametrize(("gain", "is_taken"), [(1.11, True), (1.1, False), (1.0, False)])
def test_what_lies_beside_a_fit_is_taken_where_walls_give_a_tenth_more(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, gain: float, *, is_taken: bool
) -> None:
    features = features_of(building(1), device)
    motion, away = centred(features), np.array([1.5, -0.625, 0.0])

    def scores(_: object, __: object, motions: np.ndarray, *___: object, **____: Any) -> np.ndarray:
        # A cone on a plain: at the fit 1, at its top as much as is gained.
        left = np.hypot(*(motions[:, :2] - motion[:2] - away[:2]).T) / np.hypot(*away[:2])
        return 1.0 + (gain - 1.0) * (1.0 - left) - np.abs(motions[:, 2])

    monkeypatch.setattr(narrow_fit, "score_motions", scores)
    found = climbed(features, features, motion, device)
    if is_taken:
        assert np.abs(found - motion - away).max() < 0.13
    else:
        assert np.array_equal(found, motion)


def test_maps_without_a_common_wall_are_left_where_they_are(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    motion = centred(features, 1e4, 0.0, 0.0)
    assert np.array_equal(climbed(features, features, motion, device), motion)


def test_a_fit_that_is_right_stays_as_it_is(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    motion = centred(features)
    assert np.array_equal(climbed(features, features, motion, device), motion)
