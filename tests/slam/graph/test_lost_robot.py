"""A robot that is carried away is found again where it is, or its loss is named."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan
from slamfusion.slam.graph.slam import GraphSlam
from tests.slam.drives import CELL_M
from tests.slam.places import (
    U8,
    away,
    draw_two_rooms,
    everything,
    false_closures,
    feed,
    on_truth,
    read,
    ring,
    run,
    way_along,
)

pytestmark = pytest.mark.once

REACH_M = 6.0
# Way from scan to scan once it has been carried.
STEP_M = 0.2
# After so many scans a loss has been noticed.
NOTICED_SCANS = 15


@functools.cache
def draw_building() -> U8:
    """Three rooms, A, B and C, above a corridor of 19 m by 2 m; none is like another."""
    cells, rng = np.ones((180, 400), dtype=np.uint8), np.random.default_rng(7)
    cells[10:50, 10:390] = 0
    for at in (30, 75, 150, 190, 235, 290, 345):
        deep, wide = (int(value) for value in rng.integers((3, 4), (9, 14)))
        cells[10 : 10 + deep, at : at + wide] = 1
    for low, left, high, wide in ((60, 10, 110, 120), (60, 140, 80, 110), (60, 262, 110, 128)):
        cells[low : low + high, left : left + wide] = 0
    for left in (60, 190, 320):
        cells[50:60, left : left + 22] = 0
    boxes = [
        *[(60, 10, 20, 12), (150, 35, 20, 30), (100, 112, 40, 8), (120, 10, 8, 25)],
        *[(60, 236, 50, 14), (110, 150, 12, 12), (126, 220, 14, 30)],
        *[(120, 262, 50, 44), (155, 340, 15, 14), (60, 375, 25, 15), (140, 380, 30, 10)],
        *[(102, 342, 10, 10)],
    ]
    for low, left, high, wide in boxes:
        cells[low : low + high, left : left + wide] = 1
    return cells


IN_A = [(3.6, 3.6), (1.8, 4.6), (2.6, 6.6), (4.6, 6.8), (5.0, 4.6), (3.6, 3.8)]
IN_C = [(16.5, 3.6), (14.5, 4.2), (16.2, 5.0), (16.6, 7.2), (18.2, 6.6), (18.2, 4.2), (16.5, 4.0)]
OUT_OF_A, OUT_OF_B, OUT_OF_C = [(3.55, 1.6)], [(10.05, 1.6)], [(16.5, 1.6)]


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive of a robot that was carried on the way.

    Attributes:
        cells: (H, W) the place, see ``read``.
        log: scans with odometry.
        truth: the poses.
        cuts: number of the first scan of every way but the first.
    """

    cells: U8
    log: list[LogScan]
    truth: list[Pose2]
    cuts: list[int]

    def first(self, cut: int, *, below_m: float) -> int:
        """Return the first scan after a cut at which the robot is below a y."""
        after = range(self.cuts[cut], len(self.truth))
        return next(index for index in after if self.truth[index].y < below_m)


def carried(cells: U8, *ways: list[tuple[float, float]]) -> Drive:
    """Return a drive along some ways; from the end of each it is carried to the next, unnoticed.

    Args:
        cells: (H, W) the place.
        ways: corners of each, metres.
    """
    truth: list[Pose2] = []
    cuts = []
    for way in ways:
        cuts.append(len(truth))
        truth += way_along(way, STEP_M if truth else 0.2)
    for pose in truth:
        assert cells[math.floor(pose.y / CELL_M), math.floor(pose.x / CELL_M)] == 0, pose
    odometry, log = truth[0], []
    for index, scan in enumerate(read(cells, truth, REACH_M, beams=181)):
        if index not in cuts:
            step = truth[index - 1].inverse().compose(truth[index])
            turn = step.yaw_rad + 0.02 * math.hypot(step.x, step.y)
            odometry = odometry.compose(Pose2(1.02 * step.x, 1.02 * step.y, turn))
        log.append(LogScan(scan, odometry, index + 1))
    return Drive(cells, log, truth, cuts[1:])


def false_ties(slam: GraphSlam, truth: list[Pose2]) -> list[tuple[float, float]]:
    """Return false closures; odometry across a loss, from one node to the next, is none."""
    return [(start, end) for start, end in false_closures(slam, truth) if end - start > 2.0]


# -- carried to where it has never been ------------------------------------------------------------


@functools.cache
def to_c() -> Drive:
    """From A out, back in, and carried to C; from there by the corridor to A, twice around in it.

    Its odometry has not noticed: by it the robot is still in A.
    """
    first = [*IN_A, *OUT_OF_A, *OUT_OF_B, *OUT_OF_A, *IN_A[:3]]
    home = [*IN_C, *OUT_OF_C, *OUT_OF_B, *OUT_OF_A, *IN_A, *IN_A]
    return carried(draw_building(), first, home)


@dataclass(frozen=True, eq=False)
class Trip:
    """What the trip to C and home made of the graph.

    Attributes:
        state: a file of the graph when it comes out of C.
        health: kidnappings, relocalizations, map components and nodes, then.
        slam: at the end.
    """

    state: Path
    health: tuple[int, int, int, int]
    slam: GraphSlam


@pytest.fixture(scope="module")
def trip(device: ComputeDevice, tmp_path_factory: pytest.TempPathFactory) -> Trip:
    drive, folder = to_c(), tmp_path_factory.mktemp("lost")
    out, state = drive.first(0, below_m=2.5), folder / "state.npz"
    slam = run(device, drive.log[:out])
    slam.save_state(state)
    health = slam.health
    then = (health.kidnappings, health.relocalizations, health.map_components, health.nodes)
    return Trip(state, then, feed(slam, drive.log[out:]))


def test_a_robot_that_is_carried_to_a_new_place_begins_a_part_of_its_own(trip: Trip):
    assert trip.health[:3] == (1, 0, 2)
    assert trip.health[3] > 60
    reasons = trip.slam.health.skips.counts
    assert reasons["the robot is lost: a new submap starts, placed by odometry alone"] == 1


def test_the_way_back_to_the_old_map_joins_both(trip: Trip):
    drive, slam = to_c(), trip.slam
    assert (slam.health.kidnappings, slam.health.relocalizations, slam.health.map_components) == (
        1,
        1,
        1,
    )
    assert false_ties(slam, drive.truth) == []
    away_m, cut = away(slam.trajectory(), drive.truth), drive.cuts[0]
    assert away_m[:cut].max() < 0.3
    assert away_m[cut + NOTICED_SCANS :].max() < 0.4  # C is in its place now, too
    assert away_m[-1] < 0.1
    correct, found = on_truth(slam.grid(), drive.cells)
    assert correct > 0.98
    assert found > 0.7


def test_a_state_saved_while_lost_goes_on_as_if_nothing_had_been(device: ComputeDevice, trip: Trip):
    drive = to_c()
    loaded = GraphSlam.load_state(trip.state, GraphConfig(), device)
    assert loaded.health.map_components == 2
    feed(loaded, drive.log[drive.first(0, below_m=2.5) :])
    assert everything(loaded)[:4] == everything(trip.slam)[:4]


# -- what is no loss -------------------------------------------------------------------------------


@pytest.mark.parametrize("jump", [Pose2(0.0, 4.9, -1.0), Pose2(80.0, 0, 3)])
def test_odometry_that_jumps_loses_no_robot(device: ComputeDevice, jump: Pose2):
    """In A the robot drives on; its odometry is suddenly elsewhere."""
    drive = carried(draw_building(), IN_A)
    jumped = [
        replace(item, odometry=jump.compose(item.odometry or Pose2())) if index >= 25 else item
        for index, item in enumerate(drive.log)
    ]
    slam = run(device, jumped)
    assert (slam.health.kidnappings, slam.health.map_components) == (0, 1)
    assert away(slam.trajectory(), drive.truth).max() < 0.15
    assert on_truth(slam.grid(), drive.cells)[0] > 0.98


@pytest.mark.parametrize("first", [45, pytest.param(120, marks=pytest.mark.full)])
def test_a_log_that_starts_in_the_middle_of_a_loop(device: ComputeDevice, first: int):
    """The loop closes where the log began, in the odometry's frame of then."""
    log, truth = ring()
    slam = run(device, log[first:])
    begin = (log[first].odometry or Pose2()).compose(truth[first].inverse())
    moved = [begin.compose(pose) for pose in truth[first:]]
    assert slam.health.kidnappings == 0
    assert slam.health.closures_accepted > 10
    away_m = away(slam.trajectory(), moved)
    assert away_m[-1] < 0.3
    assert away_m.max() < 0.5


# -- rooms that look the same ----------------------------------------------------------------------


@pytest.mark.parametrize("room", [0, pytest.param(1, marks=pytest.mark.full)])
def test_a_robot_carried_into_one_of_two_equal_rooms_is_never_put_into_the_other(
    device: ComputeDevice, room: int
):
    """Both are mapped; it is carried from the corridor into one, drives there, and goes out."""
    inside = [(1.5, 3.3), (1.2, 5.6), (2.6, 5.5), (3.2, 4.0), (1.6, 3.2), (3.0, 3.2)]
    rooms = [[(x + 5.0 * number, y) for x, y in inside] for number in (0, 1)]
    out = [[(3.0 + 5.0 * number, 2.6), (3.0 + 5.0 * number, 1.15)] for number in (0, 1)]
    first = [*rooms[0], *out[0], *out[1][::-1], *rooms[1], *out[1], (6.0, 1.15)]
    back = [*rooms[room][1:], *out[room], (1.0 + 8.0 * (1 - room), 1.15), (1.0 + 8.0 * room, 1.15)]
    drive = carried(draw_two_rooms(), first, back)
    slam = run(device, drive.log)
    assert slam.health.kidnappings >= 1
    assert false_ties(slam, drive.truth) == []
    away_m = away(slam.trajectory(), drive.truth)
    assert away_m[: drive.cuts[0]].max() < 0.3
    # Either it is not known where the room is, or it is where it is.
    if slam.health.map_components == 1:
        assert away_m[-1] < 0.3
        assert on_truth(slam.grid(), drive.cells)[0] > 0.95
