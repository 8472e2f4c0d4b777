"""The fusion of the maps of one drive."""

from __future__ import annotations

import numpy as np

from slamfusion.errors import AlignmentError
from slamfusion.jobs.fuse_drive import fuse_drive
from slamfusion.trajectory import Trajectory
from tests.fusion.drawings import building
from tests.jobs.maps import CONFIG, device


def test_where_nothing_is_fused_a_map_to_go_on_with_is_named() -> None:
    grids = [building(3).with_name("a"), building(4).with_name("b")]
    paths = {
        name: Trajectory(np.arange(2.0), np.array([[0.0, 0, 0], [9.0 * index, 0, 0]]))
        for index, name in enumerate("ab")
    }
    none = fuse_drive([], {}, CONFIG, device(), shared_frame=True)
    assert (none.result, none.fallback) == (None, None)
    assert "needs at least 2 maps, found 0" in str(none.failure)
    single = fuse_drive(grids[:1], paths, CONFIG, device(), shared_frame=True)
    assert single.fallback is grids[0]
    apart = fuse_drive(grids, paths, CONFIG, device(), shared_frame=False)
    assert apart.result is None
    assert apart.fallback in grids
    assert len(apart.pairs) == 1
    assert isinstance(apart.failure, AlignmentError)
