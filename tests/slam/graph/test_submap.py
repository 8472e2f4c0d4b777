"""Submaps hold the mean of what their scans told, and answer as they did when they are finished."""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.compute.cell_means import LikelihoodRule
from slamfusion.compute.layout import BEAM_ONE
from slamfusion.geometry import Pose2
from slamfusion.slam.common.matcher import ScanOnTiles
from slamfusion.slam.graph.submap import (
    MEMORY,
    MOST_REACH,
    REACH_SIGMAS,
    UNSEEN_WALL,
    Pyramid,
    Submap,
    likelihood_rule,
)
from tests.slam.drives import CELL_M, scan_at, true_poses
from tests.support.examples import examples

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
SMEAR_M = 0.1
LASER = np.zeros(2)


def field_of(submap: Submap) -> tuple[I64, I64]:
    """Return a submap's field as one array, and column and row of its first cell."""
    values, first = submap._tiles.cells("field")
    return np.asarray(values, dtype=np.int64), first


def words_of_scan(
    points: F64, laser: F64, pose: Pose2, shape: tuple[int, int], first: I64, rule: LikelihoodRule
) -> F64:
    """Return (H, W) what a scan tells the cells, 0 to 255; NaN where it tells nothing."""
    told = np.full(shape, np.nan)
    # Positions count in 1/1024 cell.
    start, *hits = (
        np.floor(pose.transform(place) / CELL_M * BEAM_ONE) / BEAM_ONE - first
        for place in (laser, *points)
    )
    for hit in hits:
        way = start - hit
        longest = float(np.abs(way).max())
        for number in range(1, math.floor(longest) + 1):
            col, row = np.floor(hit + way * (number / longest)).astype(int)
            told[row, col] = np.fmax(told[row, col], 0.0)
    around = range(-rule.reach, rule.reach + 1)
    for hit in hits:
        middle = np.floor(hit).astype(int)
        for down, right in itertools.product(around, around):
            col, row = middle[0] + right, middle[1] + down
            squared = ((hit - (col + 0.5, row + 0.5)) ** 2).sum()
            entry = min(255, int(squared * BEAM_ONE**2) >> rule.shift)
            told[row, col] = np.fmax(told[row, col], float(rule.table[entry]))
    return told


def mean_of_scans(told: list[F64], memory: int) -> F64:
    """Return the mean of what scans told, the oldest forgotten; NaN where none told anything."""
    mean, seen = np.full(told[0].shape, np.nan), np.zeros(told[0].shape)
    for word in told:
        tells = ~np.isnan(word)
        seen = np.where(tells, np.minimum(seen + 1, memory), seen)
        start = np.where(np.isnan(mean), 0.0, mean)
        with np.errstate(invalid="ignore"):
            mean = np.where(tells, start + (word - start) / np.maximum(seen, 1), mean)
    return mean


def scans_of_the_flat(noise_m: float = 0.0, every: int = 20) -> list[tuple[F64, Pose2]]:
    """Return the hits of some places of the flat, and where the robot was."""
    rng = np.random.default_rng(2)
    found = []
    for pose in true_poses(120)[::every]:
        points = scan_at(pose, 0.0).points()[::3]
        found.append((points + rng.normal(0.0, noise_m, points.shape), pose))
    return found


# -- the field -------------------------------------------------------------------------------------


@pytest.mark.parametrize("smear_m", [0.1, 0.06])
def test_field_is_the_mean_of_what_scans_told(device: ComputeDevice, smear_m: float):
    submap = Submap(device, 0, CELL_M, smear_m)
    scans = scans_of_the_flat(0.02)
    for points, pose in scans:
        submap.insert(points, LASER, pose)
    found, first = field_of(submap)
    rule = likelihood_rule(smear_m / CELL_M)
    told = [words_of_scan(*(p, LASER, at), found.shape, first, rule) for p, at in scans]
    wanted = mean_of_scans(told, MEMORY)
    seen = ~np.isnan(wanted)
    assert 5000 < seen.sum() < seen.size
    # Beams that pass a cell's very corner may count for its neighbour.
    right = np.where(seen, np.abs(found - np.nan_to_num(wanted)) < 2.0, found == UNSEEN_WALL)
    assert np.count_nonzero(~right) <= 3
    assert found[seen].max() > 200
    assert submap.scans == len(scans)


def test_what_a_cell_was_told_long_ago_is_forgotten(device: ComputeDevice):
    """A wall is seen as often as a cell remembers; then it is gone, and beams go through."""
    submap = Submap(device, 0, CELL_M, SMEAR_M)
    wall, past = np.array([[2.025, 0.025]]), np.array([[4.025, 0.025]])
    for _ in range(MEMORY):
        submap.insert(wall, np.array([0.025, 0.025]), Pose2())
    values = []
    for _ in range(3 * MEMORY):
        submap.insert(past, np.array([0.025, 0.025]), Pose2())
        field, first = field_of(submap)
        values.append(int(field[-first[1], 40 - first[0]]))
    wanted = 255.0 * (1.0 - 1.0 / MEMORY) ** np.arange(1, 3 * MEMORY + 1)
    assert np.abs(np.array(values) - wanted).max() < 2.0
    assert values[-1] < 15


def test_walls_do_not_grow_with_the_number_of_scans(device: ComputeDevice):
    """A wall across the view, its readings noisy by 2 cm: as wide after 200 scans as after 10."""
    rng = np.random.default_rng(1)
    submap = Submap(device, 0, CELL_M, SMEAR_M)
    across = np.linspace(-1.0, 1.0, 81)
    widths, peaks = {}, {}
    for number in range(1, 201):
        points = np.column_stack((2.0 + rng.normal(0.0, 0.02, 81), across))
        submap.insert(points, LASER, Pose2())
        if number in {10, 50, 200}:
            field, first = field_of(submap)
            middle = field[-first[1] - 10 : 10 - first[1]]
            widths[number] = (middle >= 128).sum(axis=1).mean()
            peaks[number] = middle.max(axis=1).mean()
    # Half of the likelihood lies 1.18 deviations off: 2.4 cells to both sides.
    assert all(3.0 <= width <= 6.0 for width in widths.values())
    assert widths[200] <= widths[10] + 0.5
    assert peaks[200] > peaks[10] - 20


def test_twins_write_the_same_field(device: ComputeDevice):
    ours, twin = (Submap(place, 0, CELL_M, SMEAR_M) for place in (device, NumpyDevice()))
    for points, pose in scans_of_the_flat(0.02):
        for submap in (ours, twin):
            submap.insert(points, LASER, pose)
    (field, first), (other, also) = field_of(ours), field_of(twin)
    assert first.tolist() == also.tolist()
    np.testing.assert_array_equal(field, other)
    assert ours.memory_bytes == twin.memory_bytes


# -- the likelihood of a hit -----------------------------------------------------------------------


@given(deviation=st.floats(0.1, 40.0))
@settings(max_examples=examples(100), deadline=None)
def test_rule_is_the_gaussian_of_the_deviation(deviation: float):
    rule = likelihood_rule(deviation)
    assert rule.reach == min(MOST_REACH, max(1, math.ceil(REACH_SIGMAS * deviation)))
    assert rule.most == MEMORY
    assert rule.table.shape == (256,)
    assert rule.table[0] == 255
    assert (np.diff(rule.table.astype(int)) <= 0).all()
    # The farthest cell that a hit tells has an entry of its own or the last one.
    farthest = 2 * ((2 * rule.reach + 1) * BEAM_ONE // 2) ** 2
    assert farthest >> rule.shift <= 256
    # Each entry is the likelihood where its squared distances begin.
    cells = np.linspace(0.0, rule.reach + 0.5, 50)
    entries = np.minimum((cells * BEAM_ONE).astype(np.int64) ** 2 >> rule.shift, 255)
    steps = np.stack((entries, entries + 1)) * 2.0**rule.shift / BEAM_ONE**2
    most, least = 255.0 * np.exp(-0.5 * steps / deviation**2)
    told = rule.table[entries]
    assert (told <= most + 0.5).all()
    assert (told >= least - 0.5).all()
    if deviation >= 2.0:
        assert (most - least).max() < 16.0


# -- a finished submap -----------------------------------------------------------------------------


def test_finishing_lets_go_of_memory_and_answers_as_before(device: ComputeDevice):
    submap = Submap(device, 0, CELL_M, SMEAR_M)
    for points, pose in scans_of_the_flat(0.02):
        submap.insert(points, LASER, pose)
    points = scan_at(true_poses(120)[50], 0.0).points()
    poses = np.random.default_rng(5).normal((3.0, 1.0, 0.0), 0.5, (40, 3))
    scores = ScanOnTiles(device, submap.walls(), points, 120).scores(poses)
    before, bytes_before = submap.walls(), submap.memory_bytes
    submap.finish()
    after = submap.walls()
    np.testing.assert_array_equal(device.download(after.field), device.download(before.field))
    np.testing.assert_array_equal(device.download(after.pages), device.download(before.pages))
    assert after.corner.tolist() == before.corner.tolist()
    assert after.resolution == before.resolution == CELL_M
    np.testing.assert_array_equal(ScanOnTiles(device, after, points, 120).scores(poses), scores)
    assert submap.memory_bytes < 0.3 * bytes_before


def test_pyramid_is_made_once_of_what_has_been_seen(device: ComputeDevice):
    submap = Submap(device, 0, CELL_M, SMEAR_M)
    for points, pose in scans_of_the_flat(0.02):
        submap.insert(points, LASER, pose)
    submap.finish()
    bare = submap.memory_bytes
    pyramid = submap.pyramid()
    assert submap.pyramid() is pyramid
    assert submap.memory_bytes > bare
    field, first = field_of(submap)
    pad = Pyramid.windows[0] - 1
    finest = device.download(pyramid.fields[-1])[0]
    np.testing.assert_array_equal(pyramid.corner, first - pad)
    np.testing.assert_array_equal(finest[pad:, pad:], np.where(field == UNSEEN_WALL, 0, field))
    assert not finest[:pad].any()
    assert not finest[:, :pad].any()


@given(seed=st.integers(0, 2**32 - 1), height=st.integers(1, 70), width=st.integers(1, 70))
@settings(max_examples=examples(25), deadline=None)
def test_pyramid_fields_are_the_greatest_of_their_squares(
    device: ComputeDevice, seed: int, height: int, width: int
):
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 256, (height, width)) * (rng.random((height, width)) < 0.1)
    corner = rng.integers(-99, 99, 2).astype(np.float64)
    pyramid = Pyramid(device, values.astype(np.uint8), corner)
    pad = Pyramid.windows[0] - 1
    assert Pyramid.windows == tuple(sorted(Pyramid.windows, reverse=True))
    assert Pyramid.windows[-1] == 1
    for window, handle in zip(Pyramid.windows, pyramid.fields, strict=True):
        found = device.download(handle)
        assert found.dtype == np.uint8
        # Every square that touches the field starts within the padded one.
        assert found.shape == (1, height + pad, width + pad)
        whole = np.pad(values, ((pad, window), (pad, window)))
        squares = np.lib.stride_tricks.sliding_window_view(whole, (window, window))
        wanted = squares.max(axis=(2, 3))[: height + pad, : width + pad]
        np.testing.assert_array_equal(found[0], wanted)
    assert pyramid.corner.tolist() == (corner - pad).tolist()


# -- far away --------------------------------------------------------------------------------------
