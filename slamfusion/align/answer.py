"""Judge what a search found: measure it, hold it against its rivals, decide, write the record."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import check_cancelled
from slamfusion.align.common_walls import NEAR_CELLS_MIN, NEAR_M, beside_lines_m, held_by
from slamfusion.align.decide import (
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
from slamfusion.align.features import FINE_TABLE, spread_sample
from slamfusion.align.hypotheses import (
    DISTINCT_CELLS,
    DISTINCT_YAW_RAD,
    PLAIN_SHARE,
    SURE_SHARE,
    PairScores,
    estimate_scale,
    mirror_gain,
    scored_answer,
)
from slamfusion.align.pair import Pair, displacement, invert, to_lattice
from slamfusion.align.records import Alignment, MatchEvidence, RunnerUp
from slamfusion.align.refine import climbed, narrow_fits, refine
from slamfusion.align.scores import rank, wall_pieces
from slamfusion.align.search import CoarseSearch, SearchResult, meeting_cells, prior_within, search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute.lattice import fixed_poses
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
# A mirror image that gives more times as much is not told from one that gives this.
GAIN_MAX = 100.0
CLASH_M, CLASH_CELLS_MIN = 0.4, 3.0
FAR_CLASH_M, FAR_CLASH_CELLS_MIN = 1.0, 5.0
MEASURED_POINTS = 4096


def conclude(
    pair: Pair,
    config: AlignConfig,
    found: SearchResult,
    start: Pose2 | None,
    pairs: int,
    began: float,
) -> Alignment:
    """Measure the answer and its rivals, decide, and write the record.

    Args:
        pair: the two maps.
        config: settings of the search, for the mirror image.
        found: at least one motion.
        start: where the answer is expected, without a window; None: nowhere.
        pairs: pairs of maps in the job.
        began: ``time.perf_counter()`` when the work on this pair began.
    """
    stand = scored_answer(pair, found, pairs)
    others = stand.others
    is_likely = stand.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX
    best, statistics = _placed(pair, found, stand, is_likely=is_likely)
    overlap, error = statistics.pop("overlap"), statistics.pop("error")
    shown = [best] if not others else [best, stand.motions[others[0]]]
    scores = rank(pair, np.array(shown), 1, FINE_TABLE)
    score = float(scores[0])
    transform = pair.transform_of(best)
    runner_up = None
    if others:
        ratio = float(scores[1]) / score if score > 0 else 1.0
        runner_up = RunnerUp(pair.transform_of(shown[1]), float(scores[1]), max(0.0, ratio))
    prior = found.prior
    if start is not None and found.search == "full" and _near_start(pair, transform, start):
        prior = prior_within(pair, DISTINCT_CELLS, DISTINCT_YAW_RAD)
    if found.coarse is not None:
        prior *= ground_prior(pair, is_plain=stand.is_plain)
    evidence = _evidence(
        pair, stand, runner_up, statistics, found=found, pairs=pairs, prior=prior, overlap=overlap
    )
    decision = decide(evidence)
    if found.search in {"full", "window"} and decision.accepted:
        evidence = replace(
            evidence,
            held_m=held_by(pair, best),
            # Near a start it does not matter which other corners look alike.
            beside_lines_m=beside_lines_m(pair, best) if found.search == "full" else None,
        )
        decision = decide(evidence)
    if found.search in {"full", "window"} and (decision.accepted or decision.kind == "bent"):
        evidence = _looked_closer(evidence, pair, config, stand, best)
        decision = decide(evidence)
    if (
        found.search == "full"
        and not decision.accepted
        and decision.kind not in {"mirrored", "other scale"}
        and decision.kind in found.image_after
    ):
        evidence = _looked_at_image(evidence, pair, config, stand, pairs)
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
        pair.reference.grid.name,
        pair.moving.grid.name,
        transform,
        decision.accepted,
        decision.reason,
        score,
        overlap,
        error,
        runner_up,
        time.perf_counter() - began,
        statistics,
        None if found.coarse is None else _profile(pair, found.coarse),
        match,
        decision.kind,
    )


def _placed(
    pair: Pair, found: SearchResult, stand: PairScores, *, is_likely: bool
) -> tuple[F64, dict[str, float]]:
    """Return the answer as finely as the maps allow (3,), and its numbers (see ``measure``).

    An answer that may be believed as that of bent maps is tried as one of good maps, too, which may
    lie some degrees beside it.
    """
    narrow, broad = pair.widths
    found_at = best = stand.motions[0]
    is_bent = stand.share < PLAIN_SHARE or stand.sigma > narrow
    if found.coarse is not None and (is_likely or not is_bent):
        best = narrow_fits(pair, found_at[None])[0]
        best = climbed(pair, best)
        if is_bent:
            both = wall_pieces(pair, np.array([found_at, best]), narrow)
            is_bent = not (both.total[1] > both.total[0] and both.share()[1] >= PLAIN_SHARE)
            best = found_at if is_bent else best
    statistics = measure(pair, best)
    if is_bent and _met(statistics) < BENT_MATCH:
        # Both maps mostly miss each other's walls. A narrow fit locks one part of a bent map and
        # leaves the rest; the wide one spreads the misfit over the whole map.
        spread = refine(pair, best[None], 1, BENT_SCALES, iterations=8, everywhere=True)[0]
        both = wall_pieces(pair, np.array([best, spread]), broad)
        if both.total[1] >= SPREAD_LEAST * both.total[0]:
            best = spread
            statistics = measure(pair, best)
    return best, statistics


def _met(statistics: dict[str, float]) -> float:
    """Return the share of one map's walls that meet the other's, of the map that has more."""
    return max(statistics["wall_match_moving"], statistics["wall_match_reference"])


def _evidence(
    pair: Pair,
    stand: PairScores,
    runner_up: RunnerUp | None,
    statistics: dict[str, float],
    *,
    found: SearchResult,
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
        walls=min(len(pair.reference.wall_points), len(pair.moving.wall_points)),
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
    evidence: Evidence, pair: Pair, config: AlignConfig, stand: PairScores, best: F64
) -> Evidence:
    """Add what would explain the walls better than the answer: another scale, a mirror image."""
    motion, mirrored, narrow = stand.motions[0], None, pair.widths[0]
    if evidence.share < SURE_SHARE:
        mirrored = mirror_gain(pair, motion, config, stand.sigma, doubt=stand.pieces.doubt)
    # Where little is in common another scale leaves little unexplained: it is always looked for.
    if stand.is_plain:
        fit = estimate_scale(pair, motion, (stand.sigma, narrow))
    else:
        # A part of what is bent fits, by one width or the other, where the answer was found or at
        # its last fit, and that need not be the part about which the scale turns.
        places = (motion,) if np.array_equal(motion, best) else (motion, best)
        fit = max(
            (
                estimate_scale(pair, at, (width, narrow), is_far=True)
                for at in places
                for width in pair.widths
            ),
            key=lambda found: found.share,
        )
    return replace(evidence, mirrored=mirrored, scale=fit.scale, scaled_share=fit.share)


def _looked_at_image(
    evidence: Evidence, pair: Pair, config: AlignConfig, stand: PairScores, pairs: int
) -> Evidence:
    """Add the mirror image where it would be believed, though the map itself is not."""
    image = pair.mirrored()
    coarse, motions, _ = search(image, config, SearchWindow())
    if not len(motions):
        return evidence
    other = scored_answer(image, SearchResult(motions, coarse, "full"), pairs)
    # A half of a place that is nearly its own image may fit both ways.
    least = EXPECTED_WRONG_MAX * min(1.0, stand.wrong(pairs))
    if other.share < SHARE_MIN or other.wrong(pairs) >= least:
        return evidence
    # By one width, and by no sides of walls: like is held against like.
    own, gained = (
        float(wall_pieces(of, motion[None], other.sigma).evidence[0].sum())
        for of, motion in ((pair, stand.motions[0]), (image, other.motions[0]))
    )
    gain = GAIN_MAX if own * GAIN_MAX <= gained else gained / own
    return replace(evidence, mirrored=gain)


def ground_prior(pair: Pair, *, is_plain: bool) -> float:
    """Return how many times more wrong answers there are than on the ground of ``decide``, or 1.

    So many times as many places there are, and of good maps that fade each fits more often.
    """
    ground_m2 = meeting_cells(pair) * pair.resolution**2
    places = max(1.0, ground_m2 / (GROUND_ONE_GOOD_M2 if is_plain else GROUND_ONE_M2))
    return (
        FADED_TRIALS * places
        if is_plain and (pair.reference.fades or pair.moving.fades)
        else places
    )


def _near_start(pair: Pair, transform: Pose2, start: Pose2) -> bool:
    """Whether the answer agrees with the start frame that producers of one robot share."""
    a = pair.motion_of(transform)
    b = pair.motion_of(start)
    shift, turn = displacement(a, b)
    return shift <= DISTINCT_CELLS and turn <= DISTINCT_YAW_RAD


def _profile(pair: Pair, coarse: CoarseSearch) -> F64:
    """Return (K, 2) yaw of the map-frame transform, sorted, and the best coarse score there."""
    turn = pair.reference.grid.grid.origin.yaw_rad - pair.moving.grid.grid.origin.yaw_rad
    yaws = np.array([wrap_angle(float(yaw) + turn) for yaw in coarse.yaws])
    order = np.argsort(yaws)
    return np.stack((yaws[order], coarse.best[order]), axis=1)


def rejected_alignment(pair: Pair, reason: str, time_s: float) -> Alignment:
    """Return the record of a pair that could not be searched."""
    return Alignment(
        pair.reference.grid.name,
        pair.moving.grid.name,
        Pose2(),
        accepted=False,
        reason=reason,
        score=0.0,
        overlap=0.0,
        error=0.0,
        runner_up=None,
        time_s=time_s,
    )


def measure(pair: Pair, motion: F64) -> dict[str, float]:
    """Return the numbers by which a motion is judged.

    ``wall_match`` is the smaller of the two shares of wall cells with a wall of the other map
    within 0.15 m, ``wall_clash`` the larger of the two shares in the other's free space more than
    1 m from any wall, ``wall_clash_near`` the same beyond 0.4 m; ``chance`` is the larger of the
    two shares of known cells within 0.15 m of a wall, what a random place would match.
    ``explained`` is the share of the map with fewer wall cells, and ``explained_by_chance`` what a
    random place on the known cells of the other map would match of it.
    """
    lattice = to_lattice(motion[None], pair.moving.centre)
    ref, mov = pair.reference.level(1), pair.moving.level(1)
    size = pair.resolution
    near2 = int(max(NEAR_M / size, NEAR_CELLS_MIN) ** 2 + 1e-9)
    clashes2 = [
        int(max(metres / size, least) ** 2 + 1e-9)
        for metres, least in ((FAR_CLASH_M, FAR_CLASH_CELLS_MIN), (CLASH_M, CLASH_CELLS_MIN))
    ]
    match, known, chance = [], [], []
    clash: list[list[float]] = [[], []]
    for points, pose, features, level in (
        (pair.moving.wall_points, lattice, pair.reference, ref),
        (pair.reference.wall_points, invert(lattice), pair.moving, mov),
    ):
        sample = spread_sample(points, MEASURED_POINTS)
        for far2, shares in zip(clashes2, clash, strict=True):
            check_cancelled()
            counts = pair.device.pose_counts(
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
        check_cancelled()
        chance.append(features.near_wall_share(near2))
    smaller = 0 if len(pair.moving.wall_points) <= len(pair.reference.wall_points) else 1
    overlap, error = _overlap_and_error(pair, lattice)
    return {
        "wall_match": float(min(match)),
        "wall_match_moving": float(match[0]),
        "wall_match_reference": float(match[1]),
        "wall_clash": float(max(clash[0])),
        "wall_clash_near": float(max(clash[1])),
        "wall_known": float(min(known)),
        "chance": float(max(chance)),
        "explained": float(match[smaller]),
        "explained_by_chance": float(chance[smaller]),
        "overlap": overlap,
        "error": error,
    }


def _overlap_and_error(pair: Pair, lattice: F64) -> tuple[float, float]:
    """Return the share of known cells in common, and the [F16] error over the reference's box."""
    check_cancelled()
    warped = pair.device.warp(
        pair.moving.cells, fixed_poses(invert(lattice)), pair.reference.shape, -1
    )
    check_cancelled()
    counts = pair.device.confusion(pair.reference.cells, warped)
    both = float(counts[1:, 1:].sum())
    smaller = max(1, min(pair.reference.known_cells, pair.moving.known_cells))
    squares = np.array([[0, 1, 4], [1, 0, 1], [4, 1, 0]])
    return min(1.0, both / smaller), math.sqrt(float((counts * squares).sum()))
