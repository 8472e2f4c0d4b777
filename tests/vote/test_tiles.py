"""The vote on tiles: [F16]'s majority by hand; how a map is cut into tiles does not matter."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, NumpyDevice, open_device
from slamfusion.compute.votes import Votes
from slamfusion.config import VoteConfig
from slamfusion.errors import ConfigError, GridError
from slamfusion.grid import CellBox
from slamfusion.vote.tiles import TileVoter, check_votes
from tests.support.examples import examples

U, F, O = -1, 0, 1


@pytest.fixture(scope="module", params=["numpy", "auto"])
def device(request: pytest.FixtureRequest) -> ComputeDevice:
    return open_device(request.param)


def majority(grids: list[np.ndarray], device: ComputeDevice, unknown: str = "auto") -> Votes:
    """The majority under a rule for unknown."""
    names = tuple(f"map {n}" for n in range(len(grids)))
    voter = TileVoter(CellBox(0, 0, 1, 1), VoteConfig("majority", unknown), 0.05, names)
    return device.vote_majority(grids, unknown_votes=voter.unknown_votes)


def column(cells: tuple[int, ...]) -> list[np.ndarray]:
    """One grid of one cell for each input."""
    return [np.array([[cell]], dtype=np.int8) for cell in cells]


def table(combos: list[tuple[int, ...]]) -> list[np.ndarray]:
    """One grid for each input, one cell for each combination."""
    return list(np.array(combos, dtype=np.int8).T[:, None, :].copy())


def plain_vote(cells: tuple[int, ...], *, unknown_is_vote: bool) -> tuple[int, int, int]:
    """The vote of one cell in plain words: winner, agreement, dissent bits."""
    cast = [cell for cell in cells if unknown_is_vote or cell != U]
    if not cast:
        return U, -1, 0
    counts = {value: cast.count(value) for value in (U, F, O)}
    first = [value for value in (U, F, O) if counts[value] == max(counts.values())]
    winner = first[0] if len(first) == 1 else O
    percent = int(100 * counts[winner] / len(cast) + 0.5)
    bits = [n for n, cell in enumerate(cells) if cell != winner and (unknown_is_vote or cell != U)]
    return winner, percent, sum(1 << n for n in bits)


def same(a: Votes, b: Votes) -> bool:
    """Whether two results are equal in every cell."""
    return all(np.array_equal(one, other) for one, other in zip(a, b, strict=True))


# --- the majority of [F16] -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cells", "value", "abstains"),
    [
        ((U, F, O), O, O),  # three different values give occupied
        ((U, U, F), U, F),
        ((U, U, O), U, O),
        ((U, F, F), F, F),
        ((U, O, O), O, O),
        ((F, F, O), F, F),
        ((F, O, O), O, O),
    ],
)
def test_two_of_three_decide(
    device: ComputeDevice, cells: tuple[int, ...], value: int, abstains: int
) -> None:
    """[F16], by hand; a known cell alone decides where unknown abstains."""
    orders = list(itertools.permutations(cells))
    for unknown, wanted in (("auto", value), ("value", value), ("abstain", abstains)):
        assert set(majority(table(orders), device, unknown).fused[0].tolist()) == {wanted}


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("unknown", ["value", "abstain", "auto"])
def test_every_combination(device: ComputeDevice, count: int, unknown: str) -> None:
    combos = list(itertools.product((U, F, O), repeat=count))
    result = majority(table(combos), device, unknown)
    votes = unknown == "value" or (unknown == "auto" and count == 3)
    wanted = [plain_vote(cells, unknown_is_vote=votes) for cells in combos]
    assert result.fused[0].tolist() == [w[0] for w in wanted]
    assert result.agreement[0].tolist() == [w[1] for w in wanted]
    assert result.dissent[0, 0].tolist() == [w[2] for w in wanted]
    phantoms = sum(w[0] == O and O not in cells for w, cells in zip(wanted, combos, strict=True))
    assert result.phantom_cells == phantoms


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8, 9, 16, 17, 32])
def test_dissent_has_a_bit_for_every_input(device: ComputeDevice, count: int) -> None:
    cells = (O,) + (F,) * (count - 1) if count > 2 else (O,) * count
    for first in range(count):
        order = cells[-first:] + cells[:-first] if first else cells
        dissent = majority(column(order), device).dissent
        bits = int.from_bytes(dissent.tobytes(), "little")
        assert bits == (1 << first if count > 2 else 0)


def test_inputs_are_not_changed_and_may_be_read_only_or_strided(device: ComputeDevice) -> None:
    big = np.random.default_rng(0).integers(-1, 2, (40, 81)).astype(np.int8)
    views = [big[1:30, 3:44], big[2:31, 5:46], big[::-1][:29, 40:]]
    dense = [np.ascontiguousarray(view) for view in views]
    for grid in dense:
        grid.flags.writeable = False
    odd = np.frombuffer(b"\0" + dense[0].tobytes(), dtype=np.int8, offset=1).reshape(29, 41)
    before = big.copy()
    wanted = majority(dense, NumpyDevice())
    assert same(majority(views, device), wanted)
    assert same(majority(dense, device), wanted)
    assert same(majority([odd, *dense[1:]], device), wanted)
    assert np.array_equal(big, before)


def test_what_cannot_vote_is_refused(device: ComputeDevice) -> None:
    shown = {f"map {n}": column((F,))[0] for n in range(33)}
    voter = TileVoter(CellBox(0, 0, 1, 1), VoteConfig("majority"), 0.05, tuple(shown))
    with pytest.raises(GridError, match="a vote takes up to 32 grids, found 33"):
        voter.decide(voter.whole, shown, device)
    with pytest.raises(
        ConfigError, match=r"'drawn' draws the map from .* a log.*consensus or majority"
    ):
        check_votes(VoteConfig(mode="drawn"))


# --- tiles -----------------------------------------------------------------------------------


@settings(max_examples=examples(60), deadline=None)
@given(
    corner=st.tuples(st.integers(-40, 40), st.integers(-40, 40)),
    shape=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    side=st.integers(1, 40),
)
def test_tiles_are_the_whole_once_cut_at_multiples_of_their_side(
    corner: tuple[int, int], shape: tuple[int, int], side: int
) -> None:
    whole = CellBox(*corner, corner[0] + shape[0], corner[1] + shape[1])
    times = np.zeros(shape, dtype=int)
    for tile in whole.tiles(side):
        times[tile.slices(whole)] += 1
        for cell, start in zip((tile.row0, tile.col0), corner, strict=True):
            assert cell == start or cell % side == 0
    assert (times == 1).all()
