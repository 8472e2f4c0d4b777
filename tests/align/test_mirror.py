"""Mirrored maps are refused by name, and only those; what needs no look at an image gets none."""

from __future__ import annotations

import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.hypotheses import mirror_gain
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.search import search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of, part
from tests.fusion.live.maps import mirrored, transposed, trio
from tests.support.overlap import simulated

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

CONFIG = AlignConfig()


def aligned(reference: OccupancyGrid, moving: OccupancyGrid, device: ComputeDevice) -> Alignment:
    a, b = features_of(reference, device), features_of(moving, device)
    return align_pair(Pair(a, b), CONFIG)


@pytest.mark.parametrize("wrong", [mirrored, transposed])
@pytest.mark.parametrize("is_moving", [True, False])
def test_a_mirrored_or_transposed_map_is_refused_by_name(
    device: ComputeDevice, wrong: object, *, is_moving: bool
) -> None:
    assert callable(wrong)
    a, b = trio()["a"], trio()["b"]
    found = aligned(a, wrong(b), device) if is_moving else aligned(wrong(a), b, device)
    assert not found.accepted
    assert found.decision == "mirrored"
    assert "a map mirrored or transposed?" in found.reason
    assert found.evidence.mirrored is not None
    assert found.evidence.mirrored > 1.3


def test_the_image_of_a_mirrored_map_is_the_map(device: ComputeDevice) -> None:
    """What it gains is what the right pair loses by its own image."""
    a, b = features_of(trio()["a"], device), features_of(trio()["b"], device)
    wrong = features_of(mirrored(trio()["b"]), device)
    gains = []
    for moving in (b, wrong):
        _, motions = search(Pair(a, moving), CONFIG, SearchWindow())
        gain = mirror_gain(Pair(a, moving), motions[0], CONFIG)
        assert gain is not None
        gains.append(gain)
    assert gains[0] < 0.8
    assert gains[1] == pytest.approx(1.0 / gains[0], rel=0.05)


def test_what_is_refused_is_named_if_its_image_would_be_believed(device: ComputeDevice) -> None:
    """A mirrored half fits nowhere itself; its image does."""
    place = building(4, 14.0, 9.0, 0.05)
    low, high = part(place, 0.0, 0.65, "low"), part(place, 0.35, 1.0, "high")
    right = aligned(low, high, device)
    assert right.accepted, right.reason
    found = aligned(low, mirrored(high), device)
    assert found.decision == "mirrored"
    assert found.evidence.mirrored is not None
    assert found.evidence.mirrored > 1.0
    unnamed = align_pair(
        Pair(features_of(low, device), features_of(mirrored(high), device)), CONFIG, thorough=False
    )
    assert not unnamed.accepted
    assert unnamed.decision != "mirrored"


def test_a_place_that_is_nearly_its_own_image_is_accepted(device: ComputeDevice) -> None:
    """A corridor whose doors are nearly symmetric; chance does not explain its image."""
    name = "simulated, 20%: sim/office/72100 y high to sim/office/72100 y low"
    (case,) = (draft.draw() for draft in simulated(0) if draft.name == name)
    found = aligned(case.reference, case.moving, device)
    assert found.accepted, found.reason
    assert case.is_right(found.transform)
    assert found.evidence.mirrored is not None
    assert 0.9 < found.evidence.mirrored < 1.0


def test_another_building_is_no_mirror_image(device: ComputeDevice) -> None:
    refused = aligned(trio()["a"], building(4, 12.0, 8.0, 0.05), device)
    assert not refused.accepted
    assert refused.decision != "mirrored"
    assert refused.evidence.mirrored is None
