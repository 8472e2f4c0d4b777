"""A check for each operation of the families that keep tiled maps; each returns what it gives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute.cell_means import LikelihoodRule, ScanRule
from slamfusion.compute.compute_device import ComputeDevice
from slamfusion.compute.hit_counts import BeamScan, FieldRule
from slamfusion.compute.layout import (
    BEAM_ONE,
    CLIMBERS,
    FACINGS,
    FULL_HITS,
    FULL_VISITS,
    PAIRS,
    TILE,
    UNSEEN,
)
from slamfusion.compute.scan_match import upload_hits
from tests.kernels.checks.sample import Arrays, Check, Sample, fetch


def _extend(device: ComputeDevice, sample: Sample) -> Arrays:
    pool = device.upload(sample.rng.integers(0, 9, (3, 5, 7)).astype(np.uint32))
    grown = [device.extend(pool, count, UNSEEN, 5) for count in (3, 4, 11)]
    grown.append(device.extend(grown[1], 5, UNSEEN, 5))
    return [*fetch(device, grown), device.download(pool)]


def _window(sample: Sample) -> tuple[npt.NDArray[np.int32], int]:
    """Return the page table of a window that holds the sample's shape, and how many tiles it has.

    One page in three has no tile, nor has the border.
    """
    inner = tuple(-(-size // TILE) for size in sample.shape)
    used = sample.rng.random(inner) < 2.0 / 3.0
    numbers = np.where(used, np.cumsum(used).reshape(inner), 0)
    return np.pad(numbers, 1).astype(np.int32), int(used.sum()) + 1


def _tiled_field(sample: Sample) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """Return a random score field over the sample's window, and the window's pages."""
    pages, tiles = _window(sample)
    pool = sample.rng.integers(0, 256, (tiles, TILE, TILE))
    pool[0] = 0
    return pool.astype(np.uint8), pages


def _search(device: ComputeDevice, sample: Sample) -> Arrays:
    """Climb from none, one and the best of looked-at poses, and from two hypotheses."""
    pool, pages = _tiled_field(sample)
    field, table = device.upload(pool), device.upload(pages)
    size = np.array([*pages.shape[::-1], 0.1]) * TILE
    rng = sample.rng
    points = rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    centres = rng.random((2, 3)) * size + [sample.away, 0.0, 0.0]
    losses = np.column_stack((centres, [[0.01, 0.02, 0.1, 0.0], [0.02, 0.01, 0.2, 0.05]]))
    results = []
    for climbs, rounds, every in ((0, 1, 1), (1, 1, 1), (5, 3, 2)):
        looked = centres[0] + rng.normal(0.0, 1.0, (40, 3))
        looked[7] = looked[3]  # equals
        poses = np.concatenate((centres, looked))
        steps = rng.normal(0.0, 1.0, (rounds, climbs + 2, CLIMBERS, 3))
        turned = [np.stack((np.cos(a), np.sin(a)), axis=-1) for a in (poses[:, 2], steps[..., 2])]
        tables = [
            np.concatenate(pair, axis=-1) for pair in zip((poses, steps), turned, strict=True)
        ]
        given = [table.astype(np.float32) for table in (losses, *tables)]
        hits = upload_hits(points[::every], device)
        window = device.field_window(field, table, centres[0, :2] - 130.0, centres[0, :2] + 130.0)
        results.append(device.download(window.cells))
        results.append(device.search(window, hits, *given, reach=2))
    return results


def _two_maps(sample: Sample) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.int32]]:
    """Return a random field of pairs, and the pages of two maps that share some of its tiles."""
    pages, tiles = _window(sample)
    pool = sample.rng.integers(0, 1 << 16, (tiles, TILE, PAIRS)).astype(np.uint16)
    pool[0] = 0
    return pool, np.stack((pages, np.where(sample.rng.random(pages.shape) < 0.2, 0, pages)))


def _climb_maps(device: ComputeDevice, sample: Sample) -> Arrays:
    pool, pages = _two_maps(sample)
    field, tables = device.upload(pool), device.upload(pages)
    rng = sample.rng
    points = rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    size = np.array([*pages.shape[:0:-1], 0.1]) * TILE
    starts = rng.random((2, 3)) * size + [sample.away, 0.0, 0.0]
    losses = np.column_stack((starts + 0.3, np.full((2, 3), 0.01), (0.0, 0.1)))
    starts = np.column_stack((starts, np.cos(starts[:, 2]), np.sin(starts[:, 2])))
    steps = 0.5 ** np.arange(4)
    sizes = np.column_stack((steps, 0.1 * steps, np.cos(0.1 * steps), np.sin(0.1 * steps)))
    climbed = [table.astype(np.float32) for table in (losses, starts, sizes)]
    window = device.field_window(field, device.upload(pages[0]), (-9.0, 3.5), size[:2] - 5.0)
    return [device.download(window.cells)] + [
        device.climb_maps(
            field,
            tables,
            upload_hits(points[::every], device),
            *climbed,
            tries=tries,
            scale=1.0 / 9000.0,
        )
        for tries, every in ((1, 1), (9, 2), (60, 1))
    ]


def _score_maps(device: ComputeDevice, sample: Sample) -> Arrays:
    pool, pages = _two_maps(sample)
    field, tables = device.upload(pool), device.upload(pages)
    size = np.array(pages.shape[:0:-1]) * TILE
    points = sample.rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    yaw = sample.rng.uniform(-np.pi, np.pi, (2, 27))
    places = sample.rng.uniform(-0.2, 1.2, (2, 27, 2)) * size + sample.away
    poses = np.dstack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32)
    table = sample.rng.integers(-5000, 5000, 256).astype(np.int32)
    hits = [upload_hits(points[::every], device) for every in (1, 3)]
    return [device.score_maps(field, tables, own, poses, table) for own in hits]


def _score_poses(device: ComputeDevice, sample: Sample) -> Arrays:
    pool, pages = _tiled_field(sample)
    field, table = device.upload(pool), device.upload(pages)
    size = np.array(pages.shape[::-1]) * TILE
    points = sample.rng.normal(0.0, 20.0, (83, 2)).astype(np.float32)
    yaw = sample.rng.uniform(-np.pi, np.pi, 37)
    places = sample.rng.uniform(-0.2, 1.2, (37, 2)) * size + sample.away
    poses = np.column_stack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32)
    window = device.field_window(field, table, np.zeros(2), size)
    counts = sample.rng.integers(-5000, 5000, 256).astype(np.int32)
    return [
        device.score_poses(window, upload_hits(points[::every], device), poses[:count], **options)
        for count, every, options in ((37, 1, {}), (37, 1, {"table": counts}), (1, 100, {}))
    ]


def _beams(sample: Sample) -> npt.NDArray[np.int32]:
    """Return 57 beams from one laser inside the window of the sample; one has no length."""
    low = TILE * BEAM_ONE
    size = np.array(sample.shape[::-1]) * BEAM_ONE
    hits = low + (sample.rng.random((57, 2)) * size).astype(np.int32)
    laser = hits[0]
    length = np.hypot(*(hits - laser).T)
    peaks = sample.rng.integers(0, 4096, 57)
    return np.column_stack((hits, np.broadcast_to(laser, hits.shape), length, peaks)).astype(
        np.int32
    )


def _write_scans(
    device: ComputeDevice, sample: Sample, kinds: dict[str, tuple[Any, int]], rules: list[Any]
) -> Arrays:
    """Mark and integrate scans into one map, each by a rule; return also what was marked."""
    pages, tiles = _window(sample)
    pools = {
        name: device.upload(np.full((tiles, TILE, TILE), fill, dtype=kind))
        for name, (kind, fill) in kinds.items()
    }
    table, met = device.upload(pages), device.upload(np.zeros_like(pages))
    box = (0, 0, *pages.shape[::-1])
    window = device.field_window(pools["field"], table, (TILE + 1.0, 3.0), (2.0 * TILE, 70.0))
    results: Arrays = []
    for seed, rule in enumerate(rules):
        beams = _beams(replace(sample, seed=sample.seed + seed))
        if isinstance(rule, LikelihoodRule):
            beams = np.ascontiguousarray(beams[:, :4])
        handle = device.upload(beams)
        results.append(device.mark_scan(pools, table, handle, rule, met))
        results += [array.copy() for array in fetch(device, [met, pools["observed"]])]
        device.integrate_scan(pools, table, met, box, rule, window)
    return [*results, *fetch(device, [met, *pools.values()]), device.download(window.cells)]


def _scan_map(device: ComputeDevice, sample: Sample) -> Arrays:
    """With both cell models, with blur and without."""
    unseen = (np.uint32, UNSEEN)
    kinds = {
        "observed": (np.uint32, 0),
        "valley": unseen,
        "published": unseen,
        "field": (np.uint8, 0),
    }
    results: Arrays = []
    for is_mean, half_blur in ((True, 3000), (False, 3000), (True, 0)):
        rules = [
            ScanRule(half_blur, 2048, 819, 41, quality, is_mean, wall_floor=367002, wall_gain=425)
            for quality in (1024, 300, 700)
        ]
        results += _write_scans(device, sample, kinds, rules)
    return results


def _likelihood_map(device: ComputeDevice, sample: Sample) -> Arrays:
    """Near and far around the hits of some scans."""
    kinds = {"observed": (np.uint32, 0), "states": (np.uint32, 0), "field": (np.uint8, 20)}
    table = np.linspace(255.0, 0.0, 256).astype(np.uint8)
    return [
        result
        for reach, most in ((2, 4095), (0, 2))
        for result in _write_scans(
            device, sample, kinds, 4 * [LikelihoodRule(table, 15, reach, most)]
        )
    ]


def _hit_pools(sample: Sample, tiles: int) -> list[npt.NDArray[Any]]:
    """Return counts, sums and field of tiles; most cells have no hits, and tile 0 nothing."""
    shape, rng = (tiles, TILE, TILE), sample.rng
    visits = rng.integers(0, 200, shape)
    hits = np.where(rng.random(shape) < 0.1, rng.integers(0, visits + 1), 0)
    sum_x, sum_y = (rng.integers(0, 15 * hits + 1) for _ in range(2))
    pools = [(high << 16 | low).astype(np.uint32) for high, low in ((hits, visits), (sum_x, sum_y))]
    pools.append(rng.integers(0, 1 << 16, (tiles, TILE, PAIRS)).astype(np.uint16))
    for pool in pools:
        pool[0] = 0
    return pools


def _hit_maps(sample: Sample) -> tuple[npt.NDArray[np.int32], list[npt.NDArray[Any]]]:
    """Return the pages of two maps over the sample's window, no tile shared, and their pools."""
    pages, tiles = _window(sample)
    other = np.where(pages[::-1] > 0, pages[::-1] + tiles, 0)
    return np.stack((pages, other)), _hit_pools(sample, 2 * tiles)


def _beam_scan(sample: Sample, pages: npt.NDArray[np.int32]) -> BeamScan:
    """Return a scan of 23 beams inside the window; one has no length, two leave the window."""
    rng, count, maps = sample.rng, 23, len(pages)
    size = np.array(pages.shape[:0:-1]) * TILE
    yaw = rng.uniform(-np.pi, np.pi, maps)
    places = rng.uniform(0.3, 0.7, (maps, 2)) * size + sample.away
    ends = rng.uniform(-0.5, 0.5, (count, 2)) * np.minimum(size, 90)
    laser = np.array([0.7, -0.3])
    ends[0] = laser
    ends[1:3] = [[9e9, -np.inf], [-9e9, np.nan]]
    return BeamScan(
        ends.astype(np.float32),
        (rng.random(count) < 0.7).astype(np.uint8),
        laser.astype(np.float32),
        np.column_stack((places, np.cos(yaw), np.sin(yaw))).astype(np.float32),
    )


def _touch_pages(device: ComputeDevice, sample: Sample) -> Arrays:
    pages, _ = _hit_maps(sample)
    table, scan = device.upload(pages), _beam_scan(sample, pages)
    short = scan._replace(ends=scan.ends[:0], is_hit=scan.is_hit[:0])
    return [
        *(device.touch_pages(table, scan, reach) for reach in (0, 3, 16)),
        device.touch_pages(table, short, 3),
    ]


def _copy_tiles(device: ComputeDevice, sample: Sample) -> Arrays:
    tiles = 1 + sum(sample.shape) // 2
    pools = tuple(device.upload(pool) for pool in _hit_pools(sample, tiles))
    targets = 1 + sample.rng.permutation(tiles - 1)
    half = len(targets) // 2
    pairs = np.column_stack((np.append(0, targets[half:])[:half], targets[:half])).astype(np.int32)
    device.copy_tiles(pools, pairs)
    device.copy_tiles(pools, pairs[:0])
    return fetch(device, pools)


def _discard_tiles(device: ComputeDevice, sample: Sample) -> Arrays:
    """Discarded tiles are undefined: the others stay."""
    pool = device.upload(sample.rng.integers(0, 9, (6, 64, 64)).astype(np.uint32))
    device.discard_tiles(pool, np.array([1, 2, 4]))
    return [device.download(pool)[[0, 3, 5]]]


def _take_tiles(device: ComputeDevice, sample: Sample) -> Arrays:
    tiles = 1 + sum(sample.shape) // 2
    numbers = sample.rng.integers(0, tiles, tiles + 5).astype(np.int32)
    pools = [device.upload(pool) for pool in _hit_pools(sample, tiles)]
    return [device.take_tiles(pool, some) for pool in pools for some in (numbers, numbers[:0])]


def _count_walks(device: ComputeDevice, sample: Sample) -> Arrays:
    pages, (hits, visits, _) = _hit_maps(sample)
    rng, size = sample.rng, np.array(pages.shape[:0:-1]) * TILE * BEAM_ONE
    beams = (rng.random((57, 4)) * np.tile(size, 2)).astype(np.int32)
    beams[0, 2:] = beams[0, :2]
    is_hit = (rng.random(len(beams)) < 0.7).astype(np.uint8)
    pools, table = (device.upload(hits), device.upload(visits)), device.upload(pages[:1])
    results: Arrays = []
    for some, sign in ((beams, 1), (beams[:0], 1), (beams[::2], -1)):
        device.count_walks(*pools, table, some, is_hit[: len(some)], sign)
        results += [array.copy() for array in fetch(device, pools)]
    return results


def _count_and_settle(device: ComputeDevice, sample: Sample) -> Arrays:
    pages, (counts, sums, field) = _hit_maps(sample)
    table, scan = device.upload(pages), _beam_scan(sample, pages)
    none = scan._replace(ends=scan.ends[:0], is_hit=scan.is_hit[:0])
    falling = np.arange(255, -1, -1).astype(np.uint8)
    results: Arrays = []
    # As it is, and in one map a beam or two away from too many visits, or hits.
    for more, reach, shift, occupied, least_hits in (
        (0, 1, 10, 20000, 1),
        (FULL_VISITS - 2, 3, 13, 0, 2),
        (FULL_HITS - 2 << 16, 0, 9, 1 << 16, 1),
    ):
        rule = FieldRule(falling, shift, reach, occupied, least_hits)
        nearly = counts.copy()
        nearly[1 : len(counts) // 2 : 3] |= np.uint32(more)
        pools = [device.upload(pool) for pool in (nearly, sums, field)]
        for part in (scan, none):
            touched = device.touch_pages(table, part, reach + 1)
            full = device.count_and_settle(*pools, table, touched, part, rule)
            results += [np.array(full), *(array.copy() for array in fetch(device, pools))]
    return results


def _marks(sample: Sample) -> tuple[Arrays, Arrays]:
    """Return a map with some marks (hits, seen, pages), and beams in and beyond its window.

    Of the beams: places, facings, and bits of chunks.
    """
    pages, tiles = _window(sample)
    rng = sample.rng
    pools = []
    for shape in ((tiles, FACINGS, TILE, TILE), (tiles, TILE, TILE)):
        pool = ((rng.random(shape) < 0.1) * (1 << rng.integers(0, 32, shape))).astype(np.uint32)
        pool[0] = 0
        pools.append(pool)
    count = 7 + sum(sample.shape) // 3
    size = np.tile(np.array(pages.shape[::-1]) * TILE, 2)
    places = (rng.uniform(-0.1, 1.1, (count, 4)) * size + min(sample.away, 1000.0)) * BEAM_ONE
    places[0, 2:] = places[0, :2]
    facings = rng.integers(0, FACINGS, count).astype(np.int32)
    bits = (1 << rng.integers(0, 32, count)).astype(np.uint32)
    return [*pools, pages], [places.astype(np.int32), facings, bits]


def _mark_chunks(device: ComputeDevice, sample: Sample) -> Arrays:
    marks, beams = _marks(sample)
    hits, seen, pages = (device.upload(array) for array in marks)
    places, facings, bits = (device.upload(array) for array in beams)
    device.mark_chunks(hits, seen, pages, places, facings, bits)
    return fetch(device, (hits, seen))


def _nearest_marks(device: ComputeDevice, sample: Sample) -> Arrays:
    marks, beams = _marks(sample)
    hits, seen, pages = (device.upload(array) for array in marks)
    places, facings = (device.upload(array) for array in beams[:2])
    words = beams[2]
    return [
        device.nearest_marks(hits, seen, pages, places, facings, device.upload(left_out), reach)
        for left_out, reach in ((words | words >> 1, 4), (0 * words, 0), (~words, 16))
    ]


MAP_CHECKS: dict[str, Check] = {
    "extend": _extend,
    "score_poses": _score_poses,
    "field_window, search": _search,
    "climb_maps": _climb_maps,
    "score_maps": _score_maps,
    "mark_scan, integrate_scan": _scan_map,
    "mark_scan, integrate_scan of likelihoods": _likelihood_map,
    "touch_pages": _touch_pages,
    "copy_tiles": _copy_tiles,
    "discard_tiles": _discard_tiles,
    "take_tiles": _take_tiles,
    "count_walks": _count_walks,
    "count_and_settle": _count_and_settle,
    "mark_chunks": _mark_chunks,
    "nearest_marks": _nearest_marks,
}
