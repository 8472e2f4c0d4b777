"""Rays meet what stands in their way: nothing before it, nothing through it, on every device."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.geometry import F32
from tests.support.examples import examples

TWIN = NumpyDevice()

SEEDS = st.integers(0, 2**32 - 1)


def drawn(*rows: str) -> npt.NDArray[np.uint8]:
    """Cells from a drawing, the top row last: . open, # wall, o glass."""
    return np.array([[".#o".index(cell) for cell in row] for row in reversed(rows)], np.uint8)


def rays_of(*rays: tuple[float, float, float]) -> F32:
    """Rays from x, y in cells and a direction in degrees."""
    table = np.array(rays, dtype=np.float64)
    angles = np.radians(table[:, 2])
    return np.column_stack((table[:, :2], np.cos(angles), np.sin(angles))).astype(np.float32)


def random_case(seed: int, rays: int = 40) -> tuple[npt.NDArray[np.uint8], F32]:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 13, 2))
    cells = rng.choice(3, shape, p=(0.8, 0.13, 0.07)).astype(np.uint8)
    places = rng.uniform(-2.0, 2.0, (rays, 2)) + rng.uniform(0.0, 1.0, (rays, 2)) * shape[::-1]
    angles = rng.uniform(-math.pi, math.pi, rays)
    return cells, np.column_stack((places, np.cos(angles), np.sin(angles))).astype(np.float32)


def slab_distance(ray: npt.NDArray[np.float64], row: int, col: int) -> float:
    """Distance along a ray to the square of one cell, infinite when it is missed."""
    near, far = 0.0, math.inf
    for place, way, low in ((ray[0], ray[2], col), (ray[1], ray[3], row)):
        if way == 0.0:
            if not low <= place < low + 1:
                return math.inf
            continue
        ends = sorted(((low - place) / way, (low + 1 - place) / way))
        near, far = max(near, ends[0]), min(far, ends[1])
    return near if near < far else math.inf


@given(seed=SEEDS)
@settings(max_examples=examples(60), deadline=None)
def test_distance_is_that_of_the_nearest_cell_in_the_way(seed: int):
    cells, rays = random_case(seed)
    hits = TWIN.cast_rays(cells, rays, 1000.0)
    for ray, hit in zip(rays.astype(np.float64), hits, strict=True):
        to_wall = [slab_distance(ray, int(r), int(c)) for r, c in np.argwhere(cells == 1)]
        to_glass = [slab_distance(ray, int(r), int(c)) for r, c in np.argwhere(cells == 2)]
        wall, glass = min(to_wall, default=math.inf), min(to_glass, default=math.inf)
        assert hit[0] == pytest.approx(min(wall, glass), abs=1e-4)
        assert hit[3] == pytest.approx(wall, abs=1e-4)
        if math.isinf(hit[0]):
            assert hit[1] == 0
        elif abs(wall - glass) > 1e-3:
            assert hit[1] == (1 if wall < glass else 2)


def test_hand_computed_hits(device: ComputeDevice):
    cells = drawn("#####", "#..o#", "#...#", "#####")
    rays = rays_of((1.5, 1.5, 0), (1.5, 1.5, 180), (1.5, 1.5, 90), (1.5, 2.5, 0), (1.5, 1.5, 30))
    hits = device.cast_rays(device.upload(cells), rays, 100.0)
    cosine = math.cos(math.radians(30.0))
    wanted = [
        (2.5, 1, 1, 2.5),
        (0.5, 1, 1, 0.5),
        (1.5, 1, 1, 1.5),
        (1.5, 2, 1, 2.5),
        (1.5 / cosine, 2, cosine, 2.5 / cosine),
    ]
    np.testing.assert_allclose(hits, wanted, rtol=1e-5)


def test_reach_start_in_a_wall_and_the_outside(device: ComputeDevice):
    cells = drawn("...", ".#.", "...")
    rays = rays_of((1.5, 1.5, 30), (-7.0, 1.5, 0), (-7.0, 1.5, 180), (0.5, 0.5, 0), (-7.0, 9.0, 90))
    hits = device.cast_rays(device.upload(cells), rays, 8.0)
    assert hits[0].tolist() == [0.0, 1.0, 1.0, 0.0]
    assert hits[1].tolist() == [8.0, 1.0, 1.0, 8.0]
    assert np.isinf(hits[2:, [0, 3]]).all()
    assert not hits[2:, 1:3].any()
    short = device.cast_rays(device.upload(cells), rays, 7.9)
    assert np.isinf(short[1, 0])


def test_rays_along_the_edges_of_cells(device: ComputeDevice):
    cells = drawn("...#", "....", "....")
    rays = rays_of((0.0, 2.0, 0), (0.0, 1.0, 0), (3.0, 0.0, 90), (2.0, 0.0, 90))
    hits = device.cast_rays(device.upload(cells), rays, 100.0)
    # A cell owns its lower and left edge.
    assert hits[:, 0].tolist() == [3.0, math.inf, 2.0, math.inf]


def test_no_ray_gives_no_hit(device: ComputeDevice):
    empty = np.empty((0, 4), dtype=np.float32)
    assert device.cast_rays(device.upload(drawn("#")), empty, 5.0).shape == (0, 4)
