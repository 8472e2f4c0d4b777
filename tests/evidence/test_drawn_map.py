"""The drawn map on drives through drawn rooms: what beams told is counted once, and no more."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.errors import TrajectoryError
from slamfusion.evidence.beams import ScanHits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.geometry import Pose2, compose_poses, transform_points
from slamfusion.grid import FREE, OCCUPIED, OccupancyGrid
from slamfusion.trajectory import Trajectory

BEAMS = 180
SCANS = 40
# A room of 6 x 4 m about the frame's zero.
HALF_X, HALF_Y = 3.0, 2.0


@cache
def device() -> ComputeDevice:
    return open_device()


def driven() -> np.ndarray:
    """A slow drive along the middle of the room."""
    x = np.linspace(-1.5, 1.5, SCANS)
    return np.stack((x, 0.3 * np.sin(x), 0.4 * x), axis=1)


def to_walls(pose: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distance to the walls of the room along directions in the room, metres."""
    cos, sin = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        across = (np.sign(cos) * HALF_X - pose[0]) / cos
        along = (np.sign(sin) * HALF_Y - pose[1]) / sin
    return np.minimum(across, along)


def seen(poses: np.ndarray) -> list[ScanHits]:
    """What a laser in the robot's middle sees of the room."""
    scans = []
    bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False) + 0.003
    for index, pose in enumerate(poses):
        ranges = to_walls(pose, bearings + pose[2])
        ends = np.stack((ranges * np.cos(bearings), ranges * np.sin(bearings)), axis=1)
        scans.append(ScanHits(0.1 * index, (0.0, 0.0), None, ends))
    return scans


def path(poses: np.ndarray) -> Trajectory:
    return Trajectory(0.1 * np.arange(len(poses)), poses, "path")


def draw(scans: list[ScanHits], poses: np.ndarray, **options: object) -> OccupancyGrid:
    return draw_map(scans, path(poses), device(), resolution=0.05, **options)


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    """Return the cell at a place; -1 outside the map."""
    row, col = (int(index[0]) for index in grid.cell_indices(np.array([[x, y]])))
    inside = 0 <= row < grid.height and 0 <= col < grid.width
    return int(grid.cells[row, col]) if inside else -1


def replaced(scan: ScanHits, beams: slice, ranges_m: float) -> ScanHits:
    """Return a scan some of whose beams end elsewhere."""
    ends = scan.ends.copy()
    ends[beams] *= (ranges_m / np.hypot(*ends[beams].T))[:, None]
    return replace(scan, ends=ends)


def test_the_room_is_drawn_with_thin_walls_and_nothing_beyond() -> None:
    grid = draw(seen(driven()), driven())
    assert at(grid, 0.0, 0.0) == FREE
    for x in np.linspace(-2.8, 2.8, 29):
        assert OCCUPIED in {at(grid, x, HALF_Y - 0.01), at(grid, x, HALF_Y + 0.01)}
    rows, cols = np.nonzero(grid.cells == OCCUPIED)
    centres = grid.cell_centres(rows, cols)
    off = np.minimum(np.abs(np.abs(centres[:, 0]) - HALF_X), np.abs(np.abs(centres[:, 1]) - HALF_Y))
    assert off.max() < 0.05
    known = grid.cell_centres(*np.nonzero(grid.cells >= 0))
    assert np.abs(known).max(axis=0).tolist() == pytest.approx((HALF_X, HALF_Y), abs=0.06)


def test_the_map_lies_in_the_frame_of_the_path_on_the_lattice_asked_for() -> None:
    scans = seen(driven())
    moved = Pose2(12.0, -7.0, 0.9)
    poses = compose_poses((moved.x, moved.y, moved.yaw_rad), driven())
    turned = draw(scans, poses, origin=moved)
    plain = draw(scans, driven())
    assert (turned.cells == plain.cells).mean() > 0.999
    assert turned.origin.yaw_rad == pytest.approx(0.9)
    assert at(turned, *moved.transform((0.0, 0.0))) == FREE
    # Whole cells from the corner that was given.
    corner = moved.inverse().transform((turned.origin.x, turned.origin.y)) / 0.05
    assert np.abs(corner - np.rint(corner)).max() < 1e-9


def test_somebody_who_walked_by_leaves_nothing() -> None:
    scans = seen(driven())
    for index in range(10, 16):
        scans[index] = replaced(scans[index], np.s_[100:104], 0.8)
    grid = draw(scans, driven())
    assert (grid.cells == draw(seen(driven()), driven()).cells).all()


def test_what_stays_is_drawn() -> None:
    # Something at (0, 1) hides what is behind it in every scan.
    scans = seen(driven())
    bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False) + 0.003
    for index, pose in enumerate(driven()):
        away = np.array((0.0, 1.0)) - pose[:2]
        bearing = np.arctan2(away[1], away[0]) - pose[2]
        beam = int(np.argmin(np.abs(np.angle(np.exp(1j * (bearings - bearing))))))
        hidden = np.s_[max(beam - 2, 0) : beam + 3]
        scans[index] = replaced(scans[index], hidden, float(np.hypot(*away)))
    grid = draw(scans, driven())
    near = [at(grid, x, y) for x in (-0.05, 0.0, 0.05) for y in (0.95, 1.0, 1.05)]
    assert OCCUPIED in near


def test_stray_returns_leave_neither_walls_nor_spikes() -> None:
    scans = seen(driven())
    rng = np.random.default_rng(0)
    clean = draw(scans, driven())
    for index in range(SCANS):
        for beam in rng.integers(0, BEAMS, 3):
            # Short ones in the air, long ones through the wall.
            stray = rng.choice((rng.uniform(0.3, 1.0), rng.uniform(8.0, 20.0)))
            scans[index] = replaced(scans[index], np.s_[beam : beam + 1], float(stray))
    grid = draw(scans, driven())
    assert (grid.width, grid.height) == (clean.width, clean.height)
    assert (grid.cells != clean.cells).mean() < 0.002


def test_what_is_seen_through_a_pane_of_glass_is_not_drawn_behind_it() -> None:
    # A third of the beams through one wall go on, always at the same places: a window.
    scans = seen(driven())
    rng = np.random.default_rng(1)
    for index, pose in enumerate(driven()):
        bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False) + 0.003 + pose[2]
        ranges = to_walls(pose, bearings)
        y = pose[1] + ranges * np.sin(bearings)
        through = (y > HALF_Y - 0.01) & (rng.random(BEAMS) < 0.33)
        ends = scans[index].ends.copy()
        ends[through] *= ((ranges[through] + 3.0) / ranges[through])[:, None]
        scans[index] = replace(scans[index], ends=ends)
    grid = draw(scans, driven())
    rows, cols = np.nonzero(grid.cells >= 0)
    assert grid.cell_centres(rows, cols)[:, 1].max() < HALF_Y + 0.1


@pytest.mark.parametrize(("side", "is_drawn"), [(1, False), (12, True)])
def test_what_lies_apart_and_is_small_is_left_out(side: int, is_drawn: bool) -> None:
    """Beams of four scans go out through a hole in the wall, to a patch far behind it."""
    scans, poses = seen(driven()), driven()
    patch = 8.0 + 0.05 * np.stack(np.meshgrid(*[np.arange(side)] * 2), axis=-1).reshape(-1, 2)
    for index, scan in enumerate(scans):
        ends = transform_points(poses[[index]], scan.ends, np.zeros(BEAMS, dtype=np.int64))
        ends = ends[(ends[:, 0] < 0.5) | (ends[:, 1] < HALF_Y - 0.01)]
        if index % 13 == 0:
            ends = np.concatenate((ends, patch))
        scans[index] = replace(scan, ends=Pose2(*poses[index]).inverse().transform(ends))
    grid = draw(scans, poses)
    far = grid.cell_centres(*np.nonzero(grid.cells >= 0)).max() > 7.9
    assert far == is_drawn


def test_scans_without_a_pose_are_left_out() -> None:
    scans = seen(driven())
    half = Trajectory(0.1 * np.arange(SCANS)[:20], driven()[:20], "half")
    grid = draw_map(scans, half, device(), resolution=0.05)
    same = draw_map(scans[:20], half, device(), resolution=0.05)
    assert (grid.cells == same.cells).all()
    late = Trajectory(1000.0 + np.arange(SCANS), driven(), "late")
    with pytest.raises(TrajectoryError, match="late: its poses are of 1000"):
        draw_map(scans, late, device(), resolution=0.05)
    with pytest.raises(TrajectoryError, match="found 0 and 40"):
        draw_map([], path(driven()), device(), resolution=0.05)
