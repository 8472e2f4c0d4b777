"""Paths of a drive of an experiment: weighed as in ``run``, and the layers that come of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.evidence.drawn_map import draw_map, drawn_scans
from slamfusion.experiments.drive_paths import (
    CHOICE,
    FUSED_PATH,
    drive_layers,
    judge_scans,
    weigh_paths,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, moved, recorded

TRUTH = circuit()
SCANS = recorded(TRUTH)
NEAR = Trajectory(TRUTH.stamps_s, TRUTH.poses + np.array([0.0, 0.0, 0.001]))
PATHS = {"tinyslam": NEAR, "gmapping": moved(TRUTH, (0.9, 1.2, 0.0), 108), "graph": TRUTH}
FED = dict.fromkeys(PATHS, SCANS)


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


@pytest.fixture(scope="module")
def maps(device: ComputeDevice) -> Mapping[str, OccupancyGrid]:
    drawn = drawn_scans(SCANS)
    return {
        name: draw_map(drawn, path, device, resolution=0.05, name=name)
        for name, path in PATHS.items()
    }


def test_who_left_the_others_votes_in_part_and_is_filled(
    device: ComputeDevice, maps: Mapping[str, OccupancyGrid]
) -> None:
    notes: dict[str, str] = {}
    weighed = weigh_paths(judge_scans(SCANS, notes), PATHS, device, notes)
    assert notes == {}
    assert set(weighed.paths) == {*PATHS, FUSED_PATH}
    assert weighed.choice in {"tinyslam", "graph"}
    layers = drive_layers(list(maps.values()), weighed, SCANS, FED, device)
    (vote,) = layers.partial
    assert (vote.name, vote.filled) == ("gmapping", True)
    assert weighed.exclusions is not None
    assert vote.excluded_share == pytest.approx(0.25, abs=0.01)
    # Without it, nobody has left the others, and the fused path is another one.
    rest = weighed.without("gmapping", device, notes)
    assert set(rest.paths) == {"tinyslam", "graph", FUSED_PATH}
    kept = [maps[name] for name in ("tinyslam", "graph")]
    assert drive_layers(kept, rest, SCANS, FED, device).grids == tuple(kept)


def test_where_scans_cannot_be_asked_all_vote(
    device: ComputeDevice, maps: Mapping[str, OccupancyGrid]
) -> None:
    notes: dict[str, str] = {}
    weighed = weigh_paths(judge_scans(SCANS[:20], notes), PATHS, device, notes)
    assert list(notes) == [CHOICE]
    assert (weighed.choice, weighed.evidence, weighed.exclusions) == ("", None, None)
    layers = drive_layers(list(maps.values()), weighed, SCANS[:20], FED, device)
    assert (layers.grids, layers.partial) == (tuple(maps.values()), ())
    rest = weighed.without("graph", device, notes)
    assert set(rest.paths) == {"tinyslam", "gmapping", FUSED_PATH}
