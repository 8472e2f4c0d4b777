"""Alignments by an executor: the same as without, begun ahead, as many at once as may be."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, NormalizeConfig
from slamfusion.fusion.pair_tasks import AlignmentTasks
from tests.support.sites import RESOLUTION, many_maps

ALIGN = partial(align_pair, config=AlignConfig(), pairs=21, thorough=False)
GRIDS = many_maps(7, 0, 200).grids


@pytest.fixture(scope="module")
def features(device: ComputeDevice) -> list[GridFeatures]:
    normalized = (normalize_grid(grid, RESOLUTION, NormalizeConfig(), device) for grid in GRIDS)
    return [GridFeatures(grid, device) for grid in normalized]


class Noting(Executor):
    """Notes what is handed over, and does it where it works at all."""

    def __init__(self, slots: int, *, works: bool = True) -> None:
        self.slots, self._works = slots, works
        self.packed: list[tuple[Any, ...]] = []

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        self.packed.append(arguments[:2])
        future: Future[Any] = Future()
        if self._works:
            future.set_result(function(*arguments))
        return future


def test_an_alignment_of_a_task_is_that_of_this_process(features: list[GridFeatures]) -> None:
    executor = Noting(1)
    tasks = AlignmentTasks(executor, ALIGN)
    given = Pair(features[0], features[1]), None
    found = tasks.result(*given)
    assert tasks.result(*given) is found
    assert len(executor.packed) == 1
    (data, _), _ = executor.packed[0]
    assert len(data) < 0.2 * 3 * math.prod(features[0].shape)  # a grid travels small
    wanted = ALIGN(Pair(features[0], features[1]))
    assert replace(found, time_s=0.0, yaw_profile=None) == replace(
        wanted, time_s=0.0, yaw_profile=None
    )
    assert found.yaw_profile is not None
    assert wanted.yaw_profile is not None
    assert np.array_equal(found.yaw_profile, wanted.yaw_profile)
