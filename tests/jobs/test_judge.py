"""``judge_paths`` as a library: paths of a log in files, with a truth and without."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import RunConfig, TrajectoryConfig
from slamfusion.errors import TrajectoryError
from slamfusion.io import read_trajectory, write_tum
from slamfusion.io.carmen import write_carmen
from slamfusion.jobs.judge import (
    JudgeDocument,
    judge_paths,
    rankings,
    write_fused_path,
    write_judgement,
)
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import bent, circuit, moved, recorded
from tests.support.documents import check_document

TRUTH = circuit()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with its true path, a path in another frame, a sparse one, and one that goes wrong."""
    folder = tmp_path_factory.mktemp("drive")
    write_carmen(folder / "drive.log", recorded(TRUTH))
    paths = {
        "truth": TRUTH,
        "elsewhere": moved(TRUTH, (30.0, -4.0, 2.0)),
        "sparse": Trajectory(TRUTH.stamps_s[::6], TRUTH.poses[::6]),
        "bent": bent(TRUTH, 0.2, 70),
    }
    for name, path in paths.items():
        write_tum(folder / f"{name}.tum", path)
    return folder


def test_paths_are_ranked_without_a_truth(drive: Path) -> None:
    files = [drive / "bent.tum", drive / "elsewhere.tum", drive / "sparse.tum"]
    found = judge_paths(drive / "drive.log", files)
    assert [path.name for path in found.paths] == ["bent", "elsewhere", "sparse"]
    answer = found.recommendation
    assert answer.path in {"elsewhere", "sparse"}
    assert answer.best_single == answer.path
    assert answer.use is None
    assert [path.name for path in answer.paths][-1] == "bent"
    document = plain(JudgeDocument(found, found.circumstances))
    check_document(document, "judge")
    assert (found.ranking_by_truth, found.ranking_by_relations) == ((), ())
    by_name = {item.name: item for item in found.path_evidence}
    assert by_name["sparse"].own_poses_share == pytest.approx(1.0 / 6.0)
    assert by_name["sparse"].covered_share > 0.9
    assert not by_name["bent"].tied
    assert not all(span.agrees for span in by_name["bent"].spans)
    assert found.fused_path is None


def test_with_a_truth_there_is_a_ranking_by_errors_and_a_report(
    drive: Path, tmp_path: Path
) -> None:
    files = [drive / "bent.tum", drive / "elsewhere.tum"]
    found = judge_paths(drive / "drive.log", files, truth=drive / "truth.tum")
    assert list(rankings(found.measured)["ATE"]) == ["elsewhere", "bent"]
    assert found.ranking_by_relations == ()
    document = plain(JudgeDocument(found, found.circumstances))
    check_document(document, "judge")
    bent_path, elsewhere = document["paths"]
    assert elsewhere["ate"]["rmse"] == pytest.approx(0.0, abs=1e-6)
    assert bent_path["ate"]["rmse"] > 0.1

    page = write_judgement(found, tmp_path / "report")
    assert page == tmp_path / "report" / "report.html"
    assert (tmp_path / "report" / "02-evidence.png").exists()
    text = page.read_text(encoding="utf-8")
    assert f"<h1>{found.recommendation.headline}</h1>" in text
    assert "<strong>Single SLAM:</strong> elsewhere" in text
    assert "<details><summary>The scores</summary>" in text
    assert f"{rankings(found.measured)['ATE']['bent'][0]:.4f}" in text
    assert "relations, m" not in text, "there were none"
    # A path alone.
    alone = judge_paths(drive / "drive.log", files[:1])
    text = write_judgement(alone, tmp_path / "report").read_text(encoding="utf-8")
    assert f"<h1>{alone.recommendation.headline}</h1>" in text
    assert "Held against what is known" not in text


def test_one_path_is_made_of_all_and_judged_beside_them(drive: Path, tmp_path: Path) -> None:
    files = [drive / "bent.tum", drive / "elsewhere.tum", drive / "sparse.tum"]
    out = tmp_path / "one.tum"
    found = judge_paths(drive / "drive.log", files, truth=drive / "truth.tum", fused=out)
    assert [path.name for path in found.paths] == ["bent", "elsewhere", "sparse"]
    answer = found.recommendation
    assert {path.name for path in answer.paths} == {"bent", "elsewhere", "sparse", "fused"}
    assert answer.path == "fused"
    assert answer.best_single in {"elsewhere", "sparse"}
    assert rankings(found.measured)["ATE"]["fused"][0] < 0.02
    check_document(plain(JudgeDocument(found, found.circumstances)), "judge")
    fused = found.fused_path
    assert (fused.file, fused.poses) == (out, len(TRUTH))
    assert fused.trust["bent"] < 0.9 < fused.trust["sparse"]
    # Nothing is written before it is asked for.
    assert not out.exists()
    write_fused_path(found)
    assert len(read_trajectory(out)) == len(TRUTH)


def test_paths_that_cannot_be_fused_are_one_line(drive: Path, tmp_path: Path) -> None:
    log, good, out = drive / "drive.log", drive / "truth.tum", tmp_path / "out.tum"
    with pytest.raises(TrajectoryError, match=r"^1 path cannot be fused; give at least 2$"):
        judge_paths(log, [good], fused=out)
    with pytest.raises(TrajectoryError, match=r"called fused, too; give this one another name"):
        judge_paths(log, {"truth": good, "fused": drive / "bent.tum"}, fused=out)
    write_tum(tmp_path / "short.tum", Trajectory(TRUTH.stamps_s[:40], TRUTH.poses[:40]))
    with pytest.raises(TrajectoryError, match=r"^short: it has poses for .* give a longer path$"):
        judge_paths(log, [good, tmp_path / "short.tum"], fused=out)
    # A fused path of another day is a path like any other where none is made.
    found = judge_paths(log, {"truth": good, "fused": drive / "bent.tum"})
    assert (found.fused_path, found.recommendation.path) == (None, "truth")


def test_what_cannot_be_measured_does_not_take_the_answer_along(
    drive: Path, tmp_path: Path
) -> None:
    write_tum(tmp_path / "other.tum", Trajectory(TRUTH.stamps_s + 1e4, TRUTH.poses))
    files = [drive / "bent.tum", drive / "elsewhere.tum"]
    found = judge_paths(drive / "drive.log", files, truth=tmp_path / "other.tum")
    assert found.recommendation.path == "elsewhere"
    assert [words.split(":")[0] for words in found.not_measured] == ["bent", "elsewhere"]
    check_document(plain(JudgeDocument(found, found.circumstances)), "judge")


def test_two_files_of_one_name_are_told_apart(drive: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "bent.tum", TRUTH)
    found = judge_paths(drive / "drive.log", [drive / "bent.tum", tmp_path / "bent.tum"])
    _, other = found.paths
    assert found.recommendation.path == other.name == f"{tmp_path.name}/bent"
    assert np.array_equal(other.trajectory.stamps_s, TRUTH.stamps_s)


def test_a_path_on_another_clock_is_named_and_put_on_the_logs(drive: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "relative.tum", TRUTH.later(-1e6))
    files = [tmp_path / "relative.tum"]
    with pytest.raises(TrajectoryError, match=r"use --time-offset 1000000\.000, or"):
        judge_paths(drive / "drive.log", files)
    config = RunConfig(trajectory=TrajectoryConfig(time_offset="auto"))
    found = judge_paths(drive / "drive.log", files, config)
    (path,) = found.recommendation.paths
    assert path.own_poses_share > 0.95


def turning(most_rad: float = 1.0) -> Trajectory:
    yaws = [[0.0, 0.0, most_rad * math.sin(2.0 * stamp_s)] for stamp_s in TRUTH.stamps_s]
    return replace(TRUTH, poses=TRUTH.poses + yaws)


def test_a_mirrored_path_is_not_taken_for_a_mirrored_laser(tmp_path: Path) -> None:
    path = turning(0.1)
    write_carmen(tmp_path / "drive.log", recorded(path))
    write_tum(tmp_path / "slam.tum", path.mirrored())
    told: list[str] = []
    found = judge_paths(tmp_path / "drive.log", [tmp_path / "slam.tum"], warn=told.append)
    assert found.recommendation.laser_fault is None
    assert "slam: the path is mirrored: negate its y and yaw" in told
    (evidence,) = plain(found)["path_evidence"]
    assert evidence["faults"] == ["the path is mirrored: negate its y and yaw"]
    assert found.recommendation.confidence == "low"


def test_a_mirrored_laser_is_said(tmp_path: Path) -> None:
    scans = [
        replace(item, scan=replace(item.scan, ranges=item.scan.ranges[::-1]))
        for item in recorded(turning())
    ]
    write_carmen(tmp_path / "drive.log", scans)
    write_tum(tmp_path / "image.tum", turning().mirrored())
    found = judge_paths(tmp_path / "drive.log", [tmp_path / "image.tum"])
    assert "use --laser mirrored" in (found.recommendation.laser_fault or "")
    assert found.recommendation.tone == "bad"
