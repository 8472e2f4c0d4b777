"""Cell sizes too coarse or too fine for the others."""

from __future__ import annotations

import pytest

from slamfusion.fusion.inputs import odd_resolution, odd_resolutions


@pytest.mark.parametrize("ratio", [15.9, 16.1])
def test_cells_may_be_sixteen_times_coarser_or_finer(ratio: float) -> None:
    is_odd = ratio > 16.0
    assert (odd_resolution(0.05 * ratio, 0.05) is not None) is is_odd
    assert (odd_resolution(0.05 / ratio, 0.05) is not None) is is_odd
    found = odd_resolutions({"a": 0.05, "b": 0.05 * ratio, "c": 0.05})
    assert list(found) == (["b"] if is_odd else [])
    assert odd_resolutions({}) == {}


@pytest.mark.parametrize(("size", "is_said"), [(50.0, True), (5.0, True), (4.9, False)])
def test_a_factor_of_a_hundred_or_more_asks_for_the_units(size: float, *, is_said: bool) -> None:
    assert ("in other units" in (odd_resolution(size, 0.05) or "")) == is_said
    assert ("in other units" in (odd_resolution(0.05, size) or "")) == is_said
