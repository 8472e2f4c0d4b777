"""Cell sizes too coarse or too fine for the others."""

from __future__ import annotations

import pytest

from slamfusion.fusion.resolutions import odd_resolution, odd_resolutions


@pytest.mark.parametrize("ratio", [15.9, 16.1])
def test_cells_may_be_sixteen_times_coarser_or_finer(ratio: float) -> None:
    is_odd = ratio > 16.0
    assert (odd_resolution(0.05 * ratio, 0.05) is not None) is is_odd
    assert (odd_resolution(0.05 / ratio, 0.05) is not None) is is_odd
    found = odd_resolutions({"a": 0.05, "b": 0.05 * ratio, "c": 0.05})
    assert list(found) == (["b"] if is_odd else [])
    assert odd_resolutions({}) == {}


def test_of_two_the_coarser_is_typical() -> None:
    found = odd_resolutions({"fine": 0.01, "coarse": 1.0})
    assert list(found) == ["fine"]
    assert "finer than those of the others (1 m)" in found["fine"]


def test_sixteen_times_is_not_odd_and_equal_is_neither() -> None:
    assert odd_resolution(16.0, 1.0) is odd_resolution(1.0, 16.0) is None
    assert "coarser" in (odd_resolution(16.1, 1.0) or "")
    assert "finer" in (odd_resolution(1.0, 16.1) or "")
    four = {"a": 0.01, "b": 0.01, "c": 1.0, "d": 1.0}
    assert list(odd_resolutions(four)) == ["a", "b"]


@pytest.mark.parametrize(("size", "is_said"), [(50.0, True), (5.0, True), (4.9, False)])
def test_a_factor_of_a_hundred_or_more_asks_for_the_units(size: float, *, is_said: bool) -> None:
    assert ("in other units" in (odd_resolution(size, 0.05) or "")) == is_said
    assert ("in other units" in (odd_resolution(0.05, size) or "")) == is_said
