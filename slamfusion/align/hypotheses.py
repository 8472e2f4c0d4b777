"""What else may explain a pair: other motions, shifts along walls, a mirror image, another scale.

An answer is weighed in one of two ways. Of two good maps of one place it leaves little unexplained,
and so must its rivals: then what is left unexplained counts against each (see ``scores``), and
walls that were seen from different sides are not one (see ``features``). Of maps of which one is
bent any answer leaves much, and only what is explained counts.

A search keeps peaks that lie apart; what slides along a wall, a corridor or a row of desks is one
long ridge and leaves no second peak. So the shifts around an answer are looked at on their own, and
the best of them are rivals. A mirrored map of a place with many right angles fits the right one at
a third of its walls; its mirror image fits better still. A wrong resolution shows as a scale that
fits better.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from slamfusion.align.common_walls import common_middle
from slamfusion.align.decide import EXPECTED_WRONG_MAX, SHARE_MIN, expected_wrong
from slamfusion.align.pair import Pair, displacement, distinct, watched
from slamfusion.align.refine import narrow_fits
from slamfusion.align.scores import GOOD_DOUBT, WallPieces, score_motions, wall_pieces
from slamfusion.align.search import SearchResult, search
from slamfusion.align.shifts import SearchWindow
from slamfusion.config import AlignConfig

F64 = npt.NDArray[np.float64]

DISTINCT_CELLS = 20.0
DISTINCT_YAW_RAD = math.radians(10.0)
# A bent map fits its place in several ways a metre or two apart; they are one answer.
BENT_CELLS = 60.0
# Less of what the common ground could give than this, and one of the maps is bent: a wider width of
# a wall may tell more, and the fit is spread over the whole map.
PLAIN_SHARE = 0.75
# Less than this, and its fits a metre or two apart are one answer.
BENT_SHARE = 0.5
# Answers that explain so much may be those of two good maps, and are fitted narrowly: as many, the
# best. Of right halves that were refused before the wide fit of the search gave 0.75 to 0.8.
NARROWED_SHARE, NARROWED = 0.6, 8
# Of the answers that give this much of the most evidence the one with the highest share may be
# right.
NOTED_RATIO = 0.7
# Both maps' pieces of a metre of wall: no metre of common wall has more witnesses, though it lie in
# the corners of several pieces.
WITNESSES_A_METRE = 2.0
# Pieces that speak for an answer whose rivals on the backs of walls were left out, however well it
# fits: of 90 right halves that share a tenth one 0.85 m off had 3.4.
SIDED_MIN = 3.5
# A wide width speaks only where the narrow one says the same by so many pieces.
NARROW_MIN = 2.0
# How far the farthest is, in distances of the nearest.
SLIDE_REACH = 2.5
# Wall points of each map that judge them, and how many are kept.
SLIDE_POINTS = 512
SLIDES_KEPT = 3
# An answer that is so much of what the common ground could give needs no look at a mirror image.
SURE_SHARE = 0.9
# Scales that are tried, coarse and then around the best.
COARSE_SCALES = np.linspace(-0.12, 0.12, 25)
FINE_SCALES = np.linspace(-0.0075, 0.0075, 7)
# Shifts that go with them, in widths of a wall.
SCALE_SHIFTS = np.array([(x, y, 0.0) for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)])
# ... of an answer that is bent: a part of it fits, and is not the part about which the scale turns.
FAR_SCALE_SHIFTS = np.array([(float(x), float(y), 0.0) for y in range(-4, 5) for x in range(-4, 5)])
SCALE_POINTS = 1024
# So many pieces of wall must say that the other scale is better, as an answer needs.
BETTER_MIN = 6.0


@dataclass(frozen=True, eq=False)
class PairScores:
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

    @cached_property
    def better(self) -> float:
        """Pieces that say that the answer is better than any other, and than none."""
        return self._better_than(self.others)

    def wrong(self, pairs: int = 1, prior: float = 1.0) -> float:
        """Return the wrong answers to be expected to look as good; see ``expected_wrong``."""
        return expected_wrong(self.better, self.share, pairs, prior, is_plain=self.is_plain)

    def _better_than(self, others: list[int]) -> float:
        """Return the pieces for the answer against the best of some others, or against none."""
        pieces = self.pieces
        found = [pieces.witnesses(0), *(pieces.against(k) for k in others)]
        if self.is_plain:
            found.append(WITNESSES_A_METRE * float(pieces.seen_m[0]))
        return min(found)

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


def scored_answer(pair: Pair, found: SearchResult, pairs: int) -> PairScores:
    """Return the answer and its rivals, weighed as two good maps, or as maps that are bent."""
    narrow, broad = pair.widths
    good = _believed_by_sides(pair, found, pairs)
    if good is not None:
        return good
    pieces = wall_pieces(pair, found.motions, narrow)
    stand = _standing(found, narrow, pieces)
    if found.coarse is None:
        return stand
    # Maps that draw one wall thick and thin have no sides to tell, and may be good ones yet.
    plain = _plain_standing(pair, found, pieces, pairs, sided=False)
    if _is_believed(plain, found, pairs):
        return plain
    if plain.share >= PLAIN_SHARE and _gives_as_much(plain, stand):
        if is_distinct(plain.motions[0], stand.motions[0]):
            return plain
        return min(plain, stand, key=PairScores.wrong)
    pieces = wall_pieces(pair, found.motions, broad)
    wide = _standing(found, broad, pieces)
    is_same = not is_distinct(stand.motions[0], wide.motions[0], BENT_CELLS)
    if not is_same or stand.better < NARROW_MIN or stand.share < SHARE_MIN:
        return stand
    return min(stand, wide, key=PairScores.wrong)


def _believed_by_sides(pair: Pair, found: SearchResult, pairs: int) -> PairScores | None:
    """Return the answer weighed as that of two good maps, by the sides of their walls; None: none.

    As it was found, or where that is not believed, as it and its rivals are fitted narrowly: of
    maps that are bent a narrow fit locks one part and leaves the rest.
    """
    if found.coarse is None:
        return None
    plain = _sided_standing(pair, found, pairs)
    if plain.better >= SIDED_MIN and _is_believed(plain, found, pairs):
        return plain
    # Without a window any of them may be the answer; slides stand behind these.
    rows = range(len(found.motions)) if found.candidates is None else (0, *plain.inside)
    fitted = _narrow_rows(pair, plain, rows)
    if not len(fitted):
        return None
    limit = None if found.candidates is None else found.candidates + len(fitted)
    motions = np.concatenate((fitted, found.motions))
    found = replace(found, motions=motions, candidates=limit)
    plain = _sided_standing(pair, found, pairs)
    is_believed = plain.better >= SIDED_MIN and _is_believed(plain, found, pairs)
    return plain if is_believed else None


def _sided_standing(pair: Pair, found: SearchResult, pairs: int) -> PairScores:
    narrow = pair.widths[0]
    pieces = wall_pieces(pair, found.motions, narrow, sided=True)
    return _plain_standing(pair, found, pieces, pairs, sided=True)


def _narrow_rows(pair: Pair, plain: PairScores, rows: Iterable[int]) -> F64:
    """Return narrow fits (K, 3) of those of some rows that may be the answer of two good maps."""
    share = plain.pieces.share()
    good = [k for k in rows if share[k] >= NARROWED_SHARE][:NARROWED]
    return narrow_fits(pair, plain.motions[good])


def _plain_standing(
    pair: Pair, found: SearchResult, pieces: WallPieces, pairs: int, *, sided: bool
) -> PairScores:
    """Return the answer weighed as that of two good maps; its slides too where it is believed.

    Args:
        pieces: of all motions, by the narrow width.
        sided: whether these are, see ``wall_pieces``.
    """
    narrow = pair.widths[0]
    plain = _standing(found, narrow, replace(pieces, doubt=GOOD_DOUBT))
    if not _is_believed(plain, found, pairs):
        return plain
    return _with_slides(pair, plain, sided=sided)


def _is_believed(plain: PairScores, found: SearchResult, pairs: int) -> bool:
    """Whether an answer that is weighed as that of two good maps is one."""
    return plain.share >= PLAIN_SHARE and plain.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX


def _standing(found: SearchResult, sigma: float, pieces: WallPieces) -> PairScores:
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
    return PairScores(sigma, motions, others, pieces, inside)


def _gives_as_much(plain: PairScores, kind: PairScores) -> bool:
    """Whether two good maps of one place explain the walls nearly as well as bent ones could.

    Args:
        plain: the best answer where what it leaves unexplained speaks against it.
        kind: the best answer where that weighs little.
    """
    return float(plain.pieces.evidence[0].sum()) >= NOTED_RATIO * float(kind.pieces.total[0])


def _with_slides(pair: Pair, stand: PairScores, *, sided: bool) -> PairScores:
    """Return the same with the best shifts of the answer among its rivals."""
    further = slides(pair, stand.motions[0], stand.sigma, DISTINCT_CELLS)
    pieces = wall_pieces(pair, further, stand.sigma, sided=sided)
    pieces = stand.pieces.joined(pieces)
    total = pieces.total
    new = range(len(stand.motions), len(stand.motions) + len(further))
    others = sorted([*stand.others, *new], key=lambda k: -total[k])
    motions = np.concatenate((stand.motions, further))
    return replace(stand, motions=motions, pieces=pieces, others=others)


def _others(motions: F64, cells: float) -> list[int]:
    """Return the motions that are another answer than the first: farther, or turned."""
    return [k for k in range(1, len(motions)) if is_distinct(motions[k], motions[0], cells)]


def is_distinct(a: F64, b: F64, cells: float = DISTINCT_CELLS) -> bool:
    """Whether two motions are different answers rather than the same one found twice."""
    shift, turn = displacement(a, b)
    return shift > cells or turn > DISTINCT_YAW_RAD


def slides(pair: Pair, motion: F64, sigma: float, nearest: float) -> F64:
    """Return the best shifts of an answer, apart from it and from each other.

    Args:
        pair: the two maps.
        motion: (3,) the answer: where the moving centre lands, cells, and yaw.
        sigma: width of a wall, cells; shifts are so far apart that no wall is missed.
        nearest: how far the nearest is, cells.

    Returns:
        (R, 3) motions, best first.
    """
    farthest = SLIDE_REACH * nearest
    steps = np.arange(-np.floor(farthest / sigma), np.floor(farthest / sigma) + 1.0) * sigma
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    far = np.hypot(x, y)
    kept = (far > nearest) & (far <= farthest)
    motions = motion + np.stack((x[kept], y[kept], np.zeros(int(kept.sum()))), axis=1)
    scores = score_motions(pair, motions, 1, sigma=sigma, points=SLIDE_POINTS)
    order = np.argsort(-scores, kind="stable")
    return distinct(motions[order], nearest, 1.0, SLIDES_KEPT)


@watched
def mirror_gain(
    pair: Pair, motion: F64, config: AlignConfig, sigma: float, *, doubt: float = 0.0
) -> float | None:
    """Return the evidence for the best fit of the moving map's image over that for a motion.

    Args:
        pair: the two maps.
        motion: (3,) of the map as it is: where its centre lands, cells, and yaw.
        config: settings of the search; everywhere, since no start holds for an image.
        sigma: width of a wall, cells.
        doubt: how much speaks against both what they leave unexplained, see ``WallPieces``.

    Returns:
        None where nothing speaks for the motion.
    """
    pieces = wall_pieces(pair, motion[None], sigma)
    own = float(replace(pieces, doubt=doubt).total[0])
    if own <= 0.0:
        return None
    image = pair.mirrored()
    _, motions, _ = search(image, config, SearchWindow())
    if not len(motions):
        return 0.0
    pieces = wall_pieces(image, motions, sigma)
    return max(0.0, float(replace(pieces, doubt=doubt).total.max())) / own


@dataclass(frozen=True)
class ScaleFit:
    """The scale at which two maps fit best.

    Attributes:
        scale: size of the moving map's metre in the reference's; 1.0 unless another is better.
        share: evidence there as a share of what the common ground could give, by the narrow width.
    """

    scale: float
    share: float


def estimate_scale(
    pair: Pair, motion: F64, widths: tuple[float, float], *, is_far: bool = False
) -> ScaleFit:
    """Return the scale at which two maps fit best, and how well they do.

    Args:
        pair: the two maps.
        motion: (3,) where the moving centre lands, cells, and yaw: right in the common ground.
        widths: of a wall in cells: the one by which the scale is looked for, and the narrow one.
        is_far: look farther from the answer, as of one that leaves much unexplained.
    """
    wide, narrow = widths
    shifts = FAR_SCALE_SHIFTS if is_far else SCALE_SHIFTS
    middle = common_middle(pair, motion, wide)
    scale, at = 1.0, motion
    for offsets, sigma in ((COARSE_SCALES, wide), (FINE_SCALES, wide), (FINE_SCALES, narrow)):
        scales = scale + offsets
        motions = np.concatenate(
            [_scaled_about(at, middle, s / scale) + shifts * (sigma, sigma, 1.0) for s in scales]
        )
        each = np.repeat(scales, len(shifts))
        found = score_motions(
            pair, motions, 1, sigma=sigma, points=SCALE_POINTS, scales=each)  # fmt: skip
        best = int(np.argmax(found))
        scale, at = float(each[best]), motions[best]
    both = wall_pieces(
        pair, np.stack((at, motion)), wide, scales=np.array([scale, 1.0]),
    )  # fmt: skip
    if not _is_better(both):
        scale, at = 1.0, motion
    fit = wall_pieces(pair, at[None], narrow, scales=np.array([scale]))
    return ScaleFit(scale, float(fit.share()[0]))


def _is_better(both: WallPieces) -> bool:
    return both.better(0, 1) >= BETTER_MIN


def _scaled_about(motion: F64, middle: F64, scale: float) -> F64:
    """Return (1, 3) the motion whose moving map, larger by ``scale``, keeps ``middle`` in place."""
    moved = middle + scale * (motion[:2] - middle)
    return np.array([[moved[0], moved[1], motion[2]]])
