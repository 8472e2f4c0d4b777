"""Maps of another scale: small differences are said, large ones refused, none is invented."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.decide import SAME_TIME_SHARE, Reading
from slamfusion.align.hypotheses import estimate_scale
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of
from tests.support.cuts import along, kept, move_frame

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

CONFIG = AlignConfig()
NO_OTHERS = np.empty((0, 3))


def scaled(seed: int, factor: float) -> tuple[OccupancyGrid, OccupancyGrid]:
    """Return a drawn building, and it larger by a factor in another frame."""
    truth = building(seed, 14.0, 11.0, 0.05)
    moving, _ = move_frame(truth, np.random.default_rng(seed), factor)
    return truth, moving.with_name("scaled")


def aligned(seed: int, factor: float, device: ComputeDevice) -> Alignment:
    truth, moving = scaled(seed, factor)
    return align_pair(Pair(features_of(truth, device), features_of(moving, device)), CONFIG)


def scale_of(found: Alignment) -> float:
    assert found.evidence.scale is not None, found.reason
    return found.evidence.scale


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("factor", [1.02, 0.98])
def test_a_small_difference_is_said_to_a_third_of_a_percent(
    device: ComputeDevice, seed: int, factor: float
) -> None:
    found = aligned(seed, factor, device)
    assert found.accepted, found.reason
    assert scale_of(found) == pytest.approx(1.0 / factor, abs=0.003)
    assert f"differ in scale by {abs(scale_of(found) - 1.0):.1%}" in found.reason


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("factor", [1.05, 0.95])
def test_a_large_difference_is_refused_by_name(
    device: ComputeDevice, seed: int, factor: float
) -> None:
    found = aligned(seed, factor, device)
    assert found.decision == "other scale", found.reason
    assert scale_of(found) == pytest.approx(1.0 / factor, abs=0.012)
    assert "is a resolution wrong?" in found.reason


@pytest.mark.parametrize("seed", range(3))
def test_one_scale_says_nothing(device: ComputeDevice, seed: int) -> None:
    found = aligned(seed, 1.0, device)
    assert found.accepted, found.reason
    assert scale_of(found) == 1.0
    assert "scale" not in found.reason


def test_little_common_ground_hides_no_scale(device: ComputeDevice) -> None:
    """A strip of 2.5 m fits nearly as well at another scale: little is left unexplained."""
    truth, _ = scaled(3, 1.0)
    places = along(truth, truth, Pose2(), "x")
    low = kept(truth, places, (0, 200)).with_name("low")
    high = kept(truth, places, (150, 10_000))
    moving, _ = move_frame(high, np.random.default_rng(3), 1.04)
    found = align_pair(Pair(features_of(low, device), features_of(moving, device)), CONFIG)
    assert found.evidence.share > SAME_TIME_SHARE
    assert found.decision == "other scale", found.reason


def test_a_scale_is_estimated_about_the_common_ground(device: ComputeDevice) -> None:
    """The answer holds in the middle of what both saw, wherever the moving map's own middle is."""
    truth, moving = scaled(2, 1.02)
    a, b = features_of(truth, device), features_of(moving, device)
    found = align_pair(Pair(a, b), CONFIG)
    motion = Pair(a, b).motion_of(found.transform)
    for reading in get_args(Reading):
        scale = estimate_scale(Pair(a, b), motion, reading, NO_OTHERS)
        assert scale == pytest.approx(1.0 / 1.02, abs=0.003), reading
    # Elsewhere nothing is better at another scale by as much as an answer needs.
    away = motion + np.array([0.0, 0.0, 1.0])
    assert estimate_scale(Pair(a, b), away, "good", NO_OTHERS) == 1.0


@pytest.mark.parametrize("degrees", [0.0, 2.0])
def test_a_scale_is_found_though_the_answer_is_turned(
    device: ComputeDevice, degrees: float
) -> None:
    """A part of a map of another scale fits best a little turned, and the rest does not fit."""
    truth = building(2, 40.0, 30.0, 0.1)
    rows, cols = ((np.arange(round(1.08 * n)) / 1.08).astype(int) for n in truth.cells.shape)
    moving = OccupancyGrid(truth.cells[np.ix_(rows, cols)], 0.1, name="larger")
    pair = Pair(features_of(truth, device), features_of(moving, device))
    motion = np.array([*pair.reference.centre, np.radians(degrees)])
    for reading in get_args(Reading):
        scale = estimate_scale(pair, motion, reading, NO_OTHERS)
        assert scale == pytest.approx(1.0 / 1.08, abs=0.005), reading


@pytest.mark.parametrize("factor", [1.0, 1.1])
def test_the_pose_of_most_evidence_may_be_of_another_scale(
    device: ComputeDevice, factor: float
) -> None:
    """A wrong answer that fits a small part is no match for all of the map at its own scale."""
    truth = building(2, 14.0, 11.0, 0.05)
    rows, cols = ((np.arange(round(factor * n)) / factor).astype(int) for n in truth.cells.shape)
    moving = OccupancyGrid(truth.cells[np.ix_(rows, cols)], 0.05, name="larger")
    pair = Pair(features_of(truth, device), features_of(moving, device))
    right = np.array([*pair.reference.centre, 0.0])
    wrong = right + np.array([100.0, 70.0, 1.0])
    for reading in get_args(Reading):
        scale = estimate_scale(pair, wrong, reading, right[None])
        assert scale == pytest.approx(1.0 / factor, abs=0.012), reading
