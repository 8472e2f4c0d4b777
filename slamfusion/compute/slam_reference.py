"""The NumPy twins of the SLAMs' kernels: scoring poses on tiled maps, and tinySLAM's map update.

A tiled map is a window of pages (PH, PW) int32 and pools (T, TILE, TILE): a page holds the number
of a tile, and tile 0 is the empty tile that every unused page shares. Positions are in cells of the
window. All results are whole numbers and equal the kernels' exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = [
    "BEAM_ONE",
    "CLIMBERS",
    "HALF",
    "MOST_OBSERVATIONS",
    "TILE",
    "UNSEEN",
    "VALUE_ONE",
    "BeamRule",
    "SmearRule",
    "climb",
    "climb_maps",
    "score_maps",
    "score_poses",
    "smear_fold",
    "smear_mark",
    "tiny_fold",
    "tiny_mark",
]

U8 = npt.NDArray[np.uint8]
U32 = npt.NDArray[np.uint32]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
F32 = npt.NDArray[np.float32]

TILE = 32
# Poses that a climber tries in a round.
CLIMBERS = 16
# Positions and lengths of beams count in 1/1024 cell, values of cells in 1/4095.
BEAM_ONE = 1024
VALUE_ONE = 4095
# A cell's state: mean in 1/2^20 above 12 bits of observations.
HALF = 1 << 19
MOST_OBSERVATIONS = 4095
UNSEEN = HALF << 12
# A word of the observed pool: hit, value, in front of the hit; 0 is no word.
HIT_SHIFT, VALUE_SHIFT = 13, 1
# A mean of 255 in a cell's 20 bits.
MEAN_ONE = 4112
SIXTEENTHS = np.float32(16.0)


class BeamRule(NamedTuple):
    """How beams of one scan write into the map.

    Attributes:
        half_blur: half width of the valley around a hit, 1/1024 cell.
        behind: least value that is written behind a hit, 0 to 4095.
        free: value of a passed cell for the matcher, 0 to 4095.
        map_free: the same for the published map.
        quality: how much of the scan is believed, in 1/1024.
        is_mean: cell model ``mean``; otherwise ``base``.
        wall_floor: mean of a cell, in 1/2^20, up to which the score field is 0.
        wall_gain: what a mean above it adds to the field; at most 2000.
    """

    half_blur: int
    behind: int
    free: int
    map_free: int
    quality: int
    is_mean: bool
    wall_floor: int
    wall_gain: int


def _cells(field: U8, pages: I32, cols: I64, rows: I64) -> I64:
    """Return field values of cells; beyond the window, those of its empty border."""
    height, width = pages.shape
    col = np.clip(cols, 0, width * TILE - 1)
    row = np.clip(rows, 0, height * TILE - 1)
    tiles = pages[row // TILE, col // TILE]
    return field[tiles, row % TILE, col % TILE].astype(np.int64)


def score_poses(field: U8, pages: I32, points: F32, poses: F32, *, reach: int = 0) -> I64:
    """Sum the score field under a scan's points at each candidate pose.

    Args:
        field: (T, TILE, TILE) uint8 wall values.
        pages: (PH, PW) int32, tile of each page of the window; the border is empty.
        points: (P, 2) float32, cells, in the robot's frame.
        poses: (N, 4) float32: x, y in cells of the window, cos, sin.
        reach: 0 interpolates between cell centres, in sixteenths; otherwise the greatest of five
            cells counts: the one under the point and four, ``reach`` cells away diagonally.

    Returns:
        (N,) int64 sums.
    """
    px, py = points.T
    x, y, cos, sin = (poses[:, i : i + 1] for i in range(4))
    east = x + (cos * px - sin * py)
    north = y + (sin * px + cos * py)
    if reach:
        col, row = east.astype(np.int64), north.astype(np.int64)
        around = [(0, 0), (-reach, -reach), (reach, -reach), (-reach, reach), (reach, reach)]
        found = [_cells(field, pages, col + dx, row + dy) for dx, dy in around]
        return np.asarray(np.max(found, axis=0).sum(axis=1))
    return np.asarray(_smooth(field, pages, east, north).sum(axis=1))


def _smooth(field: U8, pages: I32, east: F32, north: F32) -> I64:
    """Return the field at positions in cells, between cell centres bilinear in sixteenths."""
    east, north = east - np.float32(0.5), north - np.float32(0.5)
    col, row = east.astype(np.int64), north.astype(np.int64)
    right = ((east - col.astype(np.float32)) * SIXTEENTHS).astype(np.int64)
    up = ((north - row.astype(np.float32)) * SIXTEENTHS).astype(np.int64)
    a, b = _cells(field, pages, col, row), _cells(field, pages, col + 1, row)
    c, d = _cells(field, pages, col, row + 1), _cells(field, pages, col + 1, row + 1)
    low, high = a * (16 - right) + b * right, c * (16 - right) + d * right
    blended: I64 = np.asarray(low * (16 - up) + high * up, dtype=np.int64)
    return np.asarray(blended >> 8)


def climb(
    field: U8,
    pages: I32,
    points: F32,
    guesses: F32,
    starts: F32,
    steps: F32,
    *,
    scale: float,
) -> F32:
    """Climb from some poses by rounds of random steps; every climber keeps to itself.

    In each round ``CLIMBERS`` steps are tried from the climber's best pose, and the best of the
    poses they lead to, the first of equals, is where its next round starts. What counts is the sum
    of the smooth score field times ``scale``, less the least over the guesses of the weighted
    squares of the distances from it plus its own loss.

    Args:
        field: (T, TILE, TILE) uint8 wall values.
        pages: (PH, PW) int32.
        points: (P, 2) float32, cells, in the robot's frame.
        guesses: (K, 7) float32: x, y, yaw, the weights of their squares, the guess's own loss.
        starts: (G, 5) float32: x, y in cells of the window, yaw, cos, sin.
        steps: (R, G, CLIMBERS, 5) float32: dx, dy, dyaw, cos and sin of dyaw. R at least 1.
        scale: from a sum to a score.

    Returns:
        (G, 6) float32: x, y, yaw, cos, sin and the value of where each climber ended.
    """
    best = starts.copy()
    values = np.zeros(len(starts), dtype=np.float32)
    for step in steps:
        x, y, yaw, cos, sin = (best[:, None, k] for k in range(5))
        turned = cos * step[..., 3] - sin * step[..., 4], sin * step[..., 3] + cos * step[..., 4]
        tried = np.stack((x + step[..., 0], y + step[..., 1], yaw + step[..., 2], *turned), axis=-1)
        poses = tried[..., [0, 1, 3, 4]].reshape(-1, 4)
        sums = score_poses(field, pages, points, poses)
        away = tried[:, :, None, :3] - guesses[:, :3]
        squares = away * away * guesses[:, 3:6]
        losses = ((squares[..., 0] + squares[..., 1]) + squares[..., 2]) + guesses[:, 6]
        told = sums.reshape(tried.shape[:2]).astype(np.float32) * np.float32(scale)
        value = told - losses.min(axis=-1)
        winner = value.argmax(axis=1)
        each = np.arange(len(starts))
        best, values = tried[each, winner], value[each, winner]
    return np.concatenate((best, values[:, None]), axis=1)


def climb_maps(
    field: U8,
    pages: I32,
    points: F32,
    guesses: F32,
    starts: F32,
    sizes: F32,
    *,
    tries: int,
    scale: float,
) -> F32:
    """Climb on each of many maps by steps along the axes and diagonals of (x, y, yaw).

    The best of a try's poses, the first of equals, is where the next one starts; where staying is
    best the next smaller step follows. What counts is as for ``climb``, with one guess a map.

    Args:
        field: (T, TILE, TILE) uint8 wall values of all maps.
        pages: (N, PH, PW) int32.
        points: (P, 2) float32, cells, in the robot's frame.
        guesses: (N, 7) float32, as for ``climb``.
        starts: (N, 5) float32: x, y in cells of the window, yaw, cos, sin.
        sizes: (S, 4) float32: cells, radians, their cos and sin; largest first.
        tries: at most so many in all, at least 1.
        scale: from a sum to a score.

    Returns:
        (N, 6) float32: x, y, yaw, cos, sin and the value of where each climb ended.
    """
    found = np.empty((len(starts), 6), dtype=np.float32)
    ways = _ways().astype(np.float32)
    for own, guess, start, place in zip(pages, guesses, starts, found, strict=True):
        best, at = start.copy(), 0
        for _ in range(tries):
            cells, radians, cos, sin = sizes[at]
            turn = ways[:, 2]
            dcos = np.where(turn == 0, np.float32(1.0), cos)
            dsin = turn * sin
            turned = best[3] * dcos - best[4] * dsin, best[4] * dcos + best[3] * dsin
            moved = best[:2] + ways[:, :2] * cells, best[2] + turn * radians
            tried = np.column_stack((*moved, *turned))
            sums = score_poses(field, own, points, tried[:, [0, 1, 3, 4]])
            away = tried[:, :3] - guess[:3]
            squares = away * away * guess[3:6]
            losses = ((squares[:, 0] + squares[:, 1]) + squares[:, 2]) + guess[6]
            values = sums.astype(np.float32) * np.float32(scale) - losses
            winner = int(values.argmax())
            best, place[5] = tried[winner], values[winner]
            at += winner == 0
            if at >= len(sizes):
                break
        place[:5] = best
    return found


def _ways() -> I64:
    """Return (CLIMBERS, 3) signs along x, y and yaw: stay, the axes, the diagonals."""
    axes = [np.roll((sign, 0, 0), axis) for axis in range(3) for sign in (1, -1)]
    diagonals = [(2 * (k & 1) - 1, (k & 2) - 1, (k & 4) // 2 - 1) for k in range(8)]
    return np.array([(0, 0, 0), *axes, *diagonals, (0, 0, 0)], dtype=np.int64)


def score_maps(field: U8, pages: I32, points: F32, poses: F32, table: I32) -> I64:
    """Sum what a table makes of the smooth score field under the points, on each of many maps.

    Args:
        field: (T, TILE, TILE) uint8 wall values of all maps.
        pages: (N, PH, PW) int32.
        points: (P, 2) float32, cells, in the robot's frame.
        poses: (N, K, 4) float32: x, y in cells of the window, cos, sin.
        table: (256,) int32.

    Returns:
        (N, K) int64 sums.
    """
    px, py = points.T
    sums = np.empty(poses.shape[:2], dtype=np.int64)
    for own, at, out in zip(pages, poses, sums, strict=True):
        x, y, cos, sin = (at[:, i : i + 1] for i in range(4))
        east, north = x + (cos * px - sin * py), y + (sin * px + cos * py)
        out[:] = table[_smooth(field, own, east, north)].sum(axis=1)
    return sums


class _Walks(NamedTuple):
    """Every step of every beam, flat: its beam, its number (0 at the hit) and its cell."""

    beam: I64
    i: I64
    col: I64
    row: I64
    step: I64


def _walks(beams: I32, half_blur: int) -> _Walks:
    """Walk each beam from behind its hit to the laser, one cell of the longer axis a step."""
    hit_x, hit_y, laser_x, laser_y, length, _ = beams.astype(np.int64).T
    dx, dy = laser_x - hit_x, laser_y - hit_y
    longest = np.maximum(np.abs(dx), np.abs(dy))
    m = np.maximum(longest, 1)
    step_x = np.abs(dx) * (1 << 20) // m * np.where(dx < 0, -1, 1)
    step_y = np.abs(dy) * (1 << 20) // m * np.where(dy < 0, -1, 1)
    step = length * (1 << 20) // m
    reach = np.where(step > 0, (half_blur << 10) // np.maximum(step, 1), 0)
    counts = reach + longest // BEAM_ONE + 1
    beam = np.repeat(np.arange(len(beams)), counts)
    i = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts, counts) - reach[beam]
    col = ((hit_x[beam] << 10) + i * step_x[beam]) >> 20
    row = ((hit_y[beam] << 10) + i * step_y[beam]) >> 20
    return _Walks(beam, i, col, row, step[beam])


def tiny_mark(observed: U32, pages: I32, beams: I32, rule: BeamRule, wanted: I32) -> bool:
    """Write into ``observed``, in place, what the beams of a scan say of their cells.

    Args:
        observed: (T, TILE, TILE) uint32, 0 before; the strongest word stays: a hit over the
            greatest value over in front over behind.
        pages: (PH, PW) int32.
        beams: (B, 6) int32: x, y of the hit and of the laser and the length between them in 1/1024
            cell, the value at the ridge of the valley, 0 to 4095. All inside the window.
        rule: see ``BeamRule``.
        wanted: (1 + PH * PW,) int32, set to 1 in place at 0 and at 1 + page where a page has no
            tile yet; those cells are left out.

    Returns:
        Whether a page was missing: provide tiles and mark again, which changes nothing twice.
    """
    w = _walks(beams, rule.half_blur)
    away = (np.abs(w.i) * w.step) >> 10
    half = max(1, rule.half_blur)
    value = np.full(len(w.i), rule.free, dtype=np.int64)
    near = away < rule.half_blur
    rise = np.maximum(beams[w.beam, 5].astype(np.int64) - rule.free, 0)
    value[near] += (rise * (rule.half_blur - away) // half)[near]
    keep = (w.i >= 0) | (value >= rule.behind)
    value[w.i == 0] = beams[w.beam[w.i == 0], 5]
    word = (w.i == 0).astype(np.int64) << HIT_SHIFT | value << VALUE_SHIFT | (w.i >= 0)
    tiles = pages[w.row // TILE, w.col // TILE]
    missing = keep & (tiles == 0)
    wanted[1 + (w.row // TILE * pages.shape[1] + w.col // TILE)[missing]] = 1
    wanted[0] |= int(missing.any())
    put = keep & (tiles != 0)
    at = (tiles[put], w.row[put] % TILE, w.col[put] % TILE)
    np.maximum.at(observed, at, word[put].astype(np.uint32))
    return bool(wanted[0])


def _joined(state: I64, value: I64, rule: BeamRule) -> I64:
    """Join observations (0 to 4095) to the states of cells, by the cell model."""
    mean, seen = state >> 12, state & MOST_OBSERVATIONS
    told = value << 8
    if rule.is_mean:
        change = HALF + (((told - HALF) * rule.quality) >> 10) - mean
        following = mean + np.sign(change) * (np.abs(change) // (seen + 1))
    else:
        following = mean + (((told - mean) * rule.quality) >> 10)
    return np.asarray(following << 12 | np.minimum(seen + 1, MOST_OBSERVATIONS))


def tiny_fold(
    observed: U32,
    valley: U32,
    published: U32,
    field: U8,
    pages: I32,
    beams: I32,
    rule: BeamRule,
) -> None:
    """Fold, in place, what a scan marked into the cells; each cell learns once a scan.

    Args:
        observed: (T, TILE, TILE) uint32, as ``tiny_mark`` left it; becomes 0.
        valley: (T, TILE, TILE) uint32 states with the blur, for the matcher.
        published: the same without the blur and without what lies behind hits.
        field: (T, TILE, TILE) uint8: how much of a wall the valley is, 0 to 255.
        pages: (PH, PW) int32.
        beams: as for ``tiny_mark``.
        rule: as for ``tiny_mark``.
    """
    w = _walks(beams, rule.half_blur)
    places = np.stack((pages[w.row // TILE, w.col // TILE], w.row % TILE, w.col % TILE), axis=-1)
    places = np.unique(places, axis=0)
    words = observed[tuple(places.T)].astype(np.int64)
    places, words = (item[words > 0] for item in (places, words))
    at = tuple(places.T)
    observed[at] = 0
    value = words >> VALUE_SHIFT & VALUE_ONE
    state = _joined(valley[at].astype(np.int64), value, rule)
    valley[at] = state.astype(np.uint32)
    walls = ((state >> 12) - rule.wall_floor) * rule.wall_gain >> 20
    field[at] = np.clip(walls, 0, 255).astype(np.uint8)
    front = (words & 1) == 1
    at = tuple(places[front].T)
    told = np.where(words[front] >> HIT_SHIFT, value[front], rule.map_free)
    published[at] = _joined(published[at].astype(np.int64), told, rule).astype(np.uint32)


class SmearRule(NamedTuple):
    """How the hits of one scan spread into the cells around them.

    Attributes:
        table: (256,) uint8 value by the squared distance from a cell's centre to a hit, in (1/1024
            cell)^2; it never rises, and its last counts for all that is farther.
        shift: the squared distance is shifted right by this first.
        reach: cells around a hit's own that learn of it.
        most: observations that a cell remembers, 1 to 4095.
    """

    table: U8
    shift: int
    reach: int
    most: int


def _smears(beams: I32, reach: int) -> tuple[I64, I64, I64, I64]:
    """Return beam, column and row of every cell that beams speak of, and whether it is passed."""
    flat = np.column_stack((beams, np.zeros((len(beams), 2), dtype=np.int32)))
    w = _walks(flat, 0)
    way = w.i >= 1
    around = np.arange(-reach, reach + 1)
    rows, cols = (axis.ravel() for axis in np.meshgrid(around, around, indexing="ij"))
    col = (beams[:, :1].astype(np.int64) >> 10) + cols
    row = (beams[:, 1:2].astype(np.int64) >> 10) + rows
    beam = np.repeat(np.arange(len(beams)), len(rows))
    passed = np.concatenate((np.ones(int(way.sum()), np.int64), np.zeros(col.size, np.int64)))
    return (
        np.concatenate((w.beam[way], beam)),
        np.concatenate((w.col[way], col.ravel())),
        np.concatenate((w.row[way], row.ravel())),
        passed,
    )


def smear_mark(observed: U32, pages: I32, beams: I32, rule: SmearRule, wanted: I32) -> bool:
    """Write into ``observed``, in place, how near the hits of a scan come to the cells.

    Args:
        observed: (T, TILE, TILE) uint32, 0 before; the strongest word stays.
        pages: (PH, PW) int32.
        beams: (B, 4) int32: x, y of the hit and of the laser in 1/1024 cell; all that they come
            near to inside the window.
        rule: see ``SmearRule``.
        wanted: as for ``tiny_mark``.

    Returns:
        Whether a page was missing: provide tiles and mark again, which changes nothing twice.
    """
    beam, col, row, passed = _smears(beams, rule.reach)
    hit_x, hit_y = beams[beam, 0].astype(np.int64), beams[beam, 1].astype(np.int64)
    dx, dy = hit_x - (col << 10) - 512, hit_y - (row << 10) - 512
    step = np.minimum((dx * dx + dy * dy) >> rule.shift, 255)
    value = np.where(passed == 1, 0, rule.table[step].astype(np.int64))
    tiles = pages[row // TILE, col // TILE]
    missing = tiles == 0
    wanted[1 + (row // TILE * pages.shape[1] + col // TILE)[missing]] = 1
    wanted[0] |= int(missing.any())
    put = ~missing
    at = (tiles[put], row[put] % TILE, col[put] % TILE)
    np.maximum.at(observed, at, (value[put] << 1 | 1).astype(np.uint32))
    return bool(wanted[0])


def smear_fold(
    observed: U32, states: U32, field: U8, pages: I32, beams: I32, rule: SmearRule
) -> None:
    """Fold, in place, what a scan marked into the cells' means; each cell learns once a scan.

    Args:
        observed: (T, TILE, TILE) uint32, as ``smear_mark`` left it; becomes 0.
        states: (T, TILE, TILE) uint32: mean in 1/2^20 of 255 above 12 bits of observations.
        field: (T, TILE, TILE) uint8: the mean.
        pages: (PH, PW) int32.
        beams: as for ``smear_mark``.
        rule: as for ``smear_mark``.
    """
    _, col, row, _ = _smears(beams, rule.reach)
    places = np.stack((pages[row // TILE, col // TILE], row % TILE, col % TILE), axis=-1)
    places = np.unique(places, axis=0)
    words = observed[tuple(places.T)].astype(np.int64)
    places, words = (item[words > 0] for item in (places, words))
    at = tuple(places.T)
    observed[at] = 0
    state = states[at].astype(np.int64)
    mean = state >> 12
    more = np.minimum((state & MOST_OBSERVATIONS) + 1, rule.most)
    change = (words >> 1) * MEAN_ONE - mean
    following = mean + np.sign(change) * (np.abs(change) // more)
    states[at] = (following << 12 | more).astype(np.uint32)
    field[at] = (following // MEAN_ONE).astype(np.uint8)
