"""Submaps hold the mean of what their scans told, and answer as they did when they are finished."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import F64, Pose2
from slamfusion.slam.common.matcher import ScanOnTiles
from slamfusion.slam.graph.submap import Pyramid, Submap
from tests.slam.drives import CELL_M, scan_at, true_poses
from tests.support.examples import examples

SMEAR_M = 0.1
LASER = np.zeros(2)


def scans_of_the_flat(noise_m: float = 0.0, every: int = 20) -> list[tuple[F64, Pose2]]:
    """Return the hits of some places of the flat, and where the robot was."""
    rng = np.random.default_rng(2)
    found = []
    for pose in true_poses(120)[::every]:
        points = scan_at(pose, 0.0).points()[::3]
        found.append((points + rng.normal(0.0, noise_m, points.shape), pose))
    return found


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
    assert submap.memory_bytes < 0.3 * bytes_before
    after = submap.walls()
    assert after.corner.tolist() == before.corner.tolist()
    assert after.resolution == before.resolution == CELL_M
    np.testing.assert_array_equal(ScanOnTiles(device, after, points, 120).scores(poses), scores)
    submap.forget_dense()
    assert submap.memory_bytes < 0.3 * bytes_before


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
        assert found.shape == (height + pad, width + pad)
        whole = np.pad(values, ((pad, window), (pad, window)))
        squares = np.lib.stride_tricks.sliding_window_view(whole, (window, window))
        wanted = squares.max(axis=(2, 3))[: height + pad, : width + pad]
        np.testing.assert_array_equal(found, wanted)
    assert pyramid.corner.tolist() == (corner - pad).tolist()
