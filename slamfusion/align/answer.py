"""Compare the answer of a search with its rivals, measure it, decide, write the record."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from slamfusion.align.decide import (
    EXPECTED_WRONG_MAX,
    GROUND_ONE_M2,
    MOST,
    OBSERVED_M,
    START_WRONG,
    TRIALS,
    WALLS_MIN,
    Decision,
    MatchEvidence,
    decide,
    odds,
)
from slamfusion.align.hypotheses import (
    APART_RAD,
    DISTINCT_CELLS,
    Answer,
    Chances,
    best_answer,
    best_image,
    estimate_scale,
    weigh,
)
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment, RunnerUp
from slamfusion.align.refine import climbed, narrow_fits, refine
from slamfusion.align.scores import SCORED_POINTS, count_met, rank
from slamfusion.align.search import SearchResult, meeting_cells, prior_within
from slamfusion.config import AlignConfig
from slamfusion.geometry import F64, Pose2, wrap_angle

# A bent map with a smaller share of matching walls is fitted as a whole, at a wide scale in cells.
BENT_MATCH, BENT_SCALES = 0.45, (24.0,)
# Tolerances of a match and of two clashes, metres, with a minimum in cells for coarse maps.
TOLERANCES = ((0.15, 1.5), (1.0, 5.0), (0.4, 3.0))


def conclude(
    pair: Pair,
    config: AlignConfig,
    found: SearchResult,
    start: Pose2 | None,
    pairs: int,
    began: float,
    near: str | None = None,
) -> Alignment:
    """Measure the answer and its rivals, decide, and write the record.

    ``found`` has at least one motion; ``start`` is where the answer is expected, without a window;
    ``began`` is ``time.perf_counter()`` at the start of the work on this pair; ``near`` says where
    alone was searched, for the reason of a rejection.
    """
    # More wrong answers look right on large ground, fewer near a start.
    trials = pairs * max(1.0, meeting_cells(pair) * pair.resolution**2 / GROUND_ONE_M2)
    chances = Chances(trials, prior=found.prior)
    if found.search != "window" and start is not None:
        prior = prior_within(pair, DISTINCT_CELLS, APART_RAD)
        chances = Chances(trials, pair.motion_of(start), prior)
    answer = best_answer(pair, found, chances)
    # As finely as the maps allow.
    best = answer.motion
    if found.coarse is not None and answer.reading != "bent":
        best = climbed(pair, narrow_fits(pair, best[None])[0])
    scores, statistics = measure(pair, np.concatenate((best[None], answer.others[:1])))
    met = max(statistics["wall_match_moving"], statistics["wall_match_reference"])
    if answer.reading == "bent" and met < BENT_MATCH:
        # A narrow fit locks onto one part of a bent map; a wide one spreads the misfit over all of
        # it.
        best = refine(pair, best[None], 1, BENT_SCALES, iterations=8, everywhere=True)[0]
        scores, statistics = measure(pair, np.concatenate((best[None], answer.others[:1])))
    overlap, error = statistics["overlap"], statistics.pop("error")
    runner_up = None
    if len(scores) > 1:
        ratio = max(0.0, scores[1] / scores[0]) if scores[0] > 0 else 1.0
        runner_up = RunnerUp(pair.transform_of(answer.others[0]), scores[1], ratio)
    evidence, decision = _decided(
        pair, config, found, answer, chances, best, statistics=statistics, runner_up=runner_up
    )
    if near is not None and not decision.accepted:
        decision = decision._replace(reason=f"{near}: {decision.reason}")
    statistics.pop("overlap")
    profile = None
    if found.coarse is not None:
        turn = pair.reference.grid.grid.origin.yaw_rad - pair.moving.grid.grid.origin.yaw_rad
        yaws = np.array([wrap_angle(float(yaw) + turn) for yaw in found.coarse.yaws])
        order = np.argsort(yaws)
        profile = np.stack((yaws[order], found.coarse.best[order]), axis=1)
    return Alignment(
        moving=pair.moving.grid.name,
        reference=pair.reference.grid.name,
        accepted=decision.accepted,
        reason=decision.reason,
        transform=pair.transform_of(best),
        score=scores[0],
        overlap=overlap,
        error=error,
        runner_up=runner_up,
        time_s=time.perf_counter() - began,
        statistics=statistics,
        yaw_profile=profile,
        evidence=evidence,
        decision=decision.kind,
    )


def _decided(
    pair: Pair,
    config: AlignConfig,
    found: SearchResult,
    answer: Answer,
    chances: Chances,
    best: F64,
    *,
    statistics: dict[str, float],
    runner_up: RunnerUp | None,
) -> tuple[MatchEvidence, Decision]:
    """Return the evidence for an answer, and the decision."""
    # A start limits the possible common ground.
    is_anywhere = chances.prior >= 1.0
    patches = max(1.0, MOST / max(statistics["overlap"], 1e-3)) if is_anywhere else 1.0
    evidence = _evidence(answer, chances, patches)
    walls = min(len(pair.reference.wall_points), len(pair.moving.wall_points))
    if walls < WALLS_MIN:
        words = f"too few walls to judge: {walls} of the {WALLS_MIN} needed"
        return evidence, Decision("too little in common", words)
    rival = None
    if runner_up is not None:
        pose = runner_up.transform
        rival = f"at {pose.x:.2f}, {pose.y:.2f} m, {math.degrees(pose.yaw_rad):.0f} deg"
    trials = TRIALS * patches * answer.trials[0]
    decision = decide(evidence, statistics, rival, trials)
    mirrored = scale = None
    if found.coarse is None:
        return evidence, decision._replace(reason=f"{found.search}: {decision.reason}")
    if decision.accepted:
        answer, mirrored, scale = _looked_at(pair, config, answer, chances, best, evidence)
    elif found.search == "full" and decision.kind in found.image_after:
        image = best_image(pair, config, chances.trials)
        if image is not None and image.is_accepted and image.wrong < answer.wrong:
            own = max(float(weigh(pair, answer.motion[None], image.reading).total[0]), 0.0)
            mirrored = odds(image.total / (image.total + own))
    if mirrored is not None or scale is not None:
        evidence = replace(_evidence(answer, chances, patches), mirrored=mirrored, scale=scale)
        decision = decide(evidence, statistics, rival, trials)
    if found.coarse.is_cut:
        said = (
            "; walls are everywhere, so fine cells were searched only at yaws with parallel walls"
        )
        decision = decision._replace(reason=decision.reason + said)
    return evidence, decision


def _looked_at(
    pair: Pair,
    config: AlignConfig,
    answer: Answer,
    chances: Chances,
    best: F64,
    evidence: MatchEvidence,
) -> tuple[Answer, float | None, float]:
    """Return an answer compared with its image, the evidence for that over its own, and its scale.

    None: not looked for, since no two good maps of two places fit so well.
    """
    mirrored, others = None, np.empty((0, 3))
    at = answer.motion if answer.reading == "bent" else best
    if answer.reading != "good" or evidence.expected_wrong >= EXPECTED_WRONG_MAX**4:
        # A start is evidence for an answer, and does not hold for an image.
        is_near = "a pose away from the start" in answer.against
        own = answer.total - (OBSERVED_M * math.log(START_WRONG) if is_near else 0.0)
        image = best_image(pair, config, chances.trials, answer.reading)
        mirrored, others = 0.0 if image is None else max(0.0, image.total) / own, answer.others
        if answer.reading == "good" and image is not None:
            answer = answer.compared_with_image(mirrored, is_chance=not image.is_accepted)
    return answer, mirrored, estimate_scale(pair, at, answer.reading, others)


def _evidence(answer: Answer, chances: Chances, patches: float) -> MatchEvidence:
    """Return what the record has of an answer; ``patches`` is the prior of little common ground."""
    return MatchEvidence(
        answer.reading,
        answer.against["no relation"],
        answer.against[answer.nearest],
        answer.nearest,
        answer.weight,
        answer.share,
        answer.common_m,
        answer.ratio,
        patches * (answer.wrong if answer.weight > 0.0 else TRIALS * chances.trials),
    )


def measure(pair: Pair, motions: F64) -> tuple[list[float], dict[str, float]]:
    """Return the score of each motion (P, 3), see ``rank``, and the statistics of the first.

    ``wall_match``: the smaller of the two shares of wall cells within 0.15 m of a wall of the other
    map. ``wall_clash`` and ``wall_clash_near``: the larger of the two shares in the other's
    free space more than 1 m and 0.4 m from any wall. ``chance``: the larger of the two shares
    of known cells (``known_at_distance``) within 0.15 m of a wall, the match of a random place.
    ``explained``: the share of the map with fewer wall cells; ``explained_by_chance``: the share
    of it that a random place on the other map's known cells would explain.
    """
    size = pair.resolution
    limits2 = [int(max(metres / size, least) ** 2 + 1e-9) for metres, least in TOLERANCES]
    *counts, ours, theirs = count_met(pair, motions, SCORED_POINTS, limits2, solid=(False, True))
    scores = rank(pair, counts).tolist()
    sampled = [min(SCORED_POINTS, len(own.wall_points)) for own in (pair.moving, pair.reference)]
    _, known, match, _, _, _, *clash = (
        [float(count) / points for count, points in zip(both, sampled, strict=True)]
        for both in zip(ours[0], theirs[0], strict=True)
    )
    known_at = [other.known_at_distance(1) for other in pair]
    chance = [at[: limits2[0] + 1].sum() / max(1.0, at.sum()) for at in known_at]
    smaller = 0 if len(pair.moving.wall_points) <= len(pair.reference.wall_points) else 1
    # Common known cells, and the [F16] error over the reference's box.
    _, (_, back, _) = pair.sides(motions[:1])
    poses = back.T.astype(np.int64)
    ((error, common),) = pair.device.grid_error(pair.reference.cells, pair.moving.cells, poses)
    least = max(1, min(pair.reference.known_cells, pair.moving.known_cells))
    return scores, {
        "wall_match": float(min(match)),
        "wall_match_moving": float(match[0]),
        "wall_match_reference": float(match[1]),
        "wall_clash": float(max(clash[0])),
        "wall_clash_near": float(max(clash[1])),
        "wall_known": float(min(known)),
        "chance": float(max(chance)),
        "explained": float(match[smaller]),
        "explained_by_chance": float(chance[smaller]),
        "overlap": min(1.0, float(common) / least),
        "error": math.sqrt(float(error)),
    }
