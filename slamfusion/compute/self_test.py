"""Run every operation of a backend on small random input against its NumPy twin.

``slamfusion doctor`` runs this in about a second. The kernel tests run the same checks over many
shapes, and one of them holds that every operation of ``Backend`` has a check here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.compute import hit_map_reference, reference, slam_reference
from slamfusion.compute.backend import Backend, NumpyBackend
from slamfusion.errors import DeviceError

__all__ = ["CHECKS", "Sample", "differences", "self_test"]

Arrays: TypeAlias = list[npt.NDArray[Any]]
Check: TypeAlias = Callable[[Backend, "Sample"], Arrays]

# Kernels that sum float32 where their twin sums float64 may differ by this share of the largest
# term of a row; all others not at all.
RELATIVE = 1e-4
FLAT_FILL = 7
BASE = 64


@dataclass(frozen=True)
class Sample:
    """Random input of one size; equal fields make equal input.

    Attributes:
        shape: rows and columns.
        seed: of every random number.
        known_share: of the cells; 0 makes a grid of unknown cells only.
        away: cells that poses shift everything by; far more than the shape leaves no overlap.
    """

    shape: tuple[int, int]
    seed: int = 0
    known_share: float = 0.7
    away: float = 0.0

    @property
    def rng(self) -> np.random.Generator:
        """A generator that starts anew at each use."""
        return np.random.default_rng(self.seed)

    def grids(self, count: int) -> list[npt.NDArray[np.int8]]:
        """Return trinary grids (H, W) int8."""
        share = (1.0 - self.known_share, 0.8 * self.known_share, 0.2 * self.known_share)
        values = np.array([-1, 0, 1], dtype=np.int8)
        stack = self.rng.choice(values, (count, *self.shape), p=share)
        return list(stack)

    def percents(self, count: int) -> list[npt.NDArray[np.int8]]:
        """Return grids of occupancy in percent (H, W) int8, -1 unknown."""
        percent = self.rng.integers(0, 101, (count, *self.shape)).astype(np.int8)
        stack = np.stack(self.grids(count))
        return list(np.where(stack < 0, stack, percent))

    @cached_property
    def cells(self) -> npt.NDArray[np.int8]:
        """(H, W) int8 trinary."""
        return self.grids(1)[0]

    @cached_property
    def solid(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8, 1 where occupied."""
        solid: npt.NDArray[np.uint8] = (self.cells == 1).astype(np.uint8)
        return solid

    @cached_property
    def walls(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8, 0 or 1."""
        return reference.surface_walls(self.cells, self.solid)

    @cached_property
    def distance2(self) -> npt.NDArray[np.uint16]:
        """(H, W) uint16."""
        return reference.distance_squared(self.walls)

    @cached_property
    def field(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8."""
        field: npt.NDArray[np.uint8] = self.rng.integers(0, 256, self.shape).astype(np.uint8)
        return field

    @cached_property
    def free(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8, 1 where free."""
        free: npt.NDArray[np.uint8] = (self.cells == 0).astype(np.uint8)
        return free

    @cached_property
    def motions(self) -> npt.NDArray[np.float64]:
        """(3, 3) x, y in cells and yaw."""
        size = max(self.shape)
        scale = np.array([size, size, 6.0])
        motions: npt.NDArray[np.float64] = self.rng.uniform(-0.5, 0.5, (3, 3)) * scale
        motions[:, :2] += self.away
        return motions

    def points(self, count: int) -> npt.NDArray[np.int32]:
        """Return cell centres (N, 2) int32 in half cells, x and y."""
        rows, cols = self.rng.integers(0, self.shape, (count, 2)).T
        return (2 * np.stack((cols, rows), axis=1) + 1).astype(np.int32)


def self_test(backend: Backend) -> list[tuple[str, bool, str]]:
    """Check every operation once.

    Returns:
        (operation, passed, what was found) each.
    """
    sample = Sample((33, 70), seed=1)
    results = []
    for name in CHECKS:
        try:
            found = differences(name, backend, sample)
        except DeviceError as error:
            found = str(error)
        results.append((name, not found, found or "equals its NumPy twin"))
    return results


def differences(name: str, backend: Backend, sample: Sample) -> str:
    """Return how an operation differs from its twin on a sample; empty where it does not."""
    found = CHECKS[name](backend, sample)
    wanted = CHECKS[name](NumpyBackend(), sample)
    for n, (own, twin) in enumerate(zip(found, wanted, strict=True)):
        if own.shape != twin.shape or own.dtype != twin.dtype:
            return f"output {n} is {own.dtype} {own.shape}, the twin's {twin.dtype} {twin.shape}"
        if not own.size:
            continue
        gap = np.abs(own.astype(np.float64) - twin.astype(np.float64))
        allowed = np.zeros_like(gap)
        if twin.dtype.kind == "f":
            allowed += RELATIVE * np.maximum(1.0, np.abs(twin).max(axis=-1, keepdims=True))
        wrong = int(np.count_nonzero(~(gap <= allowed)))
        if wrong:
            return f"output {n}: {wrong} of {gap.size} values differ, by up to {gap.max():g}"
    return ""


# -- one check for each operation; each returns what the operation gives -------------------------


def _fetch(backend: Backend, handles: Iterable[Any]) -> Arrays:
    """Download results."""
    return [backend.download(handle) for handle in handles]


def _solid_walls(backend: Backend, sample: Sample) -> Arrays:
    return _fetch(backend, [backend.solid_walls(backend.upload(sample.cells))])


def _surface_walls(backend: Backend, sample: Sample) -> Arrays:
    cells, solid = backend.upload(sample.cells), backend.upload(sample.solid)
    return _fetch(backend, [backend.surface_walls(cells, solid)])


def _shrink(backend: Backend, sample: Sample) -> Arrays:
    walls, cells = backend.upload(sample.walls), backend.upload(sample.cells)
    return [a for step in (1, 7) for a in _fetch(backend, backend.shrink(walls, cells, step))]


def _distance_squared(backend: Backend, sample: Sample) -> Arrays:
    walls = backend.upload(sample.walls)
    reaches = (reference.DISTANCE_MAX, 24, 1)
    return _fetch(backend, [backend.distance_squared(walls, reach) for reach in reaches])


def _score_field(backend: Backend, sample: Sample) -> Arrays:
    d2 = np.arange(reference.DISTANCE2_MAX + 1)
    hit = np.rint(191 * np.exp(-d2 / 18.0)).astype(np.uint16)
    miss = np.minimum(d2, BASE).astype(np.uint16)
    share = backend.upload(sample.field)
    field = backend.score_field(backend.upload(sample.distance2), share, hit, miss, BASE)
    return _fetch(backend, [field])


def _max_window(backend: Backend, sample: Sample) -> Arrays:
    field = backend.upload(sample.field)
    return _fetch(
        backend,
        [
            backend.max_window(field, window, along_rows=along_rows, fill=BASE)
            for window in (1, 2, 5, 40)
            for along_rows in (True, False)
        ],
    )


def _warp(backend: Backend, sample: Sample) -> Arrays:
    poses = reference.fixed_poses(sample.motions)
    return _fetch(backend, [backend.warp(backend.upload(sample.cells), poses, (19, 23), -1)])


def _confusion(backend: Backend, sample: Sample) -> Arrays:
    a, b = (backend.upload(grid) for grid in sample.grids(2))
    return [backend.confusion(a, b)]


def _squared_error(backend: Backend, sample: Sample) -> Arrays:
    whole, other = sample.grids(2)
    a, b = backend.upload(whole), backend.upload(other[: -(-len(other) // 2)])
    poses = reference.fixed_poses(sample.motions)
    return [backend.squared_error(a, b, poses, stride) for stride in (1, 3)]


def _correlate(backend: Backend, sample: Sample) -> Arrays:
    height, width = 9, 64
    planes = sample.rng.integers(0, 16, (3, sample.shape[0] + height, sample.shape[1] + width))
    fields = planes.astype(np.uint8)
    rows, cols = sample.rng.integers(0, sample.shape, (3, 37, 2)).transpose(2, 0, 1)
    offsets = (rows * fields.shape[2] + cols).astype(np.int32)
    shifts = (height, width)
    pairs = ((fields, offsets), (fields[:1], offsets), (fields, offsets[:1]))
    return _fetch(backend, [backend.correlate(backend.upload(f), o, shifts) for f, o in pairs])


def _polyphase(backend: Backend, sample: Sample) -> Arrays:
    field = backend.upload(sample.field)
    height, width = sample.shape
    corners = ((0, 0), (-3, 2), (height + 5, -width - 40))
    return _fetch(
        backend, [backend.polyphase(field, corner, 4, (7, 11), FLAT_FILL) for corner in corners]
    )


def _bound_blocks(backend: Backend, sample: Sample) -> Arrays:
    height, width = sample.shape
    fields = sample.rng.integers(0, 256, (2, height, width)).astype(np.uint8)
    starts = sample.rng.integers(-5, max(sample.shape) + 5, (2, 2, 29)).astype(np.int32)
    classes = sample.rng.integers(0, 2, 29).astype(np.uint8)
    shifts = sample.rng.integers(-5, 5, (13, 2)) + round(sample.away)
    groups = sample.rng.integers(0, 2, (13, 1))
    blocks = np.concatenate((groups, shifts), axis=1).astype(np.int32)
    lent = backend.upload(starts), backend.upload(fields)
    bounds = backend.bound_blocks(blocks, lent[0], classes, lent[1], FLAT_FILL)
    least = int(np.median(bounds))
    return [
        bounds,
        backend.bound_blocks(blocks, lent[0], classes, lent[1], FLAT_FILL, least=least),
    ]


def _tile_peaks(backend: Backend, sample: Sample) -> Arrays:
    shape = (2, 2, sample.shape[0], sample.shape[1] + 3)
    both = sample.rng.integers(0, 9, shape).astype(np.int32)
    forward, backward = backend.upload(both[0]), backend.upload(both[1])
    return list(backend.tile_peaks(forward, backward, sample.shape[1], 8))


def _pose_counts(backend: Backend, sample: Sample) -> Arrays:
    lent = [backend.upload(a) for a in (sample.field, sample.distance2, sample.free)]
    poses = reference.fixed_poses(sample.motions)
    return [
        backend.pose_counts(sample.points(count), poses, *lent, base=BASE, near2=9, far2=16)
        for count in (1, 150)
    ]


def _look_up(backend: Backend, sample: Sample) -> Arrays:
    distance2 = backend.upload(sample.distance2)
    return [backend.download(backend.look_up(distance2, reference.DISTANCE_TABLE))]


def _refine_terms(backend: Backend, sample: Sample) -> Arrays:
    x, y, yaw = sample.motions.T
    poses = np.stack((np.cos(yaw), np.sin(yaw), x, y), axis=1).astype(np.float32)
    size = (sample.shape[1], sample.shape[0])
    points = backend.upload((sample.rng.random((150, 2)) * size).astype(np.float32))
    distance = backend.upload(reference.look_up(sample.distance2, reference.DISTANCE_TABLE))
    centre = (size[0] / 2.0, size[1] / 2.0)
    return [
        backend.refine_terms(points, poses, distance, scale=6.0, centre=centre, backward=backward)
        for backward in (False, True)
    ]


def _flat(votes: Iterable[reference.Votes]) -> Arrays:
    """Return the parts of votes as arrays."""
    return [np.asarray(part) for vote in votes for part in vote]


def _vote_majority(backend: Backend, sample: Sample) -> Arrays:
    return _flat(
        backend.vote_majority(sample.grids(count), unknown_votes=unknown_votes)
        for count in (1, 2, 3, 4, 9, 17)
        for unknown_votes in (True, False)
    )


def _vote_weighted(backend: Backend, sample: Sample) -> Arrays:
    weights = sample.rng.integers(1, 5, 9).astype(np.int32)
    return _flat(
        backend.vote_weighted(sample.grids(count), weights[:count], unknown_votes=unknown_votes)
        for count in (1, 3, 9)
        for unknown_votes in (True, False)
    )


def _vote_log_odds(backend: Backend, sample: Sample) -> Arrays:
    percent = np.arange(101).clip(2, 98)
    odds = np.rint(256 * np.log(percent / (100 - percent))).astype(np.int32)
    return _flat(
        backend.vote_log_odds(sample.percents(count), odds, occupied_percent=65, free_percent=25)
        for count in (1, 3, 9)
    )


def _cast_rays(backend: Backend, sample: Sample) -> Arrays:
    classes = sample.rng.choice(3, sample.shape, p=(0.9, 0.07, 0.03)).astype(np.uint8)
    size = np.array(sample.shape[::-1])
    places = sample.rng.uniform(-0.2, 1.2, (97, 2)) * size + sample.away
    places[:9] = np.floor(places[:9])  # on the edges of cells
    angles = sample.rng.uniform(-np.pi, np.pi, 97)
    angles[:17] = np.arange(-8, 9) * (np.pi / 4.0)  # along the cells and through their corners
    rays = np.column_stack((places, np.cos(angles), np.sin(angles))).astype(np.float32)
    cells = backend.upload(classes)
    return [
        np.nan_to_num(backend.cast_rays(cells, rays[:count], reach), posinf=-1.0)
        for count, reach in ((97, 300.0), (97, 2.5), (1, 40.0))
    ]


def _extend(backend: Backend, sample: Sample) -> Arrays:
    pool = backend.upload(sample.rng.integers(0, 9, (3, 5, 7)).astype(np.uint32))
    grown = [backend.extend(pool, count, slam_reference.UNSEEN) for count in (3, 4, 11)]
    return [*_fetch(backend, grown), backend.download(pool)]


def _window(sample: Sample) -> tuple[npt.NDArray[np.int32], int]:
    """Return the page table of a window that holds the sample's shape, and how many tiles it has.

    One page in three has no tile, nor has the border.
    """
    inner = tuple(-(-size // slam_reference.TILE) for size in sample.shape)
    used = sample.rng.random(inner) < 2.0 / 3.0
    numbers = np.where(used, np.cumsum(used).reshape(inner), 0)
    return np.pad(numbers, 1).astype(np.int32), int(used.sum()) + 1


def _tiled_field(sample: Sample) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """Return a random score field over the sample's window, and the window's pages."""
    pages, tiles = _window(sample)
    pool = sample.rng.integers(0, 256, (tiles, slam_reference.TILE, slam_reference.TILE))
    pool[0] = 0
    return pool.astype(np.uint8), pages


def _climb(backend: Backend, sample: Sample) -> Arrays:
    pool, pages = _tiled_field(sample)
    field, table = backend.upload(pool), backend.upload(pages)
    size = np.array([*pages.shape[::-1], 0.1]) * slam_reference.TILE
    rng = sample.rng
    points = rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    centres = rng.random((2, 3)) * size + [sample.away, 0.0, 0.0]
    losses = np.column_stack((centres, [[0.01, 0.02, 0.1, 0.0], [0.02, 0.01, 0.2, 0.05]]))
    results = []
    for groups, rounds, every in ((1, 1, 1), (7, 3, 2)):
        starts = centres[0] + rng.normal(0.0, 1.0, (groups, 3))
        steps = rng.normal(0.0, 1.0, (rounds, groups, slam_reference.CLIMBERS, 3))
        turned = [np.stack((np.cos(a), np.sin(a)), axis=-1) for a in (starts[:, 2], steps[..., 2])]
        tables = [
            np.concatenate(pair, axis=-1) for pair in zip((starts, steps), turned, strict=True)
        ]
        climbed = [table.astype(np.float32) for table in (losses, *tables)]
        hits = backend.upload(points[::every])
        results.append(backend.climb(field, table, hits, *climbed, scale=1.0 / 9000.0))
    return results


def _two_maps(sample: Sample) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """Return a random score field, and the pages of two maps that share some of its tiles."""
    pool, pages = _tiled_field(sample)
    return pool, np.stack((pages, np.where(sample.rng.random(pages.shape) < 0.2, 0, pages)))


def _climb_maps(backend: Backend, sample: Sample) -> Arrays:
    pool, pages = _two_maps(sample)
    field, tables = backend.upload(pool), backend.upload(pages)
    rng = sample.rng
    points = rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    size = np.array([*pages.shape[:0:-1], 0.1]) * slam_reference.TILE
    starts = rng.random((2, 3)) * size + [sample.away, 0.0, 0.0]
    losses = np.column_stack((starts + 0.3, np.full((2, 3), 0.01), (0.0, 0.1)))
    starts = np.column_stack((starts, np.cos(starts[:, 2]), np.sin(starts[:, 2])))
    steps = 0.5 ** np.arange(4)
    sizes = np.column_stack((steps, 0.1 * steps, np.cos(0.1 * steps), np.sin(0.1 * steps)))
    climbed = [table.astype(np.float32) for table in (losses, starts, sizes)]
    return [
        backend.climb_maps(
            field,
            tables,
            backend.upload(points[::every]),
            *climbed,
            tries=tries,
            scale=1.0 / 9000.0,
        )
        for tries, every in ((1, 1), (9, 2), (60, 1))
    ]


def _score_maps(backend: Backend, sample: Sample) -> Arrays:
    pool, pages = _two_maps(sample)
    field, tables = backend.upload(pool), backend.upload(pages)
    size = np.array(pages.shape[:0:-1]) * slam_reference.TILE
    points = sample.rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    yaw = sample.rng.uniform(-np.pi, np.pi, (2, 27))
    places = sample.rng.uniform(-0.2, 1.2, (2, 27, 2)) * size + sample.away
    poses = np.dstack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32)
    table = sample.rng.integers(-5000, 5000, 256).astype(np.int32)
    hits = [backend.upload(points[::every]) for every in (1, 3)]
    return [backend.score_maps(field, tables, own, poses, table) for own in hits]


def _score_poses(backend: Backend, sample: Sample) -> Arrays:
    pool, pages = _tiled_field(sample)
    field, table = backend.upload(pool), backend.upload(pages)
    size = np.array(pages.shape[::-1]) * slam_reference.TILE
    points = sample.rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    yaw = sample.rng.uniform(-np.pi, np.pi, 37)
    places = sample.rng.uniform(-0.2, 1.2, (37, 2)) * size + sample.away
    poses = np.column_stack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32)
    return [
        backend.score_poses(
            field, table, backend.upload(points[::every]), poses[:count], reach=reach
        )
        for count, every, reach in ((37, 1, 0), (37, 3, 2), (1, 100, 0))
    ]


def _beams(sample: Sample) -> npt.NDArray[np.int32]:
    """Return 57 beams from one laser inside the window of the sample; one has no length."""
    low = slam_reference.TILE * slam_reference.BEAM_ONE
    size = np.array(sample.shape[::-1]) * slam_reference.BEAM_ONE
    hits = low + (sample.rng.random((57, 2)) * size).astype(np.int32)
    laser = hits[0]
    length = np.hypot(*(hits - laser).T)
    peaks = sample.rng.integers(0, 4096, 57)
    return np.column_stack((hits, np.broadcast_to(laser, hits.shape), length, peaks)).astype(
        np.int32
    )


def _tiny_map(backend: Backend, sample: Sample, *, fold: bool) -> Arrays:
    """Mark and fold a few scans, with both cell models, with blur and without."""
    results: Arrays = []
    for is_mean, half_blur in ((True, 3000), (False, 3000), (True, 0)):
        pages, tiles = _window(sample)
        shape = (tiles, slam_reference.TILE, slam_reference.TILE)
        unseen = np.full(shape, slam_reference.UNSEEN, dtype=np.uint32)
        observed = backend.upload(np.zeros(shape, dtype=np.uint32))
        valley, published = backend.upload(unseen), backend.upload(unseen)
        field = backend.upload(np.zeros(shape, dtype=np.uint8))
        table = backend.upload(pages)
        wanted = backend.upload(np.zeros(1 + pages.size, dtype=np.int32))
        for seed, quality in ((1, 1024), (2, 300), (3, 700)):
            rule = slam_reference.BeamRule(
                half_blur, 2048, 819, 41, quality, is_mean, wall_floor=367002, wall_gain=425
            )
            beams = backend.upload(_beams(replace(sample, seed=sample.seed + seed)))
            missing = backend.tiny_mark(observed, table, beams, rule, wanted)
            if fold:
                backend.tiny_fold(observed, valley, published, field, table, beams, rule)
            else:
                results.append(np.array([missing]))
        results += _fetch(backend, [observed, wanted, valley, published, field])
    return results


def _smear_map(backend: Backend, sample: Sample, *, fold: bool) -> Arrays:
    """Mark and fold a few scans, near and far around their hits."""
    results: Arrays = []
    table = np.linspace(255.0, 0.0, 256).astype(np.uint8)
    for reach, most in ((2, 4095), (0, 2)):
        pages, tiles = _window(sample)
        shape = (tiles, slam_reference.TILE, slam_reference.TILE)
        observed = backend.upload(np.zeros(shape, dtype=np.uint32))
        states = backend.upload(np.zeros(shape, dtype=np.uint32))
        field = backend.upload(np.full(shape, 20, dtype=np.uint8))
        page_table = backend.upload(pages)
        wanted = backend.upload(np.zeros(1 + pages.size, dtype=np.int32))
        rule = slam_reference.SmearRule(table, 15, reach, most)
        for seed in range(4):
            beams = _beams(replace(sample, seed=sample.seed + seed))[:, :4]
            handle = backend.upload(np.ascontiguousarray(beams))
            missing = backend.smear_mark(observed, page_table, handle, rule, wanted)
            if fold:
                backend.smear_fold(observed, states, field, page_table, handle, rule)
            else:
                results.append(np.array([missing]))
        results += _fetch(backend, [observed, wanted, states, field])
    return results


def _smear_mark(backend: Backend, sample: Sample) -> Arrays:
    return _smear_map(backend, sample, fold=False)


def _smear_fold(backend: Backend, sample: Sample) -> Arrays:
    return _smear_map(backend, sample, fold=True)


def _tiny_mark(backend: Backend, sample: Sample) -> Arrays:
    return _tiny_map(backend, sample, fold=False)


def _tiny_fold(backend: Backend, sample: Sample) -> Arrays:
    return _tiny_map(backend, sample, fold=True)


def _hit_pools(sample: Sample, tiles: int) -> list[npt.NDArray[Any]]:
    """Return counts, sums and field of tiles; most cells have no hits, and tile 0 nothing."""
    shape, rng = (tiles, slam_reference.TILE, slam_reference.TILE), sample.rng
    visits = rng.integers(0, 200, shape)
    hits = np.where(rng.random(shape) < 0.1, rng.integers(0, visits + 1), 0)
    sum_x, sum_y = (rng.integers(0, 15 * hits + 1) for _ in range(2))
    pools = [(high << 16 | low).astype(np.uint32) for high, low in ((hits, visits), (sum_x, sum_y))]
    pools.append(rng.integers(0, 256, shape).astype(np.uint8))
    for pool in pools:
        pool[0] = 0
    return pools


def _hit_maps(sample: Sample) -> tuple[npt.NDArray[np.int32], list[npt.NDArray[Any]]]:
    """Return the pages of two maps over the sample's window, no tile shared, and their pools."""
    pages, tiles = _window(sample)
    other = np.where(pages[::-1] > 0, pages[::-1] + tiles, 0)
    return np.stack((pages, other)), _hit_pools(sample, 2 * tiles)


def _beam_scan(sample: Sample, pages: npt.NDArray[np.int32]) -> hit_map_reference.BeamScan:
    """Return a scan of 23 beams inside the window; one has no length, two leave the window."""
    rng, count, maps = sample.rng, 23, len(pages)
    size = np.array(pages.shape[:0:-1]) * slam_reference.TILE
    yaw = rng.uniform(-np.pi, np.pi, maps)
    places = rng.uniform(0.3, 0.7, (maps, 2)) * size + sample.away
    ends = rng.uniform(-0.5, 0.5, (count, 2)) * np.minimum(size, 90)
    laser = np.array([0.7, -0.3])
    ends[0] = laser
    ends[1:3] = [[9e9, -np.inf], [-9e9, np.nan]]
    return hit_map_reference.BeamScan(
        ends.astype(np.float32),
        (rng.random(count) < 0.7).astype(np.uint8),
        laser.astype(np.float32),
        np.column_stack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32),
    )


def _touch_pages(backend: Backend, sample: Sample) -> Arrays:
    pages, _ = _hit_maps(sample)
    table, scan = backend.upload(pages), _beam_scan(sample, pages)
    short = scan._replace(ends=scan.ends[:0], is_hit=scan.is_hit[:0])
    return [
        *(backend.touch_pages(table, scan, reach) for reach in (0, 3, 16)),
        backend.touch_pages(table, short, 3),
    ]


def _copy_tiles(backend: Backend, sample: Sample) -> Arrays:
    tiles = 1 + sum(sample.shape) // 2
    pools = tuple(backend.upload(pool) for pool in _hit_pools(sample, tiles))
    targets = 1 + sample.rng.permutation(tiles - 1)
    half = len(targets) // 2
    pairs = np.column_stack((np.append(0, targets[half:])[:half], targets[:half])).astype(np.int32)
    backend.copy_tiles(pools, pairs)
    backend.copy_tiles(pools, pairs[:0])
    return _fetch(backend, pools)


def _take_tiles(backend: Backend, sample: Sample) -> Arrays:
    tiles = 1 + sum(sample.shape) // 2
    numbers = sample.rng.integers(0, tiles, tiles + 5).astype(np.int32)
    pools = [backend.upload(pool) for pool in _hit_pools(sample, tiles)]
    return [backend.take_tiles(pool, some) for pool in pools for some in (numbers, numbers[:0])]


def _count_beams(backend: Backend, sample: Sample) -> Arrays:
    pages, (counts, sums, _) = _hit_maps(sample)
    visits, hits = hit_map_reference.FULL_VISITS, hit_map_reference.FULL_HITS
    table, scan = backend.upload(pages), _beam_scan(sample, pages)
    none = scan._replace(ends=scan.ends[:0], is_hit=scan.is_hit[:0])
    results = []
    # As it is, and in one map a beam or two away from too many visits, or hits.
    for more in (0, visits - 2, hits - 2 << 16):
        nearly = counts.copy()
        nearly[1 : len(counts) // 2 : 3] |= np.uint32(more)
        own = backend.upload(nearly), backend.upload(sums)
        full = [backend.count_beams(*own, table, part) for part in (scan, none)]
        results += [np.array(full), *_fetch(backend, own)]
    return results


def _settle_field(backend: Backend, sample: Sample) -> Arrays:
    pages, pools = _hit_maps(sample)
    table, scan = backend.upload(pages), _beam_scan(sample, pages)
    counts, sums = (backend.upload(pool) for pool in pools[:2])
    falling = np.arange(255, -1, -1).astype(np.uint8)
    results = []
    for reach, shift, occupied, least_hits in (
        (1, 10, 20000, 1),
        (3, 13, 0, 2),
        (0, 9, 1 << 16, 1),
    ):
        rule = hit_map_reference.FieldRule(falling, shift, reach, occupied, least_hits)
        field = backend.upload(pools[2])
        backend.settle_field(counts, sums, field, table, scan, rule)
        results.append(field)
    return _fetch(backend, results)


CHECKS: dict[str, Check] = {
    "solid_walls": _solid_walls,
    "surface_walls": _surface_walls,
    "shrink": _shrink,
    "distance_squared": _distance_squared,
    "look_up": _look_up,
    "score_field": _score_field,
    "max_window": _max_window,
    "warp": _warp,
    "confusion": _confusion,
    "squared_error": _squared_error,
    "correlate": _correlate,
    "polyphase": _polyphase,
    "bound_blocks": _bound_blocks,
    "tile_peaks": _tile_peaks,
    "pose_counts": _pose_counts,
    "refine_terms": _refine_terms,
    "vote_majority": _vote_majority,
    "vote_weighted": _vote_weighted,
    "vote_log_odds": _vote_log_odds,
    "cast_rays": _cast_rays,
    "extend": _extend,
    "score_poses": _score_poses,
    "climb": _climb,
    "climb_maps": _climb_maps,
    "score_maps": _score_maps,
    "tiny_mark": _tiny_mark,
    "tiny_fold": _tiny_fold,
    "smear_mark": _smear_mark,
    "smear_fold": _smear_fold,
    "touch_pages": _touch_pages,
    "copy_tiles": _copy_tiles,
    "take_tiles": _take_tiles,
    "count_beams": _count_beams,
    "settle_field": _settle_field,
}
