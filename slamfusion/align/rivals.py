"""How an answer of the search stands against its rivals: chosen, weighed, held against each.

An answer is weighed in one of two ways. Of two good maps of one place it leaves little unexplained,
and so must its rivals: then what is left unexplained counts against each (see ``pieces``), and
walls that were seen from different sides are not one (see ``facing``). Of maps of which one is bent
any answer leaves much, and only what is explained counts.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from slamfusion.align.accept import (
    EXPECTED_WRONG_MAX,
    SHARE_MIN,
    DecisionKind,
    expected_wrong,
)
from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import displacement
from slamfusion.align.narrow_fit import narrow_fits
from slamfusion.align.pieces import GOOD_DOUBT, WallPieces, wall_pieces
from slamfusion.align.search import CoarseSearch, wall_widths
from slamfusion.align.slides import slides
from slamfusion.compute import ComputeDevice

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


@dataclass(frozen=True, eq=False)
class Found:
    """What the search leaves for the decision.

    Attributes:
        motions: (P, 3) what the search ends with.
        coarse: outcome of the coarse stages; None where there was no search.
        search: ``full``, ``window``, ``fixed step`` or ``tracked``.
        prior: see ``Evidence.prior``.
        candidates: how many of the motions, the first, may be the answer; None: all. The others are
            rivals only.
        image_after: kinds of refusals after which the mirror image is searched.
    """

    motions: F64
    coarse: CoarseSearch | None
    search: str
    prior: float = 1.0
    candidates: int | None = None
    image_after: Collection[DecisionKind] = ()


@dataclass(frozen=True, eq=False)
class Standing:
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


def chosen_standing(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    pairs: int,
    cancel: CancelToken | None,
) -> Standing:
    """Return the answer and its rivals, weighed as two good maps, or as maps that are bent."""
    narrow, broad = wall_widths(reference)
    good = _believed_by_sides(reference, moving, device, found, pairs, cancel)
    if good is not None:
        return good
    pieces = wall_pieces(reference, moving, found.motions, narrow, device, cancel)
    stand = _standing(found, narrow, pieces)
    if found.coarse is None:
        return stand
    # Maps that draw one wall thick and thin have no sides to tell, and may be good ones yet.
    plain = _plain_standing(reference, moving, device, found, pieces, pairs, cancel, sided=False)
    if _is_believed(plain, found, pairs):
        return plain
    if plain.share >= PLAIN_SHARE and _gives_as_much(plain, stand):
        if is_distinct(plain.motions[0], stand.motions[0]):
            return plain
        return min(plain, stand, key=Standing.wrong)
    pieces = wall_pieces(reference, moving, found.motions, broad, device, cancel)
    wide = _standing(found, broad, pieces)
    is_same = not is_distinct(stand.motions[0], wide.motions[0], BENT_CELLS)
    if not is_same or stand.better < NARROW_MIN or stand.share < SHARE_MIN:
        return stand
    return min(stand, wide, key=Standing.wrong)


def _believed_by_sides(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    pairs: int,
    cancel: CancelToken | None,
) -> Standing | None:
    """Return the answer weighed as that of two good maps, by the sides of their walls; None: none.

    As it was found, or where that is not believed, as it and its rivals are fitted narrowly: of
    maps that are bent a narrow fit locks one part and leaves the rest.
    """
    if found.coarse is None:
        return None
    plain = _sided_standing(reference, moving, device, found, pairs, cancel)
    if plain.better >= SIDED_MIN and _is_believed(plain, found, pairs):
        return plain
    # Without a window any of them may be the answer; slides stand behind these.
    rows = range(len(found.motions)) if found.candidates is None else (0, *plain.inside)
    fitted = _narrow_rows(reference, moving, device, plain, rows, cancel)
    if not len(fitted):
        return None
    limit = None if found.candidates is None else found.candidates + len(fitted)
    motions = np.concatenate((fitted, found.motions))
    found = replace(found, motions=motions, candidates=limit)
    plain = _sided_standing(reference, moving, device, found, pairs, cancel)
    is_believed = plain.better >= SIDED_MIN and _is_believed(plain, found, pairs)
    return plain if is_believed else None


def _sided_standing(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    pairs: int,
    cancel: CancelToken | None,
) -> Standing:
    narrow = wall_widths(reference)[0]
    pieces = wall_pieces(reference, moving, found.motions, narrow, device, cancel, sided=True)
    return _plain_standing(reference, moving, device, found, pieces, pairs, cancel, sided=True)


def _narrow_rows(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    plain: Standing,
    rows: Iterable[int],
    cancel: CancelToken | None,
) -> F64:
    """Return narrow fits (K, 3) of those of some rows that may be the answer of two good maps."""
    share = plain.pieces.share()
    good = [k for k in rows if share[k] >= NARROWED_SHARE][:NARROWED]
    return narrow_fits(reference, moving, plain.motions[good], device, cancel)


def _plain_standing(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    found: Found,
    pieces: WallPieces,
    pairs: int,
    cancel: CancelToken | None,
    *,
    sided: bool,
) -> Standing:
    """Return the answer weighed as that of two good maps; its slides too where it is believed.

    Args:
        pieces: of all motions, by the narrow width.
        sided: whether these are, see ``wall_pieces``.
    """
    narrow = wall_widths(reference)[0]
    plain = _standing(found, narrow, replace(pieces, doubt=GOOD_DOUBT))
    if not _is_believed(plain, found, pairs):
        return plain
    return _with_slides(reference, moving, plain, device, cancel, sided=sided)


def _is_believed(plain: Standing, found: Found, pairs: int) -> bool:
    """Whether an answer that is weighed as that of two good maps is one."""
    return plain.share >= PLAIN_SHARE and plain.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX


def _standing(found: Found, sigma: float, pieces: WallPieces) -> Standing:
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
    return Standing(sigma, motions, others, pieces, inside)


def _gives_as_much(plain: Standing, kind: Standing) -> bool:
    """Whether two good maps of one place explain the walls nearly as well as bent ones could.

    Args:
        plain: the best answer where what it leaves unexplained speaks against it.
        kind: the best answer where that weighs little.
    """
    return float(plain.pieces.evidence[0].sum()) >= NOTED_RATIO * float(kind.pieces.total[0])


def _with_slides(
    reference: GridFeatures,
    moving: GridFeatures,
    stand: Standing,
    device: ComputeDevice,
    cancel: CancelToken | None,
    *,
    sided: bool,
) -> Standing:
    """Return the same with the best shifts of the answer among its rivals."""
    further = slides(
        reference, moving, stand.motions[0], stand.sigma, DISTINCT_CELLS, device, cancel
    )
    pieces = wall_pieces(reference, moving, further, stand.sigma, device, cancel, sided=sided)
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
