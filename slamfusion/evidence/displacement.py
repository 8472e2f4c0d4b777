"""``find_displacements``: where a path draws walls away from where it has drawn them before.

A bent map shows what the robot saw on one visit next to what it saw on another. So the hits of each
chunk of the drive are moved together over the map of the chunks before some time, or after it. If
they fit another place better than their own, the path is wrong there by that distance. People,
glass, vegetation and a noisy laser make hits unlikely at every place, so they do not count.

That place is sought nearby. Where a path is torn, all that was seen afterwards lies farther off,
and turned. So if more than a quarter of what was seen after some time stands where there was free
space before, the maps of both times are aligned. Without that, rooms that look alike would pass for
one room.

The place is chosen on one half of the chunk and tested on the other, and vice versa, so that the
best of many places is no better by chance. The test is a t-test over blocks of neighbouring scans,
corrected for the number of tests: at most one in a hundred right drives has a chunk that is
reported as displaced.

Source: Stone, Cross-validatory choice and assessment of statistical predictions, Journal of the
Royal Statistical Society B 36(2), 1974 (choose on one part, test on the other).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import scipy

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.align.search import search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute.layout import BEAM_ONE, TILE
from slamfusion.config import AlignConfig, NormalizeConfig
from slamfusion.evidence.beams import CHUNKS
from slamfusion.evidence.parting import PART_M
from slamfusion.evidence.predictive import (
    CELL_M,
    NEIGHBOURS,
    OTHERS,
    REACH_CELLS,
    SURE,
    UNKNOWN,
    DrawnChunks,
    PathEvidence,
)
from slamfusion.geometry import F64, I64, U32, Pose2, moved_poses, wrap_angles
from slamfusion.trajectory import Trajectory

# Share of the seen walls that were free space at other times above which a map needs a check:
# people and moved furniture make up to a quarter. If more than the second share were free space
# before, the robot is elsewhere.
DOUBTED, CONTRADICTED = 0.25, 0.5
# Share of the hits seen at another time below which nothing confirms the path.
LITTLE_SEEN = 0.25
# The fewest hits for a contradiction.
LEAST_ASKED = 200

# Range and step of the moved hits, metres: twice the deviation of a hit misses no place.
REACH_M, STEP_M = 0.8, 0.1
# The most places tried of all that was seen after some time, how far they may be turned, and cells
# of the largest map that is aligned, 200 m on each side.
MOST_PLACES, TURNED_RAD, MOST_CELLS = 4, 0.25 * np.pi, 1 << 24
# Among the times after which the hits gain this share of the most, the path decides.
TELLING = 0.9
# Smaller displacements are ignored, metres: paths this close have met again.
LEAST_M = 0.5 * PART_M
# Walls farther from a hit, cells, do not explain it: twice the deviation again.
WALL_CELLS = 2
# Blocks of neighbouring scans of a chunk; places are chosen on every second one.
BLOCKS = 8
# The most moved hits, 200 a chunk; and parts of the motions, which bound the memory.
MOST_HITS, PARTS = 200 * CHUNKS, 8
# What was seen before each of these shares of the drive is compared with what was seen after it.
SPLITS = (0.25, 0.5, 0.75)
# Log-likelihood of a hit where nothing was seen.
PRICE = float(np.log(UNKNOWN))
# Motions within ``REACH_M``, (S, 2) metres.
_STEPS_M = np.arange(-round(REACH_M / STEP_M), round(REACH_M / STEP_M) + 1) * STEP_M
_SQUARE_M = np.stack(np.meshgrid(_STEPS_M, _STEPS_M), axis=-1).reshape(-1, 2)
MOVES_M = _SQUARE_M[np.hypot(*_SQUARE_M.T) <= REACH_M + 0.5 * STEP_M]


@dataclass(frozen=True)
class Displacement:
    """A part of the drive in which walls stand away from where other parts of the drive saw them.

    Attributes:
        from_s, to_s: seconds since the first scan.
        away_m: how far away, metres.
    """

    from_s: float
    to_s: float
    away_m: float


class Contradiction(NamedTuple):
    """From some time on most of what a robot sees stands where it saw free space before.

    Attributes:
        since_s: seconds since the first scan.
        share: of the hits in places that were seen before, ``CONTRADICTED`` to 1.
        moved_share: the same after the best move of each chunk within ``REACH_M``.
    """

    since_s: float
    share: float
    moved_share: float


def find_displacements(evidence: PathEvidence, name: str) -> tuple[Displacement, ...]:
    """Return the chunks of a drive that are surely displaced, in the order of time."""
    scans = evidence.scans
    drawn = _drawn(evidence, name, WALL_CELLS)
    some = _some_hits(drawn)
    p_values, away_m = np.ones(CHUNKS), np.zeros(CHUNKS)
    for split in SPLITS:
        among, is_late = _other_side(split), drawn.chunks[some] >= split * CHUNKS
        # Hits that the other side has not seen contradict nothing.
        likelihoods, is_seen = drawn.look_up(some, among=among)
        if not is_seen.any():
            continue
        picked, own = some[is_seen], np.maximum(likelihoods[is_seen], PRICE)
        block = drawn.hit_scans[picked] * (CHUNKS * BLOCKS) // len(scans)
        hits = np.maximum(np.bincount(block, minlength=CHUNKS * BLOCKS), 1)
        moved = np.maximum(_moved(drawn, picked, among), PRICE) - own
        moves_m = np.tile(np.hypot(*MOVES_M.T)[:, None], CHUNKS)
        is_moved = is_seen & is_late
        places = _better_places(drawn, some[is_moved], likelihoods[is_moved], split)
        # The one that explains most of all chunks together.
        place = max(places, key=lambda place: float(place[0].sum()), default=None)
        if place is not None:
            gained = np.zeros(len(picked))
            gained[is_late[is_seen]], motion = place
            moved = np.concatenate((moved, gained[None]))
            moves_m = np.concatenate((moves_m, _means_m(drawn, picked, motion)[None]))
        sums = np.array([np.bincount(block, gain, CHUNKS * BLOCKS) for gain in moved])
        gains = (sums / hits).reshape(-1, CHUNKS, BLOCKS)
        found = _p_values(gains)
        is_surer = found < p_values
        p_values[is_surer] = found[is_surer]
        best = gains.sum(axis=2).argmax(axis=0)
        away_m[is_surer] = moves_m[best, np.arange(CHUNKS)][is_surer]
    since_s = scans.stamps_s - scans.stamps_s[0]
    displaced = []
    is_sure = (p_values < SURE / (CHUNKS * len(SPLITS))) & (away_m > LEAST_M)
    for chunk in np.flatnonzero(is_sure).tolist():
        here = np.flatnonzero(scans.chunks == chunk)
        end = min(int(here[-1]) + 1, len(scans) - 1)
        times_s = float(since_s[here[0]]), float(since_s[end])
        displaced.append(Displacement(*times_s, float(away_m[chunk])))
    return tuple(displaced)


def find_place_seen_before(evidence: PathEvidence, name: str) -> Displacement | None:
    """Return from when on a path draws a place elsewhere that it has drawn before, else None.

    A robot that was carried away sees little where others saw something. So only then the maps of
    both times are aligned, and the answer counts if it stands up to its rivals.
    """
    scans, drawn = evidence.scans, _drawn(evidence, name)
    since_s = scans.stamps_s - scans.stamps_s[0]
    for split in SPLITS:
        late = np.flatnonzero(drawn.chunks >= split * CHUNKS)
        _, is_seen = drawn.look_up(late, _other_side(split))
        is_little = np.count_nonzero(is_seen) < LITTLE_SEEN * len(late)
        pair = _before_and_after(drawn, split) if is_little else None
        answer = None if pair is None else align_pair(pair, AlignConfig())
        if answer is None or not answer.accepted:
            continue
        away_m = float(_means_m(drawn, late, answer.transform).max())
        if away_m > REACH_M:
            from_s, to_s = since_s[[drawn.hit_scans[late[0]], -1]].tolist()
            return Displacement(from_s, to_s, away_m)
    return None


def contradicted_share(evidence: PathEvidence, name: str) -> float:
    """Return the share of hits, 0 to 1, that fell on free space seen at another time.

    Only hits count that scans shortly before and after explain, in places seen at other times.
    """
    drawn = _drawn(evidence, name)
    (now, _), (then, is_seen) = (drawn.look_up(among=bits) for bits in (NEIGHBOURS, OTHERS))
    is_asked = is_seen & (now > PRICE)
    return float(np.mean(then[is_asked] < PRICE)) if is_asked.any() else 0.0


def find_contradiction(evidence: PathEvidence, name: str) -> Contradiction | None:
    """Return since when most of what a robot sees was free space before, else None."""
    scans = evidence.scans
    drawn = _drawn(evidence, name)
    some = _some_hits(drawn)
    # Only hits that the scans shortly before and after explain.
    some = some[drawn.look_up(some, among=NEIGHBOURS)[0] > PRICE]
    shares = np.zeros(CHUNKS)
    for first in range(2, CHUNKS):
        late = some[drawn.chunks[some] >= first]
        if len(late) < LEAST_ASKED:
            break
        then, is_seen = drawn.look_up(late, among=_before(first))
        if np.count_nonzero(is_seen) >= LEAST_ASKED:
            shares[first] = np.mean(then[is_seen] < PRICE)
    first = int(shares.argmax())
    if shares[first] <= CONTRADICTED:
        return None
    late = some[drawn.chunks[some] >= first]
    late = late[drawn.look_up(late, among=_before(first))[1]]
    found = _moved(drawn, late, _before(first))
    chunks = drawn.chunks[late]
    by_chunk = [np.bincount(chunks, np.maximum(row, PRICE), CHUNKS) for row in found]
    moved = found[np.argmax(by_chunk, axis=0)[chunks], np.arange(len(late))]
    since_s = scans.stamps_s[np.flatnonzero(scans.chunks == first)[0]] - scans.stamps_s[0]
    return Contradiction(float(since_s), float(shares[first]), float(np.mean(moved < PRICE)))


def moved_together(
    evidence: PathEvidence, name: str, path: Trajectory, *, is_torn: bool
) -> tuple[Trajectory, float]:
    """Move all scans after some time together to where they fit those before it best.

    is_torn: whether they are moved as far as the maps of both times say, else within ``REACH_M``.

    Returns:
        ``path``, scored in ``evidence`` as ``name``, after the best motion from the best time on;
        and by how much the mean log-likelihood of a hit rises.
    """
    scans, drawn = evidence.scans, _drawn(evidence, name, WALL_CELLS)
    some = _some_hits(drawn)
    own = evidence.scores[name].poses
    moves = _far_moves(drawn, some, own) if is_torn else _near_moves(drawn, some, scans.chunks)
    gain, since, motion = max(moves, key=itemgetter(0), default=(0.0, 0, Pose2()))
    poses, is_late = path.poses.copy(), path.stamps_s >= scans.stamps_s[since]
    poses[is_late] = moved_poses(motion, poses[is_late])
    return replace(path, poses=poses), gain / len(some)


def _near_moves(drawn: DrawnChunks, some: I64, chunks: I64) -> Iterator[tuple[float, int, Pose2]]:
    """Yield for each chunk the gain of moving all from its first scan on, that scan, the motion."""
    along = Pose2(0.0, 0.0, drawn.origin.yaw_rad)
    for first in range(2, CHUNKS):
        late = some[drawn.chunks[some] >= first]
        late = late[drawn.look_up(late, _before(first))[1]]
        sums = _moved(drawn, late, _before(first)).sum(axis=1)
        move_m = along.transform(MOVES_M[sums.argmax()]).tolist()
        gain = float(sums.max() - sums[len(sums) // 2])
        yield gain, int(chunks.searchsorted(first)), Pose2(*move_m)


def _far_moves(drawn: DrawnChunks, some: I64, own: F64) -> Iterator[tuple[float, int, Pose2]]:
    """Yield the same of motions that bring what was seen after a time onto what was seen before.

    own: (N, 3) the poses at the scans. Where no hit tells it, the scan is the one that the motion
    brings nearest to the one before it: the path is torn there.
    """
    for split in SPLITS:
        late = some[drawn.chunks[some] >= split * CHUNKS]
        likelihoods, is_seen = drawn.look_up(late, _other_side(split))
        late = late[is_seen]
        for gains, motion in _better_places(drawn, late, likelihoods[is_seen], split):
            # Of the hits from each one on.
            sums = np.cumsum(gains[::-1])[::-1]
            best = np.flatnonzero(sums >= TELLING * sums.max())
            first = 1 if best[0] == 0 else int(drawn.hit_scans[late[best[0] - 1]])
            last = int(drawn.hit_scans[late[best[-1]]])
            steps = moved_poses(motion, own[first : last + 1]) - own[first - 1 : last]
            far = np.hypot(steps[:, 0], steps[:, 1]) + np.abs(wrap_angles(steps[:, 2]))
            yield float(sums.max()), first + int(np.nan_to_num(far, nan=np.inf).argmin()), motion


def _better_places(
    drawn: DrawnChunks, late: I64, own: F64, split: float
) -> Iterator[tuple[F64, Pose2]]:
    """Yield motions of all that was seen after a share of the drive onto what was seen before.

    Each after by how much it raises the log-likelihoods of the hits ``late``, (P,), which are
    ``own`` where they lie. None if few of the hits contradict what was seen before; else, moved,
    half as many or fewer do, and few, and they gain: where nothing was seen nothing contradicts.
    """
    against = int(np.count_nonzero(own < PRICE))
    if against <= DOUBTED * len(late):
        return
    if (pair := _before_and_after(drawn, split)) is None:
        return
    start = pair.motion_of(Pose2())
    window = SearchWindow((start[0], start[1], start[2]), None, TURNED_RAD)
    _, motions = search(pair, AlignConfig(), window)
    for motion in map(pair.transform_of, motions[:MOST_PLACES]):
        found, _ = drawn.moved(motion).look_up(late, _other_side(split))
        is_better = 2 * np.count_nonzero(found < PRICE) <= min(against, CONTRADICTED * len(late))
        gains = np.maximum(found, PRICE) - np.maximum(own, PRICE)
        if is_better and gains.sum() > 0.0:
            yield gains, motion


def _before_and_after(drawn: DrawnChunks, split: float) -> Pair | None:
    """Make the maps of what was seen before and after a share of the drive ready to be aligned.

    None if they would be too large.
    """
    if drawn.table.size * TILE**2 > MOST_CELLS:
        return None
    before = np.uint32((1 << round(split * CHUNKS)) - 1)
    device, config = drawn.device, NormalizeConfig()
    grids = (normalize_grid(grid, CELL_M, config, device) for grid in drawn.grids(before, ~before))
    return Pair(*(GridFeatures(grid, device) for grid in grids))


def _means_m(drawn: DrawnChunks, picked: I64, motion: Pose2) -> F64:
    """Return how far a motion moves the hits of each chunk in the mean, (CHUNKS,) metres."""
    moves = (drawn.moved(motion).beams - drawn.beams)[picked, :2] * (CELL_M / BEAM_ONE)
    chunks = drawn.chunks[picked]
    sums = np.bincount(chunks, np.hypot(*moves.T), CHUNKS)
    return np.asarray(sums / np.maximum(np.bincount(chunks, minlength=CHUNKS), 1))


def _moved(drawn: DrawnChunks, picked: I64, among: U32) -> F64:
    """Return how likely hits are at each of ``MOVES_M``, (M, P) log-likelihoods."""
    parts = [
        drawn.look_up(np.tile(picked, len(some)), among, np.repeat(some, len(picked), axis=0))[0]
        for some in np.array_split(MOVES_M, PARTS)
    ]
    return np.concatenate(parts).reshape(len(MOVES_M), -1)


def _drawn(evidence: PathEvidence, name: str, reach_cells: int = REACH_CELLS) -> DrawnChunks:
    """Return the chunks along a path."""
    poses, is_judged = evidence.scores[name].poses, evidence.is_judged
    return DrawnChunks.of(name, poses, evidence.scans, is_judged, evidence.device, reach_cells)


def _some_hits(drawn: DrawnChunks) -> I64:
    """Return at most ``MOST_HITS`` of all hits, evenly chosen."""
    return np.arange(0, len(drawn.hit_scans), -(-len(drawn.hit_scans) // MOST_HITS))


def _before(first: int) -> U32:
    """Return for each chunk the bits of those before one that are neither it nor next to it."""
    return np.asarray(OTHERS & np.uint32((1 << first) - 1))


def _other_side(split: float) -> U32:
    """Return for each chunk the bits of those on the other side of a share of the drive."""
    number = np.arange(CHUNKS)
    is_late = number >= split * CHUNKS
    bits = np.uint32(1) << number.astype(np.uint32)
    other = np.where(is_late, bits[~is_late].sum(), bits[is_late].sum()).astype(np.uint32)
    return np.asarray(OTHERS & other)


def _p_values(gains: F64) -> F64:
    """Return (CHUNKS,) how likely each gain is if no place is better than the chunk's own."""
    tested = np.empty(gains.shape[1:])
    for half in (0, 1):
        chosen = gains[:, :, half::2].sum(axis=2).argmax(axis=0)
        tested[:, 1 - half :: 2] = gains[chosen, np.arange(CHUNKS), 1 - half :: 2]
    p_values = np.ones(CHUNKS)
    differ = np.ptp(tested, axis=1) > 0.0
    means, deviations = tested[differ].mean(axis=1), tested[differ].std(axis=1, ddof=1)
    count = gains.shape[2]
    # The one-sided t-test; scipy.stats, which has it too, takes a second to load.
    p_values[differ] = scipy.special.stdtr(count - 1, -means / deviations * np.sqrt(count))
    return p_values
