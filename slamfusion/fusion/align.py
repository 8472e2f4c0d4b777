"""Align one grid to another: search, prove, measure, decide."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.config import AlignConfig, FusionConfig
from slamfusion.fusion.accept import Evidence, decide
from slamfusion.fusion.cancel import CancelToken, check_cancelled
from slamfusion.fusion.features import FINE_TABLE, GridFeatures, spread_sample
from slamfusion.fusion.fixed_step import fixed_step_search
from slamfusion.fusion.motions import displacement, invert, to_lattice
from slamfusion.fusion.normalize import check_resampling, common_resolution, normalize_grid
from slamfusion.fusion.proof import LatticeScore, neighbourhood_best, prove
from slamfusion.fusion.records import Alignment, RunnerUp
from slamfusion.fusion.refine import rank, refine, settle
from slamfusion.fusion.search import CoarseSearch, SearchWindow, inside, search
from slamfusion.fusion.start import StartPose, pose_of
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OccupancyGrid

__all__ = ["align_features", "align_grids", "measure", "rejected_alignment", "track_features"]

F64 = npt.NDArray[np.float64]

# Tolerances in metres, and the least they are in cells where cells are coarse.
NEAR_M, NEAR_CELLS_MIN = 0.15, 1.5
CLASH_M, CLASH_CELLS_MIN = 0.4, 3.0
FAR_CLASH_M, FAR_CLASH_CELLS_MIN = 1.0, 5.0
EVIDENCE_POINTS = 4096
DISTINCT_CELLS = 20.0
DISTINCT_YAW_RAD = math.radians(10.0)
# A bent map fits its place in several ways a metre or two apart; they are one answer.
BENT_CELLS = 60.0
NEIGHBOURHOOD_CELLS = 8
NEIGHBOURHOOD_YAW_RAD = math.radians(2.0)
PROOF_ROUNDS = 3
RIVALS = 8
PLANE_CELLS_MAX = 1 << 28
BENT_MATCH = 0.45
BENT_SCALES = (24.0,)
OTHER_YAW_RAD = math.radians(15.0)


@dataclass(frozen=True, eq=False)
class _Found:
    """What the search leaves for the decision."""

    motions: F64
    scores: F64
    coarse: CoarseSearch | None
    bound_gap: float | None
    search: str
    rival: bool = False


def align_grids(
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    config: FusionConfig,
    device: ComputeDevice,
    start: Pose2 | StartPose | None = None,
) -> Alignment:
    """Align one occupancy grid to another.

    Args:
        reference: held still.
        moving: gets the transform.
        config: normalisation and search; ``config.align.window_*`` limit the search around a
            ``start`` that has no tolerances.
        device: computes.
        start: expected pose of the moving map frame in the reference's, metres; identity when
            None. With tolerances (``StartPose``) the search looks only within these.

    Returns:
        The alignment; also when it is rejected, with the reason.

    Raises:
        GridError: a grid has no known cells.
        MemoryBudgetError: at their common resolution the grids would not fit into memory.
    """
    check_resampling([reference, moving], config.normalize, "aligning")
    resolution = common_resolution([reference, moving], config.normalize)
    features = [
        GridFeatures(normalize_grid(grid, resolution, config.normalize, device), device)
        for grid in (reference, moving)
    ]
    return align_features(features[0], features[1], config.align, device, start)


def align_features(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    start: Pose2 | StartPose | None = None,
    cancel: CancelToken | None = None,
) -> Alignment:
    """Align two prepared grids; see ``align_grids``.

    Args:
        reference, moving, config, device, start: as there.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so; what was computed of the grids is kept.
    """
    began = time.perf_counter()
    for features in (reference, moving):
        if not len(features.wall_points):
            reason = f"{features.grid.name} has no occupied cell, so there is nothing to align"
            return rejected_alignment(reference, moving, reason, time.perf_counter() - began)
    given = start if isinstance(start, StartPose) else None
    window = _window(reference, moving, config, start)
    if given is not None and not _meets(reference, moving, window):
        reason = f"the maps do not meet within {given.reach} of the start"
        return rejected_alignment(reference, moving, reason, time.perf_counter() - began)
    if config.step is not None:
        motion = fixed_step_search(reference, moving, config.step, window, device, cancel)
        score = rank(reference, moving, motion[None], 1, FINE_TABLE, device, cancel=cancel)
        found = _Found(motion[None], score, None, None, "fixed step")
    else:
        coarse, motions, scores = search(reference, moving, config, window, device, cancel)
        is_full = window.shift_cells is None and window.yaw_rad >= math.pi
        found = _Found(motions, scores, coarse, None, "full" if is_full else "window")
        if config.prove and len(motions):
            found = _prove(reference, moving, config, window, device, found, cancel)
    if not len(found.motions):
        reason = "no fit inside the window; widen it"
        if given is not None:
            reason = f"no fit within {given.reach} of the start"
        return rejected_alignment(reference, moving, reason, time.perf_counter() - began)
    if start is None and config.shared_frame:
        start = Pose2()
    return _conclude(reference, moving, device, found, start, began, cancel)


def track_features(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    start: Pose2,
    cancel: CancelToken | None = None,
) -> Alignment:
    """Refine a known transform without a search; the decision rests on the fit alone.

    Args:
        reference, moving: the grids.
        device: computes.
        start: pose of the moving map frame in the reference's, within about half a metre and a few
            degrees.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    began = time.perf_counter()
    motion = _motion(reference, moving, start)[None]
    motion = settle(reference, moving, motion, device, cancel)
    score = rank(reference, moving, motion, 1, FINE_TABLE, device, cancel=cancel)
    found = _Found(motion, score, None, None, "tracked")
    return _conclude(reference, moving, device, found, start, began, cancel)


def rejected_alignment(
    reference: GridFeatures, moving: GridFeatures, reason: str, time_s: float
) -> Alignment:
    """Return the record of a pair that could not be searched."""
    return Alignment(
        reference.grid.name,
        moving.grid.name,
        Pose2(),
        accepted=False,
        reason=reason,
        score=0.0,
        overlap=0.0,
        error=0.0,
        runner_up=None,
        bound_gap=None,
        time_s=time_s,
    )


def _window(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    start: Pose2 | StartPose | None,
) -> SearchWindow:
    """Return the search window in lattice cells: a start's own tolerances, or the settings'."""
    metres, yaw_rad = config.window_m, config.window_yaw_rad
    if isinstance(start, StartPose):
        metres, yaw_rad = start.metres, min(start.radians, math.pi)
    motion = _motion(reference, moving, pose_of(start) or Pose2())
    x, y, yaw = (float(value) for value in motion)
    shift = None if metres is None else metres / reference.grid.grid.resolution
    if shift is not None and shift >= max(abs(x), abs(y)) + 2 * sum(
        max(features.shape) for features in (reference, moving)
    ):
        shift = None  # the window holds every place where the two maps meet
    if start is None and yaw_rad >= math.pi:
        yaw = 0.0
    return SearchWindow((x, y, yaw), shift, yaw_rad)


def _meets(reference: GridFeatures, moving: GridFeatures, window: SearchWindow) -> bool:
    """Whether the two maps, boxes in their circles, can meet at all inside a window."""
    if window.shift_cells is None:
        return True
    height, width = reference.shape
    reach = window.shift_cells + math.hypot(*moving.shape) / 2.0
    x, y, _ = window.start
    return -reach <= x <= width + reach and -reach <= y <= height + reach


def _motion(reference: GridFeatures, moving: GridFeatures, transform: Pose2) -> F64:
    """Return a map-frame transform as (x, y where the moving centre lands, yaw) in cells."""
    ref, mov = reference.grid.grid, moving.grid.grid
    lattice = ref.origin.inverse().compose(transform).compose(mov.origin)
    centre = np.array(moving.centre) * mov.resolution
    landed = lattice.transform(centre) / ref.resolution
    return np.array([landed[0], landed[1], lattice.yaw_rad])


def _transform(reference: GridFeatures, moving: GridFeatures, motion: F64) -> Pose2:
    """Return a motion as the transform of map frames, metres."""
    ref, mov = reference.grid.grid, moving.grid.grid
    x, y, yaw = to_lattice(motion[None], moving.centre)[0]
    lattice = Pose2(float(x) * ref.resolution, float(y) * ref.resolution, wrap_angle(float(yaw)))
    return ref.origin.compose(lattice).compose(mov.origin.inverse())


def _prove(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    found: _Found,
    cancel: CancelToken | None = None,
) -> _Found:
    """Bound the whole search set; rivals that the proof turns up are refined and may win."""
    end = time.perf_counter() + config.deadline_s
    lattice = LatticeScore(reference, moving, config, window, device)
    motions, scores = found.motions, found.scores
    if lattice.plane_cells > PLANE_CELLS_MAX:
        # Nothing can be bounded in reasonable memory: the rest of the set may score anything.
        return replace(found, bound_gap=1.0)
    gap, rival = 0.0, False
    for _ in range(PROOF_ROUNDS):
        check_cancelled(cancel)
        best, _ = neighbourhood_best(lattice, motions[0], NEIGHBOURHOOD_CELLS)
        proof = prove(lattice, best, max(0.0, end - time.perf_counter()))
        gap, rival = proof.bound_gap, False
        if not len(proof.rivals):
            break
        others = inside(window, settle(reference, moving, proof.rivals[:RIVALS], device, cancel))
        elsewhere = [other for other in others if not _is_same(other, motions[0])]
        if not elsewhere:
            # All that scores above the answer runs into it when refined: it is their optimum.
            gap = gap if not proof.finished else 0.0
            break
        rival = any(_is_distinct(other, motions[0]) for other in elsewhere)
        everything = np.concatenate((motions, np.array(elsewhere)))
        ranked = rank(reference, moving, everything, 1, FINE_TABLE, device, cancel=cancel)
        order = np.argsort(-ranked, kind="stable")
        changed = order[0] >= len(motions)
        motions, scores = everything[order], ranked[order]
        if not changed:
            break
    return _Found(motions, scores, found.coarse, gap, found.search, rival)


def _is_same(a: F64, b: F64) -> bool:
    """Whether one motion lies in the neighbourhood of the other, which the proof takes as one."""
    shift, turn = displacement(a, b)
    return shift <= NEIGHBOURHOOD_CELLS and turn <= NEIGHBOURHOOD_YAW_RAD


def _is_distinct(a: F64, b: F64, cells: float = DISTINCT_CELLS) -> bool:
    """Whether two motions are different answers rather than the same one found twice."""
    shift, turn = displacement(a, b)
    return shift > cells or turn > DISTINCT_YAW_RAD


def _conclude(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: _Found,
    start: Pose2 | StartPose | None,
    began: float,
    cancel: CancelToken | None,
) -> Alignment:
    """Measure the best motion and its runner-up, decide, and write the record."""
    best, score = found.motions[0], float(found.scores[0])
    statistics = measure(reference, moving, best, device, cancel)
    is_bent = max(statistics["wall_match_moving"], statistics["wall_match_reference"]) < BENT_MATCH
    runner_up = _runner_up(reference, moving, found, BENT_CELLS if is_bent else DISTINCT_CELLS)
    if is_bent:
        # Both maps mostly miss each other's walls. A narrow fit locks one part of a bent map and
        # leaves the rest; the wide one spreads the misfit over the whole map.
        best = refine(
            reference, moving, best[None], 1, BENT_SCALES, device, iterations=8, cancel=cancel
        )[0]
        statistics = measure(reference, moving, best, device, cancel)
    transform = _transform(reference, moving, best)
    overlap, error = statistics.pop("overlap"), statistics.pop("error")
    profile = None
    if found.coarse is not None:
        profile = _profile(reference, moving, found.coarse)
        z, ratio = _separation(found.coarse, float(best[2]))
        statistics |= {"z": z, "coarse_ratio": ratio}
    if runner_up is not None:
        statistics["runner_up_ratio"] = runner_up.ratio
    pose = pose_of(start)
    evidence = Evidence(
        score=score,
        overlap=overlap,
        walls=min(len(reference.wall_points), len(moving.wall_points)),
        statistics=statistics,
        bound_gap=found.bound_gap,
        rival=found.rival,
        search=found.search,
        near_start=pose is not None and _near_start(reference, moving, transform, pose),
        start=start if isinstance(start, StartPose) else None,
    )
    accepted, reason = decide(evidence)
    return Alignment(
        reference.grid.name,
        moving.grid.name,
        transform,
        accepted,
        reason,
        score,
        overlap,
        error,
        runner_up,
        found.bound_gap,
        time.perf_counter() - began,
        statistics,
        profile,
    )


def _runner_up(
    reference: GridFeatures, moving: GridFeatures, found: _Found, cells: float
) -> RunnerUp | None:
    """Return the best motion that is another answer: farther than ``cells``, or turned."""
    best, score = found.motions[0], float(found.scores[0])
    for motion, other in zip(found.motions[1:], found.scores[1:], strict=True):
        if _is_distinct(motion, best, cells):
            ratio = float(other) / score if score > 0 else 1.0
            return RunnerUp(_transform(reference, moving, motion), float(other), max(0.0, ratio))
    return None


def _near_start(
    reference: GridFeatures, moving: GridFeatures, transform: Pose2, start: Pose2
) -> bool:
    """Whether the answer agrees with the start frame that producers of one robot share."""
    a = _motion(reference, moving, transform)
    b = _motion(reference, moving, start)
    shift, turn = displacement(a, b)
    return shift <= DISTINCT_CELLS and turn <= DISTINCT_YAW_RAD


def _profile(reference: GridFeatures, moving: GridFeatures, coarse: CoarseSearch) -> F64:
    """Return (K, 2) yaw of the map-frame transform, sorted, and the best coarse score there."""
    turn = reference.grid.grid.origin.yaw_rad - moving.grid.grid.origin.yaw_rad
    yaws = np.array([wrap_angle(float(yaw) + turn) for yaw in coarse.yaws])
    order = np.argsort(yaws)
    return np.stack((yaws[order], coarse.best[order]), axis=1)


def _separation(coarse: CoarseSearch, yaw: float) -> tuple[float, float]:
    """Return how far the answer's yaw stands out of all others: z, and other over best."""
    turn = np.abs(np.angle(np.exp(1j * (coarse.yaws - yaw))))
    other = coarse.best[turn > OTHER_YAW_RAD]
    near = coarse.best[turn <= OTHER_YAW_RAD]
    if other.size < 2 or near.size == 0:
        return 0.0, 1.0
    best = float(near.max())
    spread = float(other.std())
    z = (best - float(other.mean())) / spread if spread > 0 else 0.0
    return z, float(other.max()) / best if best > 0 else 1.0


def measure(
    reference: GridFeatures,
    moving: GridFeatures,
    motion: F64,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> dict[str, float]:
    """Return the numbers by which a motion is judged.

    ``wall_match`` is the smaller of the two shares of wall cells with a wall of the other map
    within 0.15 m, ``wall_clash`` the larger of the two shares in the other's free space more than
    1 m from any wall, ``wall_clash_near`` the same beyond 0.4 m; ``chance`` is the larger of the
    two shares of known cells within 0.15 m of a wall, what a random place would match.
    """
    lattice = to_lattice(motion[None], moving.centre)
    ref, mov = reference.level(1, cancel), moving.level(1, cancel)
    size = reference.grid.grid.resolution
    near2 = int(max(NEAR_M / size, NEAR_CELLS_MIN) ** 2 + 1e-9)
    clashes2 = [
        int(max(metres / size, least) ** 2 + 1e-9)
        for metres, least in ((FAR_CLASH_M, FAR_CLASH_CELLS_MIN), (CLASH_M, CLASH_CELLS_MIN))
    ]
    match, known, chance = [], [], []
    clash: list[list[float]] = [[], []]
    for points, pose, features, level in (
        (moving.wall_points, lattice, reference, ref),
        (reference.wall_points, invert(lattice), moving, mov),
    ):
        sample = spread_sample(points, EVIDENCE_POINTS)
        for far2, shares in zip(clashes2, clash, strict=True):
            check_cancelled(cancel)
            counts = device.pose_counts(
                sample,
                fixed_poses(pose),
                features.known,
                level.distance2,
                level.free,
                base=0,
                near2=near2,
                far2=far2,
            )[0]
            shares.append(counts[2] / len(sample))
        match.append(counts[1] / len(sample))
        known.append(counts[0] / len(sample))
        check_cancelled(cancel)
        chance.append(features.near_wall_share(near2))
    overlap, error = _overlap_and_error(reference, moving, lattice, device, cancel)
    return {
        "wall_match": float(min(match)),
        "wall_match_moving": float(match[0]),
        "wall_match_reference": float(match[1]),
        "wall_clash": float(max(clash[0])),
        "wall_clash_near": float(max(clash[1])),
        "wall_known": float(min(known)),
        "chance": float(max(chance)),
        "overlap": overlap,
        "error": error,
    }


def _overlap_and_error(
    reference: GridFeatures,
    moving: GridFeatures,
    lattice: F64,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> tuple[float, float]:
    """Return the share of known cells in common, and the [F16] error over the reference's box."""
    check_cancelled(cancel)
    warped = device.warp(moving.cells, fixed_poses(invert(lattice)), reference.shape, -1)
    check_cancelled(cancel)
    counts = device.confusion(reference.cells, warped)
    both = float(counts[1:, 1:].sum())
    smaller = max(1, min(reference.known_cells, moving.known_cells))
    squares = np.array([[0, 1, 4], [1, 0, 1], [4, 1, 0]])
    return min(1.0, both / smaller), math.sqrt(float((counts * squares).sum()))
