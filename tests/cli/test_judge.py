"""``slamfusion judge`` as a user starts it."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamfusion.io import read_trajectory, write_tum
from slamfusion.io.carmen import write_carmen
from slamfusion.trajectory import Trajectory
from tests.cli.command import run
from tests.evidence.rooms import bent, circuit, recorded

pytestmark = pytest.mark.once

TRUTH = circuit()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("judge")
    write_carmen(folder / "drive.log", recorded(TRUTH))
    write_tum(folder / "good.tum", Trajectory(TRUTH.stamps_s, TRUTH.poses))
    write_tum(folder / "bent.tum", bent(TRUTH, 0.2, 70))
    return folder


def test_the_table_and_the_recommendation_are_printed(drive: Path) -> None:
    files = (drive / "drive.log", drive / "bent.tum", drive / "good.tum")
    done = run("judge", *files, "--truth", drive / "good.tum")
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines() if line.split()[:1]]
    ranked = [row for row in rows if row[0] in {"good", "bent"}]
    assert [row[0] for row in ranked] == ["good", "bent"]
    # Both rankings: by the scans, and by the truth.
    assert [row[-1] for row in ranked] == ["1", "2"]
    answer = done.stdout.splitlines()[-2:]
    assert answer == ["Use the good path: no scan contradicts it.", "Single SLAM: good"]


def test_a_fused_path_is_written_and_told(drive: Path, tmp_path: Path) -> None:
    files = (drive / "drive.log", drive / "bent.tum", drive / "good.tum")
    out = tmp_path / "new" / "fused.tum"
    done = run("judge", *files, "--fused", out, "--report", tmp_path / "report")
    assert done.returncode == 0, done.stderr
    assert "from fused, rms [m]" in done.stdout
    assert f"\nfused path: {out}\n" in done.stdout
    assert "\nSingle SLAM: good\nreport: " in done.stdout
    assert len(read_trajectory(out)) == len(TRUTH)
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "<h1>Use the fused path" in page
