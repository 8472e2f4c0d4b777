"""Judge what a search found: measure it, hold it against its rivals, decide, write the record."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fusion.accept import (
    EXPECTED_WRONG_MAX,
    SHARE_MIN,
    Evidence,
    decide,
    expected_wrong,
)
from slamfusion.fusion.cancel import CancelToken
from slamfusion.fusion.features import FINE_TABLE, GridFeatures
from slamfusion.fusion.frames import motion_of, transform_of
from slamfusion.fusion.measure import measure
from slamfusion.fusion.mirror import SURE_SHARE, mirror_gain, mirror_image
from slamfusion.fusion.motions import displacement
from slamfusion.fusion.pieces import WallPieces, wall_pieces
from slamfusion.fusion.records import Alignment, MatchEvidence, RunnerUp
from slamfusion.fusion.refine import polish, rank, refine
from slamfusion.fusion.scale import estimate_scale
from slamfusion.fusion.search import DOUBT, CoarseSearch, SearchWindow, search, wall_widths
from slamfusion.fusion.slides import slides
from slamfusion.geometry import Pose2, wrap_angle

__all__ = ["Found", "is_distinct", "judge", "prior_within", "rejected_alignment"]

F64 = npt.NDArray[np.float64]

DISTINCT_CELLS = 20.0
DISTINCT_YAW_RAD = math.radians(10.0)
# A bent map fits its place in several ways a metre or two apart; they are one answer.
BENT_CELLS = 60.0
# Less of what the common ground could give than this, and one of the maps is bent: a wider width of
# a wall may tell more, and the fit is spread over the whole map. Where an answer gives more, what
# others leave unexplained speaks against them.
PLAIN_SHARE = 0.75
# So much less, and its fits a metre or two apart are one answer.
BENT_SHARE = 0.5
# Of the answers that give this much of the most evidence the one with the highest share may be
# right.
NOTED_RATIO = 0.7
# And less than this of either map's walls meets.
BENT_MATCH = 0.45
BENT_SCALES = (24.0,)
# A wide width speaks only where the narrow one says the same by so many pieces.
NARROW_MIN = 2.0
YAW_RAD_MIN = math.radians(0.5)
# A mirror image that gives more times as much is not told from one that gives this.
GAIN_MAX = 100.0


@dataclass(frozen=True, eq=False)
class Found:
    """What the search leaves for the decision.

    Attributes:
        motions: (P, 3) what the search ends with.
        coarse: outcome of the coarse stages; None where there was no search.
        bound_gap: see ``Alignment.bound_gap``.
        search: ``full``, ``window``, ``fixed step`` or ``tracked``.
        prior: see ``Evidence.prior``.
        candidates: how many of the motions, the first, may be the answer; None: all. The others are
            rivals only.
        looks_at_image: whether what is refused is searched once more as a mirror image.
    """

    motions: F64
    coarse: CoarseSearch | None
    bound_gap: float | None
    search: str
    prior: float = 1.0
    candidates: int | None = None
    looks_at_image: bool = False


@dataclass(frozen=True, eq=False)
class _Stand:
    """How an answer stands against its rivals, by one width of a wall.

    Attributes:
        sigma: the width, cells.
        motions: (P, 3) the answer, then its rivals.
        others: which of them are other answers, best first.
        pieces: what the pieces of wall say of them.
        inside: those of the others that lie in the window.
    """

    sigma: float
    motions: F64
    others: list[int]
    pieces: WallPieces
    inside: list[int]

    @property
    def is_plain(self) -> bool:
        """Whether it is weighed as that of two good maps of one place."""
        return self.pieces.doubt > 0.0

    @property
    def better_inside(self) -> float:
        """The same of the others in the window alone."""
        return self._better_than(self.inside)

    @property
    def better(self) -> float:
        """Pieces that say that the answer is better than any other, and than none."""
        return self._better_than(self.others)

    def wrong(self, pairs: int = 1, prior: float = 1.0, gap: float = 0.0) -> float:
        """Return the wrong answers to be expected to look as good; see ``expected_wrong``."""
        return expected_wrong(
            self.better, self.share, pairs, prior, is_plain=self.is_plain, gap=gap
        )

    def _better_than(self, others: list[int]) -> float:
        """Return the pieces for the answer against the best of some others, or against none."""
        pieces = self.pieces
        return min([pieces.witnesses(0), *(pieces.against(k) for k in others)])

    @property
    def clean_share(self) -> float:
        """The highest share of another answer that gives at least 0.7 as much."""
        total, share = self.pieces.total, self.pieces.share()
        noted = [float(share[k]) for k in self.others if total[k] >= NOTED_RATIO * total[0]]
        return max(noted, default=0.0)

    @property
    def share(self) -> float:
        """Evidence as a share of what the common ground could give."""
        return float(self.pieces.share()[0])


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
    stand = _chosen(reference, moving, device, found, pairs, cancel)
    others = stand.others
    best, statistics = _placed(reference, moving, device, found, stand, cancel)
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
    evidence = _evidence(
        reference, moving, stand, runner_up, statistics,
        pairs=pairs, prior=prior, search=found.search, gap=found.bound_gap or 0.0,
    )  # fmt: skip
    decision = decide(evidence)
    if found.search in {"full", "window"} and (decision.accepted or decision.kind == "bent"):
        evidence = _looked_closer(
            evidence, reference, moving, config, device, stand, narrow, cancel
        )
        decision = decide(evidence)
    elif found.search == "full" and found.looks_at_image:
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
        expected_wrong=stand.wrong(pairs, prior, evidence.gap),
        mirrored=evidence.mirrored,
        scale=evidence.scale,
        scaled_share=None if evidence.scale is None else evidence.scaled_share,
        rival_share=evidence.clean_share,
        good_maps=evidence.is_plain,
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
        found.bound_gap,
        time.perf_counter() - began,
        statistics,
        None if found.coarse is None else _profile(reference, moving, found.coarse),
        match,
        decision.kind,
    )


def _chosen(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    pairs: int,
    cancel: CancelToken | None,
) -> _Stand:
    """Return the answer and its rivals, weighed as two good maps, or as maps that are bent."""
    narrow, broad = wall_widths(reference)
    pieces = wall_pieces(reference, moving, found.motions, narrow, device, cancel)
    stand = _stand(found, narrow, pieces)
    if found.coarse is None:
        return stand
    plain = _stand(found, narrow, replace(pieces, doubt=DOUBT))
    if _is_plain(plain, stand):
        if plain.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX:
            plain = _with_slides(reference, moving, plain, device, cancel)
        is_enough = plain.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX
        if is_enough or is_distinct(plain.motions[0], stand.motions[0]):
            return plain
        return min(plain, stand, key=_Stand.wrong)
    pieces = wall_pieces(reference, moving, found.motions, broad, device, cancel)
    wide = _stand(found, broad, pieces)
    is_same = not is_distinct(stand.motions[0], wide.motions[0], BENT_CELLS)
    if not is_same or stand.better < NARROW_MIN or stand.share < SHARE_MIN:
        return stand
    return min(stand, wide, key=_Stand.wrong)


def _placed(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    stand: _Stand,
    cancel: CancelToken | None,
) -> tuple[F64, dict[str, float]]:
    """Return the answer as finely as the maps allow (3,), and its numbers (see ``measure``)."""
    best = stand.motions[0]
    is_bent = stand.share < PLAIN_SHARE or stand.sigma > wall_widths(reference)[0]
    if not is_bent and found.coarse is not None:
        best = polish(reference, moving, best, device, cancel)
    statistics = measure(reference, moving, best, device, cancel)
    if is_bent and _met(statistics) < BENT_MATCH:
        # Both maps mostly miss each other's walls. A narrow fit locks one part of a bent map and
        # leaves the rest; the wide one spreads the misfit over the whole map.
        best = refine(
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
        statistics = measure(reference, moving, best, device, cancel)
    return best, statistics


def _stand(found: Found, sigma: float, pieces: WallPieces) -> _Stand:
    """Return the best candidate by what the pieces say of all, and its rivals, best first.

    Args:
        found: the motions.
        sigma: the width of a wall by which the pieces were weighed, cells.
        pieces: of all motions.
    """
    total = pieces.total
    best = int(np.argmax(total[: found.candidates]))
    order = np.argsort(-total, kind="stable")
    order = np.concatenate(([best], order[order != best]))
    motions, pieces = found.motions[order], pieces.take(order)
    is_bent = float(pieces.share()[0]) < BENT_SHARE
    others = _others(motions, BENT_CELLS if is_bent else DISTINCT_CELLS)
    limit = len(order) if found.candidates is None else found.candidates
    inside = [k for k in others if order[k] < limit]
    return _Stand(sigma, motions, others, pieces, inside)


def _is_plain(plain: _Stand, kind: _Stand) -> bool:
    """Whether two good maps of one place explain the walls nearly as well as bent ones could.

    Args:
        plain: the best answer where what it leaves unexplained speaks against it.
        kind: the best answer where that weighs little.
    """
    gives = float(plain.pieces.evidence[0].sum())
    return plain.share >= PLAIN_SHARE and gives >= NOTED_RATIO * float(kind.pieces.total[0])


def _with_slides(
    reference: GridFeatures,
    moving: GridFeatures,
    stand: _Stand,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> _Stand:
    """Return the same with the best shifts of the answer among its rivals."""
    further = slides(
        reference, moving, stand.motions[0], stand.sigma, DISTINCT_CELLS, device, cancel
    )
    pieces = wall_pieces(reference, moving, further, stand.sigma, device, cancel)
    pieces = stand.pieces.joined(pieces)
    total = pieces.total
    new = range(len(stand.motions), len(stand.motions) + len(further))
    others = sorted([*stand.others, *new], key=lambda k: -total[k])
    motions = np.concatenate((stand.motions, further))
    return replace(stand, motions=motions, pieces=pieces, others=others)


def _met(statistics: dict[str, float]) -> float:
    """Return the share of one map's walls that meet the other's, of the map that has more."""
    return max(statistics["wall_match_moving"], statistics["wall_match_reference"])


def _others(motions: F64, cells: float) -> list[int]:
    """Return the motions that are another answer than the first: farther, or turned."""
    return [k for k in range(1, len(motions)) if is_distinct(motions[k], motions[0], cells)]


def _evidence(
    reference: GridFeatures,
    moving: GridFeatures,
    stand: _Stand,
    runner_up: RunnerUp | None,
    statistics: dict[str, float],
    *,
    pairs: int,
    prior: float,
    search: str,
    gap: float,
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
        share=stand.share,
        witnesses=witnesses,
        better=stand.better,
        clean_share=stand.clean_share,
        better_inside=stand.better_inside,
        is_plain=stand.is_plain,
        gap=gap,
        ratio=max(0.0, highest / float(total[0])) if total[0] > 0 else 1.0,
        rival=rival,
        pairs=pairs,
        prior=prior,
        statistics=statistics,
        search=search,
    )


def _looked_closer(
    evidence: Evidence,
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    stand: _Stand,
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
    fit = estimate_scale(reference, moving, motion, (stand.sigma, narrow), device, cancel)
    return replace(evidence, mirrored=mirrored, scale=fit.scale, scaled_share=fit.share)


def _looked_at_image(
    evidence: Evidence,
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    stand: _Stand,
    pairs: int,
    cancel: CancelToken | None,
) -> Evidence:
    """Add the mirror image where it would be believed, though the map itself is not."""
    image = mirror_image(moving, device)
    coarse, motions, _ = search(reference, image, config, SearchWindow(), device, cancel)
    if not len(motions):
        return evidence
    other = _chosen(reference, image, device, Found(motions, coarse, None, "full"), pairs, cancel)
    # A half of a place that is nearly its own image may fit both ways.
    least = EXPECTED_WRONG_MAX * min(1.0, stand.wrong(pairs))
    if other.share < SHARE_MIN or other.wrong(pairs) >= least:
        return evidence
    own, gained = (float(item.pieces.evidence[0].sum()) for item in (stand, other))
    gain = GAIN_MAX if own * GAIN_MAX <= gained else gained / own
    return replace(evidence, mirrored=gain)


def prior_within(
    reference: GridFeatures, moving: GridFeatures, cells: float, yaw_rad: float
) -> float:
    """Return how much fewer the poses within these distances are than all that could overlap."""
    reach = math.hypot(*moving.shape)
    everywhere = (reference.shape[0] + reach) * (reference.shape[1] + reach) * 2.0 * math.pi
    here = (2.0 * max(cells, 1.0)) ** 2 * 2.0 * max(min(yaw_rad, math.pi), YAW_RAD_MIN)
    return min(1.0, here / everywhere)


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


def is_distinct(a: F64, b: F64, cells: float = DISTINCT_CELLS) -> bool:
    """Whether two motions are different answers rather than the same one found twice."""
    shift, turn = displacement(a, b)
    return shift > cells or turn > DISTINCT_YAW_RAD


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
