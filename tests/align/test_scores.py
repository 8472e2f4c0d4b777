"""Evidence by pieces of wall: they add up to that of all cells, and are counted."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.align.features import GridFeatures
from slamfusion.align.lines import PieceLines, relate_pieces
from slamfusion.align.pair import Pair
from slamfusion.align.scores import ALIKE, PIECE_M, PIECE_POINTS, WallPieces, start_pieces
from slamfusion.align.search import score_motions
from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import FACES, FACING_PARTS, OPPOSED_PARTS
from slamfusion.compute.wall_pieces import is_another
from slamfusion.grid import OccupancyGrid
from tests.align.definitions import Side, landings, landings_back, look_up, side_of
from tests.fusion.drawings import building, draw, features_of, random_grid

SIGMA = 1.5
# Eighths: sums and differences of these are exact.
FINITE = st.integers(-400, 400).map(lambda n: n / 8.0)


# Points of a crooked piece of wall and of a straight one, half cells from its middle.
CROOKED = np.array([(-6, -6), (6, -6), (-6, 6), (6, 6)])
STRAIGHT = np.array([(-8, 0), (-4, 0), (0, 0), (4, 0), (8, 0)])


def lines_of(squares: Sequence[tuple[int, int]], shapes: Sequence[np.ndarray]) -> PieceLines:
    """Pieces of ten cells at columns and rows."""
    points = [shape + 20 * np.array(place) for shape, place in zip(shapes, squares, strict=True)]
    starts = np.cumsum([0, *map(len, points)], dtype=np.int32)[:-1]
    return relate_pieces(
        np.concatenate(points, dtype=np.int32), starts, np.array(squares), SIGMA, ALIKE
    )


def table_of(evidence: np.ndarray, *lines: PieceLines, apart: int = ALIKE) -> WallPieces:
    """Pieces that land where the other map knows its ground: of these lines, or crooked in a row.

    Without lines all are of one map; the other has no walls.
    """
    count = evidence.shape[1]
    none = relate_pieces(
        np.empty((0, 2), np.int32), np.empty(0, np.int32), np.empty((0, 2), np.int64), SIGMA, ALIKE
    )
    row = lines or [lines_of([(apart * k, 0) for k in range(count)], [CROOKED] * count)]
    own, other, *_ = *row, none
    return WallPieces(evidence, evidence, evidence, np.ones(len(evidence)), (own, other))


def some_motions(ref: GridFeatures, seed: int, count: int = 6) -> np.ndarray:
    """Motions that land the moving centre within a quarter of the reference from its middle."""
    rng = np.random.default_rng(seed)
    size = np.array([ref.shape[1], ref.shape[0]])
    places = size / 2 + rng.uniform(-0.25, 0.25, (count, 2)) * size
    return np.column_stack((places, rng.uniform(-3.0, 3.0, count)))


def direct_pieces(points: np.ndarray, values: np.ndarray, size: float) -> dict[tuple, float]:
    """Sum over the walls of each square of one metre of their own map; half: two maps count."""
    sums: dict[tuple, float] = {}
    for (x, y), value in zip(points, values, strict=True):
        square = math.floor(x * size / PIECE_M), math.floor(y * size / PIECE_M)
        sums[square] = sums.get(square, 0.0) + 0.5 * size * float(value)
    return sums


def is_seen(side: Side, features: GridFeatures) -> np.ndarray:
    """Known cells, and cells within two widths of a wall."""
    near = np.zeros_like(side.walls)
    row, col = np.indices(near.shape)
    for y, x in np.argwhere(side.walls):
        near |= (row - y) ** 2 + (col - x) ** 2 <= (2 * SIGMA) ** 2
    return near | (np.asarray(features.grid.cells) >= 0)


@pytest.mark.parametrize("seed", range(3))
def test_pieces_equal_their_definition(device: ComputeDevice, seed: int) -> None:
    ref, mov = (features_of(random_grid(seed + k), device) for k in (0, 60))
    motions = some_motions(ref, seed, 3)
    found = start_pieces(Pair(ref, mov), motions, SIGMA)()
    a, b = side_of(ref, SIGMA, 255), side_of(mov, SIGMA, 255)
    for k, motion in enumerate(motions):
        evidence, most, metres = [], [], 0.0
        there = landings(b.points, motion, mov.centre)
        back = landings_back(a.points, motion, mov.centre)
        for own, landed, other, features in ((b, there, a, ref), (a, back, b, mov)):
            values = look_up(other.value, landed) * other.unit
            seen = look_up(is_seen(other, features).astype(int), landed)
            top = other.value.max() * other.unit
            evidence += direct_pieces(own.points, values, 0.1).values()
            most += direct_pieces(own.points, seen * top, 0.1).values()
            metres += 0.05 * seen.sum()
        assert np.allclose(np.sort(found.evidence[k]), np.sort(evidence), atol=1e-9)
        assert np.allclose(np.sort(found.most[k]), np.sort(most), atol=1e-9)
        assert found.seen_m[k] == pytest.approx(metres)


def test_pieces_add_up_to_the_evidence_of_all_cells(device: ComputeDevice) -> None:
    ref, mov = features_of(building(3), device), features_of(building(4), device)
    motions = some_motions(ref, 5)
    pieces = start_pieces(Pair(ref, mov), motions, SIGMA)()
    cells = score_motions(Pair(ref, mov), motions, 1, sigma=SIGMA, points=PIECE_POINTS)
    # Nats a cell of 0.1 m of either map; a hundredth of it where one cell is read otherwise.
    assert np.allclose(pieces.total, 0.5 * 0.1 * cells, rtol=0, atol=0.01)
    assert np.abs(pieces.total).max() > 1.0


def test_a_map_on_itself_gives_all_that_it_could(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    pieces = start_pieces(Pair(grid, grid), np.array([[*grid.centre, 0.0]]), SIGMA)()
    assert pieces.share() == pytest.approx(1.0)
    assert pieces.seen_m == pytest.approx(0.1 * len(grid.level(1).points))
    assert 10 < pieces.count(pieces.weighed[0]) <= pieces.evidence.shape[1]


def test_where_the_maps_share_nothing_there_is_no_evidence(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    pieces = start_pieces(Pair(grid, grid), np.array([[900.0, 900.0, 1.0]]), SIGMA)()
    assert not pieces.evidence.any()
    assert pieces.seen_m.tolist() == pieces.share().tolist() == [0.0]
    assert pieces.count(pieces.weighed[0]) == 0.0


@given(value=st.floats(0.01, 100.0), count=st.integers(1, 50), idle=st.integers(0, 20))
def test_n_pieces_that_say_the_same_are_n(value: float, count: int, idle: int) -> None:
    """Pieces that say nothing are none; pieces that speak against count with a minus."""
    rows = np.array([[value] * count + [0.0] * idle, [-value] * (count + idle)])
    assert table_of(rows).count(rows) == pytest.approx([count, -(count + idle)])


@given(values=st.lists(FINITE, min_size=1, max_size=30))
def test_what_prefers_one_motion_contradicts_the_other(values: list[float]) -> None:
    row = np.array(values)
    pieces = table_of(row[None], apart=1)
    assert pieces.count(row) == pytest.approx(-pieces.count(-row))


@pytest.mark.parametrize("apart", range(1, ALIKE + 1))
def test_neighbouring_pieces_are_less_than_two(apart: int) -> None:
    """Two pieces with correlation r are 2 / (1 + r) independent ones."""
    row = np.array([3.0, 3.0])
    r = 1.0 - apart / ALIKE
    assert table_of(row[None], apart=apart).count(row) == pytest.approx(2 / (1 + r))


def test_pieces_of_two_maps_are_independent() -> None:
    row = np.array([3.0, 3.0])
    one = lines_of([(4, 7)], [CROOKED])
    assert table_of(row[None], one, one).count(row) == 2.0


def test_pieces_of_one_straight_wall_are_one() -> None:
    """At any distance; a parallel wall is another, and so are crooked pieces of one row."""
    row = np.ones(4)
    places = [(0, 0), (30, 0), (0, 8), (30, 8)]
    assert table_of(row[None], lines_of(places, [STRAIGHT] * 4)).count(row) == pytest.approx(2.0)
    assert table_of(row[None], lines_of(places, [CROOKED] * 4)).count(row) == pytest.approx(4.0)


def test_of_a_room_of_four_walls_one_is_left() -> None:
    """The fitted shift and turn take three; crooked walls in the same places are all left."""
    row = np.ones(8)
    sides = [(9, 0), (21, 0), (9, 20), (21, 20)], [(0, 4), (0, 16), (30, 4), (30, 16)]
    places = [*sides[0], *sides[1]]
    room = table_of(row[None], lines_of(places, [STRAIGHT] * 4 + [STRAIGHT[:, ::-1]] * 4))
    assert room.count(row) == pytest.approx(4.0)
    assert room.count(row, left=room.left(0)) == pytest.approx(1.0)
    assert table_of(row[None], lines_of(places, [CROOKED] * 8)).left(0) == pytest.approx(1.0)


def test_evidence_that_contradicts_is_not_spent() -> None:
    """Nothing was fitted to walls that lie elsewhere, and no share is outside 0 to 1."""
    row = -np.ones(3)
    pieces = table_of(row[None], lines_of([(0, 0), (0, 9), (9, 20)], [STRAIGHT] * 3))
    left = pieces.left(0)
    assert left.tolist() == [1.0, 1.0, 1.0]
    assert pieces.count(row, left=left) == pieces.count(row) < 0.0
    assert pieces.share().tolist() == [0.0]


def grown(picture: str, times: int) -> OccupancyGrid:
    """A drawing with each cell ``times`` as wide and high, walls one cell thick."""
    lines = picture.strip("\n").splitlines()
    wide = ["".join(sign * times for sign in line) for line in lines for _ in range(times)]
    return draw("\n".join(wide))


def test_a_map_of_twice_the_size_fits_at_half_the_scale(device: ComputeDevice) -> None:
    room = ["#" * 30, *["#" + "." * 28 + "#"] * 8, "#" * 12 + "." * 17 + "#"]
    room += [*["#" + "." * 28 + "#"] * 9, "#" * 30]
    small, large = (features_of(grown("\n".join(room), n), device) for n in (1, 2))
    motions = np.repeat([[*small.centre, 0.0]], 3, axis=0)
    pieces = start_pieces(Pair(small, large), motions, SIGMA, scales=np.array([0.5, 1.0, 0.6]))()
    assert pieces.total[0] > 3.0 * max(pieces.total[1], pieces.total[2], 1.0)


def rooms(device: ComputeDevice) -> tuple[GridFeatures, GridFeatures]:
    """Two rooms that have one wall between them, each seen from inside."""
    low, high = np.full((2, 60, 100), -1, dtype=np.int8)
    for cells, left in ((low, 5), (high, 50)):
        cells[10:50, left : left + 46] = 100
        cells[11:49, left + 1 : left + 45] = 0
    return features_of(OccupancyGrid(low, 0.1), device), features_of(
        OccupancyGrid(high, 0.1), device
    )


def test_a_wall_laid_on_the_back_of_another_is_no_evidence(device: ComputeDevice) -> None:
    low, high = rooms(device)
    # The cells that both rooms' grids were cropped to.
    beside = np.array([[low.shape[1] + high.shape[1] / 2.0 - 1.0, low.shape[0] / 2.0, 0.0]])
    backs = [start_pieces(Pair(low, high), beside, SIGMA, sided=sided)() for sided in (False, True)]
    assert backs[0].total[0] > 1.0
    assert backs[1].total[0] < 0.2 * backs[0].total[0]
    same = np.array([[*low.centre, 0.0]])
    on_itself = [
        start_pieces(Pair(low, low), same, SIGMA, sided=sided)() for sided in (False, True)
    ]
    assert np.array_equal(on_itself[0].evidence, on_itself[1].evidence)


def test_what_was_not_seen_contradicts_nothing(device: ComputeDevice) -> None:
    """A strip of common ground ends in cuts: beyond them good maps leave nothing unexplained."""
    whole = building(3)
    cut = whole.cells.copy()
    cut[:, 1 : whole.width // 2] = -1
    truth = features_of(whole, device)
    half = features_of(OccupancyGrid(cut, whole.resolution), device)
    middle = truth.shape[1] - half.shape[1] / 2.0, half.shape[0] / 2.0, 0.0
    shares = [
        start_pieces(Pair(truth, half), np.array([middle]), SIGMA, sided=sided)().share()[0]
        for sided in (False, True)
    ]
    assert shares[0] < shares[1] <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("own", "other", "turn", "wanted"),
    [
        (FACES, FACES + OPPOSED_PARTS, 0, True),
        (FACES, FACES + OPPOSED_PARTS - 1, 0, False),
        (FACES, FACES + FACING_PARTS - OPPOSED_PARTS, 0, True),
        (FACES, FACES + FACING_PARTS - OPPOSED_PARTS + 1, 0, False),
        (FACES, FACES, FACING_PARTS // 2, True),
        (FACES, FACES + FACING_PARTS // 2, -FACING_PARTS // 2, False),
        (0, FACES, 0, False),
        (FACES, 0, FACING_PARTS // 2, False),
    ],
)
def test_walls_seen_from_opposite_sides_are_not_one(
    own: int, other: int, turn: int, wanted: bool
) -> None:
    given = np.array([own], dtype=np.uint8), np.array([other], dtype=np.uint8)
    assert is_another(*given, turn)[0] == wanted
    assert is_another(*given[::-1], -turn)[0] == wanted
