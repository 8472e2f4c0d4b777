"""Drawn alignment cases: a recorded map against a degraded copy of itself, transform known."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from slamfusion.align.records import Alignment
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from tests.support.datasets import MAPS, load_carpin
from tests.support.degrade import Degradation, degrade_map, draw_degradation

# Eight recorded places, from one home of 7 m to a floor of 140 m.
BASES = (
    "multi-slam/nanorobot-real/gmapping.yaml",
    "multi-slam/mit-csail/karto.yaml",
    "multi-slam/husky-lar-gazebo-sim/map_gmapping.yaml",
    "giraff/UMA_236_237.yaml",
    "giraff/map_05_03_2019_4.yaml",
    "strands/aaf_y4/y4_aaf-cropped.yaml",
    "carpin/intel.txt.gz",
    "carpin/LongRun6.txt.gz",
)


@dataclass(frozen=True)
class DrawnCase:
    """One case: the truth, the degraded map, and the transform between their map frames."""

    base: str
    truth: OccupancyGrid
    moving: OccupancyGrid
    transform: Pose2
    degradation: Degradation


@cache
def load_base(name: str) -> OccupancyGrid:
    """Load one of the recorded maps that cases are drawn from."""
    path = MAPS / name
    grid = load_carpin(path) if name.endswith(".txt.gz") else load_map(path)
    box = grid.known_box()
    assert box is not None
    return grid.crop(box).with_name(name)


def drawn_cases(per_base: int, seed: int, bases: tuple[str, ...] = BASES) -> Iterator[DrawnCase]:
    """Draw cases over the bases in turn; the same seed gives the same cases."""
    for index, name in enumerate(bases):
        truth = load_base(name)
        rng = np.random.default_rng([seed, index])
        for _ in range(per_base):
            degradation = draw_degradation(rng)
            moving, transform = degrade_map(truth, rng, degradation)
            yield DrawnCase(name, truth, moving.with_name("drawn"), transform, degradation)


def case_error(case: DrawnCase, alignment: Alignment) -> tuple[float, float]:
    """Return the displacement of the moving map's centre in cells, and the yaw error in degrees."""
    box = case.moving.known_box()
    assert box is not None
    size = case.moving.resolution
    middle = ((box.col0 + box.col1) / 2 * size, (box.row0 + box.row1) / 2 * size)
    centre = case.moving.origin.transform(middle)
    found, wanted = alignment.transform.transform(centre), case.transform.transform(centre)
    cell = min(case.truth.resolution, case.moving.resolution)
    turn = wrap_angle(alignment.transform.yaw_rad - case.transform.yaw_rad)
    return math.dist(found, wanted) / cell, abs(math.degrees(turn))
