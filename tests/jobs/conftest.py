"""A short drive in files, for the jobs on logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.io import write_carmen, write_tum
from slamfusion.trajectory import Trajectory
from tests.slam.drives import drive
from tests.support.searches import RememberedSearches


@pytest.fixture(autouse=True)
def _remembered(remembered_searches: RememberedSearches) -> None:
    """Many of these tests align the sample maps."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short drive, its true path and one known relation."""
    folder = tmp_path_factory.mktemp("place")
    scans, truth = drive(32)
    write_carmen(folder / "flat.log", scans)
    stamps = np.array([item.scan.stamp_s for item in scans])
    poses = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in truth])
    write_tum(folder / "truth.tum", Trajectory(stamps, poses, "truth"))
    motion = truth[0].inverse().compose(truth[30])
    line = f"0.0 3.0 {motion.x} {motion.y} 0 0 0 {motion.yaw_rad}\n"
    (folder / "flat.relations").write_text(line, encoding="utf-8")
    return folder
