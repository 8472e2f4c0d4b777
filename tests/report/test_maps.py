"""The shared parts of reports: overlays of pairs, tables, marks of the best."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from slamfusion.config import NormalizeConfig
from slamfusion.evaluation.map_error import compare_to_truth
from slamfusion.geometry import Pose2
from slamfusion.grid import ClassifiedGrid
from slamfusion.palette import NAMED
from slamfusion.report.maps import error_section, input_colours, map_statistics, pair_overlay
from tests.report.drawn import alignment, room

NORMALIZE = NormalizeConfig()
COLOURS = input_colours(["a", "b"])


def shown(name: str, seed: int) -> ClassifiedGrid:
    return room(name, seed).classified(NORMALIZE)


def test_the_overlay_of_a_rejected_pair_is_marked_if_there_is_something_to_draw() -> None:
    found = alignment("a", "b", accepted=False)
    far = replace(found, transform=Pose2(1e5, 1e5))
    assert pair_overlay(shown("a", 1), shown("b", 2), far, COLOURS) is None
    unknown = replace(shown("b", 2), cells=np.full((5, 5), -1, dtype=np.int8))
    assert pair_overlay(shown("a", 1), unknown, found, COLOURS) is None
    picture = pair_overlay(shown("a", 1), shown("b", 2), found, COLOURS)
    assert picture.badge == "rejected"
    assert picture.legend == COLOURS


def test_an_input_has_no_colour_of_another_nor_of_the_fused_map() -> None:
    colours = input_colours(["fused", "graph", "a"])
    assert colours["graph"] == NAMED["graph"]
    assert len({*colours.values(), NAMED["fused"]}) == 4


def rows(tables: str) -> list[list[str]]:
    """Return the cells of each row, each as its classes and its text."""
    return [
        re.findall(r'<td class="(.*?)</td>', row) for row in re.findall(r"<tr>(.*)</tr>", tables)
    ]


def test_the_best_of_each_measure_is_marked() -> None:
    truth = room("truth", 7)
    errors = [compare_to_truth(grid, truth) for grid in (room("worse", 0), room("equal", 7))]
    _, worse, equal, *_ = rows(error_section(errors, [None, None]).tables)
    assert len(worse) == len(equal) > 5
    assert all(cell.startswith("best number") for cell in equal[1:])
    assert worse[1].startswith("plain number")


def test_the_statistics_state_the_known_area() -> None:
    _, row = rows(map_statistics([shown("a", 1)]))
    assert row[3] == f'plain number">{32 * 52 * 0.05**2:.1f}'
