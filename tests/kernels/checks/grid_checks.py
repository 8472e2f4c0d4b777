"""A check for each operation of the families that look at grids; each returns what it gives."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from slamfusion.compute.compute_device import ComputeDevice
from slamfusion.compute.lattice import fixed_poses, point_planes, shift_spans
from slamfusion.compute.layout import (
    DISTANCE2_MAX,
    DISTANCE_MAX,
    DISTANCE_ONE,
    DISTANCE_TABLE,
    DISTANCE_UNSEEN,
    FIXED_ONE,
    RUN,
    SHIFT_POINTS,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.compute.search import CountedSide, FitSide, ScoredSide, ShiftedSide
from slamfusion.compute.votes import Votes
from slamfusion.compute.wall_pieces import PieceSide, piece_points
from slamfusion.geometry import F64
from tests.kernels.checks.sample import Arrays, Check, Sample, fetch

# Worth of a cell that says nothing, and the value outside a field.
BASE = 64
FLAT_FILL = 7


def _solid_walls(device: ComputeDevice, sample: Sample) -> Arrays:
    return fetch(device, [device.solid_walls(device.upload(sample.cells))])


def _surface_walls(device: ComputeDevice, sample: Sample) -> Arrays:
    cells, solid = device.upload(sample.cells), device.upload(sample.solid)
    return fetch(device, [device.surface_walls(cells, solid)])


def _shrink(device: ComputeDevice, sample: Sample) -> Arrays:
    walls, cells = device.upload(sample.walls), device.upload(sample.cells)
    # Blocks of one cell, many in a run, and one that is wider than a run.
    steps = (1, 7, RUN + 6)
    return [a for step in steps for a in fetch(device, device.shrink(walls, cells, step))]


def _distance_squared(device: ComputeDevice, sample: Sample) -> Arrays:
    walls = device.upload(sample.walls)
    reaches = (DISTANCE_MAX, 24, 1)
    return fetch(device, [device.distance_squared(walls, reach) for reach in reaches])


def _worths() -> npt.NDArray[np.uint16]:
    """Return what a wall point gains and loses by squared distance."""
    d2 = np.arange(DISTANCE2_MAX + 1)
    hit = np.rint(191 * np.exp(-d2 / 18.0)).astype(np.uint16)
    return hit | np.minimum(d2, BASE).astype(np.uint16) << np.uint16(8)


def _score_field(device: ComputeDevice, sample: Sample) -> Arrays:
    given = (device.upload(plane) for plane in (sample.distance2, sample.field))
    return fetch(device, [device.score_field(*given, _worths(), BASE)])


def _known_by_distance(device: ComputeDevice, sample: Sample) -> Arrays:
    planes = (sample.distance2, sample.walls, sample.field)
    return [device.start_known_by_distance(*(device.upload(plane) for plane in planes))()]


def _wall_distances(device: ComputeDevice, sample: Sample) -> Arrays:
    distance2, free = device.upload(sample.distance2), device.upload(sample.field)
    limits = (3 * DISTANCE_ONE, DISTANCE_UNSEEN)
    return fetch(device, [device.wall_distances(distance2, free, most) for most in limits])


def _max_ahead(device: ComputeDevice, sample: Sample) -> Arrays:
    field = device.upload(sample.field)
    return fetch(device, [device.max_ahead(field, shift) for shift in (1, 2, 5, 40)])


def _warp(device: ComputeDevice, sample: Sample) -> Arrays:
    poses = fixed_poses(sample.motions)
    return fetch(device, [device.warp(device.upload(sample.cells), poses, (19, 23), -1)])


def _grid_error(device: ComputeDevice, sample: Sample) -> Arrays:
    whole, other = sample.grids(2)
    a, b = device.upload(whole), device.upload(other.reshape(other.shape[::-1]))
    poses = fixed_poses([(0.0, 0.0, 0.0), *sample.motions])
    return [device.grid_error(a, b, poses, stride) for stride in (1, 3)]


def _best_shifts(device: ComputeDevice, sample: Sample) -> Arrays:
    # Neither whole tiles nor whole lanes.
    height, width, lanes, count = 9, 45, 64, 37
    planes = sample.rng.integers(0, 16, (3, sample.shape[0] + height, sample.shape[1] + lanes))
    fields = planes.astype(np.uint8)
    rows, cols = sample.rng.integers(0, sample.shape, (3, count, 2)).transpose(2, 0, 1)
    offsets = (rows * fields.shape[2] + cols).astype(np.int32)
    all_shifts = np.full((3, -(-count // SHIFT_POINTS), 4), (0, height, 0, lanes), np.int32)
    # A field that says something in a small box only: most shifts of most points need no look.
    box = (height, height + 5, width // 2, width)
    island = np.full_like(fields[:1], FLAT_FILL)
    island[:, box[0] : box[1], box[2] : box[3]] = fields[0, box[0] : box[1], box[2] : box[3]]
    spans = shift_spans(rows.astype(np.int32), cols.astype(np.int32), np.array([box]))
    every, first, single, some = (
        ShiftedSide(device.upload(given), at, where, base)
        for given, at, where, base in (
            (fields, offsets, all_shifts, 0),
            (fields[:1], offsets, all_shifts, 0),
            (fields, offsets[:1], all_shifts, 0),
            (island, offsets, spans, FLAT_FILL),
        )
    )
    shape = height, width
    sides = ((every, first), (single, some), (some, every))
    return [part for ahead, back in sides for part in device.best_shifts(ahead, back, shape)]


def _bound_blocks(device: ComputeDevice, sample: Sample) -> Arrays:
    height, width = sample.shape
    field = device.upload(sample.rng.integers(0, 256, (height, width)).astype(np.uint8))
    starts = sample.rng.integers(-5, max(sample.shape) + 5, (2, 2, 29)).astype(np.int32)
    shifts = sample.rng.integers(-5, 5, (13, 2)) + round(sample.away)
    groups = sample.rng.integers(0, 2, (13, 1))
    blocks = np.concatenate((groups, shifts), axis=1).astype(np.int32)
    places = device.upload(starts)
    bounds = device.bound_blocks(blocks, places, field)
    return [bounds, device.bound_blocks(blocks, places, field, int(np.median(bounds)))]


def _pose_counts(device: ComputeDevice, sample: Sample) -> Arrays:
    fields = device.upload(sample.cells), device.upload(sample.distance2)
    motions = fixed_poses(sample.motions).T.astype(np.float64)
    sides = [
        CountedSide(device.upload(sample.points(count)), motions, *fields) for count in (1, 150)
    ]
    return [
        counts
        for limits2 in ((), (9, 16), (1, 4, 9, 16, 64))
        for counts in device.pose_counts(*sides, worths=_worths(), base=BASE, limits2=limits2)
    ]


def _scored_sides(device: ComputeDevice, sample: Sample, motions: F64) -> list[ScoredSide]:
    field = device.upload(sample.field)
    planes = [point_planes(sample.points(count), device) for count in (1, 150, 700)]
    return [ScoredSide(points, motions, field, BASE) for points in planes]


def _pose_scores(device: ComputeDevice, sample: Sample) -> Arrays:
    motions = fixed_poses(sample.motions).T.astype(np.float64)
    return list(device.pose_scores(*_scored_sides(device, sample, motions)))


def _neighbour_scores(device: ComputeDevice, sample: Sample) -> Arrays:
    motions = fixed_poses(sample.motions).T.astype(np.float64)
    # A step of a whole cell along x, and one that turns with the motion.
    along, turned = np.zeros((2, len(sample.motions))), -1.25 * motions[:2]
    along[0] = 2.0 * FIXED_ONE
    return [
        scores
        for steps in (along, np.rint(turned))
        for scores in device.neighbour_scores(
            *_scored_sides(device, sample, np.concatenate((motions, steps)))
        )
    ]


def _piece_words(device: ComputeDevice, sample: Sample) -> Arrays:
    facing = sample.rng.integers(0, 256, sample.shape).astype(np.uint8)
    fields = [device.upload(field) for field in (sample.distance2, sample.cells, facing)]
    return fetch(device, [device.piece_words(*fields, _worths(), base=BASE, span=191, near2=9)])


def _piece_sums(device: ComputeDevice, sample: Sample) -> Arrays:
    words = device.upload(sample.rng.integers(0, 2**32, sample.shape).astype(np.uint32))
    motions = fixed_poses(sample.motions).T.astype(np.float64)
    # A piece of one point, one of none, a large one.
    starts = np.array([0, 1, 1, 90, 150], dtype=np.int32)
    facing = sample.rng.integers(0, 256, 150).astype(np.uint8)
    pieces = piece_points(sample.points(150), facing, starts, device)
    side = PieceSide(pieces, motions, words, BASE)
    return [
        sums for sided in (True, False) for sums in device.start_piece_sums(side, sided=sided)()
    ]


def _fit_motions(device: ComputeDevice, sample: Sample) -> Arrays:
    x, y, yaw = sample.motions.T
    motions = np.stack((np.cos(yaw), np.sin(yaw), x, y))
    height, width = sample.shape
    points = device.upload((sample.rng.random((150, 2)) * (width, height)).astype(np.float32))
    distance = device.upload(DISTANCE_TABLE[sample.distance2])
    # Half and quarter turns, and eighths of a cell: no rounding says which cells a point reads.
    shift = np.rint(8.0 * sample.motions[0, :2]) / 8.0
    turns = np.array([[1, 0, 0, 0], [-1, 0, width, height], [0, 1, height, 0]], dtype=np.float64).T
    turns[2:] += shift[:, None]
    eighths = sample.rng.integers(0, 8 * np.array((width, height)), (150, 2)) / 8.0
    unseen = DISTANCE_TABLE[sample.distance2]
    unseen[sample.rng.random(sample.shape) < 0.15] = DISTANCE_UNSEEN
    # A corner of two walls, to which the steps of several rounds converge.
    rows, cols = np.indices(sample.shape)
    corner = np.minimum(abs(rows - height // 3), abs(cols - width // 3)) * DISTANCE_ONE
    near = sample.motions * (0.05, 0.05, 0.02)
    close = np.stack((np.cos(near[:, 2]), np.sin(near[:, 2]), *near[:, :2].T))
    rough = FitSide(points, distance)
    exact = FitSide(device.upload(eighths.astype(np.float32)), device.upload(unseen))
    smooth = FitSide(
        points, device.upload(np.minimum(corner, DISTANCE_UNSEEN - 1).astype(np.uint16))
    )
    pivot, scales = (width / 2.0, height / 2.0, (height + width) / 4.0), np.array([6.0, 3.0, 12.0])
    return [
        device.start_fit(forward, backward, moved, np.stack([scales] * rounds), steps, pivot)()
        for forward, backward, moved, rounds, steps in (
            (rough, rough, motions, 1, 1),
            (exact, rough, turns, 1, 1),
            (rough, exact, turns, 1, 1),
            (smooth, smooth, close, 2, 3),
        )
    ]


def _flat(votes: Iterable[Votes]) -> Arrays:
    """Return the parts of votes as arrays."""
    return [np.asarray(part) for vote in votes for part in vote]


def _vote_majority(device: ComputeDevice, sample: Sample) -> Arrays:
    return _flat(
        device.vote_majority(sample.grids(count), unknown_votes=unknown_votes)
        for count in (1, 2, 3, 4, 9, 17)
        for unknown_votes in (True, False)
    )


def _vote_walls(device: ComputeDevice, sample: Sample) -> Arrays:
    found = []
    for count, shift in ((1, 2), (3, 3), (9, 5)):
        height, width = sample.shape
        blocks = (count, (height + 1 >> shift) + 1, (width + 2 >> shift) + 1)
        codes = [_codes(grid, sample) for grid in sample.grids(count)]
        weights = sample.rng.integers(0, 16, blocks).astype(np.uint8) * np.uint8(17)
        ranks = sample.rng.permutation(math.prod(blocks)).astype(np.uint16).reshape(blocks)
        trusted = sample.rng.integers(0, 256, count).astype(np.uint8)
        votes = device.vote_walls(
            codes, weights, ranks, trusted, reach=4, shift=shift, phase=(1, 2)
        )
        found += _flat([votes])
    return found


def _codes(grid: npt.NDArray[np.int8], sample: Sample) -> npt.NDArray[np.uint8]:
    """Return codes of walls, with ways that they face at random."""
    walls = (grid == 1) * np.uint8(WALL_OCCUPIED | WALL_NEAR)
    near = (sample.rng.random(grid.shape) < 0.2) * np.uint8(WALL_NEAR)
    ways = sample.rng.integers(0, 16, grid.shape).astype(np.uint8) << np.uint8(WALL_SIDES)
    return np.asarray(walls | near | (grid == 0) * np.uint8(WALL_FREE) | ways, dtype=np.uint8)


def _cast_rays(device: ComputeDevice, sample: Sample) -> Arrays:
    classes = sample.rng.choice(3, sample.shape, p=(0.9, 0.07, 0.03)).astype(np.uint8)
    size = np.array(sample.shape[::-1])
    places = sample.rng.uniform(-0.2, 1.2, (97, 2)) * size + sample.away
    places[:9] = np.floor(places[:9])  # on the edges of cells
    angles = sample.rng.uniform(-np.pi, np.pi, 97)
    angles[:17] = np.arange(-8, 9) * (np.pi / 4.0)  # along the cells and through their corners
    rays = np.column_stack((places, np.cos(angles), np.sin(angles))).astype(np.float32)
    cells = device.upload(classes)
    return [
        np.nan_to_num(device.cast_rays(cells, rays[:count], reach), posinf=-1.0)
        for count, reach in ((97, 300.0), (97, 2.5), (1, 40.0))
    ]


GRID_CHECKS: dict[str, Check] = {
    "solid_walls": _solid_walls,
    "surface_walls": _surface_walls,
    "shrink": _shrink,
    "distance_squared": _distance_squared,
    "start_known_by_distance": _known_by_distance,
    "wall_distances": _wall_distances,
    "score_field": _score_field,
    "max_ahead": _max_ahead,
    "warp": _warp,
    "grid_error": _grid_error,
    "best_shifts": _best_shifts,
    "bound_blocks": _bound_blocks,
    "pose_counts": _pose_counts,
    "pose_scores": _pose_scores,
    "neighbour_scores": _neighbour_scores,
    "piece_words": _piece_words,
    "start_piece_sums": _piece_sums,
    "start_fit": _fit_motions,
    "vote_majority": _vote_majority,
    "vote_walls": _vote_walls,
    "cast_rays": _cast_rays,
}
