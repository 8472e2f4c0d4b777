"""The pictures of the experiments: every line and bar is there, and nothing is cut off."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.palette import NAMED, OTHERS
from slamfusion.report.experiment_report import (
    Line,
    Panel,
    cell_values_picture,
    sweep_picture,
)

FIRST, SECOND = OTHERS[:2]
SIZES = (0.1, 0.2, 0.3)


def pixels(png: bytes) -> npt.NDArray[np.uint8]:
    """Red, green, blue, opacity."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image[..., (2, 1, 0, 3)], dtype=np.uint8)


def count(image: npt.NDArray[np.uint8], rgb: tuple[int, int, int]) -> int:
    return int(((image[..., :3] == rgb).all(axis=-1) & (image[..., 3] == 255)).sum())


def sweep(*lines: Line, title: str = "office") -> npt.NDArray[np.uint8]:
    return pixels(sweep_picture([Panel(title, lines)], x_label="cell size in m", y_label="error"))


def test_each_line_has_its_colour() -> None:
    old, new = Line("constant", SIZES, (1.0, 2.0, 3.0)), Line("area", SIZES, (1.0, 1.5, 2.0))
    assert count(sweep(old, new), FIRST) > 200
    assert count(sweep(old, new), SECOND) > 200
    assert count(sweep(old), SECOND) == 0
    assert count(sweep(old, Line("graph", SIZES, (1.0, 1.5, 2.0))), NAMED["graph"]) > 200


def test_deviations_are_drawn_as_bars() -> None:
    plain, bars = (
        sweep(Line("constant", SIZES, (2.0, 2.0, 2.0), spread)) for spread in ((), (1.0, 1.0, 1.0))
    )
    # A bar of half the height of the axes adds far more than the caps.
    assert count(bars, FIRST) > count(plain, FIRST) + 300


def test_every_panel_adds_its_height() -> None:
    line = Line("constant", SIZES, (1.0, 2.0, 3.0))
    one, two = (
        pixels(sweep_picture([Panel("a", [line])] * panels, x_label="x", y_label="y"))
        for panels in (1, 2)
    )
    assert two.shape[1] == one.shape[1]
    assert two.shape[0] > 1.7 * one.shape[0]


def test_nothing_touches_the_edge() -> None:
    lines = [Line(f"a rather long name {index}", SIZES, (1.0, 2.0, 3.0)) for index in range(2)]
    image = sweep(*lines)
    edge = np.concatenate((image[:2], image[-2:])), np.concatenate((image[:, :2], image[:, -2:]))
    assert all(not strip[..., 3].any() for strip in edge)


def test_one_size_alone_can_be_drawn() -> None:
    assert count(sweep(Line("constant", (0.4,), (1.0,), (0.2,))), FIRST) > 20


@pytest.mark.parametrize("title", ["$x_{", r"a\b", "名前", "50 %"])
def test_names_are_never_formulas(title: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a font without these letters draws boxes
        assert count(sweep(Line(title, SIZES, (1.0, 2.0, 3.0)), title=title), FIRST) > 200


def test_a_cell_s_values_are_drawn_line_by_line() -> None:
    lines = [Line(name, range(4), (0.5, height, height, height)) for name, height in
             (("a", 0.2), ("b", 0.4), ("c", 0.6), ("d", 0.8))]  # fmt: skip
    image = pixels(cell_values_picture([Panel("cell", lines)]))
    assert all(count(image, colour) > 100 for colour in OTHERS)
