"""The pairs of maps that share a part are what they say: truth, share, mirror, scale."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.support.cuts import along, halves_of, kept, mirror_image, move_frame, wear
from tests.support.overlap import (
    DISJOINT_OVERLAP,
    OVERLAPS,
    SIMULATED,
    Case,
    Draft,
    cross_slam_pairs,
    disjoint_halves,
    drawn,
    load_source,
    mirrored,
    simulated,
)

pytestmark = pytest.mark.once

CELL_M = 0.05
# Middles of square blocks of 5 x 5 cells, metres in the map frame, no two distances alike.
BLOCKS_M = np.array([(1.125, 0.625), (4.125, 0.875), (2.625, 3.625)])
FLOORS = SIMULATED[::3]


def blocks() -> OccupancyGrid:
    """A free field of 6 m x 5 m with three blocks; its frame's zero at its corner."""
    cells = np.full((100, 120), FREE, dtype=np.int8)
    for x, y in BLOCKS_M:
        row, col = round(y / CELL_M - 0.5), round(x / CELL_M - 0.5)
        cells[row - 2 : row + 3, col - 2 : col + 3] = OCCUPIED
    return OccupancyGrid(cells, CELL_M, Pose2(), "blocks")


def middles(grid: OccupancyGrid) -> npt.NDArray[np.float64]:
    """Middles of the connected pieces of wall, map frame, metres."""
    labels, count = ndimage.label(grid.cells == OCCUPIED, np.ones((3, 3)))
    pieces = [np.nonzero(labels == number) for number in range(1, count + 1)]
    return np.array([grid.cell_centres(*piece).mean(axis=0) for piece in pieces])


def walls(grid: OccupancyGrid) -> npt.NDArray[np.float64]:
    """Centres of the wall cells, map frame, metres."""
    return grid.cell_centres(*np.nonzero(grid.cells == OCCUPIED))


def known(grid: OccupancyGrid) -> npt.NDArray[np.float64]:
    """Centres of the known cells, map frame, metres."""
    return grid.cell_centres(*np.nonzero(grid.cells != UNKNOWN))


def distances(
    points: npt.NDArray[np.float64], others: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """How far each point is from the nearest of the others, (N,), metres."""
    return np.asarray(KDTree(others).query(points)[0])


def nearest(
    points: npt.NDArray[np.float64], others: npt.NDArray[np.float64]
) -> npt.NDArray[np.int64]:
    """Which of the others is the nearest to each point, (N,)."""
    return np.asarray(KDTree(others).query(points)[1])


def unworn(draft: Draft) -> Case:
    """The case without dropped cells and specks."""
    case = replace(draft, dropped=0.0, specks=0.0).draw()
    assert case is not None
    return case


@pytest.mark.parametrize("seed", range(20))
def test_the_pose_of_a_moved_map_leads_back_to_known_blocks(seed: int) -> None:
    moved, pose = move_frame(blocks(), np.random.default_rng(seed))
    found = pose.transform(middles(moved))
    assert sorted(nearest(found, BLOCKS_M)) == [0, 1, 2]
    assert distances(found, BLOCKS_M).max() < 0.5 * CELL_M


def test_moved_maps_are_turned_every_way_and_some_in_their_origin_alone() -> None:
    moved = [move_frame(blocks(), np.random.default_rng(seed)) for seed in range(60)]
    yaws = np.array([pose.yaw_rad for _, pose in moved])
    assert np.histogram(yaws, 4, (-math.pi, math.pi))[0].min() > 5
    same = [np.array_equal(grid.cells, blocks().cells) for grid, _ in moved]
    assert 0 < sum(same) < 20
    straight = [grid.origin.yaw_rad == 0.0 for grid, _ in moved]
    assert 10 < sum(straight) < 50


@pytest.mark.parametrize("factor", [1.02, 1.1])
def test_a_scaled_map_is_larger_by_the_factor(factor: float) -> None:
    moved, _ = move_frame(blocks(), np.random.default_rng(1), factor)
    assert moved.resolution == CELL_M
    sides = [
        sorted(math.dist(a, b) for a, b in itertools.combinations(points, 2))
        for points in (middles(moved), BLOCKS_M)
    ]
    assert np.array(sides[0]) / np.array(sides[1]) == pytest.approx([factor] * 3, abs=0.008)


@pytest.mark.parametrize("draft", simulated(5, (0.4,), FLOORS), ids=lambda draft: draft.name)
def test_walls_of_the_common_strip_lie_on_each_other(draft: Draft) -> None:
    case = unworn(draft)
    assert case.truth is not None
    floor = load_source(draft.reference.source)
    moved = case.truth.transform(walls(case.moving))
    to_floor = distances(moved, walls(floor))
    # A cell of another lattice lies under a point of the wall cell that it shows.
    assert to_floor.max() <= 0.5 * math.sqrt(2.0) * CELL_M + 1e-9
    assert to_floor.mean() < 0.5 * CELL_M
    # Most of the strip's walls are seen from the other side too; nothing else of the reference is.
    to_moving = distances(walls(case.reference), moved)
    shared = np.count_nonzero(to_moving <= CELL_M)
    assert case.common_walls * 0.95 < shared < case.common_walls + 0.15 * len(to_moving)


@pytest.mark.parametrize("overlap", OVERLAPS)
@pytest.mark.parametrize("axis", [0, 1])
def test_the_halves_share_what_is_said(overlap: float, axis: int) -> None:
    low, high = (
        unworn(draft)
        for draft in simulated(1, (overlap,), ("sim/hall/72100",))[2 * axis : 2 * axis + 2]
    )
    # Of the two drafts of an axis the references are the low and the high half, unmoved.
    ends = [
        (known(c.reference)[:, axis].min(), known(c.reference)[:, axis].max()) for c in (low, high)
    ]
    lengths = [end - begin + CELL_M for begin, end in ends]
    strip = ends[0][1] - ends[1][0] + CELL_M
    assert lengths[0] == pytest.approx(lengths[1], abs=1e-6)
    assert strip / lengths[0] == pytest.approx(overlap, abs=2.0 * CELL_M / lengths[0])


def test_the_centre_lies_in_the_strip() -> None:
    for draft in simulated(2, (0.2,), ("sim/office/72100",)):
        case = unworn(draft)
        assert case.truth is not None
        centre = case.truth.transform(np.array([case.centre_m]))
        for grid, place in (
            (case.reference, centre),
            (case.moving, np.array([case.centre_m])),
        ):
            assert distances(place, known(grid))[0] < 1.0
        wanted = load_source("sim/office/72100")
        spans = halves_of(0, wanted.width if draft.reference.axis == "x" else wanted.height, 0.2)
        index = 0 if draft.reference.axis == "x" else 1
        own = wanted.origin.inverse().transform(centre)[0, index] / CELL_M
        assert spans.high_start < own < spans.low_end


def test_the_error_is_measured_at_the_centre() -> None:
    case = unworn(simulated(3, (0.3,), ("sim/yard/72100",))[0])
    assert case.truth is not None
    assert case.error(case.truth) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert case.is_right(case.truth)
    assert case.tolerance_m == pytest.approx(2 * CELL_M)
    turned = case.truth.compose(Pose2(0.0, 0.0, math.radians(3.0)))
    away = math.hypot(*(case.centre_m or ())) * 2 * math.sin(math.radians(1.5))
    assert case.error(turned) == pytest.approx((away, 3.0))
    x, y = case.truth.x, case.truth.y
    assert case.is_right(Pose2(x + 0.09, y, case.truth.yaw_rad))
    assert not case.is_right(Pose2(x + 0.11, y, case.truth.yaw_rad))
    about = Pose2(*(case.centre_m or ()))
    for degrees, is_right in ((0.4, True), (0.6, False)):
        turn = about.compose(Pose2(0.0, 0.0, math.radians(degrees))).compose(about.inverse())
        assert case.is_right(case.truth.compose(turn)) == is_right


def test_places_along_an_axis_are_counted_in_the_other_maps_cells() -> None:
    # Cells of 0.2 m, on axes turned by 90 degrees, laid on cells of 0.1 m whose corner is (1, 2).
    own = OccupancyGrid(np.zeros((2, 3), np.int8), 0.2, Pose2(0.0, 0.0, math.pi / 2))
    lattice = OccupancyGrid(np.zeros((9, 9), np.int8), 0.1, Pose2(1.0, 2.0))
    motion = Pose2(1.5, 2.1)
    # Own columns run along +y and own rows along -x.
    assert along(own, lattice, motion, "x") == pytest.approx(np.array([[4.0] * 3, [2.0] * 3]))
    assert along(own, lattice, motion, "y") == pytest.approx(np.array([[2.0, 4.0, 6.0]] * 2))


@pytest.mark.parametrize("draft", disjoint_halves(4, FLOORS), ids=lambda draft: draft.name)
def test_disjoint_halves_share_no_ground(draft: Draft) -> None:
    floor = load_source(draft.reference.source)
    assert draft.reference.axis is not None
    places = along(floor, floor, Pose2(), draft.reference.axis)
    extent = floor.width if draft.reference.axis == "x" else floor.height
    halves = halves_of(0, extent, DISJOINT_OVERLAP)
    assert (halves.high_start - halves.low_end) / extent == pytest.approx(0.05, abs=2 / extent)
    # Without another frame, both halves lie where they are on the floor.
    case = unworn(replace(draft, moves=False))
    assert case.truth is None
    assert distances(known(case.moving), known(case.reference)).min() > 0.04 * extent * CELL_M
    whole = sum(
        int(np.count_nonzero(kept(floor, places, halves.range_of(s)).cells >= 0))
        for s in ("low", "high")
    )
    assert whole == len(known(case.reference)) + len(known(case.moving))


def test_a_mirrored_map_is_a_mirror_image() -> None:
    case = unworn(mirrored(6, ("sim/office/72100",))[0])
    assert case.truth is None
    # What was on the left is as far on the right, and a walk around turns the other way.
    flipped = middles(mirror_image(blocks()))
    back = np.column_stack((blocks().width * CELL_M - flipped[:, 0], flipped[:, 1]))
    assert distances(back, BLOCKS_M).max() < 1e-9
    walk = flipped[np.argsort(nearest(back, BLOCKS_M))]
    assert _turning(walk) == pytest.approx(-_turning(BLOCKS_M))
    assert abs(_turning(BLOCKS_M)) > 1.0
    # The case's moving map is that image in another frame: unmoved, it is the image itself.
    still = unworn(replace(mirrored(6, ("sim/office/72100",))[0], moves=False))
    floor = load_source("sim/office/72100")
    assert np.array_equal(still.moving.cells, floor.cells[:, ::-1])
    assert np.array_equal(still.reference.cells, floor.cells)


def _turning(points: npt.NDArray[np.float64]) -> float:
    """Twice the signed area of a triangle, square metres."""
    (x0, y0), (x1, y1), (x2, y2) = points
    return float((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0))


def test_wear_drops_and_adds_what_is_said() -> None:
    floor = load_source("sim/hall/72101")
    worn = wear(floor, np.random.default_rng(1), 0.05, 0.05)
    had, has = floor.cells == OCCUPIED, worn.cells == OCCUPIED
    count = int(np.count_nonzero(had))
    assert np.count_nonzero(had & (worn.cells == FREE)) == pytest.approx(0.05 * count, rel=0.15)
    added = has & ~had
    assert (floor.cells[added] == FREE).all()
    assert 0.05 * count <= np.count_nonzero(added) <= 0.08 * count
    assert np.array_equal(worn.cells == UNKNOWN, floor.cells == UNKNOWN)


def test_the_same_draft_gives_the_same_case() -> None:
    drafts = simulated(7, (0.3,), ("sim/yard/72101",))
    again = [drafts[1].draw(), drafts[0].draw(), drafts[1].draw()]
    one, other, two = (case.moving.cells for case in again if case is not None)
    assert np.array_equal(one, two)
    assert one.shape != other.shape or not np.array_equal(one, other)
    seeds = [case.truth for seed in (7, 8) for case in drawn(simulated(seed, (0.3,))[:1])]
    assert seeds[0] != seeds[1]


@pytest.mark.datasets
@pytest.mark.parametrize(
    "draft", cross_slam_pairs(1, (0.3,))[::3], ids=lambda draft: draft.reference.name
)
def test_maps_of_two_slams_are_cut_by_the_same_line(draft: Draft) -> None:
    case = unworn(replace(draft, moves=False))
    assert case.truth is not None
    assert (case.truth == Pose2()) == ("csail" not in draft.reference.source)
    assert (case.tolerance_m, case.tolerance_deg) == (0.3, 2.0)
    moved = case.truth.transform(walls(case.moving))
    near = distances(walls(case.reference), moved) <= 0.2
    assert np.count_nonzero(near) > 0.5 * case.common_walls
    # And in another frame.
    there = unworn(draft)
    assert there.truth is not None
    moved = there.truth.transform(walls(there.moving))
    near = distances(walls(there.reference), moved) <= 0.2
    assert np.count_nonzero(near) > 0.5 * case.common_walls
