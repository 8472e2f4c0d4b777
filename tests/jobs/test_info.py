"""``slamfusion info``: logs, maps and runs in a screen."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from slamfusion.cli.program import run_program
from slamfusion.errors import LogError, MapFileError
from slamfusion.io import write_carmen
from slamfusion.io.log import LogScan
from slamfusion.jobs.fuse import fuse_maps, save_fused_maps
from slamfusion.jobs.info import describe
from tests.cli.command import SAMPLE
from tests.slam.drives import drive
from tests.support.documents import check_document
from tests.support.producers import unseeing

pytestmark = pytest.mark.once


def test_a_log_has_its_rate_its_gaps_and_its_odometry(tmp_path: Path) -> None:
    scans = drive(20)[0]
    late = [
        LogScan(replace(item.scan, stamp_s=item.scan.stamp_s + 3.0), item.odometry, item.line)
        for item in scans[10:]
    ]
    write_carmen(tmp_path / "drive.log", [*scans[:10], *late])
    found = describe(tmp_path / "drive.log").log
    step_s = scans[1].scan.stamp_s - scans[0].scan.stamp_s
    assert (found.scans, found.gaps) == (20, 1)
    assert found.rate_hz == pytest.approx(1.0 / step_s, rel=1e-3)
    assert found.longest_gap_s == pytest.approx(3.0 + step_s)
    assert found.duration_s == pytest.approx(19 * step_s + 3.0)
    assert found.beams == str(len(scans[0].scan.ranges))
    assert found.odometry_m > 0.0


def test_a_log_without_a_hit_is_named(tmp_path: Path) -> None:
    write_carmen(tmp_path / "drive.log", unseeing(drive(20)[0]))
    assert (
        "no beam of it hits anything: no SLAM can map it"
        in describe(tmp_path / "drive.log").remarks
    )


def test_stamps_out_of_order_are_counted(tmp_path: Path) -> None:
    path, scans = tmp_path / "drive.log", drive(20)[0]
    write_carmen(path, scans)
    lines = path.read_text(encoding="ascii").splitlines()
    again = [line for line in lines if "LASER" in line.split()[0]][5]
    path.write_text("\n".join([*lines, again]), encoding="ascii")
    found = describe(path).log
    assert (found.scans, found.out_of_order) == (20, 1)
    assert 8.0 < found.run_time_s < 9.0
    assert found.run_memory_mb > 100.0


@pytest.mark.parametrize(
    ("stamp_s", "figures", "remark"),
    [
        (lambda _: 5.0, (None, None), "39 of 40 are not later than one before"),
        (lambda n: 1e3 * n, (0.001, 0), "scans are 1000 s apart: are their stamps in seconds?"),
    ],
)
def test_stamps_that_cannot_be_right_are_named(
    tmp_path: Path, stamp_s: Callable[[int], float], figures: tuple[object, object], remark: str
) -> None:
    scans = [
        replace(item, scan=replace(item.scan, stamp_s=stamp_s(step)))
        for step, item in enumerate(drive(40)[0])
    ]
    write_carmen(tmp_path / "drive.log", scans)
    found = describe(tmp_path / "drive.log")
    assert (found.log.rate_hz, found.log.out_of_order) == figures
    assert any(remark in sentence for sentence in found.remarks)


def test_a_bag_has_the_frames_of_its_laser_and_transforms(tmp_path: Path) -> None:
    bags = pytest.importorskip("tests.io.bags", reason="rosbags comes with the bags extra")
    bag = bags.Bag().transform(1.0, "base_link", "laser", (0.1, 0.0, 0.0), topic="/tf_static")
    for number in range(10, 13):
        bag.transform(0.1 * number, "odom", "base_link", (0.1 * number, 0.0, 0.0))
        bag.scan(0.1 * number)
    folder = bag.write(tmp_path, "sqlite3")
    write_carmen(tmp_path / "one" / "drive.log", drive(20)[0])
    assert describe(tmp_path / "one").log is not None
    for path in (folder, folder / "metadata.yaml", *folder.glob("*.db3")):
        found = describe(path).log
        assert found.frames == ["/scan in laser", "odom > base_link", "base_link > laser"]


def test_a_map_has_its_size_and_area(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_program(["info", str(SAMPLE / "map_a.yaml"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    check_document(document, "info")
    assert (document["log"], document["run"]) == (None, None)
    assert (document["map"]["width"], document["map"]["resolution_m"]) == (332, 0.05)
    assert run_program(["info", str(SAMPLE / "map_a.yaml")]) == 0
    assert "\nresolution [m]\t0.05\n" in capsys.readouterr().out
    bare = [str(SAMPLE / "map_a.pgm"), "--resolution", "0.1"]
    assert run_program(["info", *bare]) == 0
    assert "\nresolution [m]\t0.1\n" in capsys.readouterr().out
    assert run_program(["info", "a.yaml", "b.yaml"]) == 2
    assert "(b.yaml); wanted LOG|BAG|MAP|RUN; see slamfusion info" in capsys.readouterr().err


def test_a_map_that_is_mostly_wall_or_in_millimetres_is_named(tmp_path: Path) -> None:
    text = (SAMPLE / "map_a.yaml").read_text(encoding="utf-8").replace("negate: 0", "negate: 1")
    path = tmp_path / "map.yaml"
    path.write_text(text.replace("map_a.pgm", str(SAMPLE / "map_a.pgm")), encoding="utf-8")
    assert any("is wall: check 'negate'" in remark for remark in describe(path).remarks)
    path.write_text(path.read_text().replace("resolution: 0.05", "resolution: 50.0"))
    assert "cells of over a metre: is its resolution in metres?" in describe(path).remarks
    assert not describe(SAMPLE / "map_a.yaml").remarks


def test_a_run_has_its_recommendation_and_a_damaged_record_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answer: dict[str, object] = {
        "use": "fused", "path": "fused", "best_single": "graph", "confidence": "high",
        "check": [], "laser_fault": None,
    }  # fmt: skip
    slam = {"name": "graph", "scans_used": 64, "failed": None}
    record = {
        "log": "a.log", "producers": [slam, {"name": "tinyslam", "failed": "killed"}],
        "fused_count": 2, "fused_mode": "drawn", "recommendation": answer, "time_s": 3.0,
        "report": "report.html", "not_measured": ["no truth"], "why_voted": None,
    }  # fmt: skip
    for name in ("fused.json", "graph.json"):
        (tmp_path / name).write_text(json.dumps(record), encoding="utf-8")
    assert run_program(["info", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "recommendation\tUse the fused map and its path: no scan contradicts it\n" in out
    assert "slams\tgraph: 64 scans; tinyslam: killed\n" in out
    assert out.endswith("- no truth\n")
    assert run_program(["info", str(tmp_path / "fused.json")]) == 0
    assert capsys.readouterr().out == out
    with pytest.raises(LogError, match="found results; `slamfusion info` and `show` read their"):
        describe(tmp_path / "graph.json")
    (tmp_path / "fused.json").write_text("{}", encoding="utf-8")
    with pytest.raises(MapFileError, match="wanted the record of a run"):
        describe(tmp_path)


def test_a_folder_with_fused_maps_is_described_by_its_fused_map(tmp_path: Path) -> None:
    maps = [SAMPLE / f"map_{letter}.yaml" for letter in "ab"]
    save_fused_maps(fuse_maps(maps), tmp_path / "fused")
    found = describe(tmp_path)
    assert (found.map, found.file) == (
        describe(tmp_path / "fused.yaml").map,
        tmp_path / "fused.yaml",
    )


def test_a_folder_with_one_log_is_described_by_it_with_what_else_it_holds(tmp_path: Path) -> None:
    write_carmen(tmp_path / "drive.log", drive(20)[0])
    (tmp_path / "truth.yaml").touch()
    found = describe(tmp_path)
    assert (found.log, found.file) == (describe(found.file).log, tmp_path / "drive.log")
    assert found.remarks[-1] == f"also in {tmp_path}: truth.yaml"


def test_what_is_none_of_these_is_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing", encoding="utf-8")
    with pytest.raises(LogError, match=r"notes\.txt"):
        describe(tmp_path / "notes.txt")
