"""Find the rigid motions under which the walls of two grids coincide, best first.

On a coarse level of both grids every shift with any overlap is scored at every yaw (``shifts``); if
that level is too coarse, every shift on a finer one too at the few yaws at which walls are parallel
(``parallel_motions``). The best few thousand descend level by level, each to the best of its
neighbours at half the cell size, and fewer remain on each. The last few are refined by robust
Gauss-Newton steps on both distance fields, with ever narrower scales, and ranked by the evidence of
all walls on full-resolution cells (``likelihood``). ``pair`` defines a motion.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from slamfusion.align.decide import DecisionKind
from slamfusion.align.pair import Pair, distinct
from slamfusion.align.refine import refine, settle
from slamfusion.align.scores import neighbour_offsets, score_motions, score_neighbours
from slamfusion.align.shifts import (
    COARSE_SIGMA,
    SearchWindow,
    parallel_shifts,
    score_shifts,
    shift_work,
)
from slamfusion.align.starts import StartPose, pose_of
from slamfusion.config import AlignConfig
from slamfusion.errors import ConfigError
from slamfusion.geometry import F64, Pose2

# Greatest chance of a wall of another place on the coarsest level, above which a finer one is
# taken; and the limit of a second, longer search.
COARSE_CHANCE_MAX, FINER_CHANCE_MAX = 0.8, 0.55
FINEST_FACTOR = 4
# The most field values that a level may add: 1.5 s of one core.
LEVEL_WORK_MAX = 1e11
# Motions that descend to the next level, and wall points of each map that score them there.
DESCENT = ((2304, 256), (384, 768), (96, 1536))
# A right motion keeps this share of the greatest evidence half a cell and half a step of yaw off.
# Motions with less do not descend by evidence, but at least as many do as on the next level.
KEPT_SHARE = 0.2
# Weight of the unexplained evidence, so that a large common ground that fits badly does not
# outweigh a small good one; smaller on coarse cells, which blur a good fit.
DOUBT, COARSE_DOUBT = 1.0, 0.5
# Coarse peaks that are refined.
CANDIDATES = 24
# A third as many motions, chosen with doubt among three times the number, descend too; of those
# that are refined half.
DOUBTED_OF, DOUBTED_SHARE, DOUBTED_CANDIDATES = 3, 3, 2
# Cells of the last level of the descent, metres.
DESCENT_CELL_M = 0.2
# Motions settled by the narrow width, by the broad one, and by the narrow one with doubt.
SETTLED = (8, 4, 10)
# Shifts that descend at the yaws at which walls are parallel.
PARALLEL = 144
# Lower limit of the yaw uncertainty of a start.
YAW_RAD_MIN = math.radians(0.5)
WINDOW_SLACK_CELLS = 2.0
WINDOW_SLACK_RAD = math.radians(1.0)
REACH_SHARE = 0.25
POSES_BATCH = 4096
POSES_MAX = 20_000_000


@dataclass(frozen=True, eq=False)
class CoarseSearch:
    """The outcome of the coarse stages.

    Attributes:
        step, last_step: fine cells per cell of the coarsest and of the last level.
        yaws: (K,) yaw in rad of each rotation tried.
        best: (K,) most evidence at each yaw, as a share of the most at any; 0 without evidence.
        motions: (P, 3) best distinct motions in fine cells, best first.
        is_cut: walls fill the coarsest level and a finer one would take too long: the right motion
            may be missing.
    """

    step: int
    yaws: F64
    best: F64
    motions: F64
    last_step: int
    is_cut: bool


def finer_step(pair: Pair, cells: int, step: int, window: SearchWindow, chance: float) -> int:
    """Return the next finer step if walls exceed ``chance`` (0..1), else ``step``."""
    finest = _step(pair, FINEST_FACTOR * cells)
    if step <= finest or not _is_filled(pair, step, chance):
        return step
    finer = max(finest, (2 * step) // 3)
    is_long = shift_work(pair, finer, window) > LEVEL_WORK_MAX
    return step if is_long else finer


def _is_filled(pair: Pair, step: int, chance: float) -> bool:
    """Whether a wall of another place finds more than ``chance`` at a step, in either map."""
    return max(grid.chance(step, COARSE_SIGMA) for grid in pair) > chance


def _step(pair: Pair, cells: int) -> int:
    """Return the fine cells per coarse cell that leave ``cells`` on the longest side."""
    return max(1, math.ceil(pair.longest / cells))


def coarse_search(
    pair: Pair, config: AlignConfig, window: SearchWindow, chance: float = COARSE_CHANCE_MAX
) -> CoarseSearch:
    """Score all whole-cell shifts at all yaws on shrunken grids and follow the best down.

    The grids are up to four times finer than set where walls are too close to each other, unless
    that takes too long.
    """
    step = _step(pair, config.coarse_cells)
    while (finer := finer_step(pair, config.coarse_cells, step, window, chance)) < step:
        step = finer
    is_cut = _is_filled(pair, step, COARSE_CHANCE_MAX)
    scores = score_shifts(pair, step, window)
    flat = scores.evidence.ravel()
    order = greatest_rows(flat, DOUBTED_OF * DESCENT[0][0])
    motions, found = scores.motions(order), flat[order]
    start = _leads(pair, motions, step, scores.yaw_step, found, DESCENT[0][1])
    leads = _descend(pair, start)
    if is_cut:
        parallel = parallel_shifts(pair)
        best_shifts = greatest_rows(parallel.evidence.ravel(), PARALLEL)
        motions = inside(window, parallel.motions(best_shifts))
        if len(motions):
            more = _descend(pair, _leads(pair, motions, parallel.step, parallel.yaw_step))
            # Both on the finer of their levels.
            motions = np.concatenate((leads.motions, more.motions))
            yaw_step = min(leads.yaw_step, more.yaw_step)
            leads = _leads(pair, motions, min(leads.step, more.step), yaw_step)
    shift, turn = 2.5 * step, 2.5 * scores.yaw_step
    chosen = []
    for values, most in (
        (leads.found, CANDIDATES),
        (leads.doubted, CANDIDATES // DOUBTED_CANDIDATES),
    ):
        order = np.argsort(-values, kind="stable")
        chosen.append(order[distinct(leads.motions[order], shift, turn, most)])
    kept = np.unique(np.concatenate(chosen))
    kept = kept[np.argsort(-leads.found[kept], kind="stable")]
    most_evidence = np.maximum(scores.evidence.max(axis=1), 0.0)
    best = most_evidence / max(float(most_evidence.max()), 1e-9)
    return CoarseSearch(step, scores.yaws, best, leads.motions[kept], leads.step, is_cut)


@dataclass(frozen=True, eq=False)
class _Leads:
    """Motions on their way down.

    Attributes:
        motions: (P, 3).
        found, doubted: (P,) evidence on the level, and less the unexplained part.
        step: of the level, fine cells per cell.
        yaw_step: between yaws that were looked at, rad.
    """

    motions: F64
    found: F64
    doubted: F64
    step: int
    yaw_step: float


def _leads(
    pair: Pair,
    motions: F64,
    step: int,
    yaw_step: float,
    found: F64 | None = None,
    points: int = DESCENT[-1][1],
) -> _Leads:
    """Return motions with their evidence on a level; ``found`` is known, or None."""
    score = partial(score_motions, pair, motions, step, sigma=COARSE_SIGMA, points=points)
    doubted = score(doubt=COARSE_DOUBT)
    return _Leads(motions, score() if found is None else found, doubted, step, yaw_step)


def _descend(pair: Pair, leads: _Leads) -> _Leads:
    """Follow motions down to the last level."""
    target = max(1, round(DESCENT_CELL_M / pair.resolution))
    for limit, points in DESCENT:
        if leads.step <= target:
            break
        # The best, and of the others the best by doubt.
        order = np.argsort(-leads.found, kind="stable")
        strong = int(np.count_nonzero(leads.found >= KEPT_SHARE * leads.found.max()))
        most = min(limit, max(strong, DESCENT[1][0]))
        others = order[most:]
        others = others[np.argsort(-leads.doubted[others], kind="stable")]
        order = np.concatenate((order[:most], others[: limit // DOUBTED_SHARE]))
        half = max(target, leads.step // 2)
        shift, turn = leads.step / 2.0, leads.yaw_step / 2.0
        values = score_neighbours(
            pair, leads.motions[order], half, shift=shift, turn=turn, sigma=COARSE_SIGMA,
            points=points,
        )  # fmt: skip
        best = values.argmax(axis=1)
        motions = leads.motions[order] + neighbour_offsets(shift, turn)[best]
        yaw_step, found = leads.yaw_step * (half / leads.step), values.max(axis=1)
        # The best motion of each box of two cells and turns, best first.
        order = np.argsort(-found, kind="stable")
        motions, found = motions[order], found[order]
        places = np.column_stack((motions[:, :2], np.mod(motions[:, 2], 2.0 * math.pi)))
        boxes = np.floor(places / (2.0 * np.array([half, half, yaw_step]))).astype(np.int64)
        # One number for each box: comparing rows takes ten times as long.
        boxes -= boxes.min(axis=0, initial=0)
        numbers = np.ravel_multi_index(tuple(boxes.T), tuple(boxes.max(axis=0, initial=0) + 1))
        kept = np.sort(np.unique(numbers, return_index=True)[1])
        motions, found = motions[kept], found[kept]
        leads = _leads(pair, motions, half, yaw_step, found, points)
    return leads


def greatest_rows(values: F64, most: int) -> npt.NDArray[np.intp]:
    """Return the indices of the greatest values, greatest first, the earlier of equals first."""
    # Mostly there are enough above 0: a part of all.
    chosen = np.flatnonzero(values > 0.0)
    if len(chosen) < most:
        chosen = np.arange(len(values))
    if len(chosen) > most > 0:
        some, place = values[chosen], len(chosen) - most
        chosen = chosen[some >= np.partition(some, place)[place]]
    return chosen[np.argsort(-values[chosen], kind="stable")][:most]


def search(
    pair: Pair, config: AlignConfig, window: SearchWindow, chance: float = COARSE_CHANCE_MAX
) -> tuple[CoarseSearch, F64]:
    """Run all stages; return the coarse outcome, and motions (P, 3), best first.

    The order is by the narrow width of a wall; ``chance`` limits that on the coarsest level.
    """
    coarse = coarse_search(pair, config, window, chance)
    middle = max(1, round(coarse.last_step / 2))
    motions = refine(pair, coarse.motions, middle, (8.0, 4.0), points=512)
    narrow, broad = pair.widths
    chosen = []
    by = ((narrow, 0.0), (broad, 0.0), (narrow, DOUBT))
    for (sigma, doubt), most in zip(by, SETTLED, strict=True):
        scores = score_motions(pair, motions, 1, sigma=sigma, points=1024, doubt=doubt)
        ordered = motions[np.argsort(-scores, kind="stable")]
        chosen.append(ordered[distinct(ordered, 3.0 * middle, 0.02, most)])
    motions = np.concatenate(chosen)
    motions = motions[distinct(motions, 3.0 * middle, 0.02)]
    return coarse, ranked(pair, inside(window, settle(pair, motions)))


def ranked(pair: Pair, motions: F64) -> F64:
    """Return motions (P, 3) by the evidence of all walls, best first."""
    if not len(motions):
        return motions
    scores = score_motions(pair, motions, 1, sigma=pair.widths[0])
    return np.asarray(motions[np.argsort(-scores, kind="stable")])


def inside(window: SearchWindow, motions: F64) -> F64:
    """Return the motions inside the window; refinement may have moved some out of it."""
    start = np.array(window.start)
    turn = np.abs(np.angle(np.exp(1j * (motions[:, 2] - start[2]))))
    kept = turn <= window.yaw_rad + WINDOW_SLACK_RAD
    if window.shift_cells is not None:
        limit = window.shift_cells + WINDOW_SLACK_CELLS
        kept &= np.abs(motions[:, :2] - start[:2]).max(axis=1) <= limit
    return np.asarray(motions[kept])


def fixed_step_search(pair: Pair, step: int, window: SearchWindow) -> F64:
    """Return the motion (3,) of least [F16] error: where the centre lands in cells, and yaw.

    ``step`` is the first step, cells and degrees. The window limits the shifts, else a quarter of
    the reference's longer side.
    """
    reach = window.shift_cells
    if reach is None:
        reach = REACH_SHARE * max(pair.reference.shape)
    best = np.array(window.start)
    turn = math.degrees(window.yaw_rad)
    while True:
        shifts = step * np.arange(-(reach // step), reach // step + 1)
        turns = np.radians(step * np.arange(-(turn // step), turn // step + 1))
        count = len(shifts) ** 2 * len(turns)
        if count > POSES_MAX:
            raise ConfigError(
                f"a first step of {step} cells means {count:.3g} poses to try; choose a larger "
                "step, or a narrower window (window_m, window_yaw_rad)"
            )
        grid = np.stack(np.meshgrid(shifts, shifts, turns, indexing="ij"), axis=-1).reshape(-1, 3)
        motions, errors = best + grid, []
        for start in range(0, count, POSES_BATCH):
            _, (_, back, _) = pair.sides(motions[start : start + POSES_BATCH])
            poses = back.T.astype(np.int64)
            cells = pair.reference.cells, pair.moving.cells
            errors.append(pair.device.grid_error(*cells, poses, max(1, step // 2))[:, 0])
        # Of equals the first.
        best = np.asarray(motions[int(np.argmin(np.concatenate(errors)))])
        if step == 1:
            return best
        reach, turn = float(step), float(step)
        step = max(1, step // 2)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What the search leaves for the decision.

    Attributes:
        motions: (P, 3) what the search ends with.
        coarse: outcome of the coarse stages; None where there was no search.
        search: ``full``, ``window``, ``fixed step`` or ``tracked``.
        prior: share of all poses that lie in the window.
        candidates: number of motions, from the first, that may be the answer; None: all. The others
            are rivals only.
        image_after: kinds of refusals after which the mirror image is searched.
    """

    motions: F64
    coarse: CoarseSearch | None
    search: str
    prior: float = 1.0
    candidates: int | None = None
    image_after: Collection[DecisionKind] = ()


def window_around(pair: Pair, config: AlignConfig, start: Pose2 | StartPose | None) -> SearchWindow:
    """Return the search window in lattice cells: a start's own tolerances, or the settings'."""
    metres, yaw_rad = config.window_m, config.window_yaw_rad
    if isinstance(start, StartPose):
        metres, yaw_rad = start.metres, min(start.radians, math.pi)
    motion = pair.motion_of(pose_of(start) or Pose2())
    x, y, yaw = (float(value) for value in motion)
    shift = None if metres is None else metres / pair.resolution
    if shift is not None and shift >= max(abs(x), abs(y)) + 2 * sum(
        max(features.shape) for features in pair
    ):
        shift = None  # the window holds every place where the two maps meet
    if start is None and yaw_rad >= math.pi:
        yaw = 0.0
    return SearchWindow((x, y, yaw), shift, yaw_rad)


def search_window(pair: Pair, config: AlignConfig, window: SearchWindow) -> SearchResult:
    """Search; inside a window, with the rivals of everywhere; by fixed steps where asked for."""
    if config.step is not None:
        motion = fixed_step_search(pair, config.step, window)
        return SearchResult(motion[None], None, "fixed step")
    coarse, motions = search(pair, config, window)
    if not len(motions):
        return SearchResult(motions, coarse, "window")
    if window.shift_cells is None and window.yaw_rad >= math.pi:
        return SearchResult(motions, coarse, "full")
    shift = float(pair.longest)
    if window.shift_cells is not None:
        shift = min(shift, window.shift_cells)
    prior = prior_within(pair, shift, window.yaw_rad)
    # Among few yaws and shifts every peak stands out, so the rivals come from a full search.
    _, others = search(pair, config, SearchWindow())
    everything = np.concatenate((motions, others))
    return SearchResult(everything, coarse, "window", prior, candidates=len(motions))


def prior_within(pair: Pair, cells: float, yaw_rad: float) -> float:
    """Return the share of the poses within these distances among all that could overlap."""
    everywhere = meeting_cells(pair) * 2.0 * math.pi
    here = (2.0 * max(cells, 1.0)) ** 2 * 2.0 * max(min(yaw_rad, math.pi), YAW_RAD_MIN)
    return min(1.0, here / everywhere)


def meeting_cells(pair: Pair) -> float:
    """Return the cells on which the moving centre may lie where both maps could overlap."""
    reach = math.hypot(*pair.moving.shape)
    return (pair.reference.shape[0] + reach) * (pair.reference.shape[1] + reach)
