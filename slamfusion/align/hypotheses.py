"""Compare an answer with what else may explain two maps, in three readings of the maps.

``decide`` describes the readings and hypotheses. A search keeps separate peaks; a slide along a
wall or a corridor is one long ridge without a second peak, so shifts of an answer are hypotheses of
their own. An answer of bent maps leaves much unexplained, so
only what is explained counts. A mirrored map of a place with many right angles fits at a third of
its walls, but its mirror image fits better. A wrong resolution shows as a better scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.align.decide import (
    EXPECTED_WRONG_MAX,
    MOST,
    OBSERVED_M,
    ODDS_ONE,
    SAME_TIME_SHARE,
    START_WRONG,
    STOREYS_SHARE,
    SYMMETRIC,
    TRIALS,
    Hypothesis,
    Reading,
    expected_wrong,
    odds,
)
from slamfusion.align.features import spread_sample
from slamfusion.align.likelihood import likeness
from slamfusion.align.pair import Pair, displacement, turned_about
from slamfusion.align.refine import common_walls, narrow_fits
from slamfusion.align.scores import SCORED_POINTS, WallPieces, score_motions, start_pieces
from slamfusion.align.search import SearchResult, search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute.lattice import cells_at, fixed_cells
from slamfusion.config import AlignConfig
from slamfusion.geometry import B8, F64
from slamfusion.grid import UNKNOWN

# Wall points for the comparison of scales.
POINTS = 1024
# From this shift in widths of a wall, or this turn, on two poses differ; and the farthest shift.
APART_WIDTHS, APART_RAD, FARTHEST_WIDTHS = 4.0, math.radians(10.0), 12.0
# Directions in which an answer is shifted, and the rounding noise of pieces, as a share of the
# square of a typical one.
SLIDES, SLIDE_NOISE = 16, 0.1
# Distance of another place for a moving robot, cells.
DISTINCT_CELLS = 20.0
# If no answer is that of two good maps: the number that are fitted narrowly.
NARROWED = 4
# Tried shares of the walls of one map that the other shows again.
HIT_SHARES = np.linspace(0.01, 0.99, 50)
# Tried scales, coarse and then around the best, with shifts in widths of a wall and turns: the pose
# that fits a part of a map of another scale does not fit all of it.
COARSE_SCALES, FINE_SCALES = np.linspace(-0.12, 0.12, 25), np.linspace(-0.0075, 0.0075, 7)
SCALE_TURNS = np.radians(np.linspace(-3.0, 3.0, 13))
# Width of a wall of each reading, in narrow ones (``Pair.widths``).
WIDTHS: dict[Reading, float] = {"good": 1.0, "changed": 1.0, "bent": 2.0}


def weigh(pair: Pair, motions: F64, reading: Reading, scales: F64 | None = None) -> WallPieces:
    """Return the pieces of wall for motions (P, 3) in a reading, at scales (P,)."""
    return start_weighing(pair, motions, reading, scales)()


def start_weighing(
    pair: Pair, motions: F64, reading: Reading, scales: F64 | None = None
) -> Callable[[], WallPieces]:
    """Start ``weigh``; return a function that waits for it."""
    sigma = WIDTHS[reading] * pair.widths[0]
    return start_pieces(pair, motions, sigma, scales=scales, sided=reading == "good")


@dataclass(frozen=True, eq=False)
class Answer:
    """The best pose in one reading of the maps, compared with each hypothesis.

    Attributes:
        motion: (3,) the pose.
        others: (K, 3) other poses, best first.
        against: by hypothesis, pieces of wall that prefer the answer.
        total: evidence, less what contradicts.
        ratio: that of the best other pose over its own.
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
        if self.reading == "good":
            return odds(self.share) / ODDS_ONE if self.share >= SAME_TIME_SHARE else 0.0
        return min(odds(self.share) / (MOST * ODDS_ONE), 1.0) if self.share >= MOST else 0.0

    def score(self, hypothesis: Hypothesis) -> float:
        """Return by how much it beats a hypothesis, see ``decide``."""
        # What stays unexplained does not matter for a slide, and no reading changes what is better.
        pieces, weight = self.against[hypothesis], self.weight
        if hypothesis == "a shift of itself" or pieces < 0.0:
            weight = max(weight, 1.0)
        return min(pieces * weight, self.total / OBSERVED_M)

    def expected(self, hypothesis: Hypothesis) -> float:
        """Return the expected number of equally good answers if a hypothesis is right."""
        near, away = self.trials
        trials = {
            "another pose": TRIALS * near,
            "its mirror image": TRIALS * near,
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
        """The expected number of equally good wrong answers, see ``expected_wrong``."""
        return self.expected(self.nearest)

    def compared_with_image(self, ratio: float, *, is_chance: bool) -> Answer:
        """Compare it with the mirror image, by the evidence for that over its own.

        The image has the same walls and shows no place, so it fits as well as chance allows. It
        counts as another pose with that evidence. Only for two good maps: where nothing
        contradicts, the image of any place with right angles has half of the evidence. If chance
        does not explain the image, the place may be its own image.
        """
        lead = self.against.get("another pose", self.against["no relation"])
        least = min(max((1.0 - ratio) / MOST, 0.0), 1.0) * lead if lead > 0.0 else lead
        if not is_chance:
            least = max(least, lead + math.log(SYMMETRIC) / self.weight)
        return replace(self, against=self.against | {"its mirror image": least})

    @property
    def is_accepted(self) -> bool:
        """Whether it beats every hypothesis."""
        return self.weight > 0.0 and self.wrong < EXPECTED_WRONG_MAX


@dataclass(frozen=True, eq=False)
class Chances:
    """The prior of wrong answers, see ``decide``.

    Attributes:
        trials: pairs in the job, more where there is more ground.
        start: (3,) where the answer is expected; None: nowhere, or within a window.
        prior: share of the poses that lie near the start, or in the window.
    """

    trials: float
    start: F64 | None = None
    prior: float = 1.0


def best_answer(pair: Pair, found: SearchResult, chances: Chances) -> Answer:
    """Return the answer in the reading with the most evidence; ``found`` has a motion."""
    motions, inside = found.motions, None
    if found.candidates is not None:
        inside = np.arange(len(motions)) < found.candidates

    def answered(reading: Reading, pieces: WallPieces) -> Answer:
        return _answer(pair, motions, reading, pieces, inside, chances)

    sided = weigh(pair, motions, "good")
    good = answered("good", sided)
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
    good = answered("good", sided.joined(weigh(pair, fits, "good")))
    if good.is_accepted:
        return good
    changed = answered("changed", plain.joined(weigh(pair, fits, "changed")))
    bent = answered("bent", weigh(pair, motions, "bent"))
    # Those in which the maps can be read, and do not fit each other by chance.
    readings = [
        answer
        for answer in (good, changed, bent)
        if answer.weight > 0.0 and answer.expected("no relation") < EXPECTED_WRONG_MAX
    ]
    return min(readings, key=lambda answer: answer.wrong, default=changed)


def _answer(
    pair: Pair,
    motions: F64,
    reading: Reading,
    pieces: WallPieces,
    inside: B8 | None,
    chances: Chances,
) -> Answer:
    """Return the best of the motions (P, 3) in the window, compared with all others, and slid.

    ``inside`` (P,) marks motions in the window, None: no window.
    """
    total = pieces.total
    best = int(np.argmax(total if inside is None else np.where(inside, total, -np.inf)))
    # The device weighs the shifts of the answer while the host compares it with the others.
    shifted = start_weighing(pair, slides(pair, motions[best], reading), reading)
    apart = APART_WIDTHS * WIDTHS[reading] * pair.widths[0]
    order = np.argsort(-total, kind="stable")
    others = [int(k) for k in order if is_distinct(motions[k], motions[best], apart)]
    if inside is None and chances.start is not None:
        inside = np.array([not is_distinct(motion, chances.start) for motion in motions])
    is_near = inside is not None and bool(inside[best])
    own, rivals, shares = pieces.weighed[best], pieces.weighed[others], pieces.share()
    left: F64 | float = 1.0
    if reading == "good":
        left = pieces.left(best)
        # Of good maps a pose that explains a smaller share is less likely than its evidence says.
        worth = np.clip(shares[others] / max(float(shares[best]), 1e-9), 0.0, 1.0)
        rivals = rivals * np.where(total[others] > 0.0, worth, 1.0)[:, None]
    against: dict[Hypothesis, float] = {"no relation": float(pieces.count(own, left=left))}
    leads = pieces.count(own - rivals, left=left)
    ratios = np.clip(total[others] / max(float(total[best]), 1e-9), 0.0, 1.0)
    is_away = np.full(len(others), is_near)
    if inside is not None:
        is_away &= ~inside[others]
    if is_away.any():
        against["a pose away from the start"] = float(leads[is_away].min())
    if not is_away.all():
        against["another pose"] = float(leads[~is_away].min())
    answer = Answer(
        reading,
        motions[best],
        motions[others],
        against,
        float(total[best]),
        float(ratios.max(initial=0.0)),
        float(shares[best]),
        float(pieces.seen_m[best]),
        (chances.trials * (chances.prior if is_near else 1.0), chances.trials * START_WRONG),
        hit_share(pair, motions[best]) if reading == "bent" else 0.0,
    )
    return _slid(answer, own, pieces.most[best], shifted())


def is_distinct(a: F64, b: F64, cells: float = DISTINCT_CELLS) -> bool:
    """Whether two motions are different answers rather than the same one found twice."""
    shift, turn = displacement(a, b)
    return shift > cells or turn > APART_RAD


def _slid(answer: Answer, own: F64, seen: F64, shifted: WallPieces) -> Answer:
    """Compare an answer that beats all other hypotheses with shifts of itself.

    ``own`` and ``seen`` (B,) are the evidence of its pieces, and the most that they could have;
    ``shifted`` are the pieces of the shifts. Parallel walls hold an answer across them and leave it
    free along them, where only the ends of the common ground contradict a slide.
    """
    if not answer.is_accepted:
        return answer
    unseen = np.maximum(seen - shifted.most, 0.0) / np.maximum(seen, 1e-9)
    typical = float((seen * seen).sum() / max(float(seen.sum()), 1e-9))
    lost = own - shifted.weighed - unseen * own
    least = float(shifted.count(lost, SLIDE_NOISE * typical**2).min())
    return replace(answer, against=answer.against | {"a shift of itself": least})


def slides(pair: Pair, motion: F64, reading: Reading) -> F64:
    """Return (K, 3) a motion, shifted in every direction.

    Walls in another direction hold good maps in place; other maps are held by the whole place.
    """
    widths = WIDTHS[reading] * (APART_WIDTHS if reading == "good" else FARTHEST_WIDTHS)
    angles = np.arange(SLIDES) * (2.0 * math.pi / SLIDES)
    way = np.stack((np.cos(angles), np.sin(angles), np.zeros(SLIDES)), axis=1)
    return np.asarray(motion + widths * pair.widths[0] * way)


def hit_share(pair: Pair, motion: F64) -> float:
    """Return the share of walls next to walls of the other map by the broad width of a wall.

    The other walls lie anywhere on the other map's known ground. 0 if one of two narrower widths is
    more likely.
    """
    met = []
    for own, moved, other in pair.sides(motion[None]):
        # Walls on ground that the other map knows, by squared distance to its walls.
        x, y = spread_sample(own.level(1).points, SCORED_POINTS).astype(np.int64).T
        rows, cols = fixed_cells(moved[:, 0].astype(np.int64), x, y)
        is_known = cells_at(other.grid.cells, rows, cols, UNKNOWN) >= 0
        distance2 = cells_at(other.level(1).host_distance2, rows, cols, 0)[is_known]
        met.append((other, np.bincount(distance2, minlength=1)))
    best = []
    for widths in (0.5, 1.0, WIDTHS["bent"]):
        sigma = widths * pair.widths[0]
        likely = np.zeros(len(HIT_SHARES))
        for other, counts in met:
            gain = likeness(sigma)[: len(counts)] / other.chance(1, sigma)
            likely += np.log(1.0 + HIT_SHARES[:, None] * (gain - 1.0)) @ counts
        best.append((float(likely.max()), float(HIT_SHARES[likely.argmax()])))
    return best[-1][1] if max(best)[0] == best[-1][0] else 0.0


def best_image(
    pair: Pair, config: AlignConfig, trials: float, reading: Reading | None = None
) -> Answer | None:
    """Return the best fit of the moving map's image, compared with others as an answer is.

    In one reading or, None, in any. The search covers all poses, since a start does not hold for an
    image. None: no fit.
    """
    image = pair.mirrored()
    coarse, motions = search(image, config, SearchWindow())
    if not len(motions):
        return None
    if reading is None:
        return best_answer(image, SearchResult(motions, coarse, "full"), Chances(trials))
    pieces = weigh(image, motions, reading)
    return _answer(image, motions, reading, pieces, None, Chances(trials))


def mirror_gain(pair: Pair, motion: F64, config: AlignConfig) -> float | None:
    """Return the evidence for the moving map's image over that for a motion, of maps of two times.

    Returns:
        None where the motion has no evidence.
    """
    own = float(weigh(pair, motion[None], "changed").total[0])
    if own <= 0.0:
        return None
    image = pair.mirrored()
    _, motions = search(image, config, SearchWindow())
    total = weigh(image, motions, "changed").total if len(motions) else np.zeros(1)
    return max(0.0, float(total.max())) / own


def estimate_scale(pair: Pair, motion: F64, reading: Reading, others: F64) -> float:
    """Return the scale at which two maps fit best; 1.0 unless another is better.

    ``motion`` (3,) may fit a small part only, if a map of another scale fits elsewhere as a whole.
    So the pose with most evidence among ``others`` (K, 3) is scaled too.
    """
    starts = motion[None]
    if len(others):
        starts = np.concatenate((starts, others))
        strongest = int(weigh(pair, starts, "changed").total.argmax())
        starts = starts[np.unique((0, strongest))]
    found = [_scaled(pair, start, reading) for start in starts]
    motions, scales = (np.array(column) for column in zip(*found, strict=True))
    best = 0 if len(found) == 1 else int(weigh(pair, motions, reading, scales).total.argmax())
    scale = float(scales[best])
    if scale == 1.0:
        return 1.0
    both = start_pieces(
        pair, np.stack((motions[best], motion)), pair.widths[0], scales=np.array([scale, 1.0])
    )()
    # A smaller gain of one of several scales is chance.
    pieces = float(both.count(both.weighed[0] - both.weighed[1]))
    is_better = expected_wrong(pieces, TRIALS) < 1.0 and both.share()[0] >= STOREYS_SHARE
    return scale if is_better else 1.0


def _scaled(pair: Pair, motion: F64, reading: Reading) -> tuple[F64, float]:
    """Return a motion (3,) at its best scale, and the scale.

    A scale that moves common walls by less than half their width cannot be distinguished from 1.
    """
    narrow = pair.widths[0]
    wide = WIDTHS[reading] * narrow
    walls = common_walls(pair, motion, wide)
    if not len(walls):
        return motion, 1.0
    middle, reach = walls.mean(axis=0), math.sqrt(float(walls.var(axis=0).sum()))
    # A good map fits as a whole at the right scale; others may fit in part.
    far = 1.0 if reading == "good" else APART_WIDTHS
    steps = np.arange(-far, far + 1.0)
    scale, at, least = 1.0, motion, 0.5 * narrow / max(reach, 1e-9)
    for offsets, turns, sigma in (
        (COARSE_SCALES, np.zeros(1), wide),
        (FINE_SCALES, SCALE_TURNS, wide),
        (FINE_SCALES, SCALE_TURNS / 6.0, narrow),
    ):
        if abs(scale - 1.0) + offsets[-1] < least:
            break
        grid = np.meshgrid(scale + offsets, turns, sigma * steps, sigma * steps, indexing="ij")
        scales, turn, dy, dx = (axis.ravel() for axis in grid)
        motions = turned_about(at, middle, turn, scales / scale)
        motions[:, :2] += np.stack((dx, dy), axis=1)
        found = score_motions(pair, motions, 1, sigma=sigma, points=POINTS, scales=scales)
        best = int(np.argmax(found))
        scale, at = float(scales[best]), motions[best]
    return (at, scale) if abs(scale - 1.0) >= least else (motion, 1.0)
