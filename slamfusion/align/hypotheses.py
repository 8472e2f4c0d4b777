"""Hold an answer against what else may explain two maps, in three readings of the maps.

See ``decide`` for what the readings and hypotheses are, and for what is made of the numbers.

A search keeps peaks that lie apart; what slides along a wall, a corridor or a row of desks is one
long ridge and leaves no second peak. So the shifts around an answer of two good maps are hypotheses
of their own. Of maps of which one is bent any answer leaves much unexplained, and only what is
explained counts. A mirrored map of a place with many right angles fits the right one at a third of
its walls; its mirror image fits better still. A wrong resolution shows as a scale that fits better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.align.decide import (
    EXPECTED_WRONG_MAX,
    MOST,
    OBSERVED_M,
    ODDS_ONE,
    SAME_TIME_SHARE,
    START_WRONG,
    STOREYS_SHARE,
    TRIALS,
    Hypothesis,
    Reading,
    expected_wrong,
    odds,
)
from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.likelihood import likeness
from slamfusion.align.pair import Pair, displacement, invert, to_lattice
from slamfusion.align.refine import common_walls, narrow_fits
from slamfusion.align.scores import (
    GOOD_DOUBT,
    SCORED_POINTS,
    WallPieces,
    pieces_for,
    score_motions,
    wall_pieces,
)
from slamfusion.align.search import SearchResult, search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute.lattice import fixed_cells, fixed_poses
from slamfusion.config import AlignConfig
from slamfusion.geometry import F64

# Points of walls by which shifts and scales are compared.
POINTS = 1024
# Poses differ from this many widths of a wall or this turn on. Shifts of an answer are looked at up
# to the last number of widths.
APART_WIDTHS, APART_RAD, FARTHEST_WIDTHS = 4.0, math.radians(10.0), 12.0
# Directions in which an answer is slid, and shifts of it that are weighed; what pieces say less of
# than this, as a share of the square of a typical one, is rounding.
SLIDES, SLIDE_NOISE = 16, 0.1
# What is another place for a robot on its way: cells.
DISTINCT_CELLS = 20.0
# Where no answer is that of two good maps as it was found, those that are fitted narrowly: the best
# by each of two readings.
NARROWED = 4
# Shares of the walls of one map that the other shows again, which are tried.
HIT_SHARES = np.linspace(0.01, 0.99, 50)
# Scales that are tried, coarse and then around the best, with shifts in widths of a wall and turns:
# a pose that fits a part of a map of another scale is not the one that fits all of it.
COARSE_SCALES, FINE_SCALES = np.linspace(-0.12, 0.12, 25), np.linspace(-0.0075, 0.0075, 7)
SCALE_TURNS = np.radians(np.linspace(-3.0, 3.0, 13))


class How(NamedTuple):
    """How a reading weighs pieces of wall.

    Attributes:
        widths: of a wall, in narrow ones (``Pair.widths``).
        sided: see ``wall_pieces``.
        doubt: see ``WallPieces``.
        slide: how far the answer is slid, in widths of this wall: good maps hold it to another
            pose by each wall that runs another way, of others the whole place has to.
    """

    widths: float
    sided: bool
    doubt: float
    slide: float


READINGS: dict[Reading, How] = {
    "good": How(1.0, True, GOOD_DOUBT, APART_WIDTHS),
    "changed": How(1.0, False, 0.0, FARTHEST_WIDTHS),
    "bent": How(2.0, False, 0.0, FARTHEST_WIDTHS),
}


def weigh(pair: Pair, motions: F64, reading: Reading, scales: F64 | None = None) -> WallPieces:
    """Return what the pieces of wall say of motions (P, 3) in a reading, at scales (P,)."""
    how = READINGS[reading]
    sigma = how.widths * pair.widths[0]
    return replace(
        wall_pieces(pair, motions, sigma, scales=scales, sided=how.sided), doubt=how.doubt
    )


@dataclass(frozen=True, eq=False)
class Answer:
    """The best pose in one reading of the maps, and how it stands against each hypothesis.

    Attributes:
        reading: of the maps.
        motion: (3,) the pose.
        others: (K, 3) other poses, best first.
        against: pieces of wall that say that it is better than each hypothesis.
        total: evidence, less what contradicts.
        ratio: that of the best other pose over its own.
        share, common_m: see ``MatchEvidence``.
        hit: share of walls that lie next to each other by the broad width; 0 where another width is
            likelier.
        trials: pairs in the job times the prior: of any pose, and of one away from the start.
    """

    reading: Reading
    motion: F64
    others: F64
    against: dict[Hypothesis, float]
    total: float
    ratio: float
    share: float
    common_m: float
    trials: tuple[float, float]
    hit: float = 0.0

    @property
    def weight(self) -> float:
        """What a piece counts; 0 where the maps cannot be read so."""
        if self.reading == "bent":
            return self.hit
        is_good = self.reading == "good"
        if self.share < (SAME_TIME_SHARE if is_good else MOST):
            return 0.0
        weight = odds(self.share) / ODDS_ONE
        return weight if is_good else min(weight, 1.0)

    def score(self, hypothesis: Hypothesis) -> float:
        """Return by how much it beats a hypothesis, see ``decide``."""
        # What stays unexplained says nothing of a slide: what matters is whether walls hold it. And
        # what is better than the answer is so however the answer is weighed.
        pieces, weight = self.against[hypothesis], self.weight
        if hypothesis == "a shift of itself" or pieces < 0.0:
            weight = max(weight, 1.0)
        return min(pieces * weight, self.total / OBSERVED_M)

    def expected(self, hypothesis: Hypothesis) -> float:
        """Return how often a hypothesis is to be expected to be right though this looks so good."""
        near, away = self.trials
        trials = {
            "another pose": TRIALS * near,
            "no relation": TRIALS * max(near, away),
            "a shift of itself": near,
            "a pose away from the start": away,
        }
        return expected_wrong(self.score(hypothesis), trials[hypothesis])

    @property
    def nearest(self) -> Hypothesis:
        """The hypothesis that comes nearest to it."""
        return max(self.against, key=self.expected)

    @property
    def wrong(self) -> float:
        """Wrong answers to be expected to look as good, see ``expected_wrong``."""
        return self.expected(self.nearest)

    @property
    def is_related(self) -> bool:
        """Whether the maps can be read so, and do not fit each other by chance."""
        return self.weight > 0.0 and self.expected("no relation") < EXPECTED_WRONG_MAX

    @property
    def is_accepted(self) -> bool:
        """Whether it beats every hypothesis."""
        return self.weight > 0.0 and self.wrong < EXPECTED_WRONG_MAX


@dataclass(frozen=True, eq=False)
class Chances:
    """How many wrong answers there are before any wall has spoken, see ``decide``.

    Attributes:
        trials: pairs in the job, more where there is more ground.
        start: (3,) where the answer is expected; None: nowhere, or within a window.
        prior: how much fewer poses there are near the start, or in the window, than of all.
    """

    trials: float
    start: F64 | None = None
    prior: float = 1.0


def best_answer(pair: Pair, found: SearchResult, chances: Chances) -> Answer:
    """Return the answer in the reading that speaks most for it.

    Args:
        found: at least one motion.
        chances: of wrong answers.
    """
    motions, rest = found.motions, (pair.widths[0], chances)
    inside = None
    if found.candidates is not None:
        inside = np.arange(len(motions)) < found.candidates
    sided = weigh(pair, motions, "good")
    good = _slid(pair, _answer(motions, "good", sided, inside, *rest))
    if good.is_accepted:
        return good
    plain = weigh(pair, motions, "changed")
    best = [np.argsort(-by.total, kind="stable")[:NARROWED] for by in (sided, plain)]
    share = np.maximum(sided.share(), plain.share())
    # The best of all is always one of them.
    share[best[1][0]] = 1.0
    rows = np.array(
        [k for k in dict.fromkeys(np.concatenate(best).tolist()) if share[k] >= STOREYS_SHARE]
    )
    fits = narrow_fits(pair, motions[rows])
    motions = np.concatenate((motions, fits))
    if inside is not None:
        inside = np.concatenate((inside, inside[rows]))
    sided = sided.joined(weigh(pair, fits, "good"))
    good = _slid(pair, _answer(motions, "good", sided, inside, *rest))
    if good.is_accepted:
        return good
    plain = plain.joined(weigh(pair, fits, "changed"))
    changed = _slid(pair, _answer(motions, "changed", plain, inside, *rest))
    bent = _answer(motions, "bent", weigh(pair, motions, "bent"), inside, *rest)
    bent = _slid(pair, replace(bent, hit=hit_share(pair, bent.motion)))
    readings = [answer for answer in (good, changed, bent) if answer.is_related]
    return min(readings, key=lambda answer: answer.wrong, default=changed)


def _answer(
    motions: F64,
    reading: Reading,
    pieces: WallPieces,
    inside: npt.NDArray[np.bool_] | None,
    narrow: float,
    chances: Chances,
) -> Answer:
    """Return the best of the motions in the window, against all others.

    Args:
        motions: (P, 3).
        reading: of the maps.
        pieces: of all motions.
        inside: (P,) which of them lie in the window; None: there is none.
        narrow: width of a wall, cells.
        chances: see ``best_answer``.
    """
    total = pieces.total
    best = int(np.argmax(total if inside is None else np.where(inside, total, -np.inf)))
    apart = APART_WIDTHS * READINGS[reading].widths * narrow
    order = np.argsort(-total, kind="stable")
    others = [int(k) for k in order if is_distinct(motions[k], motions[best], apart)]
    if inside is None and chances.start is not None:
        inside = np.array([not is_distinct(motion, chances.start) for motion in motions])
    is_near = inside is not None and bool(inside[best])
    own = pieces.weighed[best]
    against: dict[Hypothesis, float] = {"no relation": float(pieces_for(own))}
    ratios = np.clip(total[others] / max(float(total[best]), 1e-9), 0.0, 1.0)
    leads = pieces_for(own - pieces.weighed[others])
    leads *= np.where(leads > 0.0, np.minimum((1.0 - ratios) / MOST, 1.0), 1.0)
    better = dict(zip(others, leads.tolist(), strict=True))
    away = {k for k in others if is_near and inside is not None and not inside[k]}
    if away:
        against["a pose away from the start"] = min(better[k] for k in away)
    if set(others) - away:
        against["another pose"] = min(better[k] for k in others if k not in away)
    return Answer(
        reading,
        motions[best],
        motions[others],
        against,
        float(total[best]),
        float(ratios.max(initial=0.0)),
        float(pieces.share()[best]),
        float(pieces.seen_m[best]),
        (chances.trials * (chances.prior if is_near else 1.0), chances.trials * START_WRONG),
    )


def is_distinct(a: F64, b: F64, cells: float = DISTINCT_CELLS) -> bool:
    """Whether two motions are different answers rather than the same one found twice."""
    shift, turn = displacement(a, b)
    return shift > cells or turn > APART_RAD


def _slid(pair: Pair, answer: Answer) -> Answer:
    """Return the same; one that beats all other hypotheses is compared with shifts of itself.

    An answer is slid every way. Walls that run one way hold it across them and leave it free along
    them: there no piece of wall tells it from its slide but at the ends of the common ground, and
    what a slide leaves unseen says nothing. Of two good maps farther shifts are looked at as they
    are, by whole widths of a wall: rows of doors or desks.
    """
    if not answer.is_accepted:
        return answer
    slid = slides(pair, answer.motion, answer.reading)
    pieces = weigh(pair, np.concatenate((answer.motion[None], slid)), answer.reading)
    own, seen = pieces.weighed[0], pieces.most[0]
    unseen = np.maximum(seen - pieces.most[1:], 0.0) / np.maximum(seen, 1e-9)
    typical = float((seen * seen).sum() / max(float(seen.sum()), 1e-9))
    lost = own - pieces.weighed[1:] - unseen * own
    least = float(pieces_for(lost, SLIDE_NOISE * typical**2).min())
    if answer.reading == "good":
        shifted = weigh(pair, shifts(pair, answer.motion), "good").weighed
        least = min(least, float(pieces_for(own - shifted).min()))
    return replace(answer, against=answer.against | {"a shift of itself": least})


def slides(pair: Pair, motion: F64, reading: Reading) -> F64:
    """Return (K, 3) a motion, slid every way."""
    how = READINGS[reading]
    angles = np.arange(SLIDES) * (2.0 * math.pi / SLIDES)
    way = np.stack((np.cos(angles), np.sin(angles), np.zeros(SLIDES)), axis=1)
    return np.asarray(motion + how.slide * how.widths * pair.widths[0] * way)


def shifts(pair: Pair, motion: F64) -> F64:
    """Return (K, 3) the best shifts of a motion by whole widths of a wall that are other poses."""
    steps = np.arange(-FARTHEST_WIDTHS, FARTHEST_WIDTHS + 1.0)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    far = np.hypot(x, y)
    kept = (far >= APART_WIDTHS) & (far <= FARTHEST_WIDTHS)
    width = pair.widths[0]
    moved = motion + np.stack((x, y, np.zeros_like(x)), axis=1)[kept] * (width, width, 1.0)
    scores = score_motions(pair, moved, 1, sigma=width, points=POINTS, doubt=GOOD_DOUBT)
    return np.asarray(moved[np.argsort(-scores, kind="stable")[:SLIDES]])


def hit_share(pair: Pair, motion: F64) -> float:
    """Return the share of walls that lie next to walls of the other map by the broad width.

    The others lie anywhere on ground that the other map knows. Of three widths of a wall the broad
    one must make the distances likeliest; 0 where a narrower one does.

    Args:
        motion: (3,).
    """
    lattice = to_lattice(motion[None], pair.moving.centre)
    sides = ((pair.moving, pair.reference, lattice), (pair.reference, pair.moving, invert(lattice)))
    met = [(other, _distances2(own, other, way)) for own, other, way in sides]
    best = []
    for widths in (0.5, 1.0, READINGS["bent"].widths):
        sigma = widths * pair.widths[0]
        likely = np.zeros(len(HIT_SHARES))
        for other, counts in met:
            gain = likeness(sigma)[: len(counts)] / other.chance(1, sigma)
            likely += np.log(1.0 + HIT_SHARES[:, None] * (gain - 1.0)) @ counts
        best.append((float(likely.max()), float(HIT_SHARES[likely.argmax()])))
    return best[-1][1] if max(best)[0] == best[-1][0] else 0.0


def _distances2(own: GridFeatures, other: GridFeatures, lattice: F64) -> npt.NDArray[np.int64]:
    """Return (N,) walls on ground that the other map knows, by squared distance to its walls."""
    x, y = spread_sample(own.level(1).points, SCORED_POINTS).astype(np.int64).T
    rows, cols = fixed_cells(fixed_poses(lattice)[0], x, y)
    height, width = other.shape
    inside = (rows >= 0) & (cols >= 0) & (rows < height) & (cols < width)
    at = rows[inside], cols[inside]
    distance2 = other.device.download(other.level(1).distance2)
    return np.bincount(distance2[at][other.grid.cells[at] >= 0], minlength=1)


def mirror_gain(
    pair: Pair,
    motion: F64,
    config: AlignConfig,
    reading: Reading = "changed",
    *,
    is_near: bool = False,
) -> float | None:
    """Return the evidence for the best fit of the moving map's image over that for a motion.

    Args:
        motion: (3,) of the map as it is: where its centre lands, cells, and yaw.
        config: settings of the search; everywhere, since no start holds for an image.
        reading: of the maps.
        is_near: the motion is near a start, which is evidence for it.

    Returns:
        None where the motion has no evidence.
    """
    own = float(weigh(pair, motion[None], reading).total[0])
    if own <= 0.0:
        return None
    own -= OBSERVED_M * math.log(START_WRONG) if is_near else 0.0
    image = pair.mirrored()
    _, motions, _ = search(image, config, SearchWindow())
    if not len(motions):
        return 0.0
    return max(0.0, float(weigh(image, motions, reading).total.max())) / own


def estimate_scale(pair: Pair, motion: F64, reading: Reading, others: F64) -> float:
    """Return the scale at which two maps fit best; 1.0 unless another is better.

    The answer may be the fit of a small part, where all of a map of another scale fits elsewhere.
    So the pose of most evidence gets a scale of its own, too.

    Args:
        motion: (3,) the answer: where the moving centre lands, cells, and yaw.
        reading: of the maps.
        others: (K, 3) other poses; those of an answer that is beyond doubt need no look.
    """
    narrow = pair.widths[0]
    poses = np.concatenate((motion[None], others))
    strongest = int(np.argmax(weigh(pair, poses, "changed").total))
    found = [_scaled(pair, start, reading) for start in poses[np.unique((0, strongest))]]
    motions, scales, reaches = (np.array(column) for column in zip(*found, strict=True))
    best = int(np.argmax(weigh(pair, motions, reading, scales).total))
    scale = float(scales[best])
    both = wall_pieces(
        pair, np.stack((motions[best], motion)), narrow, scales=np.array([scale, 1.0])
    )
    # By less one of a few scales is better by chance.
    is_better = expected_wrong(both.better(0, 1), TRIALS) < 1.0
    is_better = is_better and both.share()[0] >= STOREYS_SHARE
    # A scale that moves common walls by less than half their width cannot be told from 1.
    return scale if is_better and abs(scale - 1.0) * reaches[best] >= 0.5 * narrow else 1.0


def _scaled(pair: Pair, motion: F64, reading: Reading) -> tuple[F64, float, float]:
    """Return a motion (3,) at its best scale, the scale, and how far its common walls reach."""
    narrow = pair.widths[0]
    wide = READINGS[reading].widths * narrow
    walls = common_walls(pair, motion, wide)
    if not len(walls):
        return motion, 1.0, 0.0
    middle, reach = walls.mean(axis=0), math.sqrt(float(walls.var(axis=0).sum()))
    # All of a good map fits at the right scale, where the answer is; of others only a part may.
    far = 1.0 if READINGS[reading].sided else APART_WIDTHS
    steps = np.arange(-far, far + 1.0)
    scale, at = 1.0, motion
    for offsets, turns, sigma in (
        (COARSE_SCALES, np.zeros(1), wide),
        (FINE_SCALES, SCALE_TURNS, wide),
        (FINE_SCALES, SCALE_TURNS / 6.0, narrow),
    ):
        grid = np.meshgrid(scale + offsets, turns, sigma * steps, sigma * steps, indexing="ij")
        scales, turn, dy, dx = (axis.ravel() for axis in grid)
        cos, sin = np.array((np.cos(turn), np.sin(turn))) * (scales / scale)
        x, y = at[:2] - middle
        motions = np.stack(
            (middle[0] + cos * x - sin * y + dx, middle[1] + sin * x + cos * y + dy, at[2] + turn),
            axis=1,
        )
        found = score_motions(pair, motions, 1, sigma=sigma, points=POINTS, scales=scales)
        best = int(np.argmax(found))
        scale, at = float(scales[best]), motions[best]
    return at, scale, reach
