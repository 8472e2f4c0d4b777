"""The vote: who wins a cell, by how much, and who was outvoted."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slamfusion.compute import ComputeDevice, NumpyDevice, open_device
from slamfusion.config import NormalizeConfig, VoteConfig
from slamfusion.errors import ConfigError, GridError
from slamfusion.fusion.records import VoteResult
from slamfusion.fusion.vote import log_odds_table, quantise_weights, vote_grids
from tests.support.examples import examples

U, F, O = -1, 0, 1

# Every triple of one free, one occupied, one unknown and their repetitions, by hand.
# [F16]: two of three decide, three different values give occupied.
TRIPLES = {
    (U, U, U): U,
    (U, U, F): U, (U, F, U): U, (F, U, U): U,
    (U, U, O): U, (U, O, U): U, (O, U, U): U,
    (U, F, F): F, (F, U, F): F, (F, F, U): F,
    (U, O, O): O, (O, U, O): O, (O, O, U): O,
    (F, F, F): F,
    (F, F, O): F, (F, O, F): F, (O, F, F): F,
    (F, O, O): O, (O, F, O): O, (O, O, F): O,
    (O, O, O): O,
    (U, F, O): O, (U, O, F): O, (F, U, O): O, (F, O, U): O, (O, U, F): O, (O, F, U): O,
}  # fmt: skip
# The same where unknown abstains: what the known ones say, free against occupied is occupied.
ABSTAINING = TRIPLES | {
    (U, U, F): F, (U, F, U): F, (F, U, U): F,
    (U, U, O): O, (U, O, U): O, (O, U, U): O,
}  # fmt: skip


@pytest.fixture(scope="module", params=["numpy", "auto"])
def device(request: pytest.FixtureRequest) -> ComputeDevice:
    return open_device(request.param)


def column(cells: tuple[int, ...]) -> list[np.ndarray]:
    """One grid of one cell for each input."""
    return [np.array([[cell]], dtype=np.int8) for cell in cells]


def table(combos: list[tuple[int, ...]]) -> list[np.ndarray]:
    """One grid for each input, one cell for each combination."""
    return list(np.array(combos, dtype=np.int8).T[:, None, :].copy())


def plain_vote(cells: tuple[int, ...], *, unknown_votes: bool) -> tuple[int, int, int]:
    """The vote of one cell in plain words: winner, agreement, dissent bits."""
    ballots = [cell for cell in cells if unknown_votes or cell != U]
    if not ballots:
        return U, -1, 0
    counts = {value: ballots.count(value) for value in (U, F, O)}
    first = [value for value in (U, F, O) if counts[value] == max(counts.values())]
    winner = first[0] if len(first) == 1 else O
    percent = int(100 * counts[winner] / len(ballots) + 0.5)
    bits = [n for n, cell in enumerate(cells) if cell != winner and (unknown_votes or cell != U)]
    return winner, percent, sum(1 << n for n in bits)


def same(a: VoteResult, b: VoteResult) -> bool:
    """Whether two results are equal in every cell."""
    pairs = ((a.fused, b.fused), (a.agreement, b.agreement), (a.dissent, b.dissent))
    return a.phantom_cells == b.phantom_cells and all(np.array_equal(*pair) for pair in pairs)


def test_all_27_triples(device: ComputeDevice):
    assert len(TRIPLES) == 27
    combos = list(TRIPLES)
    for unknown, wanted in (("auto", TRIPLES), ("value", TRIPLES), ("abstain", ABSTAINING)):
        result = vote_grids(table(combos), VoteConfig(unknown=unknown), device)
        assert result.fused[0].tolist() == list(wanted.values()), unknown
        assert result.phantom_cells == 0


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("unknown", ["value", "abstain", "auto"])
def test_every_combination(device: ComputeDevice, count: int, unknown: str):
    combos = list(itertools.product((U, F, O), repeat=count))
    result = vote_grids(table(combos), VoteConfig(unknown=unknown), device)
    votes = unknown == "value" or (unknown == "auto" and count == 3)
    wanted = [plain_vote(cells, unknown_votes=votes) for cells in combos]
    assert result.fused[0].tolist() == [w[0] for w in wanted]
    assert result.agreement[0].tolist() == [w[1] for w in wanted]
    assert result.dissent[0].tolist() == [w[2] for w in wanted]
    phantoms = sum(w[0] == O and O not in cells for w, cells in zip(wanted, combos, strict=True))
    assert result.phantom_cells == phantoms


@pytest.mark.parametrize("cells", [(F, O), (F, F, O, O), (O, F, F, O, U), (U, O, F), (O, U, F)])
@pytest.mark.parametrize("mode", ["majority", "weighted"])
def test_tie_becomes_occupied(device: ComputeDevice, cells: tuple[int, ...], mode: str):
    config = VoteConfig(mode=mode)
    result = vote_grids(column(cells), config, device, weights=[2.5] * len(cells))
    assert result.fused.item() == O


def test_tie_of_free_and_unknown_is_a_phantom_only_where_unknown_is_a_value(device: ComputeDevice):
    grids = column((F, U))
    assert vote_grids(grids, VoteConfig(unknown="value"), device).phantom_cells == 1
    auto = vote_grids(grids, VoteConfig(), device)
    assert (auto.fused.item(), auto.agreement.item(), auto.phantom_cells) == (F, 100, 0)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8, 9, 16, 17, 32])
def test_dissent_has_a_bit_for_every_input(device: ComputeDevice, count: int):
    cells = (O,) + (F,) * (count - 1) if count > 2 else (O,) * count
    for first in range(count):
        order = cells[-first:] + cells[:-first] if first else cells
        result = vote_grids(column(order), VoteConfig(), device)
        assert result.dissent.dtype.kind == "u"
        assert result.dissent.item() == (1 << first if count > 2 else 0)


def test_agreement_rounds_half_up(device: ComputeDevice):
    config = VoteConfig(unknown="value")
    for cells, percent in (((O, O, F), 67), ((O, F, U), 33), ((O,) * 5 + (F,) * 3, 63)):
        assert vote_grids(column(cells), config, device).agreement.item() == percent


GRIDS = st.tuples(
    st.integers(1, 9), st.tuples(st.integers(1, 9), st.integers(1, 40)), st.integers(0, 2**32 - 1)
)


def draw(spec: tuple[int, tuple[int, int], int]) -> list[np.ndarray]:
    """Random trinary grids of (count, shape, seed)."""
    count, shape, seed = spec
    rng = np.random.default_rng(seed)
    return [rng.integers(-1, 2, shape).astype(np.int8) for _ in range(count)]


@settings(max_examples=examples(40), deadline=None)
@given(spec=GRIDS, unknown=st.sampled_from(("auto", "value", "abstain")), seed=st.integers(0, 99))
def test_order_of_inputs_does_not_matter(
    spec: tuple[int, tuple[int, int], int], unknown: str, seed: int
):
    device, grids, config = open_shared(), draw(spec), VoteConfig(unknown=unknown)
    order = np.random.default_rng(seed).permutation(len(grids))
    one, other = (vote_grids(g, config, device) for g in (grids, [grids[n] for n in order]))
    assert np.array_equal(one.fused, other.fused)
    assert np.array_equal(one.agreement, other.agreement)
    for place, n in enumerate(order):
        assert np.array_equal((one.dissent >> n) & 1, (other.dissent >> place) & 1)


@settings(max_examples=examples(30), deadline=None)
@given(
    cells=hnp.arrays(
        np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=40), elements=st.integers(-1, 1)
    ),
    count=st.integers(1, 8),
    mode=st.sampled_from(("majority", "weighted")),
    unknown=st.sampled_from(("auto", "value", "abstain")),
)
def test_fusing_a_grid_with_itself_changes_nothing(
    cells: np.ndarray, count: int, mode: str, unknown: str
):
    config = VoteConfig(mode=mode, unknown=unknown)
    weights = list(range(1, count + 1))
    result = vote_grids([cells] * count, config, open_shared(), weights=weights)
    assert np.array_equal(result.fused, cells)
    assert not result.dissent.any()
    assert set(np.unique(result.agreement)) <= {-1, 100}


@settings(max_examples=examples(60), deadline=None)
@given(
    spec=GRIDS,
    mode=st.sampled_from(("majority", "weighted")),
    seed=st.integers(0, 2**32 - 1),
)
def test_auto_makes_no_phantom_cells(spec: tuple[int, tuple[int, int], int], mode: str, seed: int):
    grids = draw(spec)
    weights = np.random.default_rng(seed).integers(1, 5, len(grids)).astype(float)
    result = vote_grids(grids, VoteConfig(mode=mode), open_shared(), weights=list(weights))
    assert result.phantom_cells == 0
    assert not np.any((result.fused == O) & ~np.any(np.stack(grids) == O, axis=0))


@pytest.mark.parametrize("shape", [(1, 1), (1, 67), (67, 1), (31, 33), (5, 4099)])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 9, 32])
@pytest.mark.parametrize("mode", ["majority", "weighted", "log-odds"])
def test_kernel_equals_twin(shape: tuple[int, int], count: int, mode: str):
    rng = np.random.default_rng(count)
    percents = [rng.integers(-1, 101, shape).astype(np.int8) for _ in range(count)]
    grids = [np.where(p < 0, -1, p > 50).astype(np.int8) for p in percents]
    given_ = {"weights": list(rng.random(count)), "percents": percents}
    for unknown in ("value", "abstain", "auto"):
        config = VoteConfig(mode=mode, unknown=unknown)
        kernel = vote_grids(grids, config, open_shared(), **given_)
        assert same(kernel, vote_grids(grids, config, NumpyDevice(), **given_))


def test_all_unknown_stays_unknown(device: ComputeDevice):
    grids = [np.full((7, 45), -1, dtype=np.int8)] * 4
    for mode in ("majority", "weighted", "log-odds"):
        config = VoteConfig(mode=mode)
        result = vote_grids(grids, config, device, weights=[1.0] * 4, percents=grids)
        assert (result.fused == U).all()
        assert (result.agreement == -1).all()
        assert not result.dissent.any()


def test_inputs_are_not_changed_and_may_be_read_only_or_strided(device: ComputeDevice):
    big = np.random.default_rng(0).integers(-1, 2, (40, 81)).astype(np.int8)
    views = [big[1:30, 3:44], big[2:31, 5:46], big[::-1][:29, 40:]]
    dense = [np.ascontiguousarray(view) for view in views]
    for grid in dense:
        grid.flags.writeable = False
    odd = np.frombuffer(b"\0" + dense[0].tobytes(), dtype=np.int8, offset=1).reshape(29, 41)
    before = big.copy()
    wanted = vote_grids(dense, VoteConfig(), NumpyDevice())
    assert same(vote_grids(views, VoteConfig(), device), wanted)
    assert same(vote_grids(dense, VoteConfig(), device), wanted)
    assert same(vote_grids([odd, *dense[1:]], VoteConfig(), device), wanted)
    assert np.array_equal(big, before)


def test_equal_weights_are_the_majority(device: ComputeDevice):
    for count in (2, 3, 5):
        grids = table(list(itertools.product((U, F, O), repeat=count)))
        weighted = vote_grids(grids, VoteConfig(mode="weighted"), device, weights=[0.3] * count)
        assert same(weighted, vote_grids(grids, VoteConfig(), device))


def test_heavier_input_wins(device: ComputeDevice):
    config = VoteConfig(mode="weighted")
    result = vote_grids(column((F, O)), config, device, weights=[3.0, 1.0])
    assert (result.fused.item(), result.agreement.item(), result.dissent.item()) == (F, 75, 2)


def test_auto_abstains_where_one_weight_holds_the_balance(device: ComputeDevice):
    # Free weighs as much as the two unknown: as a value this tie would be a wall of no input.
    config = VoteConfig(mode="weighted")
    result = vote_grids(column((F, U, U)), config, device, weights=[2.0, 1.0, 1.0])
    assert (result.fused.item(), result.phantom_cells) == (F, 0)


def test_weights_become_whole_numbers():
    assert quantise_weights([1.0, 0.5, 0.0]).tolist() == [252, 126, 1]
    assert quantise_weights([0.1, 0.3]).tolist() == [84, 252]
    for wrong in ([0.0, 0.0], [1.0, -1.0], [np.nan, 1.0], [np.inf, 1.0]):
        with pytest.raises(ConfigError, match="finite and not negative"):
            quantise_weights(wrong)


def log_odds(
    device: ComputeDevice, *percents: int, **thresholds: float
) -> tuple[int, int, int, int]:
    """Vote one cell of these percents: winner, agreement, dissent, phantom cells."""
    cells = column(percents)
    trinary = [np.where(c < 0, -1, c >= 65).astype(np.int8) for c in cells]
    config = NormalizeConfig(**thresholds)
    result = vote_grids(
        trinary, VoteConfig(mode="log-odds"), device, percents=cells, thresholds=config
    )
    parts = (result.fused, result.agreement, result.dissent)
    return (*(int(part.item()) for part in parts), result.phantom_cells)


def test_log_odds_add(device: ComputeDevice):
    assert log_odds(device, 90, 20, -1) == (O, 61, 2, 0)  # +2.20 - 1.39 is more than 65 % has
    assert log_odds(device, 10, 10, 90) == (F, 67, 4, 0)
    assert log_odds(device, 60, 60) == (O, 100, 0, 1)  # two weak hints: a wall of no single input
    assert log_odds(device, 60, -1) == (U, 0, 1, 0)
    assert log_odds(device, 50, 50, -1) == (U, -1, 0, 0)


def test_log_odds_tie_becomes_occupied(device: ComputeDevice):
    assert log_odds(device, 98, 2) == (O, 50, 2, 0)
    assert log_odds(device, 0, 100) == (O, 50, 1, 0)
    assert log_odds(device, 40, 60) == (U, 0, 3, 0)  # no input says wall: no evidence, no tie


@pytest.mark.parametrize("thresholds", [(65.0, 25.0), (90.0, 10.0), (50.5, 49.5)])
def test_log_odds_of_one_input_are_its_thresholds(
    device: ComputeDevice, thresholds: tuple[float, float]
):
    percent = np.arange(-1, 101, dtype=np.int8)[None]
    config = NormalizeConfig(occupied_percent=thresholds[0], free_percent=thresholds[1])
    wanted = np.where(percent >= thresholds[0], O, U)
    wanted[(percent >= 0) & (percent <= thresholds[1])] = F
    result = vote_grids(
        [wanted.astype(np.int8)],
        VoteConfig(mode="log-odds"),
        device,
        percents=[percent],
        thresholds=config,
    )
    assert np.array_equal(result.fused, wanted)


def test_log_odds_table_is_odd_and_clamped():
    odds = log_odds_table()
    assert odds[50] == 0
    assert np.array_equal(odds, -odds[::-1])
    assert odds[100] == odds[98] == 996
    assert (np.diff(odds[2:99]) > 0).all()


def test_what_cannot_vote_is_refused(device: ComputeDevice):
    cell, wide = column((F,))[0], np.zeros((1, 2), dtype=np.int8)
    for wrong, words in (
        ([], "1 to 32 grids, found 0"),
        ([cell] * 33, "found 33"),
        ([cell, wide], "one shape, found"),
        ([cell.astype(np.int16)], "int16"),
        ([np.zeros((0, 4), dtype=np.int8)], "found int8"),
    ):
        with pytest.raises(GridError, match=words):
            vote_grids(wrong, VoteConfig(), device)
    with pytest.raises(
        ConfigError, match=r"'drawn' draws the map from .*a log and `slamfusion run`"
    ):
        vote_grids([cell], VoteConfig(mode="drawn"), device)
    with pytest.raises(ConfigError, match="wants 1 weights"):
        vote_grids([cell], VoteConfig(mode="weighted"), device)
    with pytest.raises(ConfigError, match="wants 1 weights, one each input, found 2"):
        vote_grids([cell], VoteConfig(mode="weighted"), device, weights=[1.0, 1.0])
    with pytest.raises(ConfigError, match="occupancy in percent"):
        vote_grids([cell], VoteConfig(mode="log-odds"), device)
    with pytest.raises(ConfigError, match="occupancy in percent"):
        vote_grids([cell], VoteConfig(mode="log-odds"), device, percents=[wide])


def open_shared() -> ComputeDevice:
    """The OpenCL device, opened once."""
    if not _SHARED:
        _SHARED.append(open_device())
    return _SHARED[0]


_SHARED: list[ComputeDevice] = []


def wall_at(*cols: int, width: int = 40, beyond: int = F) -> npt.NDArray[np.int8]:
    """A row of free cells with walls; what lies behind the last wall is ``beyond``."""
    row = np.full((5, width), F, dtype=np.int8)
    row[:, max(cols, default=width) :] = beyond
    row[:, list(cols)] = O
    return row


CONSENSUS = VoteConfig(mode="consensus")
BARE_CONSENSUS = VoteConfig(mode="consensus", solid_walls=False)


@pytest.mark.parametrize("away", [2, 5, 8])
@pytest.mark.parametrize(("beyond", "left"), [(F, F), (U, U)])
def test_consensus_leaves_out_the_double_of_a_wall(
    device: ComputeDevice, away: int, beyond: int, left: int
):
    """Two inputs have a wall at 10, the third has it ``away`` cells further on."""
    grids = [wall_at(10, beyond=beyond), wall_at(10, beyond=beyond), wall_at(10 + away)]
    result = vote_grids(grids, CONSENSUS, device, reach_cells=8)
    assert (result.fused[:, 10] == O).all()
    assert (result.fused[:, 10 + away] == left).all()
    assert result.phantom_cells == 0
    assert (result.dissent[:, 10 + away] == 0b100).all()
    assert (result.agreement[:, 10 + away] == (67 if left == F else 0)).all()


@pytest.mark.parametrize("col", [11, 19, 30])
def test_consensus_keeps_walls_that_are_thick_or_far(device: ComputeDevice, col: int):
    """Where the others know nothing."""
    grids = [wall_at(10, beyond=U), wall_at(10, beyond=U), wall_at(10, col)]
    result = vote_grids(grids, CONSENSUS, device, reach_cells=8)
    assert (result.fused[:, col] == O).all()


def test_consensus_of_two_is_the_vote_of_those_that_know(device: ComputeDevice):
    grids = [wall_at(10, beyond=U), wall_at(14)]
    result = vote_grids(grids, CONSENSUS, device, reach_cells=8)
    assert same(result, vote_grids(grids, VoteConfig(unknown="abstain"), device))


@given(
    cells=st.lists(st.sampled_from((U, F, O)), min_size=3 * 48, max_size=3 * 48),
    reach=st.integers(0, 6),
)
def test_consensus_only_takes_lone_walls_away(device: ComputeDevice, cells: list[int], reach: int):
    grids = list(np.array(cells, dtype=np.int8).reshape(3, 6, 8))
    result = vote_grids(grids, BARE_CONSENSUS, device, reach_cells=reach)
    plain = vote_grids(grids, VoteConfig(unknown="abstain"), device)
    changed = result.fused != plain.fused
    assert (plain.fused[changed] == O).all()
    assert (np.sum(np.array(grids) == O, axis=0)[changed] == 1).all()
    assert result.phantom_cells == 0
    assert ((result.agreement >= -1) & (result.agreement <= 100)).all()
    if reach < 2:
        assert same(result, plain)


def test_consensus_gives_walls_their_backs_though_nobody_voted_for_them(device: ComputeDevice):
    grids = [wall_at(10, beyond=U) for _ in range(3)]
    result = vote_grids(grids, CONSENSUS, device, reach_cells=8)
    assert (result.fused[1:-1, 11] == O).all()
    assert (result.fused[:, 12:] == U).all()
    assert (result.agreement[:, 11] == -1).all()
    assert not result.dissent[:, 11].any()
    assert result.phantom_cells == 0


def test_consensus_cuts_what_one_denies_before_a_wall_that_stands_without_it(device: ComputeDevice):
    """Two see the wall a cell nearer than the third; behind all of them is more of it."""
    grids = [wall_at(10, 11, 12, beyond=U), wall_at(10, 11, 12, beyond=U)]
    grids.append(wall_at(11, 12, beyond=U))
    result = vote_grids(grids, CONSENSUS, device, reach_cells=8)
    assert (result.fused[:, 10] == F).all()
    assert (result.fused[:, 11:13] == O).all()
    assert (result.agreement[:, 10] == 33).all()
    assert (result.dissent[:, 10] == 0b011).all()
    bare = vote_grids(grids, BARE_CONSENSUS, device, reach_cells=8)
    assert (bare.fused[:, 10] == O).all()


def test_log_odds_cuts_by_weight(device: ComputeDevice):
    """95 and 60 percent against 20: the share of the votes for free is that of their log-odds."""
    percents = [np.full((5, 20), 5, dtype=np.int8) for _ in range(3)]
    for percent, front in zip(percents, (95, 60, 20), strict=True):
        percent[:, 10] = front
        percent[:, 11:13] = 95
        percent[:, 13:] = -1
    grids = [
        np.where(p < 0, U, np.where(p >= 65, O, np.where(p <= 25, F, U))).astype(np.int8)
        for p in percents
    ]
    config = VoteConfig(mode="log-odds")
    result = vote_grids(grids, config, device, percents=percents)
    odds = np.abs(log_odds_table()[[95, 60, 20]])
    assert (result.fused[:, 10] == F).all()
    assert (result.agreement[:, 10] == int(100 * odds[2] / odds.sum() + 0.5)).all()
    assert (result.dissent[:, 10] == 0b011).all()
    assert (result.fused[1:-1, 13] == O).all()
    bare = replace(config, solid_walls=False)
    assert (vote_grids(grids, bare, device, percents=percents).fused[:, 10] == O).all()


@pytest.mark.parametrize("mode", ["majority", "weighted"])
def test_the_plain_votes_leave_walls_as_they_are(device: ComputeDevice, mode: str):
    grids = [wall_at(10, beyond=U) for _ in range(3)]
    result = vote_grids(grids, VoteConfig(mode=mode), device, weights=[1.0, 1.0, 1.0])
    assert np.array_equal(result.fused, grids[0])
