"""Colours that must be told apart are, also by who sees no red or no green.

What they see is simulated with the matrices of Machado, Oliveira and Fernandes (IEEE TVCG 15(6),
2009, severity 1.0, on linear RGB); how far two colours are apart is their distance in CIE L*a*b*
(D65).
"""

from __future__ import annotations

import itertools
import re

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.palette import (
    DISAGREEMENT_RGB,
    END_RGB,
    FREE_RGB,
    NAMED,
    OTHERS,
    START_RGB,
    UNKNOWN_RGB,
    WALL_RGB,
    Rgb,
    colours_of,
)
from slamfusion.report import maps as plots
from tests.cli.command import ROOT

pytestmark = pytest.mark.once

# Two areas side by side are told apart from about 10 on; thin walls and lines need more.
LEAST_OF_AREAS, LEAST = 10.0, 20.0

SEEN = {
    "all": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def lab(rgb: Rgb, sight: str) -> npt.NDArray[np.float64]:
    """Return what somebody sees as L*, a*, b*."""
    value = np.array(rgb) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(SEEN[sight] @ linear, 0.0, 1.0) / (TO_XYZ @ np.ones(3))
    bent = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * bent[1] - 16, 500 * (bent[0] - bent[1]), 200 * (bent[1] - bent[2])])


def distance(one: Rgb, two: Rgb, sight: str) -> float:
    return float(np.linalg.norm(lab(one, sight) - lab(two, sight)))


TOGETHER = {
    "layers and paths": (*NAMED.values(), *OTHERS, DISAGREEMENT_RGB, FREE_RGB),
    "start and end": (START_RGB, END_RGB),
    "difference": tuple(rgb for text, rgb in plots.DIFFERENCES.values() if text.endswith("wall")),
}


@pytest.mark.parametrize("sight", SEEN)
@pytest.mark.parametrize("name", TOGETHER)
def test_colours_are_told_apart(name: str, sight: str) -> None:
    near = {
        (one, two): distance(one, two, sight)
        for one, two in itertools.combinations(TOGETHER[name], 2)
    }
    assert min(near.values()) >= LEAST, near


@pytest.mark.parametrize("sight", SEEN)
def test_classes_of_cells_are_told_apart(sight: str) -> None:
    classes = itertools.combinations((UNKNOWN_RGB, FREE_RGB, WALL_RGB), 2)
    assert min(distance(*pair, sight) for pair in classes) >= LEAST_OF_AREAS


def test_a_name_keeps_its_colour_whoever_else_is_shown() -> None:
    assert colours_of(["graph", "tinyslam"]) == {
        "graph": NAMED["graph"], "tinyslam": NAMED["tinyslam"],
    }  # fmt: skip
    few = colours_of(["left", "graph", "right"])
    assert list(few.values()) == [OTHERS[0], NAMED["graph"], OTHERS[1]]
    # Who comes later changes nobody's colour.
    assert few.items() < colours_of(["left", "graph", "right", "gmapping", "third"]).items()


def test_no_two_of_many_names_have_one_colour() -> None:
    names = [*NAMED, *(f"map {number}" for number in range(200))]
    colours = colours_of(names)
    assert list(colours) == names
    assert len(set(colours.values())) == len(names)


def test_colours_stand_in_the_palette_alone() -> None:
    """Neither Python nor JavaScript repeats one; style sheets have those of the page itself."""
    number = r"\s*\d{1,3}\s*"
    colour = re.compile(rf"[(\[]{number},{number},{number}[)\]]|[\"\']#[0-9a-fA-F]{{6}}[\"\']|tab:")
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for folder in ("report", "web")
        for path in (ROOT / "slamfusion" / folder).rglob("*")
        if path.suffix in {".py", ".js"}
        for match in colour.finditer(path.read_text(encoding="utf-8"))
    ]
    assert found == ["slamfusion/web/static/stage.js: [0, 0, 0]"], "an origin, no colour"
