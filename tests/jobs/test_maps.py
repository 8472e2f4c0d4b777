"""Jobs on maps, used as a library: fuse, align, evaluate, and the files that they write."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, MapFileError, SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, load_map, save_map
from slamfusion.jobs.align import align_document, align_maps
from slamfusion.jobs.documents import plain
from slamfusion.jobs.evaluate import (
    evaluate_document,
    evaluate_maps,
    measure_distances,
    write_evaluation,
)
from slamfusion.jobs.fuse import (
    AllRequiredError,
    failed_fuse_document,
    fuse_maps,
    save_fused_maps,
    write_failed_fusion,
)
from slamfusion.jobs.fuse_drive import fuse_drive
from slamfusion.trajectory import Trajectory
from tests.fusion.drawings import building, degraded, fusion_config
from tests.support.documents import check_document

DEVICE = NumpyDevice()
CONFIG = replace(RunConfig(), fusion=fusion_config())


def moved(seed: int = 3) -> tuple[OccupancyGrid, OccupancyGrid, Pose2]:
    """A building, a map of it in another frame, and where that lies."""
    truth = building(seed)
    grid, pose = degraded(truth, 1, shift_share=(0.1, -0.05), yaw_rad=0.2)
    return truth, grid, pose


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


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


def test_maps_are_measured_where_they_lie_or_aligned(tmp_path: Path) -> None:
    truth, grid, _ = moved()
    told: list[tuple[str, int, int]] = []
    aligned, itself = evaluate_maps(
        [grid, truth], truth, CONFIG, DEVICE, progress=lambda *words: told.append(words)
    )
    (as_it_lies,) = evaluate_maps([grid], truth, CONFIG, DEVICE, align=False)
    assert aligned.is_aligned
    assert as_it_lies.alignment is None
    assert itself.error.error == 0.0
    assert 0.0 < aligned.error.error < 0.5 * as_it_lies.error.error
    assert told == [("evaluate", 0, 2), ("evaluate", 1, 2), ("evaluate", 2, 2)]

    write_evaluation(
        [aligned, itself], CONFIG, report=tmp_path / "report", image=tmp_path / "image.png"
    )
    assert {"report/report.html", "image_moving.png", "image_building 3.png"} <= files(tmp_path)
    document = evaluate_document([aligned], [], CONFIG, truth=Path("t.yaml"), device=DEVICE.name)
    check_document(plain(document), "evaluate")
    assert document["maps"][0]["error"] == aligned.error.error


def test_an_evaluation_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    truth, *_ = moved()
    found = evaluate_maps([truth], truth, CONFIG, DEVICE)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(MapFileError, match=r"folder\.png: cannot write"):
        write_evaluation(found, CONFIG, report=tmp_path / "report", image=tmp_path / "folder.png")
    assert not files(tmp_path)
    assert not (tmp_path / "report").exists()


def test_measured_distances_are_compared(tmp_path: Path) -> None:
    truth, *_ = moved()
    with pytest.raises(MapFileError, match="absent"):
        measure_distances([truth], tmp_path / "absent.csv")


def test_maps_are_fused_measured_and_written(tmp_path: Path) -> None:
    truth, grid, _ = moved()
    other, _ = degraded(truth, 2, "other", yaw_rad=-0.4)
    told: list[str] = []
    fused = fuse_maps(
        [truth, grid, other],
        CONFIG,
        DEVICE,
        truth=truth,
        progress=lambda *words: told.append(words[0]),
    )
    assert len(fused.result.accepted) == 3
    assert [item.error.name for item in fused.evaluations][-1] == "fused"
    assert "evaluate" in told
    (tmp_path / "report" / "failed").mkdir(parents=True)
    (tmp_path / "report" / "failed" / "report.html").write_text("old", encoding="utf-8")
    document = save_fused_maps(fused, tmp_path / "all", report=tmp_path / "report")
    check_document(plain(document), "fuse")
    assert document["fused"] == str(tmp_path / "all.yaml")
    assert load_map(document["fused"]).cells.tolist() == fused.grid.cells.tolist()
    assert load_map(document["agreement"]).cells.tolist() == fused.agreement.cells.tolist()
    # The report of a fusion that failed before goes with its folder.
    assert not (tmp_path / "report" / "failed").exists()
    assert (tmp_path / "report" / "report.html").exists()


def test_files_of_a_caller_are_joined_and_stay_out_where_it_fails(tmp_path: Path) -> None:
    truth, grid, _ = moved()
    fused = fuse_maps([truth, grid], CONFIG, DEVICE)
    (tmp_path / "taken.pgm").mkdir()

    def save_both() -> None:
        with AtomicFiles() as together:
            save_fused_maps(fused, tmp_path / "fused", files=together)
            save_map(truth, tmp_path / "taken", files=together)

    with pytest.raises(MapFileError, match="taken"):
        save_both()
    assert not files(tmp_path)


def test_maps_that_do_not_fit_are_refused_with_what_was_tried(tmp_path: Path) -> None:
    grids = [building(3), building(4)]
    with pytest.raises(AlignmentError) as caught:
        fuse_maps(grids, CONFIG, DEVICE)
    assert len(caught.value.pairs) == 1
    document = failed_fuse_document(caught.value, grids, CONFIG, DEVICE.name)
    check_document(plain(document), "fuse", failed=True)
    assert document["fused"] is None
    first = write_failed_fusion(caught.value, grids, CONFIG, tmp_path, device=DEVICE.name)
    assert first == tmp_path / "report.html"
    # An earlier report is not replaced.
    again = write_failed_fusion(caught.value, grids, CONFIG, tmp_path, device=DEVICE.name)
    assert again == tmp_path / "failed" / "report.html"


def test_all_of_them_may_be_required() -> None:
    truth, grid, _ = moved()
    maps = [truth, grid, building(4)]
    assert len(fuse_maps(maps, CONFIG, DEVICE).result.rejected) == 1
    strict = replace(CONFIG, fusion=replace(CONFIG.fusion, require_all=True))
    with pytest.raises(AllRequiredError, match=r"building 4 .*nothing was fused") as caught:
        fuse_maps(maps, strict, DEVICE)
    assert len(caught.value.result.accepted) == 2


@pytest.mark.parametrize("maps", [[], [building(3)]])
def test_one_map_alone_is_no_fusion(maps: list[OccupancyGrid]) -> None:
    with pytest.raises(SlamFusionError, match="fuse needs at least two"):
        fuse_maps(maps, CONFIG, DEVICE)


def test_where_nothing_is_fused_a_map_to_go_on_with_is_named() -> None:
    grids = [building(3).with_name("a"), building(4).with_name("b")]
    paths = {
        name: Trajectory(np.arange(2.0), np.array([[0.0, 0, 0], [9.0 * index, 0, 0]]))
        for index, name in enumerate("ab")
    }
    none = fuse_drive([], {}, CONFIG, DEVICE, shared_frame=True)
    assert (none.result, none.best_founded) == (None, None)
    assert "none of at least 2" in str(none.failure)
    single = fuse_drive(grids[:1], paths, CONFIG, DEVICE, shared_frame=True)
    assert single.best_founded is grids[0]
    apart = fuse_drive(grids, paths, CONFIG, DEVICE, shared_frame=False)
    assert apart.result is None
    assert apart.best_founded in grids
    assert len(apart.pairs) == 1
    assert isinstance(apart.failure, AlignmentError)
