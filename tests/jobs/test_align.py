"""``align_maps`` as a library: maps in memory and in files, the start, and failure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamfusion.align.starts import StartPose
from slamfusion.errors import MapFileError, StartError
from slamfusion.geometry import Pose2
from slamfusion.io import save_map
from slamfusion.jobs.align import AlignDocument, align_maps
from slamfusion.jobs.records import Circumstances
from slamfusion.json_values import plain
from tests.fusion.drawings import fusion_config
from tests.jobs.maps import CONFIG, device, moved
from tests.support.documents import check_document


def test_maps_in_memory_and_in_files_are_aligned_alike(tmp_path: Path) -> None:
    truth, grid, pose = moved()
    in_memory = align_maps(truth, grid, CONFIG, device())
    assert in_memory.accepted
    assert in_memory.transform.x == pytest.approx(pose.x, abs=0.05)
    assert in_memory.transform.yaw_rad == pytest.approx(pose.yaw_rad, abs=0.01)
    save_map(truth, tmp_path / "truth")
    save_map(grid, tmp_path / "moving")
    from_files = align_maps(
        tmp_path / "truth.yaml", str(tmp_path / "moving.yaml"), CONFIG, device()
    )
    assert (from_files.reference, from_files.moving) == ("truth", "moving")
    assert from_files.transform == in_memory.transform
    check_document(
        plain(AlignDocument(from_files, Circumstances(device().name, CONFIG), grid.resolution)),
        "align",
    )
    with pytest.raises(MapFileError, match="absent"):
        align_maps(truth, tmp_path / "absent.yaml", CONFIG, device())


def test_a_start_with_tolerances_is_searched_there_alone() -> None:
    truth, grid, pose = moved()
    away = pose.compose(Pose2(3.0, 3.0, 1.0))
    assert align_maps(truth, grid, CONFIG, device(), start=StartPose(pose, 0.2, 0.05)).accepted
    assert not align_maps(truth, grid, CONFIG, device(), start=StartPose(away)).accepted
    # A bare pose limits nothing without windows.
    assert align_maps(truth, grid, CONFIG, device(), start=away).accepted


def test_starts_in_the_settings_go_by_the_names_of_the_maps() -> None:
    truth, grid, pose = moved()
    values, away = (pose.x, pose.y, pose.yaw_rad), (pose.x + 4.0, pose.y, pose.yaw_rad + 1.0)

    def with_start(**named: tuple[float, ...]) -> bool:
        start = {name.replace("_", " "): given for name, given in named.items()}
        return align_maps(truth, grid, replace(CONFIG, start=start), device()).accepted

    assert (truth.name, grid.name) == ("building 3", "moving")
    assert with_start(moving=values)
    assert not with_start(moving=away)
    back = pose.inverse()
    assert with_start(building_3=(back.x, back.y, back.yaw_rad))
    world = Pose2(20.0, -3.0, 2.0)
    there = world.compose(pose)
    told = (there.x, there.y, there.yaw_rad)
    assert with_start(building_3=(world.x, world.y, world.yaw_rad), moving=told)
    assert not with_start(building_3=(world.x + 9.0, world.y, world.yaw_rad), moving=told)
    with pytest.raises(StartError, match="'other', which is no input"):
        with_start(other=values)


def test_windows_stand_for_the_tolerances_that_a_start_does_not_have() -> None:
    """As they did before starts had any: a start that is off by more than these finds nothing."""
    truth, grid, pose = moved()
    near = replace(CONFIG, fusion=fusion_config(window_m=0.3, window_yaw_rad=0.1))
    off = (pose.x + 1.0, pose.y, pose.yaw_rad)
    for start, is_found in ((off, False), ((*off, 2.0, 0.35), True)):
        assert align_maps(
            truth, grid, replace(near, start={"moving": start}), device()
        ).accepted is (is_found)
    assert not align_maps(truth, grid, near, device(), start=Pose2(*off)).accepted
    # Without windows the defaults hold.
    assert align_maps(truth, grid, replace(CONFIG, start={"moving": off}), device()).accepted
