"""Recorded maps: those of one place come together, those of two never do."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.fusion import FusionResult, align_grids, fuse_grids
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from tests.fusion.drawings import features_of, fusion_config, off_by
from tests.support import halmstad
from tests.support.datasets import MAPS, align_entries, load_entry, map_entries
from tests.support.overlap import are_different_places, drawn, half_pairs, load_source

pytestmark = pytest.mark.datasets

QUICK = fusion_config()
HOME = ("cartographer", "gmapping", "karto")
ROOM = ("crsm", "gmapping", "hector", "karto")


@cache
def load(folder: str, *names: str) -> tuple[OccupancyGrid, ...]:
    path = MAPS / "multi-slam" / folder
    return tuple(load_map(path / f"{name}.yaml").with_name(name) for name in names)


def assert_home(
    result: FusionResult, grids: tuple[OccupancyGrid, ...], frames: dict[str, Pose2]
) -> None:
    """All accepted, and identical start frames come out within 0.35 m and 3 degrees.

    Args:
        frames: pose of each given map's frame in the frame that the recordings share.
    """
    assert len(result.accepted) == 3, [record.reason for record in result.rejected]
    assert result.phantom_cells == 0
    base = frames[result.reference]
    for record, grid in zip(result.inputs, grids, strict=True):
        wanted = base.inverse().compose(frames[record.name])
        shift, turn = off_by(grid, record.alignment.transform, wanted)
        assert shift * grid.resolution <= 0.35, record.name
        assert turn <= 3.0, record.name


def test_three_slams_of_one_home_come_together(device: ComputeDevice) -> None:
    grids = load("nanorobot-real", *HOME)
    result = fuse_grids(grids, QUICK, device)
    assert_home(result, grids, dict.fromkeys(HOME, Pose2()))


def assert_triangles_close(grids: tuple[OccupancyGrid, ...], pairs: list[Alignment]) -> None:
    """Every triangle closes within 3 cells and 1 degree at the centre of its first map."""
    motions = {(p.moving, p.reference): p.transform for p in pairs}
    motions |= {(p.reference, p.moving): p.transform.inverse() for p in pairs}
    for a, b, c in itertools.combinations(grids, 3):
        box = a.known_box
        middle = ((box.col0 + box.col1) / 2, (box.row0 + box.row1) / 2)
        centre = a.origin.transform(np.array(middle) * a.resolution)
        a_to_b, b_to_c, c_to_a = (
            motions[pair] for pair in ((a.name, b.name), (b.name, c.name), (c.name, a.name))
        )
        around = c_to_a.compose(b_to_c).compose(a_to_b)
        assert math.dist(around.transform(centre), centre) <= 3 * a.resolution
        assert abs(math.degrees(around.yaw_rad)) <= 1.0, (a.name, b.name, c.name)


@pytest.mark.parametrize(
    ("folder", "names"),
    [("nanobot-new", ROOM), pytest.param("nanorobot-real", HOME, marks=pytest.mark.full)],
)
def test_all_pairs_of_a_place_are_accepted_and_their_triangles_close(
    device: ComputeDevice, folder: str, names: tuple[str, ...]
) -> None:
    grids = load(folder, *names)
    pairs = [align_grids(a, b, QUICK, device) for a, b in itertools.combinations(grids, 2)]
    assert [f"{p.moving}-{p.reference}: {p.reason}" for p in pairs if not p.accepted] == []
    assert_triangles_close(grids, pairs)


def test_maps_of_different_places_are_never_accepted(
    device: ComputeDevice, request: pytest.FixtureRequest
) -> None:
    entries = itertools.combinations(map_entries(), 2)
    pairs = [pair for pair in entries if are_different_places(*pair)]
    # Of some two thousand pairs, evenly: maps against maps of every kind.
    wanted = 40 if request.config.getoption("--full") else 4
    chosen = pairs[11 :: len(pairs) // wanted]
    found = [align_entries(a, b, QUICK, device) for a, b in chosen]
    assert len(found) >= wanted
    assert [f"{p.moving}-{p.reference}: {p.reason}" for p in found if p.accepted] == []


def test_halmstad_pairs_are_right_as_people_marked_them(device: ComputeDevice) -> None:
    right = accepted = 0
    names = {"F5": ("F5_01", "F5_02", "F5_03", "F5_04"), "HIH": ("HIH_01", "HIH_02", "HIH_03")}
    pairs = [(place, *pair) for place in names for pair in itertools.combinations(names[place], 2)]
    pairs.append(("HIH", "HIH_01", "HIH_04"))
    for place, first, second in pairs:
        grids = halmstad.load_place(place)
        found = align_grids(grids[first], grids[second], QUICK, device)
        pixels, degrees = halmstad.annotated_error(grids[second], found)
        is_right = pixels < halmstad.RIGHT_PIXELS and degrees < halmstad.RIGHT_DEGREES
        assert is_right or not found.accepted, f"{second} to {first}: {pixels:.1f} px"
        right += is_right
        accepted += found.accepted
    assert len(pairs) == 10
    assert right >= 9
    assert accepted >= 8


# What a few walls of two maps were believed for: 5 m at the edge of a room and of a floor, and the
# corner of a depot on the map of a lost SLAM, in one direction alone.
FEW_WALLS = (
    ("multi-slam/nanobot-new/crsm.yaml", "halmstad/maps/F5/pseudo_occupancy/F5_07.png"),
    ("worlds/nav2/depot.yaml", "multi-slam/mit-csail/tinyslam-lost.yaml"),
)


@pytest.mark.once
@pytest.mark.parametrize("files", FEW_WALLS)
def test_a_corner_that_two_maps_share_is_no_common_place(
    device: ComputeDevice, files: tuple[str, str]
) -> None:
    entries = {entry.file: entry for entry in map_entries()}
    a, b = (features_of(load_entry(entries[file]), device) for file in files)
    for reference, moving in ((a, b), (b, a)):
        found = align_pair(Pair(reference, moving), QUICK.align)
        assert not found.accepted, found.reason


def test_a_room_is_not_found_among_the_many_of_a_large_building(device: ComputeDevice) -> None:
    """96 % of 38 m of walls meet, and of all other places the best has 68 % of that."""
    room = load_source("multi-slam/nanobot-new/karto.yaml")
    building = load_source("strands/aaf_y3/aaf_deployment16-cropped.pgm.gz")
    found = align_grids(room, building, QUICK, device)
    assert not found.accepted, found.reason
    assert found.evidence.share > 0.9


@pytest.mark.once
def test_a_plan_with_smoothed_lines_is_no_warehouse(device: ComputeDevice) -> None:
    """Of its walls one in seven is beside free space, and those fit on an outer wall."""
    named = {entry.file: entry for entry in map_entries()}
    plan = named["halmstad/maps/HIH/layout/HIH_layout.png"]
    warehouse = named["worlds/nav2/warehouse.yaml"]
    for pair in ((plan, warehouse), (warehouse, plan)):
        found = align_entries(*pair, QUICK, device)
        assert not found.accepted, found.reason


@pytest.mark.once
def test_a_corridor_in_common_is_fitted_narrowly_before_it_is_judged(device: ComputeDevice) -> None:
    """The wide fit leaves a fifth of 100 m of walls, and the mirror image fits better."""
    maps = ("rendered/freiburg_building79.png",)
    for seed in (1, 2):
        chosen = [
            draft
            for draft in half_pairs(seed, (0.3,), maps)
            if (draft.reference.axis, draft.reference.side) == ("y", "high")
        ]
        for case in drawn(chosen):
            found = align_grids(case.reference, case.moving, QUICK, device)
            assert found.accepted, f"{case.name}: {found.reason}"
            assert case.is_right(found.transform), case.name
