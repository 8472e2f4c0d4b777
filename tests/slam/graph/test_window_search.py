"""The search of a whole window finds what looking at every pose of it finds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import F64, U8, wrap_angle
from slamfusion.slam.graph.closure_search import (
    BESIDE_M,
    BESIDE_RAD,
    LEAST_REACH_CELLS,
    YAW_CELLS,
    Window,
    WindowMatch,
    search_window,
)
from slamfusion.slam.graph.submap import Pyramid
from tests.support.examples import examples


@dataclass(frozen=True)
class Case:
    """A field, a scan, and the window where it is looked for.

    Attributes:
        field: (H, W) uint8.
        corner: (2,) of its first cell, cells.
        points: (P, 2) metres.
        centre: (3,) metres and radians.
        half_m: half the window's side.
        half_rad: half its angle.
        resolution: metres per cell.
    """

    field: U8
    corner: F64
    points: F64
    centre: F64
    half_m: float
    half_rad: float
    resolution: float

    def search(
        self, device: ComputeDevice, least: float = 0.0, beside: F64 | None = None
    ) -> WindowMatch | None:
        """Search it."""
        return search_window(
            device,
            Pyramid(device, self.field, self.corner),
            self.points,
            Window(self.centre, self.half_m, self.half_rad),
            self.resolution,
            least,
            beside,
        )

    def poses(self) -> F64:
        """Return (N, 3) every pose of the search set."""
        far = max(np.hypot(*self.points.T).max() / self.resolution, LEAST_REACH_CELLS)
        half = math.ceil(self.half_m / self.resolution)
        shifts = np.arange(-half, half + 1) * self.resolution
        count = math.ceil(self.half_rad * far / YAW_CELLS)
        turns = np.linspace(-self.half_rad, self.half_rad, 2 * count + 1) if count else np.zeros(1)
        axes = np.meshgrid(shifts, shifts, turns, indexing="ij")
        return self.centre + np.stack([axis.ravel() for axis in axes], axis=-1)

    def scores(self, poses: F64) -> F64:
        """Return (N,) the mean of the field under the hits, 0 to 1, beyond the field 0."""
        height, width = self.field.shape
        cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x = poses[:, :1] + cos * self.points[:, 0] - sin * self.points[:, 1]
        y = poses[:, 1:2] + sin * self.points[:, 0] + cos * self.points[:, 1]
        col = np.floor(x / self.resolution - self.corner[0]).astype(np.int64)
        row = np.floor(y / self.resolution - self.corner[1]).astype(np.int64)
        inside = (col >= 0) & (row >= 0) & (col < width) & (row < height)
        values = self.field[np.clip(row, 0, height - 1), np.clip(col, 0, width - 1)]
        return np.asarray(np.where(inside, values, 0).sum(axis=1) / (255.0 * len(self.points)))


def is_elsewhere(poses: F64, beside: F64) -> npt.NDArray[np.bool_]:
    """Return of poses (N, 3) whether each is another place than one pose."""
    away = np.hypot(poses[:, 0] - beside[0], poses[:, 1] - beside[1])
    turns = np.array([abs(wrap_angle(float(yaw - beside[2]))) for yaw in poses[:, 2]])
    return np.asarray((away >= BESIDE_M) | (turns >= BESIDE_RAD))


def random_case(seed: int, half_cells: float, half_rad: float, points: int) -> Case:
    """A field of a few walls and some dirt, and points anywhere about it."""
    rng = np.random.default_rng(seed)
    height, width = (int(side) for side in rng.integers(1, 50, 2))
    field = rng.integers(0, 256, (height, width)) * (rng.random((height, width)) < 0.15)
    field[rng.integers(height)] = rng.integers(256)
    field[:, rng.integers(width)] = rng.integers(256)
    cell = float(rng.choice([0.05, 0.1, 0.3]))
    corner = rng.integers(-60, 20, 2).astype(np.float64)
    middle = (corner + np.array([width, height]) * rng.random(2)) * cell
    return Case(
        field.astype(np.uint8),
        corner,
        rng.uniform(-30.0, 30.0, (points, 2)) * cell * rng.choice([0.1, 1.0]),
        np.array([*middle, rng.uniform(-7.0, 7.0)]) + rng.normal(0.0, 0.3, 3),
        half_cells * cell,
        half_rad,
        cell,
    )


CASES = st.builds(
    random_case,
    seed=st.integers(0, 2**32 - 1),
    half_cells=st.sampled_from((0.0, 0.4, 1.0, 3.7, 9.0, 24.3)),
    half_rad=st.sampled_from((0.0, 0.01, 0.2)),
    points=st.integers(1, 40),
)


@given(case=CASES)
@settings(max_examples=examples(120), deadline=None)
def test_finds_the_best_of_every_pose(device: ComputeDevice, case: Case):
    everything = case.scores(case.poses())
    found = case.search(device)
    if everything.max() == 0.0:
        assert found is None
        return
    assert found.score == pytest.approx(everything.max(), abs=1e-12)
    assert case.scores(found.pose[None])[0] == pytest.approx(found.score, abs=1e-12)
    away = np.abs(case.poses() - found.pose)
    assert away.max(axis=1).min() < 1e-9  # it is one of the search set


@given(case=CASES, share=st.floats(0.5, 1.5))
@settings(max_examples=examples(60), deadline=None)
def test_nothing_at_or_below_the_least_is_found(device: ComputeDevice, case: Case, share: float):
    best = float(case.scores(case.poses()).max())
    found = case.search(device, least=share * best)
    if share * best < best - 1e-9:
        assert found.score == pytest.approx(best, abs=1e-12)
    elif share * best > best - 1e-12:
        assert found is None


BESIDE_CASES = st.builds(
    random_case,
    seed=st.integers(0, 2**32 - 1),
    half_cells=st.sampled_from((0.0, 1.0, 5.7, 16.0)),
    half_rad=st.sampled_from((0.0, 0.3, 1.0)),
    points=st.integers(1, 12),
)


@given(case=BESIDE_CASES, seed=st.integers(0, 2**32 - 1), turns=st.sampled_from((0, 1, -2)))
@settings(max_examples=examples(120), deadline=None)
def test_finds_the_best_of_every_other_place(
    device: ComputeDevice, case: Case, seed: int, turns: int
):
    """What lies beside one pose is passed over; whole turns of its heading change nothing."""
    poses = case.poses()
    chosen = np.random.default_rng(seed).integers(len(poses))
    # Off the search set's lattice, so that no pose lies on the limit.
    beside = poses[chosen] + (0.00123, 0.00217, 0.00031 + turns * math.tau)
    allowed = poses[is_elsewhere(poses, beside)]
    found = case.search(device, beside=beside)
    best = case.scores(allowed).max() if len(allowed) else 0.0
    if best == 0.0:
        assert found is None
        return
    assert found.score == pytest.approx(best, abs=1e-12)
    assert case.scores(found.pose[None])[0] == pytest.approx(found.score, abs=1e-12)
    assert is_elsewhere(found.pose[None], beside).all()
    assert np.abs(allowed - found.pose).max(axis=1).min() < 1e-9
