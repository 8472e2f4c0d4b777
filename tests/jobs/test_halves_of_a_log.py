"""A recorded log cut by time into two halves that share a part of the way, as two robots' logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import RunConfig
from slamfusion.io import open_log
from slamfusion.io.carmen import write_carmen
from slamfusion.jobs.align import align_maps
from slamfusion.jobs.map_log import map_log
from tests.support.datasets import DATASETS
from tests.support.two_robots import cut_scans, off_by_m, off_by_rad

LOG = DATASETS / "mit-csail" / "mit-csail.clf.gz"
BEST = DATASETS / "mit-csail" / "mit-csail-estimate-1592.txt.gz"

pytestmark = [
    pytest.mark.datasets,
    pytest.mark.full,
    pytest.mark.skipif(not LOG.exists(), reason=f"the recorded log is not at {LOG}"),
]


@pytest.mark.parametrize("overlap", [0.6, 0.4, 0.2])
def test_halves_of_a_recorded_log_come_together(tmp_path: Path, overlap: float) -> None:
    scans = list(open_log(LOG))
    stamps, poses = best_poses()
    near = [int(np.abs(stamps - item.scan.stamp_s).argmin()) for item in scans]
    halves = cut_scans(scans, poses[near], overlap)
    device, grids = open_device(), []
    for name, half in zip("ab", halves.scans, strict=True):
        path = tmp_path / f"{name}.log"
        write_carmen(path, half)
        grids.append(map_log(path, "graph", RunConfig(), device).grid.with_name(name))
    pair = align_maps(grids[0], grids[1], RunConfig(), device)
    off_m = off_by_m(pair.transform, halves.second_in_first)
    off_rad = off_by_rad(pair.transform, halves.second_in_first)
    said = f"{overlap:.0%}: {off_m:.3f} m, {off_rad:.4f} rad off; {pair.reason}"
    print(said)
    if pair.accepted or overlap >= 0.4:
        assert pair.accepted, said
        assert off_m <= 0.5, said
        assert off_rad <= 0.05, said


def best_poses() -> tuple[np.ndarray, np.ndarray]:
    """Return stamps (s) and poses (m, rad) of the best estimate of the path known."""
    stamps = np.loadtxt(BEST, usecols=0, dtype=np.int64) / 1e9
    return stamps, np.loadtxt(BEST, usecols=(1, 2, 3))
