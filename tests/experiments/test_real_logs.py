"""Recorded drives: the reference map, and what is measured against it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.evidence.beams import scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.experiments.fusions import FUSED_PATH, FUSIONS, drawn_at
from slamfusion.experiments.real_logs import (
    REAL_LOGS,
    REFERENCE,
    RealLog,
    compare_on_logs,
    other_slams,
    reference_map,
)
from slamfusion.experiments.runs import Setup
from slamfusion.geometry import Pose2
from slamfusion.io import save_map, write_carmen, write_tum
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.run_files import SavedMaps
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory
from tests.experiments.drives import room
from tests.slam.drives import drive
from tests.support.datasets import ABSENT, DATASETS

CONFIG = RunConfig()


def truth() -> Trajectory:
    return room().ground_truth.truth


def test_the_reference_map_is_drawn_at_the_reference_poses() -> None:
    # The odometry of the scans is bad, and takes no part where every scan has a pose.
    grid, count = reference_map(room(drift=0.3).scans, truth(), CONFIG, NumpyDevice())
    wanted, _ = reference_map(room().scans, truth(), CONFIG, NumpyDevice())
    assert count == 12
    assert np.array_equal(grid.cells, wanted.cells)
    assert grid.origin == wanted.origin
    assert (grid.cells == 0).any()
    assert (grid.cells == 100).any()


def test_a_reference_of_another_time_is_refused() -> None:
    later = Trajectory(truth().stamps_s + 100.0, truth().poses)
    with pytest.raises(SlamFusionError, match="no scan of the log has a pose"):
        reference_map(room().scans, later, CONFIG, NumpyDevice())


def test_maps_of_other_slams_are_told_by_their_names() -> None:
    maps = [CaseFile(Path(text)) for text in ("intel/karto.yaml", "graph_intel.yaml")]
    found = other_slams(["intel", "mit-csail"], maps, [CaseFile(Path("karto/intel.tum"))])
    assert found["mit-csail"] == SavedMaps((), (), {})
    assert found["intel"].names == ("karto", "graph (saved)")
    assert found["intel"].paths == {"karto": Path("karto/intel.tum")}
    for path in ("hector/intel.tum", "karto/mit-csail.tum"):
        with pytest.raises(ConfigError, match=r"which map of .* is it of"):
            other_slams(["intel", "mit-csail"], maps, [CaseFile(Path(path))])


@pytest.mark.parametrize(
    "name",
    [
        "majority",
        "consensus",
        REFERENCE,
        FUSED_PATH,
        "drawn",
        "fused",
        "gmapping",
        drawn_at("graph"),
    ],
)
def test_no_map_of_another_slam_has_the_name_of_a_row(name: str) -> None:
    maps, paths = ([CaseFile(Path(f"{name}/intel.{form}"))] for form in ("yaml", "tum"))
    found = other_slams(["intel", "mit-csail"], maps, paths)["intel"]
    assert found.names == (f"{name} (saved)",)
    assert found.paths == {f"{name} (saved)": Path(f"{name}/intel.tum")}


@pytest.mark.full
def test_another_slam_takes_part_with_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans, poses = drive(24)
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    true = Trajectory(stamps_s, np.array([(pose.x, pose.y, pose.yaw_rad) for pose in poses]))
    write_carmen(tmp_path / "flat.log", scans)
    write_tum(tmp_path / "flat.tum", true)
    device, moved = open_device("auto"), true.moved(Pose2(4.0, 1.0, 0.5))
    grid = draw_map([*scan_hits(scans)], moved, device, resolution=0.05, name="karto")
    save_map(grid, tmp_path / "karto_flat")
    write_tum(tmp_path / "karto_flat.tum", moved)
    monkeypatch.setitem(REAL_LOGS, "flat", RealLog("flat.log", "flat.tum", "the truth"))
    maps, paths = ([CaseFile(tmp_path / f"karto_flat.{form}")] for form in ("yaml", "tum"))
    others = other_slams(["flat"], maps, paths)
    found = compare_on_logs(tmp_path, ["flat"], Setup(CONFIG, device, tmp_path / "out"), others)
    means = found.summaries["mean"].loc["flat"]
    methods = set(found.table["method"])
    assert {*BUILT_IN, *FUSIONS, "karto", "karto, drawn", REFERENCE} <= methods
    assert means["ate_rmse_m", "karto"] == pytest.approx(0.0, abs=1e-6)
    assert means["wall_recall", "karto"] == pytest.approx(1.0, abs=0.1)
    assert "karto" in found.inputs
    assert "majority without karto" not in found.notes[0][1]


@pytest.mark.full
@pytest.mark.datasets
@pytest.mark.skipif(not (DATASETS / REAL_LOGS["intel"].log).exists(), reason=ABSENT)
def test_on_intel_the_fused_map_is_near_the_best_and_doubles_fewer_walls(tmp_path: Path) -> None:
    found = compare_on_logs(DATASETS, ["intel"], Setup(CONFIG, open_device("auto"), tmp_path))
    assert found.notes == [("intel", {})]
    assert found.overall()["majority"].ratio < 1.15
    doubled = found.summaries["mean"].loc["intel", "doubled_wall_share"]
    assert doubled["consensus"] < min(doubled[name] for name in BUILT_IN)
