"""The benchmark of the vote: its cases are repeatable, and its bars judge what they name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, IDENTITY, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.benchmarks.bench_vote import Figures, Fused, judge_bars, judge_pair, measure_case
from tests.benchmarks.vote_cases import Case, cases

GOOD = Figures(f1=0.99, error=80.0, thickness_m=0.07, doubled=0.05)
INPUTS = {
    "a": GOOD,
    "b": replace(GOOD, f1=0.98, error=100.0, thickness_m=0.09, doubled=0.10),
    "bent": Figures(f1=0.6, error=150.0, thickness_m=0.2, doubled=0.4),
}
TRUE = Figures(f1=1.0, error=0.0, thickness_m=0.05, doubled=0.0)


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, set()),
        ({"f1": 0.981}, set()),
        ({"f1": 0.979}, {"f1"}),
        ({"error": 98.9}, set()),  # 1.1 times the mean of 80 and 100 is 99
        ({"error": 99.1}, {"error"}),
        ({"thickness_m": 0.094}, set()),
        ({"thickness_m": 0.096}, {"thickness"}),
        ({"thickness_m": 0.06}, set()),  # nearer to the true walls than any input
        ({"thickness_m": 0.04}, {"thickness"}),
        ({"doubled": 0.109}, set()),
        ({"doubled": 0.111}, {"doubled"}),
    ],
)
def test_bars_compare_with_the_good_inputs_alone(
    changes: dict[str, float], missed: set[str]
) -> None:
    margins = judge_bars(replace(GOOD, **changes), INPUTS, TRUE)
    assert {bar for bar, margin in margins.items() if margin < 0.0} == missed


def test_inputs_that_cannot_be_aligned_miss_every_bar() -> None:
    assert set(judge_bars(None, INPUTS, TRUE).values()) == {-math.inf}


def room() -> OccupancyGrid:
    """Return a room of 6 m x 4 m with a wall across."""
    cells = np.full((84, 124), UNKNOWN, np.int8)
    cells[2:-2, 2:-2] = OCCUPIED
    cells[3:-3, 3:-3] = FREE
    cells[3:50, 61] = OCCUPIED
    return OccupancyGrid(cells, 0.05, Pose2(-1.0, 2.0), "truth")


def part(first: int, end: int) -> OccupancyGrid:
    """Return the room as it is known between two columns."""
    cells = np.full_like(room().cells, UNKNOWN)
    cells[:, first:end] = room().cells[:, first:end]
    return OccupancyGrid(cells, 0.05, room().origin, f"{first} to {end}")


def test_a_pair_adds_what_only_one_saw_and_keeps_what_both_saw() -> None:
    inputs = [(part(0, 80), IDENTITY), (part(45, 124), IDENTITY)]
    whole = judge_pair((room(), IDENTITY), inputs, room())
    assert whole == pytest.approx({"common": 0.01, "adds": 0.05})
    lacks = judge_pair((part(0, 80), IDENTITY), inputs, room())
    assert lacks["common"] == pytest.approx(0.01)
    assert lacks["adds"] < -0.3
    cells = room().cells.copy()
    cells[3:50, 61] = FREE  # of the common walls the one across is lost
    lost = OccupancyGrid(cells, 0.05, room().origin, "lost")
    assert judge_pair((lost, IDENTITY), inputs, room())["common"] < -0.2
    assert judge_pair((lost, IDENTITY), inputs, room())["adds"] == pytest.approx(0.05)


def test_a_map_is_measured_where_it_fits_best() -> None:
    pose = Pose2(3.0, -2.0, 0.7)
    origin = pose.inverse().compose(room().origin)
    moved = OccupancyGrid(room().cells, 0.05, origin, "moved")
    near = pose.compose(Pose2(0.2, -0.1, 0.02))
    case = Case("room", (moved, *(moved.with_name(name) for name in "bc")), {"thin": room()}, {})
    case = replace(case, poses={grid.name: near for grid in case.inputs})
    fused = {"as it is": Fused(moved, (near,)), "none": Fused(None, reason="apart")}
    rows = list(measure_case(case, fused, NumpyDevice()))
    assert [row.mode for row in rows] == ["as it is", "none"]
    assert rows[0].counts
    assert rows[0].fused is not None
    assert rows[0].fused.f1 == 1.0
    assert rows[0].fused.error < 5.0
    assert min(rows[0].margins.values()) >= 0.0
    assert rows[1].fused is None


def test_the_same_seed_gives_the_same_copies() -> None:
    first, again, other = (
        next(cases("degraded", seed, match="of office")).inputs for seed in (0, 0, 6)
    )
    assert [grid.name for grid in first] == [grid.name for grid in again]
    for grid, same in zip(first, again, strict=True):
        assert grid.cells.tobytes() == same.cells.tobytes()
    assert first[0].cells.tobytes() != other[0].cells.tobytes()
