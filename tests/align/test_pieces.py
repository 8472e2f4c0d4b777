"""Evidence by pieces of wall: they add up to that of all cells, and are counted as witnesses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import fixed_similarities
from slamfusion.align.pieces import PIECE_M, PIECE_POINTS, WallPieces, wall_pieces
from slamfusion.align.search import score_motions
from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import (
    FACES,
    FACES_NOWHERE,
    FACING_PARTS,
    FIXED_ONE,
    OPPOSED_PARTS,
)
from slamfusion.compute.wall_pieces import is_another
from slamfusion.grid import OccupancyGrid
from tests.align.definitions import Side, landings, landings_back, look_up, side_of
from tests.fusion.drawings import building, draw, features_of, random_grid

SIGMA = 1.5
# Eighths: sums and differences of these are exact.
FINITE = st.integers(-400, 400).map(lambda n: n / 8.0)


def pieces_of(*evidence: list[float]) -> WallPieces:
    table = np.array(evidence, dtype=np.float64)
    return table_of(table, np.ones_like(table))


def table_of(evidence: np.ndarray, most: np.ndarray, doubt: float = 0.0) -> WallPieces:
    """Motions under which each piece lands where the other map knows its ground."""
    return WallPieces(evidence, most, most, np.ones(len(evidence)), doubt)


def doubted(answer: list[float], rival: list[float], doubt: float = 1.0) -> WallPieces:
    """An answer and a rival that explain all that they see."""
    table = np.array([answer, rival])
    return table_of(table, table, doubt)


@pytest.mark.parametrize(
    ("rival", "share"),
    [(0.0, 1.0), (0.3, 1.0), (0.5, 1.0), (0.75, 0.5), (0.9, 0.2), (1.0, 0.0)],
)
def test_a_rival_of_good_maps_that_gives_nearly_as_much_takes_off(
    rival: float, share: float
) -> None:
    pieces = doubted([1.0] * 20 + [0.0] * 20, [0.0] * 20 + [rival] * 20)
    assert pieces.against(1) == pytest.approx(share * pieces.better(0, 1))
    bent = replace(pieces, doubt=0.0)
    assert bent.against(1) == bent.better(0, 1)


def test_a_rival_that_is_better_counts_as_it_is() -> None:
    pieces = doubted([1.0, 1.0, 0.0], [1.0, 1.0, 1.0])
    assert pieces.against(1) == pieces.better(0, 1) == pytest.approx(-1.0)
    nothing = doubted([0.0, 0.0], [-1.0, -1.0])
    assert nothing.against(1) == nothing.better(0, 1) == pytest.approx(2.0)


def test_sharp_maps_fit_whole_or_not_at_all() -> None:
    """The same share: of one motion in half of the pieces, of the other in part everywhere."""
    evidence = np.array([[3.0, 3.0, -0.2, -0.2], [1.4, 1.4, 1.4, 1.4], [1.4, 2.2, 0.0, 0.0]])
    most = np.array([[3.0, 3.0, 3.0, 3.0], [3.0, 3.0, 3.0, 3.0], [2.0, 4.0, 0.0, 4.0]])
    pieces = table_of(evidence, most)
    assert pieces.share()[0] == pytest.approx(pieces.share()[1])
    assert [pieces.whole(k) for k in range(3)] == pytest.approx([0.5, 0.0, 0.2])


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
    found = wall_pieces(ref, mov, motions, SIGMA, device)
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
    pieces = wall_pieces(ref, mov, motions, SIGMA, device)
    cells = score_motions(ref, mov, motions, 1, device, sigma=SIGMA, points=PIECE_POINTS)
    # Nats a cell of 0.1 m of either map; a hundredth of it where one cell is read otherwise.
    assert np.allclose(pieces.total, 0.5 * 0.1 * cells, rtol=0, atol=0.01)
    assert np.abs(pieces.total).max() > 1.0


def test_a_sample_of_the_walls_stands_for_all(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    answer = np.array([[*grid.centre, 0.0]])
    full = wall_pieces(grid, grid, answer, SIGMA, device)
    some = wall_pieces(grid, grid, answer, SIGMA, device, points=len(grid.level(1).points) // 3)
    assert some.total == pytest.approx(full.total)
    assert some.seen_m == pytest.approx(full.seen_m)


def test_a_map_on_itself_gives_all_that_it_could(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    pieces = wall_pieces(grid, grid, np.array([[*grid.centre, 0.0]]), SIGMA, device)
    assert pieces.share() == pytest.approx(1.0)
    assert pieces.seen_m == pytest.approx(0.1 * len(grid.level(1).points))
    assert 10 < pieces.witnesses() <= pieces.evidence.shape[1]


def test_where_the_maps_share_nothing_there_is_no_evidence(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    pieces = wall_pieces(grid, grid, np.array([[900.0, 900.0, 1.0]]), SIGMA, device)
    assert not pieces.evidence.any()
    assert pieces.seen_m.tolist() == pieces.share().tolist() == [0.0]
    assert pieces.witnesses() == 0.0


@given(value=st.floats(0.01, 100.0), count=st.integers(1, 50), idle=st.integers(0, 20))
def test_n_pieces_that_say_the_same_are_n_witnesses(value: float, count: int, idle: int) -> None:
    """Pieces that say nothing are none; pieces that speak against count with a minus."""
    row = [value] * count + [0.0] * idle
    pieces = pieces_of(row, [-value] * (count + idle))
    assert pieces.witnesses() == pieces.witnesses(0) == pytest.approx(count)
    assert pieces.witnesses(1) == pytest.approx(-(count + idle))


@given(values=st.lists(FINITE, min_size=1, max_size=30))
def test_there_are_no_more_witnesses_than_pieces(values: list[float]) -> None:
    assert abs(pieces_of(values).witnesses()) <= len(values) * (1 + 1e-9)


def test_one_loud_piece_is_one_witness() -> None:
    assert pieces_of([1000.0, 1.0, 1.0, 1.0]).witnesses() == pytest.approx(1.0, abs=0.01)


@given(pairs=st.lists(st.tuples(FINITE, FINITE), min_size=1, max_size=30))
def test_better_is_antisymmetric(pairs: list[tuple[float, float]]) -> None:
    pieces = pieces_of([a for a, _ in pairs], [b for _, b in pairs])
    assert pieces.better(0, 1) == -pieces.better(1, 0)
    assert pieces.better(0, 0) == 0.0


def test_what_stays_unexplained_is_doubted() -> None:
    given = table_of(np.array([[3.0, -1.0]]), np.array([[4.0, 2.0]]))
    assert given.total == pytest.approx([2.0])
    doubted = replace(given, doubt=1.0)
    assert np.array_equal(doubted.weighed, [[3.0 - 1.0, -1.0 - 3.0]])
    assert doubted.total == pytest.approx([-2.0])
    assert doubted.share() == given.share() == pytest.approx([2.0 / 6.0])
    assert doubted.witnesses() == pytest.approx(-4.0 / 20.0)
    # The one that gives less is the better one if it leaves nothing unexplained.
    two = table_of(np.array([[4.0, 1.0], [3.0, 0.0]]), np.array([[6.0, 3.0], [3.0, 0.0]]))
    assert two.better(0, 1) > 0.0
    assert replace(two, doubt=1.0).better(0, 1) < 0.0


def test_pieces_of_further_motions_are_joined() -> None:
    a, b = pieces_of([1.0, 2.0]), pieces_of([3.0, 4.0], [5.0, 6.0])
    joined = replace(a, doubt=0.5).joined(b)
    assert np.array_equal(joined.evidence, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    assert joined.most.shape == joined.share_most.shape == (3, 2)
    assert joined.seen_m.shape == (3,)
    assert joined.doubt == 0.5
    assert replace(a, doubt=0.5).take(np.array([0])).doubt == 0.5


def test_motions_are_taken_in_any_order() -> None:
    pieces = pieces_of([1.0, 2.0], [3.0, 0.0], [5.0, 6.0])
    some = pieces.take(np.array([2, 0]))
    assert some.evidence.tolist() == [[5.0, 6.0], [1.0, 2.0]]
    assert some.better(0, 1) == pieces.better(2, 0)
    assert some.most.shape == some.share_most.shape == (2, 2)
    assert some.seen_m.shape == (2,)


@given(
    motion=st.tuples(FINITE, FINITE, st.floats(-4.0, 4.0)),
    scale=st.floats(0.7, 1.4),
    point=st.tuples(st.integers(-200, 200), st.integers(-200, 200)),
)
def test_a_similarity_there_and_back_is_none(
    motion: tuple[float, float, float], scale: float, point: tuple[int, int]
) -> None:
    centre = (31.5, 20.0)
    there, back = fixed_similarities(np.array([motion]), centre, np.array([scale]))

    def moved(pose: np.ndarray, x2: float, y2: float) -> tuple[float, float]:
        cos, sin, x, y = pose[0] / FIXED_ONE
        return float(cos * x2 - sin * y2 + x), float(sin * x2 + cos * y2 + y)

    landed = moved(there, *point)
    assert moved(back, *landed) == pytest.approx(point, abs=1e-5)
    own = scale * (np.array(point) / 2.0 - centre)
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    wanted = cos * own[0] - sin * own[1] + motion[0], sin * own[0] + cos * own[1] + motion[1]
    assert np.array(landed) / 2.0 == pytest.approx(wanted, abs=1e-5)


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
    pieces = wall_pieces(small, large, motions, SIGMA, device, scales=np.array([0.5, 1.0, 0.6]))
    assert pieces.total[0] > 3.0 * max(pieces.total[1], pieces.total[2], 1.0)


@pytest.mark.parametrize("sided", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_the_twins_count_the_same(
    device: ComputeDevice, twins: ComputeDevice, seed: int, sided: bool
) -> None:
    found = []
    for on_device in (device, twins):
        ref, mov = (features_of(random_grid(seed + k), on_device) for k in (0, 60))
        motions = some_motions(ref, seed)
        found.append(wall_pieces(ref, mov, motions, SIGMA, on_device, sided=sided))
    for name in ("evidence", "most", "share_most", "seen_m"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name))


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
    backs = [wall_pieces(low, high, beside, SIGMA, device, sided=sided) for sided in (False, True)]
    assert backs[0].total[0] > 1.0
    assert backs[1].total[0] < 0.2 * backs[0].total[0]
    same = np.array([[*low.centre, 0.0]])
    on_itself = [wall_pieces(low, low, same, SIGMA, device, sided=sided) for sided in (False, True)]
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
        wall_pieces(truth, half, np.array([middle]), SIGMA, device, sided=sided).share()[0]
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
        (FACES, FACES_NOWHERE, 0, True),
        (FACES_NOWHERE, FACES_NOWHERE, FACING_PARTS // 2, False),
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
