"""Judge what a search found: measure it, hold it against its rivals, decide, write the record."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.accept import (
    EXPECTED_WRONG_MAX,
    GROUND_ONE_GOOD_M2,
    GROUND_ONE_M2,
    SHARE_MIN,
    SHARP_MATCH,
    SHARP_WHOLE,
    Evidence,
    decide,
    wrong_in_job,
)
from slamfusion.align.cancel import CancelToken
from slamfusion.align.corner import beside_lines_m
from slamfusion.align.features import FINE_TABLE, GridFeatures
from slamfusion.align.frames import motion_of, transform_of
from slamfusion.align.held import held_by
from slamfusion.align.measure import measure
from slamfusion.align.mirror import SURE_SHARE, mirror_gain, mirror_image
from slamfusion.align.motions import displacement
from slamfusion.align.narrow_fit import climbed, narrow_fits
from slamfusion.align.pieces import wall_pieces
from slamfusion.align.records import Alignment, MatchEvidence, RunnerUp
from slamfusion.align.refine import rank, refine
from slamfusion.align.rivals import (
    DISTINCT_CELLS,
    DISTINCT_YAW_RAD,
    PLAIN_SHARE,
    Found,
    Standing,
    chosen_standing,
)
from slamfusion.align.scale import estimate_scale
from slamfusion.align.search import CoarseSearch, search, wall_widths
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.geometry import Pose2, wrap_angle

F64 = npt.NDArray[np.float64]

# Less than this of either map's walls meets: a bent map's, whose fit is spread over the whole map.
BENT_MATCH = 0.45
BENT_SCALES = (24.0,)
# Where walls fade from a map they are known to a cell less, and chance fits so many times as often
# as that of good maps: the map of a lost SLAM on a depot, of which 20 m met, would count 5.7.
FADED_TRIALS = 2.0
# What the walls give there, by a wide width, as a share of what they gave before: with less the
# wide fit has lost the place.
SPREAD_LEAST = 0.5
YAW_RAD_MIN = math.radians(0.5)
# A mirror image that gives more times as much is not told from one that gives this.
GAIN_MAX = 100.0


def judge(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    found: Found,
    start: Pose2 | None,
    pairs: int,
    began: float,
    cancel: CancelToken | None,
) -> Alignment:
    """Measure the answer and its rivals, decide, and write the record.

    Args:
        reference, moving: the two grids.
        config: settings of the search, for the mirror image.
        device: computes.
        found: at least one motion.
        start: where the answer is expected, without a window; None: nowhere.
        pairs: pairs of maps in the job.
        began: ``time.perf_counter()`` when the work on this pair began.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    narrow = wall_widths(reference)[0]
    stand = chosen_standing(reference, moving, device, found, pairs, cancel)
    others = stand.others
    is_likely = stand.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX
    best, statistics = _placed(reference, moving, device, found, stand, cancel, is_likely=is_likely)
    overlap, error = statistics.pop("overlap"), statistics.pop("error")
    shown = [best] if not others else [best, stand.motions[others[0]]]
    scores = rank(reference, moving, np.array(shown), 1, FINE_TABLE, device, cancel=cancel)
    score = float(scores[0])
    transform = transform_of(reference, moving, best)
    runner_up = None
    if others:
        ratio = float(scores[1]) / score if score > 0 else 1.0
        runner_up = RunnerUp(
            transform_of(reference, moving, shown[1]), float(scores[1]), max(0.0, ratio)
        )
    prior = found.prior
    if (
        start is not None
        and found.search == "full"
        and _near_start(reference, moving, transform, start)
    ):
        prior = prior_within(reference, moving, DISTINCT_CELLS, DISTINCT_YAW_RAD)
    if found.coarse is not None:
        prior *= ground_prior(reference, moving, is_plain=stand.is_plain)
    evidence = _evidence(
        reference, moving, stand, runner_up, statistics,
        found=found, pairs=pairs, prior=prior, overlap=overlap,
    )  # fmt: skip
    decision = decide(evidence)
    if found.search in {"full", "window"} and decision.accepted:
        evidence = replace(
            evidence,
            held_m=held_by(reference, moving, best, cancel),
            # Near a start it does not matter which other corners look alike.
            beside_lines_m=beside_lines_m(reference, moving, best, device)
            if found.search == "full"
            else None,
        )
        decision = decide(evidence)
    if found.search in {"full", "window"} and (decision.accepted or decision.kind == "bent"):
        evidence = _looked_closer(
            evidence, reference, moving, config, device, stand, best, narrow, cancel
        )
        decision = decide(evidence)
    if (
        found.search == "full"
        and not decision.accepted
        and decision.kind not in {"mirrored", "other scale"}
        and decision.kind in found.image_after
    ):
        evidence = _looked_at_image(
            evidence, reference, moving, config, device, stand, pairs, cancel
        )
        decision = decide(evidence)
    match = MatchEvidence(
        pieces=evidence.witnesses,
        better=evidence.better,
        share=evidence.share,
        common_m=evidence.common_m,
        rival_ratio=evidence.ratio,
        expected_wrong=wrong_in_job(evidence),
        mirrored=evidence.mirrored,
        scale=evidence.scale,
        scaled_share=None if evidence.scale is None else evidence.scaled_share,
        rival_share=evidence.clean_share,
        held_m=evidence.held_m,
        beside_lines_m=evidence.beside_lines_m,
        good_maps=evidence.is_plain,
        sharp_maps=evidence.is_sharp,
    )
    return Alignment(
        reference.grid.name,
        moving.grid.name,
        transform,
        decision.accepted,
        decision.reason,
        score,
        overlap,
        error,
        runner_up,
        time.perf_counter() - began,
        statistics,
        None if found.coarse is None else _profile(reference, moving, found.coarse),
        match,
        decision.kind,
    )


def _placed(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    stand: Standing,
    cancel: CancelToken | None,
    *,
    is_likely: bool,
) -> tuple[F64, dict[str, float]]:
    """Return the answer as finely as the maps allow (3,), and its numbers (see ``measure``).

    An answer that may be believed as that of bent maps is tried as one of good maps, too, which may
    lie some degrees beside it.
    """
    narrow, broad = wall_widths(reference)
    found_at = best = stand.motions[0]
    is_bent = stand.share < PLAIN_SHARE or stand.sigma > narrow
    if found.coarse is not None and (is_likely or not is_bent):
        best = narrow_fits(reference, moving, found_at[None], device, cancel)[0]
        best = climbed(reference, moving, best, device, cancel)
        if is_bent:
            both = wall_pieces(
                reference, moving, np.array([found_at, best]), narrow, device, cancel
            )
            is_bent = not (both.total[1] > both.total[0] and both.share()[1] >= PLAIN_SHARE)
            best = found_at if is_bent else best
    statistics = measure(reference, moving, best, device, cancel)
    if is_bent and _met(statistics) < BENT_MATCH:
        # Both maps mostly miss each other's walls. A narrow fit locks one part of a bent map and
        # leaves the rest; the wide one spreads the misfit over the whole map.
        spread = refine(
            reference,
            moving,
            best[None],
            1,
            BENT_SCALES,
            device,
            iterations=8,
            everywhere=True,
            cancel=cancel,
        )[0]
        both = wall_pieces(reference, moving, np.array([best, spread]), broad, device, cancel)
        if both.total[1] >= SPREAD_LEAST * both.total[0]:
            best = spread
            statistics = measure(reference, moving, best, device, cancel)
    return best, statistics


def _met(statistics: dict[str, float]) -> float:
    """Return the share of one map's walls that meet the other's, of the map that has more."""
    return max(statistics["wall_match_moving"], statistics["wall_match_reference"])


def _evidence(
    reference: GridFeatures,
    moving: GridFeatures,
    stand: Standing,
    runner_up: RunnerUp | None,
    statistics: dict[str, float],
    *,
    found: Found,
    pairs: int,
    prior: float,
    overlap: float,
) -> Evidence:
    """Return what speaks for the answer, and for the best of the others."""
    pieces, others = stand.pieces, stand.others
    total, witnesses = pieces.total, pieces.witnesses(0)
    rival = None
    if runner_up is not None:
        pose = runner_up.transform
        rival = f"at {pose.x:.2f}, {pose.y:.2f} m, {math.degrees(pose.yaw_rad):.0f} deg"
    highest = max((float(total[k]) for k in others), default=0.0)
    return Evidence(
        walls=min(len(reference.wall_points), len(moving.wall_points)),
        common_m=float(pieces.seen_m[0]),
        common_ground=overlap,
        share=stand.share,
        witnesses=witnesses,
        better=stand.better,
        clean_share=stand.clean_share,
        better_inside=stand.better_inside,
        is_plain=stand.is_plain,
        is_sharp=statistics["wall_match"] >= SHARP_MATCH and pieces.whole() >= SHARP_WHOLE,
        is_cut=found.coarse is not None and found.coarse.is_cut,
        ratio=max(0.0, highest / float(total[0])) if total[0] > 0 else 1.0,
        rival=rival,
        pairs=pairs,
        prior=prior,
        statistics=statistics,
        search=found.search,
    )


def _looked_closer(
    evidence: Evidence,
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    stand: Standing,
    best: F64,
    narrow: float,
    cancel: CancelToken | None,
) -> Evidence:
    """Add what would explain the walls better than the answer: another scale, a mirror image."""
    motion, mirrored = stand.motions[0], None
    if evidence.share < SURE_SHARE:
        mirrored = mirror_gain(
            reference, moving, motion, config, stand.sigma, device, cancel,
            doubt=stand.pieces.doubt,
        )  # fmt: skip
    # Where little is in common another scale leaves little unexplained: it is always looked for.
    if stand.is_plain:
        fit = estimate_scale(reference, moving, motion, (stand.sigma, narrow), device, cancel)
    else:
        # A part of what is bent fits, by one width or the other, where the answer was found or at
        # its last fit, and that need not be the part about which the scale turns.
        places = (motion,) if np.array_equal(motion, best) else (motion, best)
        fit = max(
            (
                estimate_scale(reference, moving, at, (width, narrow), device, cancel, is_far=True)
                for at in places
                for width in wall_widths(reference)
            ),
            key=lambda found: found.share,
        )
    return replace(evidence, mirrored=mirrored, scale=fit.scale, scaled_share=fit.share)


def _looked_at_image(
    evidence: Evidence,
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    stand: Standing,
    pairs: int,
    cancel: CancelToken | None,
) -> Evidence:
    """Add the mirror image where it would be believed, though the map itself is not."""
    image = mirror_image(moving, device)
    coarse, motions, _ = search(reference, image, config, SearchWindow(), device, cancel)
    if not len(motions):
        return evidence
    other = chosen_standing(reference, image, device, Found(motions, coarse, "full"), pairs, cancel)
    # A half of a place that is nearly its own image may fit both ways.
    least = EXPECTED_WRONG_MAX * min(1.0, stand.wrong(pairs))
    if other.share < SHARE_MIN or other.wrong(pairs) >= least:
        return evidence
    # By one width, and by no sides of walls: like is held against like.
    own, gained = (
        float(
            wall_pieces(reference, of, motion[None], other.sigma, device, cancel).evidence[0].sum()
        )
        for of, motion in ((moving, stand.motions[0]), (image, other.motions[0]))
    )
    gain = GAIN_MAX if own * GAIN_MAX <= gained else gained / own
    return replace(evidence, mirrored=gain)


def prior_within(
    reference: GridFeatures, moving: GridFeatures, cells: float, yaw_rad: float
) -> float:
    """Return how much fewer the poses within these distances are than all that could overlap."""
    everywhere = _ground(reference, moving) * 2.0 * math.pi
    here = (2.0 * max(cells, 1.0)) ** 2 * 2.0 * max(min(yaw_rad, math.pi), YAW_RAD_MIN)
    return min(1.0, here / everywhere)


def _ground(reference: GridFeatures, moving: GridFeatures) -> float:
    """Return the cells on which the moving centre may lie where both maps could overlap."""
    reach = math.hypot(*moving.shape)
    return (reference.shape[0] + reach) * (reference.shape[1] + reach)


def ground_prior(reference: GridFeatures, moving: GridFeatures, *, is_plain: bool) -> float:
    """Return how many times more wrong answers there are than on the ground of ``accept``, or 1.

    So many times as many places there are, and of good maps that fade each fits more often.
    """
    ground_m2 = _ground(reference, moving) * reference.grid.grid.resolution**2
    places = max(1.0, ground_m2 / (GROUND_ONE_GOOD_M2 if is_plain else GROUND_ONE_M2))
    return FADED_TRIALS * places if is_plain and (reference.fades or moving.fades) else places


def _near_start(
    reference: GridFeatures, moving: GridFeatures, transform: Pose2, start: Pose2
) -> bool:
    """Whether the answer agrees with the start frame that producers of one robot share."""
    a = motion_of(reference, moving, transform)
    b = motion_of(reference, moving, start)
    shift, turn = displacement(a, b)
    return shift <= DISTINCT_CELLS and turn <= DISTINCT_YAW_RAD


def _profile(reference: GridFeatures, moving: GridFeatures, coarse: CoarseSearch) -> F64:
    """Return (K, 2) yaw of the map-frame transform, sorted, and the best coarse score there."""
    turn = reference.grid.grid.origin.yaw_rad - moving.grid.grid.origin.yaw_rad
    yaws = np.array([wrap_angle(float(yaw) + turn) for yaw in coarse.yaws])
    order = np.argsort(yaws)
    return np.stack((yaws[order], coarse.best[order]), axis=1)


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
        time_s=time_s,
    )
