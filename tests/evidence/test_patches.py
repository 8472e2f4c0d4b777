"""A scan on the walls of a solved drive: a known offset is recovered, another place is refused."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.evidence.beams import judged_scans, scan_hits
from slamfusion.evidence.patches import ScanMatch, WallMap
from slamfusion.geometry import F64, row_of, wrap_angle
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import ROOM, box, circuit, recorded

SIGMAS = np.array((0.05, 0.05, 0.02))


def match(mapped: F64, seen: F64, at: F64, expected: F64) -> ScanMatch:
    """Match a scan among some walls, taken at a pose, on the map of a drive among others."""
    truth = circuit()
    walls = WallMap.of(judged_scans(recorded(truth, walls=mapped)), truth, np.zeros((3, 3)))
    (item,) = recorded(Trajectory(np.zeros(1), at[None], "scan"), walls=seen, seed=1)
    scan = next(scan_hits([item]))
    assert scan is not None
    return walls.match([scan], expected[None], np.diag(SIGMAS**2))


@pytest.mark.parametrize("number", [0, 40, 100])
@pytest.mark.parametrize("off", [(0.05, -0.04, 0.02), (-0.03, 0.06, -0.015), (0.0, 0.0, 0.0)])
def test_a_known_offset_is_recovered(off: tuple[float, float, float], number: int) -> None:
    at = circuit().poses[number]
    found = match(ROOM, ROOM, at, at + off)
    assert found.fits
    assert np.hypot(*(row_of(found.pose) - at)[:2]) < 0.012
    assert abs(wrap_angle(found.pose.yaw_rad - at[2])) < 0.004
    # It says how sure it is.
    assert np.all(np.sqrt(np.diag(found.covariance)) < (0.012, 0.012, 0.004))


def test_a_scan_of_another_place_does_not_fit() -> None:
    at = circuit().poses[40]
    hall = np.array(box(-1.0, -0.7, 11.4, 7.9) + box(3.0, 1.0, 0.6, 0.6) + box(6.5, 4.5, 0.5, 1.0))
    assert not match(ROOM, hall, at, at).fits


def test_what_no_wall_shows_stays_as_expected() -> None:
    """Along a corridor without an end."""
    walls = np.array([(-50.0, -1.0, 90.0, -1.0), (90.0, 7.0, -50.0, 7.0)])
    at = circuit().poses[0]
    found = match(walls, walls, at, at + np.array((0.04, 0.05, 0.0)))
    assert found.fits
    assert found.pose.x - at[0] == pytest.approx(0.04, abs=0.015)
    assert found.pose.y - at[1] == pytest.approx(0.0, abs=0.01)
    along_m, across_m, _ = np.sqrt(np.diag(found.covariance))
    assert along_m > 3.0 * across_m
