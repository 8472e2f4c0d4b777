"""Which way of weighing an answer is taken, and what limits the pieces that speak for it.

The numbers of the limits stand here once more, on purpose: a limit that moves is to fail a test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest

from slamfusion.align.accept import expected_wrong
from slamfusion.align.features import GridFeatures
from slamfusion.align.pieces import WallPieces
from slamfusion.align.rivals import Found, Standing, chosen_standing, is_distinct
from slamfusion.align.search import CoarseSearch
from slamfusion.compute import ComputeDevice
from slamfusion.fusion import rivals
from tests.fusion.drawings import building, features_of

# About counting, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

NOWHERE = np.zeros((1, 3))


def standing(pieces: int, seen_m: float, doubt: float) -> Standing:
    """An answer for which so many equal pieces speak, without a rival."""
    evidence = np.ones((1, pieces))
    table = WallPieces(evidence, evidence, evidence, np.array([seen_m]), doubt)
    return Standing(1.5, NOWHERE, [], table, [])


@pytest.mark.parametrize(
    ("seen_m", "doubt", "better"),
    [(2.0, 2.0, 4.0), (5.9, 2.0, 11.8), (6.1, 2.0, 12.0), (2.0, 0.0, 12.0)],
)
def test_a_metre_of_common_wall_of_good_maps_has_two_witnesses(
    seen_m: float, doubt: float, better: float
) -> None:
    assert standing(12, seen_m, doubt).better == pytest.approx(better)


@pytest.mark.parametrize(("better", "is_sided"), [(3.51, True), (3.5, True), (3.49, False)])
def test_an_answer_by_sides_of_walls_needs_more_pieces(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, better: float, *, is_sided: bool
) -> None:
    def plain(*_: object, sided: bool) -> Standing:
        # Enough by the expected number of wrong ones in either way.
        return standing(12, better / 2.0 if sided else 6.0, 2.0)

    monkeypatch.setattr(rivals, "_plain_standing", plain)
    grid = building(1)
    features = features_of(grid, device)
    coarse = CoarseSearch(4, np.zeros(1), np.ones(1), NOWHERE, np.ones(1), 1, is_cut=False)
    motion = np.array([[*features.centre, 0.0]])
    found = Found(motion, coarse, "full")
    chosen = chosen_standing(features, features, device, found, 1, None)
    assert chosen.better == pytest.approx(better if is_sided else 12.0)


# -- an answer among its rivals --------------------------------------------------------------------

COARSE = CoarseSearch(4, np.zeros(1), np.ones(1), NOWHERE, np.ones(1), 1, is_cut=False)
PIECES = 100
NARROW, BROAD = 1.5, 3.0


def at(*places: float) -> np.ndarray:
    """Return motions that differ by where they move along x, cells."""
    return np.array([[place, 0.0, 0.0] for place in places])


def row(count: int, evidence: float = 1.0, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence of so many equal pieces that could give 1, and what they could give."""
    of = np.zeros(PIECES)
    of[first : first + count] = 1.0
    return evidence * of, of


def table(*rows: tuple[np.ndarray, np.ndarray], doubt: float = 0.0) -> WallPieces:
    """Return the pieces of some motions, on 100, 99, ... metres of wall."""
    evidence, most = np.array(rows).reshape(-1, 2, PIECES).transpose(1, 0, 2)
    return WallPieces(evidence, most, most, 100.0 - np.arange(len(rows)), doubt)


def stood(places: np.ndarray, pieces: WallPieces, **options: Any) -> Standing:
    """Return the best of some motions, held against the others."""
    return rivals._standing(Found(places, None, "full", **options), NARROW, pieces)


@pytest.mark.parametrize(
    ("shift", "turn", "is_other"),
    [
        (0.0, 0.0, False),
        (20.0, 0.0, False),
        (20.01, 0.0, True),
        (0.0, math.radians(10.0), False),
        (0.0, math.radians(10.01), True),
        (0.0, -math.radians(10.01), True),
        (21.0, math.radians(11.0), True),
    ],
)
def test_another_answer_lies_twenty_cells_off_or_is_turned_by_ten_degrees(
    shift: float, turn: float, *, is_other: bool
) -> None:
    other = np.array([0.6 * shift, 0.8 * shift, turn])
    assert is_distinct(other, NOWHERE[0]) is is_other
    assert is_distinct(NOWHERE[0], other) is is_other


def test_the_best_comes_first_and_then_its_rivals_best_first() -> None:
    pieces = table(row(2), row(9), row(8), row(4), row(5))
    stand = stood(at(0.0, 100.0, 110.0, 200.0, 300.0), pieces)
    assert stand.motions[:, 0].tolist() == [100.0, 110.0, 300.0, 200.0, 0.0]
    assert stand.pieces.total.tolist() == [9.0, 8.0, 5.0, 4.0, 2.0]
    # The second is the answer once more, ten cells off.
    assert stand.others == stand.inside == [2, 3, 4]
    assert stand.share == 1.0


def test_a_window_has_the_answer_in_it_and_rivals_inside_and_out() -> None:
    pieces = table(row(2), row(5), row(3), row(9))
    stand = stood(at(0.0, 100.0, 200.0, 300.0), pieces, candidates=3)
    assert stand.motions[:, 0].tolist() == [100.0, 300.0, 200.0, 0.0]
    assert (stand.others, stand.inside) == ([1, 2, 3], [2, 3])
    assert stand.better == -4.0
    assert stand.better_inside == 2.0


@pytest.mark.parametrize(
    ("share", "others"),
    [(0.5, [1, 2, 3]), (0.49, [3])],
)
def test_fits_of_a_bent_map_within_sixty_cells_are_one_answer(
    share: float, others: list[int]
) -> None:
    pieces = table(row(8, share), row(4, 0.9), row(3, 0.9), row(2, 0.9))
    assert stood(at(0.0, 21.0, 60.0, 61.0), pieces).others == others


def test_pieces_count_against_the_best_rival_and_against_none() -> None:
    alone = Standing(NARROW, at(0.0, 100.0), [], table(row(12), row(7)), [])
    assert alone.better == alone.better_inside == 12.0
    beside = Standing(NARROW, at(0.0, 100.0), [1], table(row(12), row(7)), [])
    assert (beside.better, beside.better_inside) == (5.0, 12.0)


def test_the_metres_that_limit_the_pieces_are_those_of_the_answer() -> None:
    pieces = WallPieces(*(np.ones((2, 12)),) * 3, np.array([3.0, 1.0]), 2.0)
    assert Standing(NARROW, at(0.0, 100.0), [], pieces, []).better == 6.0


def test_maps_are_good_ones_where_anything_is_doubted() -> None:
    assert standing(3, 9.0, 0.05).is_plain
    assert not standing(3, 9.0, 0.0).is_plain


def test_wrong_answers_are_those_of_one_pair_everywhere_unless_said() -> None:
    stand = standing(3, 9.0, 2.0)
    assert stand.wrong() == expected_wrong(3.0, 1.0, is_plain=True)
    assert stand.wrong(4, 0.5) == pytest.approx(2.0 * stand.wrong())
    assert Found(NOWHERE, None, "full").prior == 1.0


@pytest.mark.parametrize(("given", "share"), [(70, 0.5), (69, 0.0)])
def test_a_rival_that_gives_seven_tenths_may_be_the_cleaner_one(given: int, share: float) -> None:
    evidence, most = row(given)
    pieces = table(row(100), (evidence, 2.0 * most))
    assert Standing(NARROW, at(0.0, 100.0), [1], pieces, []).clean_share == share


# -- which way of weighing -------------------------------------------------------------------------


@dataclass
class World:
    """What the pieces of wall say, by the width of a wall and by sides or not, at each place.

    Attributes:
        said: rows at places; elsewhere nothing is said.
        slid: where slides of the answer lead.
        asked: from where they were asked for.
        fits: how far a narrow fit moves what it is asked to fit.
        fitted: what that was.
    """

    said: dict[tuple[float, bool], dict[float, tuple[np.ndarray, np.ndarray]]]
    slid: tuple[float, ...] = ()
    asked: list[tuple[float, float, float]] = field(default_factory=list)
    fits: float = 0.0
    fitted: list[float] = field(default_factory=list)

    def wall_pieces(
        self, _: object, __: object, motions: np.ndarray, sigma: float, *___: object, **said: bool
    ) -> WallPieces:
        """Stand in for ``pieces.wall_pieces``."""
        known = self.said.get((sigma, said.get("sided", False)), {})
        return table(*(known.get(place, row(0)) for place in motions[:, 0].tolist()))

    def slides(
        self, _: object, __: object, motion: np.ndarray, sigma: float, cells: float, *___: object
    ) -> np.ndarray:
        """Stand in for ``slides.slides``."""
        self.asked.append((float(motion[0]), sigma, cells))
        return at(*self.slid).reshape(-1, 3)

    def narrow_fits(self, _: object, __: object, motions: np.ndarray, *___: object) -> np.ndarray:
        """Stand in for ``narrow_fit.narrow_fits``."""
        self.fitted += motions[:, 0].tolist()
        return motions + np.array([self.fits, 0.0, 0.0])

    def chosen(self, patch: pytest.MonkeyPatch, **options: Any) -> Standing:
        """Return the answer among 0, 30, 100 and 300 cells."""
        patch.setattr(rivals, "wall_widths", lambda _: (NARROW, BROAD))
        patch.setattr(rivals, "wall_pieces", self.wall_pieces)
        patch.setattr(rivals, "slides", self.slides)
        patch.setattr(rivals, "narrow_fits", self.narrow_fits)
        nothing = cast("GridFeatures", None)
        found = Found(at(0.0, 30.0, 100.0, 300.0), **({"coarse": COARSE} | FOUND | options))
        return chosen_standing(nothing, nothing, cast("ComputeDevice", None), found, 1, None)


FOUND: dict[str, Any] = {"search": "full"}
SIDED, EVEN, WIDE = (NARROW, True), (NARROW, False), (BROAD, False)


def told(stand: Standing) -> tuple[float, float, bool]:
    """Return where the answer lies, by which width of a wall, and whether as of good maps."""
    return float(stand.motions[0, 0]), stand.sigma, stand.is_plain


def test_good_maps_are_weighed_by_the_sides_of_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World({SIDED: {0.0: row(10)}, EVEN: {100.0: row(40)}}, slid=(50.0,))
    stand = world.chosen(monkeypatch)
    assert told(stand) == (0.0, NARROW, True)
    assert stand.pieces.doubt == 2.0
    assert world.asked == [(0.0, NARROW, 20.0)]
    # The slide is a rival among the others.
    assert stand.motions[-1, 0] == 50.0
    assert sorted(stand.others) == [1, 2, 3, 4]


def test_a_slide_that_fits_as_well_takes_the_answer_back(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World({SIDED: {0.0: row(10), 50.0: row(9)}, EVEN: {100.0: row(40)}}, slid=(50.0,))
    assert told(world.chosen(monkeypatch)) == (100.0, NARROW, True)
    # Fitted narrowly, it has the same slide.
    assert [place for place, *_ in world.asked] == [0.0, 0.0, 100.0]


@pytest.mark.parametrize(("share", "is_plain"), [(0.75, True), (0.74, False)])
def test_good_maps_leave_a_quarter_unexplained_at_most(
    monkeypatch: pytest.MonkeyPatch, share: float, *, is_plain: bool
) -> None:
    """Enough pieces for either: a hundred count 7 at these odds."""
    world = World({SIDED: {0.0: row(100, share)}})
    assert world.chosen(monkeypatch).is_plain is is_plain
    assert bool(world.asked) is is_plain


@pytest.mark.parametrize(("share", "is_fitted"), [(0.61, True), (0.59, False)])
def test_what_explains_three_fifths_is_fitted_narrowly(
    monkeypatch: pytest.MonkeyPatch, share: float, *, is_fitted: bool
) -> None:
    """The wide fit leaves two fifths; the narrow one, five cells off, explains all."""
    world = World({SIDED: {0.0: row(10, share), 5.0: row(10), 100.0: row(9, 0.5)}}, fits=5.0)
    stand = world.chosen(monkeypatch)
    assert world.fitted == ([0.0] if is_fitted else [])
    assert (told(stand) == (5.0, NARROW, True)) is is_fitted


def test_rivals_are_fitted_as_the_answer_is(monkeypatch: pytest.MonkeyPatch) -> None:
    said = {0.0: row(10, 0.7), 5.0: row(10), 100.0: row(9, 0.7), 105.0: row(9, 1.0)}
    world = World({SIDED: said}, fits=5.0)
    stand = world.chosen(monkeypatch)
    assert world.fitted == [0.0, 100.0]
    assert stand.better < 2.0


def test_what_is_believed_is_not_fitted_first(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World({SIDED: {0.0: row(10)}}, fits=5.0)
    assert told(world.chosen(monkeypatch)) == (0.0, NARROW, True)
    assert world.fitted == []


def test_eight_are_fitted_at_most_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    places = np.arange(0.0, 1000.0, 100.0)
    rows = {place: row(30 - k, 0.7) for k, place in enumerate(places)}
    world = World({SIDED: rows})
    monkeypatch.setattr(rivals, "narrow_fits", world.narrow_fits)
    pieces = table(*rows.values(), doubt=2.0)
    stand = rivals._standing(Found(at(*places), COARSE, "full"), NARROW, pieces)
    nothing = cast("GridFeatures", None)
    rivals._narrow_rows(nothing, nothing, cast("ComputeDevice", None), stand, range(10), None)
    assert world.fitted == places[:8].tolist()


def test_fits_of_what_lies_in_a_window_may_be_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    said = {0.0: row(10, 0.7), 5.0: row(10), 300.0: row(9, 0.7), 305.0: row(9)}
    world = World({SIDED: said}, fits=5.0)
    stand = world.chosen(monkeypatch, candidates=3, search="window")
    # What lies outside is a rival as it was found.
    assert world.fitted == [0.0]
    assert told(stand) == (5.0, NARROW, True)
    assert 305.0 not in stand.motions[:, 0]
    assert sorted(stand.motions[stand.inside, 0]) == [30.0, 100.0]


@pytest.mark.parametrize(("prior", "is_sided"), [(1.0, True), (100.0, False)])
def test_a_place_where_many_are_needs_more(
    monkeypatch: pytest.MonkeyPatch, prior: float, *, is_sided: bool
) -> None:
    world = World({SIDED: {0.0: row(4)}, EVEN: {0.0: row(20)}})
    stand = world.chosen(monkeypatch, prior=prior)
    assert stand.better == (4.0 if is_sided else 20.0)


def test_without_a_search_the_pieces_count_as_of_bent_maps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World({EVEN: {100.0: row(40)}, SIDED: {0.0: row(10)}, WIDE: {0.0: row(60)}})
    stand = world.chosen(monkeypatch, coarse=None, search="tracked")
    assert told(stand) == (100.0, NARROW, False)
    assert not world.asked


@pytest.mark.parametrize(
    ("count", "share", "place"),
    [(14, 0.5, 100.0), (9, 0.8, 0.0), (8, 0.8, 100.0), (10, 0.75, 0.0), (10, 0.74, 100.0)],
)
def test_a_small_clean_answer_is_told_where_it_explains_as_much(
    monkeypatch: pytest.MonkeyPatch, count: int, share: float, place: float
) -> None:
    """Another half fits on 20 pieces: 10, of which a clean answer must explain seven tenths."""
    world = World({EVEN: {0.0: row(count, share), 100.0: row(20, 0.5, first=40)}})
    assert told(world.chosen(monkeypatch)) == (place, NARROW, place == 0.0)


@pytest.mark.parametrize(("given", "is_enough"), [(70, True), (69, False)])
def test_as_much_is_seven_tenths(given: int, *, is_enough: bool) -> None:
    plain, kind = (
        Standing(NARROW, at(0.0, 100.0), [], table(row(first), row(second)), [])
        for first, second in ((given, 80), (100, 10))
    )
    assert rivals._gives_as_much(plain, kind) is is_enough


@pytest.mark.parametrize(
    ("count", "share", "is_plain"),
    # Pieces of good maps that leave nothing count twice; at 80 % an eighth.
    [(2, 1.0, True), (9, 0.8, False)],
)
def test_of_two_ways_to_weigh_one_answer_the_surer_is_taken(
    monkeypatch: pytest.MonkeyPatch, count: int, share: float, *, is_plain: bool
) -> None:
    world = World({EVEN: {0.0: row(count, share)}})
    assert told(world.chosen(monkeypatch)) == (0.0, NARROW, is_plain)


@pytest.mark.parametrize(
    ("narrow", "wide", "chosen"),
    [
        # The surer width of a wall, ...
        ({0.0: row(10, 0.6)}, {0.0: row(20, 0.6)}, (0.0, BROAD)),
        ({0.0: row(10, 0.6)}, {0.0: row(9, 0.6)}, (0.0, NARROW)),
        ({0.0: row(10, 0.6), 100.0: row(1)}, {0.0: row(20, 0.6)}, (0.0, BROAD)),
        # ... where both say the same, within sixty cells, ...
        ({0.0: row(10, 0.6)}, {30.0: row(20, 0.6)}, (30.0, BROAD)),
        ({0.0: row(10, 0.6)}, {100.0: row(20, 0.6)}, (0.0, NARROW)),
        # ... the narrow one by two pieces, ...
        ({0.0: row(2, 0.5)}, {0.0: row(20, 0.6)}, (0.0, BROAD)),
        ({0.0: row(1, 0.5)}, {0.0: row(20, 0.6)}, (0.0, NARROW)),
        # ... and the maps fit each other.
        ({0.0: row(20, 0.25)}, {0.0: row(40, 0.6)}, (0.0, BROAD)),
        ({0.0: row(20, 0.24)}, {0.0: row(40, 0.6)}, (0.0, NARROW)),
    ],
)
def test_a_wide_wall_speaks_where_the_narrow_one_says_the_same(
    monkeypatch: pytest.MonkeyPatch,
    narrow: dict[float, tuple[np.ndarray, np.ndarray]],
    wide: dict[float, tuple[np.ndarray, np.ndarray]],
    chosen: tuple[float, float],
) -> None:
    stand = World({EVEN: narrow, WIDE: wide}).chosen(monkeypatch)
    assert told(stand) == (*chosen, False)


@pytest.mark.parametrize(("less", "width"), [(0.26, BROAD), (0.24, NARROW)])
def test_two_pieces_of_a_narrow_wall_are_needed(
    monkeypatch: pytest.MonkeyPatch, less: float, width: float
) -> None:
    """One piece and two that give a quarter of it count as two."""
    evidence, most = row(3, 0.7)
    evidence[1:3] *= less
    world = World({EVEN: {0.0: (evidence, most)}, WIDE: {0.0: row(20, 0.6)}})
    assert world.chosen(monkeypatch).sigma == width
