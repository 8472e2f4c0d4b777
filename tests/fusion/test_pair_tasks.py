"""Alignments as tasks: the same as without, begun ahead, and as many at once as may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import AlignConfig, NormalizeConfig
from slamfusion.fleet import InProcess, Task
from slamfusion.fleet.packed import Kept, pack
from slamfusion.fusion import pair_tasks
from slamfusion.fusion.align import align_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import normalize_grid
from slamfusion.fusion.pair_tasks import AlignmentTasks, PairSettings, align_packed
from tests.support.sites import RESOLUTION, many_maps

SETTINGS = PairSettings(AlignConfig(prove=False), 21, thorough=False)
GRIDS = many_maps(7, 0, 200).grids


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


@pytest.fixture(scope="module")
def features(device: ComputeDevice) -> list[GridFeatures]:
    normalized = (normalize_grid(grid, RESOLUTION, NormalizeConfig(), device) for grid in GRIDS)
    return [GridFeatures(grid, device) for grid in normalized]


class Noting(InProcess):
    """Notes what is handed over."""

    def __init__(self, slots: int) -> None:
        super().__init__()
        self.slots = slots
        self.names: list[tuple[str, str]] = []

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Task[Any]:
        self.names.append((arguments[0].unpack().name, arguments[1].unpack().name))
        return super().submit(function, *arguments)


def test_a_grid_travels_small(features: list[GridFeatures]) -> None:
    grid = features[0].grid
    whole = grid.grid.cells.nbytes + grid.cells.nbytes + grid.solid.nbytes
    assert len(pack(grid).data) < 0.2 * whole  # noise and all


def test_an_alignment_of_a_task_is_that_of_this_process(
    features: list[GridFeatures], device: ComputeDevice
) -> None:
    scheduler = Noting(1)
    tasks = AlignmentTasks(scheduler, SETTINGS)
    given = features[0], features[1], None
    found = tasks.result(*given)
    assert tasks.result(*given) is found
    assert len(scheduler.names) == 1
    wanted = align_features(
        features[0], features[1], SETTINGS.config, device, pairs=21, thorough=False
    )
    assert replace(found, time_s=0.0, yaw_profile=None) == replace(
        wanted, time_s=0.0, yaw_profile=None
    )
    assert found.yaw_profile is not None
    assert wanted.yaw_profile is not None
    assert np.array_equal(found.yaw_profile, wanted.yaw_profile)


def test_pairs_begin_ahead_as_many_as_slots_take(features: list[GridFeatures]) -> None:
    scheduler = Noting(2)
    tasks = AlignmentTasks(scheduler, SETTINGS)
    assert tasks.ahead == 4
    for moving in features[1:]:
        tasks.begin(features[0], moving, None)
        tasks.begin(features[0], moving, None)
    names = [item.grid.name for item in features]
    assert scheduler.names == [(names[0], name) for name in names[1:5]]


def test_a_worker_keeps_the_fields_of_the_last_maps(
    features: list[GridFeatures], monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = sum(item.shape[0] * item.shape[1] for item in features[:3])
    monkeypatch.setattr(pair_tasks, "_KEPT", Kept(pair_tasks._cells, cells, least=2))
    monkeypatch.setattr(pair_tasks, "align_features", lambda a, b, *_, **__: (a, b))
    packed = [pack(item.grid) for item in features[:4]]

    def looked_at(a: int, b: int) -> tuple[Any, Any]:
        found: Any = align_packed(packed[a], packed[b], SETTINGS, None, "auto")
        return found

    first, second = looked_at(0, 1)
    assert looked_at(1, 0) == (second, first)
    for one, other in ((features[0].grid, first.grid), (features[1].grid, second.grid)):
        assert np.array_equal(one.grid.cells, other.grid.cells)
        for array, back in ((one.cells, other.cells), (one.solid, other.solid)):
            assert np.array_equal(array, back)
            assert not back.flags.writeable
    looked_at(2, 0)
    looked_at(3, 0)
    assert looked_at(0, 2)[0] is first
    assert looked_at(0, 1)[1] is not second
