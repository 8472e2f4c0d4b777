"""The picture of a graph: lines where closures pull, in the colour of what is believed."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.config import NormalizeConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.palette import DISAGREEMENT_RGB, NAMED, OTHERS, Rgb
from slamfusion.report.paths import closures_picture
from slamfusion.slam.common.mapper import Closure
from slamfusion.trajectory import Trajectory
from tests.report.drawn import near, pixels

NORMALIZE = NormalizeConfig()
COLOURS = (NAMED["graph"], OTHERS[0], DISAGREEMENT_RGB)
_, BELIEVED, OUTLIER = COLOURS
GRID = OccupancyGrid(np.zeros((100, 100), dtype=np.int8), 0.1, Pose2(), "graph")


def straight(end_m: float) -> Trajectory:
    """A way along x from 1 m, a pose a second."""
    poses = np.zeros((11, 3))
    poses[:, 0], poses[:, 1] = np.linspace(1.0, end_m, 11), 5.0
    return Trajectory(np.arange(11.0), poses, "graph")


def painted(figure: Any, colour: Rgb) -> npt.NDArray[np.intp]:
    """Return columns of the pixels of about a colour, without the legend below."""
    image = pixels(figure)
    return np.nonzero(near(image[: round(0.85 * len(image))], colour, 39))[1]


def picture(path: Trajectory, weight: float) -> Any:
    closure = Closure(0.0, 8.0, Pose2(3.2, 0.0, 0.0), weight)
    return closures_picture(path, [closure], GRID.classified(NORMALIZE)).figure


def test_a_closure_that_holds_is_a_dot_and_one_that_does_not_a_line() -> None:
    held, pulled = (painted(picture(straight(end), 1.0), BELIEVED) for end in (5.0, 9.0))
    assert 0 < np.ptp(held) < 12
    assert np.ptp(pulled) > 150


def test_an_outlier_is_told_apart() -> None:
    png = picture(straight(9.0), 0.0)
    assert len(painted(png, OUTLIER)) > len(painted(picture(straight(9.0), 1.0), OUTLIER))
    assert len(painted(png, BELIEVED)) == 0


def test_the_legend_counts_outliers_and_has_the_colours_of_the_lines() -> None:
    closure = Closure(0.0, 10.0, Pose2(4.0, 0.0, 0.0), 0.2)
    shown = closures_picture(straight(5.0), [closure], GRID.classified(NORMALIZE))
    assert list(shown.legend)[2] == "outliers, not used: 1"
    assert tuple(shown.legend.values())[:3] == COLOURS
