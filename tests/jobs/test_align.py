"""``align_maps`` as a library: maps in memory and in files, the start, and failure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamfusion.errors import MapFileError
from slamfusion.geometry import Pose2
from slamfusion.io import save_map
from slamfusion.jobs.align import align_document, align_maps
from slamfusion.jobs.documents import plain
from tests.fusion.drawings import fusion_config
from tests.jobs.maps import CONFIG, DEVICE, moved
from tests.support.documents import check_document


def test_maps_in_memory_and_in_files_are_aligned_alike(tmp_path: Path) -> None:
    truth, grid, pose = moved()
    in_memory = align_maps(truth, grid, CONFIG, DEVICE)
    assert in_memory.accepted
    assert in_memory.transform.x == pytest.approx(pose.x, abs=0.05)
    assert in_memory.transform.yaw_rad == pytest.approx(pose.yaw_rad, abs=0.01)
    save_map(truth, tmp_path / "truth")
    save_map(grid, tmp_path / "moving")
    from_files = align_maps(tmp_path / "truth.yaml", str(tmp_path / "moving.yaml"), CONFIG, DEVICE)
    assert (from_files.reference, from_files.moving) == ("truth", "moving")
    assert from_files.transform == in_memory.transform
    check_document(plain(align_document(from_files, CONFIG, DEVICE.name)), "align")
    with pytest.raises(MapFileError, match="absent"):
        align_maps(truth, tmp_path / "absent.yaml", CONFIG, DEVICE)


def test_the_start_of_the_search_is_where_it_begins() -> None:
    truth, grid, pose = moved()
    near = replace(CONFIG, fusion=fusion_config(window_m=0.2, window_yaw_rad=0.05))
    assert align_maps(truth, grid, near, DEVICE, start=pose).accepted
    assert not align_maps(truth, grid, near, DEVICE, start=Pose2(9.0, 9.0, 2.0)).accepted
