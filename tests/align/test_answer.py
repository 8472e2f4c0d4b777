"""What is measured of an answer and its rivals: two of one room, bent maps, starts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.fusion import align_grids
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.json_values import record_keys
from slamfusion.sim import draw_building
from tests.fusion.drawings import (
    assert_right,
    building,
    building_parts,
    degraded,
    draw,
    fusion_config,
    off_by,
    with_origin,
)
from tests.support.cuts import along, halves_of, kept

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

QUICK = fusion_config()
WINDOW = fusion_config(window_m=1.0, window_yaw_rad=0.3)
# A room of 4 x 3 m with a niche and a pillar: it looks like itself from one side only.
ROOM = (
    "#" * 40,
    *["#" + "." * 38 + "#"] * 10,
    "#" + "." * 10 + "#" * 6 + "." * 22 + "#",
    *["#" + "." * 30 + "#" * 3 + "." * 5 + "#"] * 6,
    *["#" + "." * 38 + "#"] * 9,
    "#" * 40,
)


def part_pair(seed: int) -> tuple[OccupancyGrid, OccupancyGrid, Pose2]:
    """Return two halves of a building with 7 % of each in common, and the pose of the second."""
    truth = building(seed, 16.0, 12.0, 0.05)
    places = along(truth, truth, Pose2(), "x")
    known = places[truth.cells >= 0]
    halves = halves_of(int(known.min()), int(known.max()), 0.07)
    low = kept(truth, places, (halves.low, halves.low_end)).with_name("low")
    high = kept(truth, places, (halves.high_start, halves.high))
    moving, pose = degraded(high, seed, "high", yaw_rad=1.2, flip_share=0.01)
    return low, moving, pose


def record_of(found: Alignment) -> dict[str, float]:
    assert found.evidence is not None
    return dict(vars(found.evidence))


def test_a_room_that_stands_twice_is_ambiguous_and_both_places_are_said(
    device: ComputeDevice,
) -> None:
    two = draw("\n".join(line + " " * 20 + line for line in ROOM))
    frame = Pose2(7.0, -3.0, 0.9)
    away = with_origin(draw("\n".join(ROOM), name="room"), frame)
    found = align_grids(two, away, QUICK, device)
    assert found.decision == "ambiguous"
    lands = [pose.compose(frame) for pose in (found.transform, found.runner_up.transform)]
    for pose, x in zip(sorted(lands, key=lambda pose: pose.x), (0.0, 6.0), strict=True):
        assert (pose.x, pose.y) == pytest.approx((x, 0.0), abs=0.05)
        assert pose.yaw_rad == pytest.approx(0.0, abs=0.01)
    rival = found.runner_up.transform
    degrees = math.degrees(rival.yaw_rad)
    assert f"at {rival.x:.2f}, {rival.y:.2f} m, {degrees:.0f} deg" in found.reason
    assert record_of(found)["rival_ratio"] == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(4))
def test_two_buildings_are_not_one_place_that_is_there_twice(
    device: ComputeDevice, seed: int
) -> None:
    """An outer wall of one lies well on that of the other, in many places, back to back."""
    first, second = (
        draw_building(np.random.default_rng([seed, which]), 12.0, 10.0, 0.1).with_name(name)
        for which, name in enumerate(("first", "second"))
    )
    found = align_grids(first, second, QUICK, device)
    assert found.decision in {"different place", "too little in common", "bent"}
    assert found.strength is None
    if found.decision == "different place":
        best, chance = (found.statistics[name] for name in ("explained", "explained_by_chance"))
        assert found.reason.startswith(
            f"the maps do not show the same place: the best fit explains {best:.0%} of the smaller "
            f"map's walls, a random one {chance:.0%}; "
        )


def storey(seed: int, rooms: int) -> OccupancyGrid:
    """Return a storey of an L-shaped building of 30 x 20 m with this number of walls inside."""
    cells = np.full((440, 640), UNKNOWN, dtype=np.int8)
    for edge, value in ((20, OCCUPIED), (22, FREE)):
        cells[edge : 440 - edge, edge : 430 - edge] = value
        cells[edge : 280 - edge, edge : 640 - edge] = value
    rng = np.random.default_rng(seed)
    for _ in range(rooms):
        row, col = rng.integers(30, (360, 560))
        height, width = rng.permutation((2, int(rng.integers(40, 80))))
        wall = cells[row : row + height, col : col + width]
        wall[wall == FREE] = OCCUPIED
    return OccupancyGrid(cells, 0.05, name=f"storey {seed}")


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("rooms", [10, 16])
def test_storeys_with_the_same_outer_walls_are_a_weak_match_at_most(
    device: ComputeDevice, seed: int, rooms: int
) -> None:
    """A rectangle of outer walls is four lines, and turned by 180 degrees it fits as well."""
    found = align_grids(storey(seed, rooms), storey(seed + 100, rooms), QUICK, device)
    assert found.strength in {None, "weak"}, found.reason
    assert record_keys(found)["strength"] == found.strength
    contradiction = 1.0 - record_of(found)["share"]
    assert (
        f"{contradiction:.0%} of the common walls contradict: another storey or another time "
        "(moved furniture)?"
        in found.reason
        or found.decision == "different place"
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cells", [4.0, 30.0])
def test_a_map_that_is_bent_much_is_not_believed(
    device: ComputeDevice, seed: int, cells: float
) -> None:
    truth = building(seed, 14.0, 11.0, 0.05)
    moving, pose = degraded(truth, seed, yaw_rad=0.4, bend_cells=cells)
    found = align_grids(truth, moving, QUICK, device)
    if cells < 10.0:
        assert_right(found, moving, pose)
    else:
        assert found.decision in {"bent", "different place", "ambiguous", "too little in common"}, (
            found.reason
        )


def test_thick_walls_are_not_taken_for_a_bent_map(device: ComputeDevice) -> None:
    """A fit of a bent map is wide, and leaves a sharp one: here it would turn by a degree."""
    truth = building(1, 9.0, 7.0, 0.05)
    moving, pose = degraded(truth, 1, yaw_rad=1.3, resolution=0.1, wall_change_cells=2)
    found = align_grids(truth, moving, QUICK, device)
    # Of so small a map too little tells it from a slide, but it lies where it belongs.
    shift, degrees = off_by(moving, found.transform, pose)
    assert shift < 0.3
    assert degrees < 0.2


@pytest.mark.parametrize("seed", [4, 7])
def test_a_small_common_ground_that_fits_is_believed_beside_a_large_one_that_does_not(
    device: ComputeDevice, seed: int
) -> None:
    """What fits badly over many walls gives twice the evidence; of good maps it counts for less."""
    west, east, pose = building_parts(seed, 0.2, yaw_rad=1.2)
    found = align_grids(west, east, QUICK, device)
    assert_right(found, east, pose, cells=1.5, degrees=0.5)
    assert found.evidence.reading == "good"


@pytest.mark.parametrize("seed", [3, 5])
def test_a_start_makes_little_common_ground_enough(device: ComputeDevice, seed: int) -> None:
    low, high, pose = part_pair(seed)
    assert not align_grids(low, high, QUICK, device).accepted
    right = align_grids(low, high, WINDOW, device, pose.compose(Pose2(0.1, 0.05, 0.02)))
    assert_right(right, high, pose, cells=2.0, degrees=1.0)
    for off in (Pose2(3.0, 2.0, 1.0), Pose2(-2.5, 0.0, 0.0), Pose2(0.0, 0.0, math.pi)):
        wrong = align_grids(low, high, WINDOW, device, pose.compose(off))
        assert not wrong.accepted, wrong.reason


def test_a_window_that_holds_the_answer_is_judged_against_rivals_of_everywhere(
    device: ComputeDevice,
) -> None:
    """Within a metre of the right place a room that stands twice has no rival, but it has one."""
    two = draw("\n".join(line + " " * 20 + line for line in ROOM))
    room = draw("\n".join(ROOM), name="room")
    config: FusionConfig = WINDOW
    found = align_grids(two, room, config, device, Pose2())
    assert found.runner_up.transform.x == pytest.approx(6.0, abs=0.05)
    shift, _ = off_by(room, found.transform, Pose2())
    assert shift < 1.0
