"""Find the rigid motions under which the walls of two grids coincide, best first.

Three stages. On a coarse level of both grids every shift with any overlap is scored at every yaw
(see ``shifts``); where that level has to be too coarse, every shift on a finer one too at the few
yaws at which walls are parallel (``parallel_walls``). The best few thousand go down level by level,
each to the best of its neighbours on the level of half the cell size, and fewer stay on each. The
last few are moved by robust Gauss-Newton steps on both distance fields, with ever narrower scales,
and ranked by the evidence of all walls on full-resolution cells (see ``wall_evidence``).

What a motion is: see ``motions``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken, check_cancelled
from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.motions import distinct, distinct_rows, fixed_similarities
from slamfusion.align.parallel_walls import parallel_motions
from slamfusion.align.refine import refine, settle
from slamfusion.align.shifts import (
    COARSE_SIGMA,
    SearchWindow,
    score_shifts,
    shift_work,
)
from slamfusion.compute import ComputeDevice
from slamfusion.compute.search import ScoredSide
from slamfusion.config import AlignConfig

F64 = npt.NDArray[np.float64]

# A level on which a wall of any other place finds this much tells little: a finer one is taken.
# Where a search found nothing to believe, one that takes longer does so sooner.
COARSE_CHANCE_MAX, FINER_CHANCE_MAX = 0.8, 0.55
FINEST_FACTOR = 4
# ... nor one on which more field values would be added than this: 1.5 s of one core. Noisy copies
# of a map of 145 m need 7e10.
LEVEL_WORK_MAX = 1e11
# Motions that go down from one level to the next, and walls of each map that judge them there.
DESCENT = ((2304, 256), (384, 768), (96, 1536))
# Two good maps of one place leave little of what they have in common unexplained. A small common
# ground is outweighed by a large one that fits badly, unless that counts (see ``wall_evidence``):
# by this much when answers are compared, by less on coarse cells, which blur what fits.
DOUBT, COARSE_DOUBT = 1.0, 0.5
# Besides the best, a third as many of so many times as many go down by doubt; of those that are
# refined half as many.
DOUBTED_OF, DOUBTED_SHARE, DOUBTED_CANDIDATES = 3, 3, 2
# Cells of the last level of the descent, metres.
DESCENT_CELL_M = 0.2
# Widths of a wall on full-resolution cells, metres, and the least they are in cells. By the first
# maps are compared that show the same walls in the same places, by the second bent ones.
WIDTHS_M, WALL_CELLS_MIN = (0.15, 0.45), 1.5
# Motions that are settled: by the narrow width, by the broad one, and by the narrow one with doubt.
SETTLED = (8, 4, 10)
# Shifts at each yaw at which walls are parallel.
PARALLEL = 24
# One of so many values is looked at first where the greatest of many are sought.
SAMPLED = 16
FINE_TOP = 255
FINE_POINTS = 4096
WINDOW_SLACK_CELLS = 2.0
WINDOW_SLACK_RAD = math.radians(1.0)


@dataclass(frozen=True, eq=False)
class CoarseSearch:
    """The outcome of the coarse stages.

    Attributes:
        step: fine cells per cell of the coarsest level.
        yaws: (K,) yaw in rad of each rotation tried.
        best: (K,) most evidence at each yaw, as a share of the most at any; 0 where none speaks for
            a motion.
        motions: (P, 3) best distinct motions in fine cells, best first.
        evidence: (P,) what the last level gives for them, nats a cell of it.
        last_step: fine cells per cell of the last level.
        is_cut: whether walls fill the coarsest level, so that any place fits there, and a finer one
            would take too long: what is right may not be among the motions.
    """

    step: int
    yaws: F64
    best: F64
    motions: F64
    evidence: F64
    last_step: int
    is_cut: bool


def coarse_step(
    reference: GridFeatures,
    moving: GridFeatures,
    cells: int,
    window: SearchWindow,
    cancel: CancelToken | None = None,
    chance: float = COARSE_CHANCE_MAX,
) -> int:
    """Return the fine cells per coarse cell that leave ``cells`` on the longest side.

    Finer where walls would be so near each other that any wall finds one; but never more than four
    times finer, nor where that would take too long.
    """
    step = _step(reference, moving, cells)
    while (finer := finer_step(reference, moving, cells, step, window, chance, cancel)) < step:
        step = finer
    return step


def finer_step(
    reference: GridFeatures,
    moving: GridFeatures,
    cells: int,
    step: int,
    window: SearchWindow,
    chance: float,
    cancel: CancelToken | None = None,
) -> int:
    """Return the next finer step where walls are too near each other at one; else that step.

    Args:
        reference, moving, cells, window, cancel: see ``coarse_step``.
        step: fine cells per coarse cell.
        chance: walls are too near where a wall of another place finds more than this, 0..1.
    """
    finest = _step(reference, moving, FINEST_FACTOR * cells)
    if step <= finest or not _is_filled(reference, moving, step, chance, cancel):
        return step
    finer = max(finest, (2 * step) // 3)
    is_long = shift_work(reference, moving, finer, window) > LEVEL_WORK_MAX
    return step if is_long else finer


def _is_filled(
    reference: GridFeatures,
    moving: GridFeatures,
    step: int,
    chance: float,
    cancel: CancelToken | None,
) -> bool:
    """Whether a wall of another place finds more than ``chance`` at a step, in either map."""
    return max(grid.chance(step, COARSE_SIGMA, cancel) for grid in (reference, moving)) > chance


def _step(reference: GridFeatures, moving: GridFeatures, cells: int) -> int:
    """Return the fine cells per coarse cell that leave ``cells`` on the longest side."""
    return max(1, math.ceil(max(*reference.shape, *moving.shape) / cells))


def coarse_search(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
    chance: float = COARSE_CHANCE_MAX,
) -> CoarseSearch:
    """Score all whole-cell shifts at all yaws on shrunken grids and follow the best down."""
    step = coarse_step(reference, moving, config.coarse_cells, window, cancel, chance)
    is_cut = _is_filled(reference, moving, step, COARSE_CHANCE_MAX, cancel)
    scores = score_shifts(reference, moving, step, window, device, cancel)
    flat = scores.evidence.ravel()
    order = greatest_rows(flat, DOUBTED_OF * DESCENT[0][0])
    start = _Leads(scores.motions(order), flat[order], step, scores.yaw_step)
    leads, doubted = _descend(reference, moving, start, device, cancel)
    if is_cut:
        check_cancelled(cancel)
        motions, finer, turn = parallel_motions(reference, moving, PARALLEL, device)
        motions = inside(window, motions)
        if len(motions):
            more = _leads(reference, moving, motions, finer, turn, device, cancel)
            more, _ = _descend(reference, moving, more, device, cancel)
            leads, doubted = _joined(reference, moving, (leads, more), device, cancel)
    motions, found = leads.motions, leads.found
    shift, turn = 2.5 * step, 2.5 * scores.yaw_step
    chosen = []
    for values, most in (
        (found, config.candidates),
        (doubted, config.candidates // DOUBTED_CANDIDATES),
    ):
        order = np.argsort(-values, kind="stable")
        chosen.append(order[distinct_rows(motions[order], shift, turn, most)])
    kept = np.unique(np.concatenate(chosen))
    kept = kept[np.argsort(-found[kept], kind="stable")]
    most_evidence = np.maximum(scores.evidence.max(axis=1), 0.0)
    best = most_evidence / max(float(most_evidence.max()), 1e-9)
    return CoarseSearch(step, scores.yaws, best, motions[kept], found[kept], leads.step, is_cut)


@dataclass(frozen=True, eq=False)
class _Leads:
    """Motions on their way down.

    Attributes:
        motions: (P, 3).
        found: (P,) evidence on the level.
        step: of the level, fine cells per cell.
        yaw_step: between yaws that were looked at, rad.
    """

    motions: F64
    found: F64
    step: int
    yaw_step: float


def _descend(
    reference: GridFeatures,
    moving: GridFeatures,
    leads: _Leads,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> tuple[_Leads, F64]:
    """Follow motions down to the last level, each to the best of its neighbours.

    Returns:
        Them there; and their evidence (P,), less what stays unexplained.
    """
    motions, found, last, yaw_step = leads.motions, leads.found, leads.step, leads.yaw_step
    target = max(1, round(DESCENT_CELL_M / reference.grid.grid.resolution))
    doubted = _doubted(reference, moving, motions, last, DESCENT[0][1], device, cancel)
    for most, points in DESCENT:
        if last <= target:
            break
        order = _either(found, doubted, most)
        half = max(target, last // 2)
        motions = _neighbours(motions[order], last / 2.0, yaw_step / 2.0)
        yaw_step *= half / last
        last = half
        values = score_motions(
            reference, moving, motions.reshape(-1, 3), last, device,
            sigma=COARSE_SIGMA, points=points, cancel=cancel,
        ).reshape(motions.shape[:2])  # fmt: skip
        best = values.argmax(axis=1)
        rows = np.arange(len(best))
        motions, found = motions[rows, best], values[rows, best]
        motions, found = _apart(motions, found, float(last), yaw_step)
        doubted = _doubted(reference, moving, motions, last, points, device, cancel)
    return _Leads(motions, found, last, yaw_step), doubted


def _leads(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    step: int,
    yaw_step: float,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> _Leads:
    """Return motions with their evidence on a level."""
    found = score_motions(
        reference, moving, motions, step, device,
        sigma=COARSE_SIGMA, points=DESCENT[-1][1], cancel=cancel,
    )  # fmt: skip
    return _Leads(motions, found, step, yaw_step)


def _joined(
    reference: GridFeatures,
    moving: GridFeatures,
    leads: tuple[_Leads, _Leads],
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> tuple[_Leads, F64]:
    """Return two lots of motions on the finer of their levels; see ``_descend``."""
    motions = np.concatenate([some.motions for some in leads])
    step, yaw_step = min(some.step for some in leads), min(some.yaw_step for some in leads)
    joined = _leads(reference, moving, motions, step, yaw_step, device, cancel)
    points = DESCENT[-1][1]
    return joined, _doubted(reference, moving, motions, step, points, device, cancel)


def greatest_rows(values: F64, most: int) -> npt.NDArray[np.intp]:
    """Return the indices of the greatest values, greatest first, the earlier of equals first."""
    if len(values) > most:
        # Above what a sample has twice as many above, few are left to be parted.
        some = values[::SAMPLED]
        likely = values[values >= _greatest(some, min(len(some), 2 * most // SAMPLED + 1))]
        least = _greatest(likely if len(likely) >= most else values, most)
        chosen = np.nonzero(values >= least)[0]
    else:
        chosen = np.arange(len(values))
    return chosen[np.argsort(-values[chosen], kind="stable")][:most]


def _greatest(values: F64, rank: int) -> float:
    """Return the greatest value, the second greatest or another; the greatest has rank 1."""
    place = len(values) - rank
    return float(np.partition(values, place)[place])


def _doubted(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    step: int,
    points: int,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> F64:
    """Return the evidence (P,) on a coarse level, less what stays unexplained."""
    return score_motions(
        reference, moving, motions, step, device,
        sigma=COARSE_SIGMA, points=points, doubt=COARSE_DOUBT, cancel=cancel,
    )  # fmt: skip


def _either(found: F64, doubted: F64, most: int) -> npt.NDArray[np.intp]:
    """Return the indices of the ``most`` best, and of the best of the others by doubt."""
    order = np.argsort(-found, kind="stable")
    others = order[most:]
    others = others[np.argsort(-doubted[others], kind="stable")]
    return np.concatenate((order[:most], others[: most // DOUBTED_SHARE]))


def _neighbours(motions: F64, shift: float, turn: float) -> F64:
    """Return (P, 27, 3): each motion and its neighbours, shifted and turned by so much."""
    steps = np.stack(np.meshgrid([0, -1, 1], [0, -1, 1], [0, -1, 1], indexing="ij"), axis=-1)
    offsets = steps.reshape(-1, 3) * np.array([shift, shift, turn])
    # Each column stays one stretch of memory.
    return np.asarray((motions.T[:, :, None] + offsets.T[:, None, :]).transpose(1, 2, 0))


def _apart(motions: F64, values: F64, shift: float, turn: float) -> tuple[F64, F64]:
    """Return the best motion of each box of two cells and turns, best first."""
    order = np.argsort(-values, kind="stable")
    yaw = np.mod(motions[order, 2], 2.0 * math.pi)
    sides = np.array([2.0 * shift, 2.0 * shift, 2.0 * turn])
    boxes = np.floor(np.column_stack((motions[order, :2], yaw)) / sides).astype(np.int64)
    # One number for each box: rows of several are compared ten times as slowly.
    boxes -= boxes.min(axis=0, initial=0)
    numbers = np.ravel_multi_index(tuple(boxes.T), tuple(boxes.max(axis=0, initial=0) + 1))
    _, first = np.unique(numbers, return_index=True)
    kept = order[np.sort(first)]
    return motions[kept], values[kept]


def score_motions(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    step: int,
    device: ComputeDevice,
    *,
    sigma: float,
    points: int = FINE_POINTS,
    scales: F64 | None = None,
    doubt: float = 0.0,
    cancel: CancelToken | None = None,
) -> F64:
    """Return the evidence (P,) for motions at a level, nats summed over cells of wall of both maps.

    Args:
        reference, moving: the two grids.
        motions: (P, 3) where the moving centre lands, fine cells, and yaw.
        step: level to work on, fine cells a cell.
        device: computes.
        sigma: width of a wall, cells of the level.
        points: at most this many wall points of each grid are looked at; each stands for its share.
        scales: (P,) how much longer the moving map's metre is taken, about its centre; None: 1.
        doubt: see ``wall_evidence.evidence_table``.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    ref, mov = reference.level(step, cancel), moving.level(step, cancel)
    local = motions / np.array([step, step, 1.0])
    centre = (moving.centre[0] / step, moving.centre[1] / step)
    there, back = fixed_similarities(local, centre, scales)
    sides, units = [], []
    for own, pose, features in ((mov, there, reference), (ref, back, moving)):
        table = features.evidence_table(step, sigma, FINE_TOP, cancel, doubt)
        field = features.field(step, table, cancel)
        sample = spread_sample(own.points, points)
        sides.append(ScoredSide(sample, pose, field, table.base))
        units.append(table.unit * (len(own.points) / len(sample)))
    check_cancelled(cancel)
    total = np.zeros(len(motions))
    for values, side, unit in zip(device.pose_scores(*sides), sides, units, strict=True):
        total += (values - len(side.points) * side.base) * unit
    return total


def search(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
    chance: float = COARSE_CHANCE_MAX,
) -> tuple[CoarseSearch, F64, F64]:
    """Run all stages; return the coarse outcome, motions (P, 3) and evidence (P,), best first.

    Evidence is by the narrow width of a wall.

    Args:
        reference, moving: the two grids.
        config: settings of the search.
        window: where to search.
        device: computes.
        cancel: asked before each operation.
        chance: what a wall of any other place may find on the coarsest level, 0..1.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    coarse = coarse_search(reference, moving, config, window, device, cancel, chance)
    middle = max(1, round(coarse.last_step / 2))
    motions = refine(
        reference,
        moving,
        coarse.motions,
        middle,
        (8.0, 4.0),
        device,
        points=512,
        cancel=cancel,
    )
    widths = wall_widths(reference)
    chosen = []
    by = ((widths[0], 0.0), (widths[1], 0.0), (widths[0], DOUBT))
    for (sigma, doubt), most in zip(by, SETTLED, strict=True):
        scores = score_motions(
            reference, moving, motions, 1, device,
            sigma=sigma, points=1024, doubt=doubt, cancel=cancel,
        )  # fmt: skip
        order = np.argsort(-scores, kind="stable")
        chosen.append(distinct(motions[order], 3.0 * middle, 0.02, most))
    motions = distinct(np.concatenate(chosen), 3.0 * middle, 0.02)
    motions = inside(window, settle(reference, moving, motions, device, cancel))
    if not len(motions):
        return coarse, motions, np.zeros(0)
    scores = score_motions(reference, moving, motions, 1, device, sigma=widths[0], cancel=cancel)
    order = np.argsort(-scores, kind="stable")
    return coarse, motions[order], scores[order]


def wall_widths(features: GridFeatures) -> tuple[float, ...]:
    """Return the widths of a wall by which motions are compared, full-resolution cells."""
    size = features.grid.grid.resolution
    return tuple(max(width / size, WALL_CELLS_MIN) for width in WIDTHS_M)


def inside(window: SearchWindow, motions: F64) -> F64:
    """Return the motions that lie in the window; refinement may have carried some out of it."""
    start = np.array(window.start)
    turn = np.abs(np.angle(np.exp(1j * (motions[:, 2] - start[2]))))
    kept = turn <= window.yaw_rad + WINDOW_SLACK_RAD
    if window.shift_cells is not None:
        limit = window.shift_cells + WINDOW_SLACK_CELLS
        kept &= np.abs(motions[:, :2] - start[:2]).max(axis=1) <= limit
    return np.asarray(motions[kept])
