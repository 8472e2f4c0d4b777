"""A plan of unknown scale finds its scale, or is refused by name."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slamfusion.align.records import Alignment
from slamfusion.align.scale import align_at_any_scale
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.errors import AlignmentError, ConfigError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from slamfusion.jobs.align import align_maps, align_plan
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse import fuse_maps
from tests.fusion.drawings import building
from tests.support.cuts import along, kept, move_frame
from tests.support.datasets import ABSENT
from tests.support.halmstad import CELL_M
from tests.support.plans import maps_of, marked_error_m, places, plan_of

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once


def drawn_plan(truth: OccupancyGrid, factor: float) -> OccupancyGrid:
    """Return a drawing of a building: turned, with words, its cells said ``factor`` too large."""
    turned, _ = move_frame(truth, np.random.default_rng(5), 1.0)
    cells = np.where(turned.cells == 100, np.uint8(100), np.uint8(0))
    for row in range(40, cells.shape[0], 90):
        cv2.putText(cells, "Office 3.41", (30, row), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 100)
    return OccupancyGrid(cells.view(np.int8), turned.resolution * factor, Pose2(), "plan")


def found_in(
    seen: OccupancyGrid, plan: OccupancyGrid, device: ComputeDevice, about: float
) -> tuple[float, Alignment]:
    """Search scales a fifth smaller and larger than about the right one."""
    return align_at_any_scale(seen, plan, FusionConfig(), device, (0.82 * about, 1.25 * about))


@pytest.mark.parametrize(
    ("seed", "factor"), [(0, 1.83), pytest.param(1, 1.0, marks=pytest.mark.full), (2, 0.61)]
)
def test_a_plan_finds_its_scale(device: ComputeDevice, seed: int, factor: float) -> None:
    truth = building(seed, 24.0, 18.0, 0.05)
    # The robot saw the larger part of it.
    seen = kept(truth, along(truth, truth, Pose2(), "x"), (0, 320)).with_name("seen")
    scale, alignment = found_in(seen, drawn_plan(truth, factor), device, 1.0 / factor)
    assert alignment.accepted, alignment.reason
    assert scale == pytest.approx(1.0 / factor, rel=0.005)


def test_another_building_is_refused(device: ComputeDevice) -> None:
    _, alignment = found_in(
        building(3, 24.0, 18.0, 0.05),
        drawn_plan(building(4, 24.0, 18.0, 0.05), 1.4),
        device,
        1.0 / 1.4,
    )
    assert not alignment.accepted, alignment.reason


def test_a_mirrored_plan_is_named(device: ComputeDevice) -> None:
    truth = building(2, 24.0, 18.0, 0.05)
    plan = drawn_plan(truth, 1.3)
    image = replace(plan, cells=np.ascontiguousarray(plan.cells[::-1]))
    _, found = found_in(truth, image, device, 1.0 / 1.3)
    assert not found.accepted
    assert found.decision == "mirrored"
    assert "mirror image" in found.reason


@pytest.mark.parametrize("scales", [(0.0, 2.0), (2.0, 0.5)])
def test_impossible_scales_are_refused(device: ComputeDevice, scales: tuple[float, float]) -> None:
    grid = building(0, 14.0, 11.0, 0.05)
    with pytest.raises(ConfigError, match="two positive factors, least first"):
        align_at_any_scale(grid, grid, FusionConfig(), device, scales)


@pytest.mark.skipif(not places(), reason=ABSENT)
@pytest.mark.parametrize(
    ("seen", "place", "is_own"),
    [
        ("F5_12", "F5", True),
        pytest.param("HIH_02", "HIH", True, marks=pytest.mark.full),
        ("HIH_04", "F5", False),
    ],
)
def test_a_recorded_map_finds_its_place_on_its_plan_alone(
    device: ComputeDevice, seen: str, place: str, is_own: bool
) -> None:
    path = next(path for path in maps_of(seen.partition("_")[0]) if path.stem == seen)
    found = align_plan(load_map(path, resolution=CELL_M), plan_of(place), device=device)
    assert found.alignment.accepted == is_own, found.alignment.reason
    if is_own:
        assert marked_error_m(seen, found.plan, found.alignment.transform) < 1.0


@pytest.mark.parametrize("said", [0.055, pytest.param(0.04, marks=pytest.mark.full)])
def test_a_wrong_resolution_is_named_with_the_right_one(device: ComputeDevice, said: float) -> None:
    """In a YAML file a wrong number may stand; ``align`` and ``fuse`` say what it should be."""
    a, b, c = (
        kept(truth, along(truth, truth, Pose2(), "x"), part).with_name(name)
        for truth in [building(0, 24.0, 18.0, 0.05)]
        for name, part in (("a", (0, 400)), ("b", (40, 480)), ("c", (0, 480)))
    )
    wrong = replace(c, resolution=said)
    found = align_maps(a, wrong, device=device)
    assert found.decision == "other scale"
    (numbers,) = re.findall("its resolution should be (.*) m, it says (.*) m", found.reason)
    assert [*map(float, numbers)] == [pytest.approx(0.05, rel=0.005), said]
    assert evaluate_maps([wrong], a, device=device)[0].alignment.reason == found.reason
    if said < 0.05:
        return
    fused = fuse_maps([a, b, wrong], device=device)
    ((left_out, why),) = fused.result.remarks
    assert left_out == "c was rejected:"
    assert why.startswith("its resolution should be 0.05")
    with pytest.raises(AlignmentError, match=r"c: its resolution should be 0\.05"):
        fuse_maps([a, wrong], device=device)
