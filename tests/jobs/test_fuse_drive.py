"""Producers on a drive in memory, and the fusion of their maps."""

from __future__ import annotations

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.errors import (
    AlignmentError,
)
from slamfusion.jobs.fuse_drive import fuse_drive, produce_maps
from slamfusion.trajectory import Trajectory
from tests.fusion.drawings import building
from tests.jobs.maps import CONFIG, device
from tests.support.producers import room_drive


def test_a_producer_that_fails_is_named_and_the_others_go_on() -> None:
    scans = room_drive(6)
    told: list[str] = []
    made = produce_maps(
        {"tinyslam": scans, "graph": []},
        RunConfig(),
        device(),
        lambda *words: told.append(words[0]),
    )
    assert [grid.name for grid in made.grids] == ["tinyslam"]
    assert made.maps["graph"] is None
    assert "graph could use none of 0 scans" in made.reasons["graph"]
    assert set(made.paths) == {"tinyslam"}
    assert told == ["tinyslam"] * 6


def test_where_nothing_is_fused_a_map_to_go_on_with_is_named() -> None:
    grids = [building(3).with_name("a"), building(4).with_name("b")]
    paths = {
        name: Trajectory(np.arange(2.0), np.array([[0.0, 0, 0], [9.0 * index, 0, 0]]))
        for index, name in enumerate("ab")
    }
    none = fuse_drive([], {}, CONFIG, device(), shared_frame=True)
    assert (none.result, none.fallback) == (None, None)
    assert "none of at least 2" in str(none.failure)
    single = fuse_drive(grids[:1], paths, CONFIG, device(), shared_frame=True)
    assert single.fallback is grids[0]
    apart = fuse_drive(grids, paths, CONFIG, device(), shared_frame=False)
    assert apart.result is None
    assert apart.fallback in grids
    assert len(apart.pairs) == 1
    assert isinstance(apart.failure, AlignmentError)
