"""``fuse_maps`` as a library: the fused map, its files, and maps that do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamfusion.config import VoteConfig
from slamfusion.errors import AlignmentError, ConfigError, SlamFusionError
from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map
from slamfusion.jobs import fuse_documents
from slamfusion.jobs.fuse import AllRequiredError, fuse_maps, save_fused_maps, write_failed_fusion
from slamfusion.jobs.fuse_documents import DoubledWalls, FuseDocument
from slamfusion.jobs.records import Circumstances
from slamfusion.json_values import plain
from tests.fusion.drawings import building, degraded
from tests.jobs.maps import CONFIG, device, moved
from tests.support.documents import check_document

pytestmark = pytest.mark.once


def test_maps_are_fused_measured_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, grid, _ = moved()
    other, _ = degraded(truth, 2, "fused", yaw_rad=-0.4)
    told: list[str] = []
    with monkeypatch.context() as patched:
        # The errors against the truth have the inputs' doubled walls.
        patched.setattr(fuse_documents, "doubled_wall_share", lambda *_, **__: pytest.fail("again"))
        fused = fuse_maps(
            [truth, grid, other],
            CONFIG,
            device(),
            truth=truth,
            progress=lambda *words: told.append(words[0]),
        )
    assert fused.doubled == DoubledWalls.of(fused.result, CONFIG)
    assert len(fused.result.accepted) == 3
    assert [item.name for item in fused.evaluations][-1] == "fused"
    assert "evaluate" in told
    (tmp_path / "report" / "failed").mkdir(parents=True)
    (tmp_path / "report" / "failed" / "report.html").write_text("old", encoding="utf-8")
    document = save_fused_maps(fused, tmp_path / "all", report=tmp_path / "report")
    check_document(plain(document), "fuse")
    assert (document.fused, document.agreement) == (
        str(tmp_path / "all.yaml"),
        str(tmp_path / "all_agreement.yaml"),
    )
    assert load_map(document.fused).cells.tolist() == fused.grid.cells.tolist()
    assert load_map(document.agreement).cells.tolist() == fused.agreement.cells.tolist()
    # The report of a fusion that failed before goes with its folder.
    assert not (tmp_path / "report" / "failed").exists()
    assert (tmp_path / "report" / "report.html").exists()


def test_maps_that_do_not_fit_are_refused_with_what_was_tried(tmp_path: Path) -> None:
    grids = [building(3), building(4)]
    with pytest.raises(AlignmentError) as caught:
        fuse_maps(grids, CONFIG, device())
    assert len(caught.value.pairs) == 1
    document = FuseDocument.failed(caught.value, Circumstances(device().name, CONFIG))
    check_document(plain(document), "fuse", failed=True)
    assert document.fused is None
    first = write_failed_fusion(caught.value, CONFIG, tmp_path, device=device().name)
    assert first == tmp_path / "report.html"
    # An earlier report is not replaced.
    again = write_failed_fusion(caught.value, CONFIG, tmp_path, device=device().name)
    assert again == tmp_path / "failed" / "report.html"


def test_all_of_them_may_be_required() -> None:
    truth, grid, _ = moved()
    maps = [truth, grid, building(4)]
    assert len(fuse_maps(maps, CONFIG, device()).result.rejected) == 1
    strict = replace(CONFIG, fusion=replace(CONFIG.fusion, require_all=True))
    with pytest.raises(AllRequiredError, match=r"building 4 .*nothing was fused") as caught:
        fuse_maps(maps, strict, device())
    assert len(caught.value.result.accepted) == 2


def test_maps_of_two_buildings_become_two_maps(tmp_path: Path) -> None:
    truth, grid, _ = moved()
    other = building(4)
    again, _ = degraded(other, 5, "again", yaw_rad=0.7)
    third, _ = degraded(truth, 2, "third", yaw_rad=-0.4)
    fused = fuse_maps([other, truth, grid, again, third], CONFIG, device())
    assert [record.name for record in fused.result.accepted] == [truth.name, "moving", "third"]
    (second,) = fused.result.others
    assert [record.name for record in second.inputs] == [other.name, "again"]
    assert all(record.accepted for record in second.inputs)
    for record in fused.result.rejected:
        assert record.reason.endswith(f"; fused in group 2: {other.name}, again")
    document = save_fused_maps(fused, tmp_path / "out", report=tmp_path / "report")
    check_document(plain(document), "fuse")
    first, last = document.groups
    assert first.fused == document.fused == str(tmp_path / "out.yaml")
    assert [item.moving for item in first.inputs] == [truth.name, "moving", "third"]
    assert last.agreement == str(tmp_path / "out-2_agreement.yaml")
    assert load_map(str(last.fused)).cells.tolist() == second.fused.cells.tolist()
    assert last.reference == second.reference
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "Further groups" in page


@pytest.mark.parametrize("maps", [[], [building(3)]])
def test_one_map_alone_is_no_fusion(maps: list[OccupancyGrid]) -> None:
    with pytest.raises(SlamFusionError, match="fuse needs at least two"):
        fuse_maps(maps, CONFIG, device())


def test_maps_alone_are_not_drawn() -> None:
    drawn = replace(CONFIG.fusion, vote=VoteConfig(mode="drawn"))
    with pytest.raises(ConfigError, match=r"here are only maps; use consensus or majority"):
        fuse_maps([building(3), building(4)], replace(CONFIG, fusion=drawn), device())


def test_maps_with_starts_are_searched_there_and_the_truth_everywhere() -> None:
    truth, grid, pose = moved()
    other, other_pose = degraded(truth, 2, "other", yaw_rad=-0.4)
    starts = {
        "moving": (pose.x, pose.y, pose.yaw_rad),
        "other": (other_pose.x, other_pose.y, other_pose.yaw_rad, 1.0, 0.2),
    }
    fused = fuse_maps([grid, other], replace(CONFIG, start=starts), device(), truth=truth)
    assert len(fused.result.accepted) == 2
    assert all(item.aligned for item in fused.evaluations)
    wrong = {**starts, "other": (other_pose.x, other_pose.y + 9.0, other_pose.yaw_rad, 1.0, 0.2)}
    with pytest.raises(AlignmentError, match="no two of the inputs"):
        fuse_maps([grid, other], replace(CONFIG, start=wrong), device())
