"""gmapping: it knows where it is, each particle's map follows from its path, and it can go on."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.compute.hit_counts import percent_of_counts
from slamfusion.compute.layout import FULL_VISITS
from slamfusion.config import GmappingConfig
from slamfusion.config.slam import GMAPPING_PROFILES
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan
from slamfusion.json_values import plain
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import BLIND
from slamfusion.slam.gmapping.particles import ParticleMaps, beams_of
from slamfusion.slam.gmapping.slam import Gmapping
from tests.slam.drives import drive, scan_at, true_poses
from tests.slam.places import errors, feed
from tests.support.producers import unseeing
from tests.support.score_fields import score_field_of

pytestmark = pytest.mark.once

# What the tests run, whatever our own defaults are: few particles, and often a step.
SETTINGS: dict[str, Any] = {
    "profile": "published",
    "particles": 6,
    "linearUpdate": 0.4,
    "angularUpdate": 0.25,
    "match_every_scan": True,
    "climb_loss": 0.005,
}
# Resampled at every step at which the weights are not quite equal, and they are not evened out.
OFTEN: dict[str, Any] = {"resampleThreshold": 1.0, "linearUpdate": 0.15, "ogain": 0.2}


def config(**settings: Any) -> GmappingConfig:
    return GmappingConfig(**{**SETTINGS, **settings})


def run(device: ComputeDevice, scans: list[LogScan], seed: int = 0, **settings: Any) -> Gmapping:
    return feed(Gmapping(config(**settings), device, seed), scans)


def standing(count: int, step_s: float = 0.1) -> list[LogScan]:
    """Scans of a robot that stands."""
    pose = true_poses(1)[0]
    first = scan_at(pose, 0.0)
    scans = [replace(first, stamp_s=step_s * index) for index in range(count)]
    return [LogScan(scan, pose, index + 1) for index, scan in enumerate(scans)]


# -- settings --------------------------------------------------------------------------------------


def test_the_published_profile_maps_as_published(device: ComputeDevice):
    scans, truth = drive(120, turn_bias=0.01)
    slam = feed(Gmapping(GmappingConfig(profile="published"), device), scans)
    assert slam.health.filter_steps > 5
    assert len(slam.other_paths()) == 29
    last = scans[-1].odometry
    assert math.hypot(last.x - truth[-1].x, last.y - truth[-1].y) > 1.0
    assert errors(slam, truth)[0] < 0.4
    assert slam.series()[0].limit == 15.0


@pytest.mark.parametrize("count", [1, 2])
def test_a_filter_of_hardly_any_particles_works(device: ComputeDevice, count: int):
    scans, truth = drive(60, turn_bias=0.01)
    slam = run(device, scans, particles=count, **OFTEN)
    assert errors(slam, truth)[0] < 0.2
    assert len(slam.other_paths()) == count - 1
    assert (slam.health.resamplings > 0) == (count > 1)  # one alone is always effective
    assert 1.0 - 1e-9 <= slam.health.n_eff <= count + 1e-9


# -- where the robot is ----------------------------------------------------------------------------


@pytest.mark.parametrize(("expectation", "onward"), [("motion", 1.0), ("pose", 0.0)])
def test_what_is_expected_where_neither_odometry_nor_the_scan_tells(
    device: ComputeDevice, expectation: str, onward: float
):
    """The robot goes on by as much as it went between the last two scans, or it stands."""
    scans, truth = drive(30)
    slam = run(device, scans, odometry="none", expectation=expectation, linearUpdate=100.0)
    before, last = (slam.trajectory().pose(index) for index in (28, 29))
    (blind,) = unseeing(scans[-1:])
    found = slam.feed(replace(blind.scan, stamp_s=blind.scan.stamp_s + 0.1)).pose_map_base
    step = before.inverse().compose(last)
    wanted = last.compose(Pose2(*(onward * part for part in (step.x, step.y, step.yaw_rad))))
    assert (found.x, found.y) == pytest.approx((wanted.x, wanted.y), abs=1e-9)
    went = math.hypot(truth[29].x - truth[28].x, truth[29].y - truth[28].y)
    assert math.hypot(found.x - last.x, found.y - last.y) == pytest.approx(onward * went, abs=0.03)


# -- scans that tell nothing, or too little --------------------------------------------------------


def test_a_match_below_the_least_score_is_not_believed(device: ComputeDevice):
    """Nothing is ever good enough: the robot goes as the odometry says, errors and all."""
    scans, _ = drive(60, turn_bias=0.01)
    exact = {"srr": 0.0, "srt": 0.0, "str": 0.0, "stt": 0.0}
    slam = run(device, scans, minimumScore=1e5, **exact)
    found = slam.trajectory().poses
    wanted = np.array([(o.x, o.y) for o in (item.odometry or Pose2() for item in scans)])
    np.testing.assert_allclose(found[:, :2], wanted, atol=1e-9)
    steps = slam.health.filter_steps
    assert steps >= 5
    assert slam.health.rejected == 6 * steps
    assert plain(slam.health)["filter"]["rejected"] == 6 * steps
    believed = run(device, scans, minimumScore=0.0)
    assert believed.health.rejected == 0


# -- when the filter steps -------------------------------------------------------------------------


def test_scans_that_are_not_matched_are_told_as_such(device: ComputeDevice):
    scans, _ = drive(60)
    slam = Gmapping(config(match_every_scan=False, linearUpdate=1.0), device)
    steps = [slam.feed(item.scan, item.odometry) for item in scans]
    used = [step.used for step in steps]
    assert sum(used) == 1 + slam.health.filter_steps == slam.health.scans_used == 4
    reasons = {step.reason for step in steps if not step.used}
    assert reasons == {"the robot has not gone far enough since the last one"}
    assert {step.reason for step in steps if step.used} == {""}


def test_a_robot_that_stands_leaves_its_map_alone(device: ComputeDevice):
    """By the published gates, and where every scan is matched too: not a bit changes."""
    published = GMAPPING_PROFILES["published"]
    gates = {name: published[name] for name in ("linearUpdate", "angularUpdate", "temporalUpdate")}
    for count, match_every_scan in ((150, False), (40, True)):
        scans = standing(count)
        slam = feed(Gmapping(config(**gates, match_every_scan=match_every_scan), device), scans[:1])
        first = slam.grid()
        feed(slam, scans[1:])
        assert slam.grid().cells.tobytes() == first.cells.tobytes()
        assert slam.grid().origin == first.origin
        assert slam.health.filter_steps == 0
        assert len(slam.trajectory()) == count
        assert slam.trajectory().poses[-1] == pytest.approx(slam.trajectory().poses[0], abs=0.02)


@pytest.mark.parametrize(("every_s", "wanted"), [(0.99, 3), (-1.0, 0)])
def test_time_alone_makes_a_step_where_it_is_asked_to(
    device: ComputeDevice, every_s: float, wanted: int
):
    slam = run(device, standing(40), temporalUpdate=every_s, match_every_scan=False)
    assert slam.health.filter_steps == wanted
    assert slam.trajectory().poses[-1] == pytest.approx(slam.trajectory().poses[0], abs=0.05)


# -- particles and their maps ----------------------------------------------------------------------


def test_what_it_offers_beside_the_best_path(device: ComputeDevice):
    scans, truth = drive(60, turn_bias=0.01)
    slam = run(device, scans, **OFTEN)
    others = slam.other_paths()
    assert [len(path) for path in others] == [60] * 5
    for path in others:
        ends = path.poses[-1, :2] - (truth[-1].x, truth[-1].y)
        assert math.hypot(*ends) < 0.3
    (series,) = slam.series()
    assert (series.name, series.limit) == ("effective particles", 6.0)
    assert len(series.values) == slam.health.filter_steps
    assert ((series.values > 1.0 - 1e-9) & (series.values < 6.0 + 1e-9)).all()
    assert series.values[-1] == slam.health.n_eff
    record = plain(slam.health)["filter"]
    assert record["resamplings"] > 0
    assert min(record["tiles_owned"], record["tiles_shared"]) > 0
    assert math.isfinite(record["path_entropy"])


# -- what a beam draws -----------------------------------------------------------------------------


def reading(*ranges: float, range_max_m: float = 8.0) -> LaserScan:
    """A scan of up to three beams: ahead, to the left and back."""
    return LaserScan(0.0, np.array(ranges), 0.0, 0.5 * math.pi, 0.02, range_max_m)


def along(slam: Gmapping, beam: int, metres: float) -> int:
    """Return the cell of the map that a beam of the first scan passes at a distance."""
    grid = slam.grid()
    at = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])[beam : beam + 1] * metres + 0.01
    rows, cols = grid.cell_indices(at)
    if not (0 <= rows[0] < grid.height and 0 <= cols[0] < grid.width):
        return -1
    return int(grid.cells[rows[0], cols[0]])


def drawn(device: ComputeDevice, scan: LaserScan, **settings: Any) -> Gmapping:
    slam = Gmapping(config(**settings), device)
    slam.feed(scan, Pose2(0.01, 0.01, 0.0))
    return slam


def test_a_hit_is_a_wall_and_its_beam_is_free(device: ComputeDevice):
    slam = drawn(device, reading(2.0, 3.0, 7.0))
    for beam, metres in enumerate((2.0, 3.0, 7.0)):
        assert along(slam, beam, metres) == 100
        assert along(slam, beam, metres + 0.1) == -1
        for way in (0.3, 0.5 * metres, metres - 0.1):
            assert 0 <= along(slam, beam, way) <= 25


def test_beyond_max_urange_a_beam_clears_and_draws_no_wall(device: ComputeDevice):
    slam = drawn(device, reading(2.0, 6.0), maxUrange=4.0)
    assert along(slam, 0, 2.0) == 100
    assert along(slam, 1, 3.9) == 0
    assert along(slam, 1, 4.2) == -1
    assert along(slam, 1, 6.0) == -1
    assert (slam.grid().cells >= 65).sum() == 1


def test_beyond_max_range_a_beam_is_left_out(device: ComputeDevice):
    slam = drawn(device, reading(2.0, 6.0, 4.5), maxUrange=4.0, maxRange=5.0)
    assert along(slam, 0, 2.0) == 100
    assert along(slam, 1, 2.0) == -1  # reads 6 m: not believed at all
    assert along(slam, 2, 3.9) == 0  # reads 4.5 m: free as far as is used
    assert along(slam, 2, 4.2) == -1


@pytest.mark.parametrize("far", [np.inf, 8.0, 9.0])
def test_no_return_is_free_only_where_max_range_lies_beyond_the_laser(
    device: ComputeDevice, far: float
):
    scan = reading(2.0, far)
    assert along(drawn(device, scan), 1, 1.0) == -1
    clears = drawn(device, scan, maxRange=8.1, maxUrange=4.0)
    assert along(clears, 1, 3.9) == 0
    assert along(clears, 1, 4.2) == -1
    assert (clears.grid().cells >= 65).sum() == 1


@pytest.mark.parametrize("failed", [np.nan, 0.0, 0.01, -1.0])
def test_a_failed_reading_clears_nothing(device: ComputeDevice, failed: float):
    slam = drawn(device, reading(2.0, failed), maxRange=20.0, maxUrange=4.0)
    assert along(slam, 1, 1.0) == -1


def test_only_walls_that_may_be_used_are_matched(device: ComputeDevice):
    """Nothing within ``maxUrange``: the scan tells nothing."""
    slam = drawn(device, reading(6.0, 7.0), maxUrange=4.0)
    assert slam.health.skips.counts == {BLIND: 1}
    with pytest.raises(SlamFusionError, match="no map"):
        slam.grid()


# -- counts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("occ_thresh", [0.0, 0.1, 0.25, 0.6, 1.0])
def test_a_wall_is_what_was_hit_more_often_than_the_threshold(occ_thresh: float):
    """Of 20 visits; percents rise with the hits, and the map servers' limits tell them apart."""
    hits = np.arange(21, dtype=np.uint32)
    percent = percent_of_counts(hits, np.full_like(hits, 20), occ_thresh)
    assert (np.diff(percent.astype(int)) >= 0).all()
    for number, value in zip(hits.tolist(), percent.tolist(), strict=True):
        assert value >= 65 if number / 20 > occ_thresh else 0 <= value <= 25
    unseen = np.zeros((2, 3), dtype=np.uint32)
    assert percent_of_counts(unseen, unseen, occ_thresh).tolist() == [[-1] * 3] * 2


def counts_of(maps: ParticleMaps) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    counts = maps.tiles.cells("counts", 0)[0].astype(np.int64)
    return counts >> 16, counts & 0xFFFF


def test_counts_that_overflow_again_and_again_keep_the_map(device: ComputeDevice):
    """A robot that stands while 2000 beams cross the cell under it at every step.

    A cell holds 32768 visits, so they are halved several times in 60 steps. A place that was seen
    long ago, and by few beams, must not be forgotten, and free space must not become wall.
    """
    pose, elsewhere = (np.array([[x, 1.0, 0.0]]) for x in (1.2, 6.0))
    angles = np.linspace(-0.2, 0.2, 2000)
    ranges = (2.0 / np.cos(angles)).astype(np.float32)
    chosen, alone = config().chosen(), np.zeros(1, dtype=np.int64)
    maps = ParticleMaps(chosen, device, 1)
    scan = scan_at(Pose2(*elsewhere[0]), 0.0)
    maps.integrate(beams_of(scan, chosen), elsewhere, alone)
    first = maps.grid(0, "first")
    rows, cols = np.nonzero(first.cells >= 0)
    # Cells behind the wall that the many beams end at.
    centres = first.cell_centres(rows, cols)
    behind = centres[:, 0] > 3.5
    wanted = first.cells[rows, cols][behind]
    halvings = 0
    for index in range(60):
        scan = LaserScan(1.0 + index, ranges, -0.2, 0.4 / 1999, 0.02, 8.0)
        most = counts_of(maps)[1].max()
        maps.integrate(beams_of(scan, chosen), pose, alone)
        halvings += bool(counts_of(maps)[1].max() < most)
        assert (counts_of(maps)[0] <= counts_of(maps)[1]).all()
        assert counts_of(maps)[1].max() < FULL_VISITS
    assert halvings > 3
    grid = maps.grid(0, "last")
    at = grid.cell_indices(centres[behind])
    np.testing.assert_array_equal(grid.cells[at], wanted)
    assert (wanted >= 65).any()
    assert (wanted == 0).any()
    # The score field is what the counts say.
    counts, sums = (maps.tiles.cells(name, 0)[0] for name in ("counts", "sums"))
    window = maps.walls(0).window(*maps.tiles.used_box(0))
    field = device.download(window.cells)
    np.testing.assert_array_equal(score_field_of(counts, sums, maps.field_rule), field)
