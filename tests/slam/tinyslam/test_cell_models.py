"""Cell models against values worked out by hand, and the hit cell's area against drawn points."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.slam.tinyslam.slam import area_behind, cell_value

VALUES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20)


def test_base_moves_a_share_of_the_way() -> None:
    assert [cell_value("base", [1.0, 0.0][:count], 0.25) for count in range(3)] == [
        0.5,
        0.625,
        0.46875,
    ]


def test_mean_is_that_of_the_believed_observations() -> None:
    # Believed at 0.5: 0.75 and 0.25, then 0.75 again.
    values = [cell_value("mean", [1.0, 0.0, 1.0][:count], 0.5) for count in range(4)]
    assert values == pytest.approx([0.5, 0.75, 0.5, 1.75 / 3])


@given(VALUES, st.floats(0.0, 1.0), st.randoms(use_true_random=False))
def test_mean_forgets_the_order_and_stays_between(
    told: list[float], quality: float, random: Random
) -> None:
    shuffled = random.sample(told, len(told))
    value = cell_value("mean", told, quality)
    assert cell_value("mean", shuffled, quality) == pytest.approx(value)
    assert min(*told, 0.5) - 1e-12 <= value <= max(*told, 0.5) + 1e-12


@pytest.mark.parametrize(
    ("x", "y", "angle_rad", "share"),
    [
        (0.25, 0.4, 0.0, 0.25),  # flying along x: what lies right of x = 0.25
        (0.25, 0.4, math.pi, 0.75),
        (0.25, 0.4, math.pi / 2.0, 0.1),
        (0.5, 0.5, math.pi / 4.0, 0.0),
        (-0.5, -0.5, math.pi / 4.0, 1.0),
        (0.25, 0.25, math.pi / 4.0, 0.125),  # a corner triangle with legs of 0.5
        (-0.25, -0.25, math.pi / 4.0, 0.875),
    ],
)
def test_area_by_hand(x: float, y: float, angle_rad: float, share: float) -> None:
    assert area_behind(x, y, angle_rad) == pytest.approx(share, abs=1e-12)
