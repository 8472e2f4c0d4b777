"""The tables of evidence: their formula, the unknown at nothing, and what the fields keep of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.align.features import GridFeatures
from slamfusion.align.likelihood import ScoreTable, evidence_table, score_table
from slamfusion.compute import ComputeDevice
from tests.align.definitions import likeness_of, side_of, surface_of
from tests.fusion.drawings import draw, features_of, random_grid

CHANCE = st.floats(0.0, 1.0)
SIGMA = st.floats(0.4, 12.0)
TOP = st.sampled_from((15, 255))


def value_of(table: ScoreTable) -> np.ndarray:
    """What a free cell or a wall adds to the base, by squared distance."""
    return (table.worths & 255).astype(int) - (table.worths >> 8)


@given(chance=CHANCE, sigma=SIGMA, top=TOP)
def test_a_table_is_the_logarithm_of_the_likelihood_ratio_in_units(
    chance: float, sigma: float, top: int
) -> None:
    table = evidence_table(chance, sigma, top)
    for squared in (0, 1, 2, 5, 16, 100, 4096):
        like = math.exp(-0.5 * squared / sigma**2)
        ratio = (0.75 * like + 0.04) / (0.75 * max(0.02, chance) + 0.04)
        assert abs(value_of(table)[squared] * table.unit - math.log(ratio)) <= 0.51 * table.unit


@given(chance=CHANCE, sigma=SIGMA, top=TOP)
def test_farther_from_a_wall_is_never_worth_more(chance: float, sigma: float, top: int) -> None:
    table = evidence_table(chance, sigma, top)
    assert np.all(np.diff(value_of(table)) <= 0)
    assert np.all(np.diff((table.worths & 255).astype(int)) <= 0)
    assert np.all(np.diff((table.worths >> 8).astype(int)) >= 0)


def field_of(
    features: GridFeatures, sigma: float, top: int = 255, doubt: float = 0.0
) -> tuple[ScoreTable, np.ndarray]:
    table, field = features.field(1, sigma, top, doubt)
    return table, features.device.download(field).astype(int)


@pytest.mark.parametrize("doubt", [0.0, 1.0])
@pytest.mark.parametrize("top", [15, 255])
@pytest.mark.parametrize("seed", range(4))
def test_fields_equal_their_definition(
    device: ComputeDevice, seed: int, top: int, doubt: float
) -> None:
    features = features_of(random_grid(seed), device)
    for sigma in (0.75, 1.5, 4.0):
        table, field = field_of(features, sigma, top, doubt)
        wanted = side_of(features, sigma, top, doubt)
        assert table.unit == pytest.approx(wanted.unit)
        assert np.array_equal(field - table.base, wanted.value)


@pytest.mark.parametrize("seed", range(4))
def test_the_unknown_never_speaks_against_and_far_from_walls_says_nothing(
    device: ComputeDevice, seed: int
) -> None:
    features = features_of(random_grid(seed), device)
    table, field = field_of(features, 1.5)
    value = field - table.base
    unknown = features.grid.cells == -1
    far = device.download(features.level(1).distance2) > (2.2 * 1.5) ** 2
    assert (unknown & far).sum() > 50
    assert np.all(value[unknown & far] == 0)
    assert value[unknown].min() == 0


@pytest.mark.parametrize("step", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_chance_is_what_the_known_cells_hold_of_walls_on_average(
    device: ComputeDevice, seed: int, step: int
) -> None:
    features = features_of(random_grid(seed), device)
    level = features.level(step)
    walls, free = device.download(level.wall) != 0, device.download(level.free) / 255.0
    if step == 1:
        cells = np.asarray(features.grid.cells)
        assert np.array_equal(walls, surface_of(cells))
        assert np.array_equal(free == 1.0, cells == 0)
    weight = np.where(walls, 1.0, free)
    wanted = np.average(likeness_of(walls, 0.75), weights=weight)
    assert features.chance(step, 0.75) == pytest.approx(wanted, rel=1e-12)


def test_a_wall_in_the_other_maps_unknown_costs_nothing_and_in_its_room_it_does(
    device: ComputeDevice,
) -> None:
    room = ["#" * 12, *["#" + "." * 10 + "#"] * 10, "#" * 12]
    features = features_of(draw("\n".join([*room, *[" " * 12] * 20, "#" * 12])), device)
    table, field = field_of(features, 1.5)
    assert field[26, 5] < table.base, "in the middle of the room, six cells from its walls"
    assert field[10, 5] == table.base, "in the unknown between"
    assert field[21, 5] > table.base, "on the wall of the room"


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_score_tables_equal_their_definition(sigma: float) -> None:
    table = score_table(sigma, 64, 191)
    for squared in range(4097):
        d = math.sqrt(squared) / sigma
        assert table.worths[squared] & 255 == round(191 * math.exp(-0.5 * d * d))
        # 1.5 widths of a wall are beside it still.
        assert table.worths[squared] >> 8 == (round(64 * min(1.0, d / 4.0)) if d > 1.5 else 0)
