"""Recorded drives: the reference map, and what is measured against it."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import compare_to_truth
from slamfusion.experiments import REAL_LOGS, RealLogTable, compare_on_logs
from slamfusion.experiments.real_logs import REFERENCE, RealLogRow, reference_map
from slamfusion.experiments.voting import FUSIONS
from slamfusion.grid import OccupancyGrid
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory
from tests.experiments.drives import room
from tests.support.datasets import ABSENT, DATASETS

CONFIG = RunConfig()


def truth() -> Trajectory:
    reference = room().reference
    assert reference is not None
    return reference


def test_the_reference_map_is_drawn_at_the_reference_poses() -> None:
    # The odometry of the scans is bad, and takes no part where every scan has a pose.
    grid, count = reference_map(room(drift=0.3).scans, truth(), CONFIG, NumpyDevice())
    wanted, _ = reference_map(room().scans, truth(), CONFIG, NumpyDevice())
    assert count == 12
    assert np.array_equal(grid.cells, wanted.cells)
    assert grid.origin == wanted.origin
    assert (grid.cells == 0).any()
    assert (grid.cells == 100).any()


def test_scans_between_the_poses_do_not_draw() -> None:
    every_third = Trajectory(truth().stamps_s[::3], truth().poses[::3])
    grid, count = reference_map(room().scans, every_third, CONFIG, NumpyDevice())
    wanted, _ = reference_map(room().scans[::3], truth(), CONFIG, NumpyDevice())
    assert count == 4
    assert np.array_equal(grid.cells, wanted.cells)


def test_a_reference_of_another_time_is_refused() -> None:
    later = Trajectory(truth().stamps_s + 100.0, truth().poses)
    with pytest.raises(SlamFusionError, match="no scan of the log has a pose"):
        reference_map(room().scans, later, CONFIG, NumpyDevice())


def drawn(name: str, shift: int) -> OccupancyGrid:
    """A free field with a wall, shifted to the right."""
    cells = np.zeros((20, 20), dtype=np.int8)
    cells[:, 10 + shift] = 100
    return OccupancyGrid(cells, 0.1, name=name)


def table() -> RealLogTable:
    """Walls that are off by 0 to 6 cells; the log-odds vote is the best, majority the worst."""
    reference = drawn(REFERENCE, 0)
    shifts = dict(zip((*BUILT_IN, *FUSIONS), (2, 3, 2, 6, 2, 2, 0), strict=True))
    rows = []
    for method, shift in shifts.items():
        settings = {"normalize": CONFIG.fusion.normalize, "tolerance_m": 0.1}
        error = compare_to_truth(drawn(method, shift), reference, **settings)
        path_error_m = {"tinyslam": 0.07}.get(method)
        rows.append(RealLogRow("hall", method, 0.25, error, path_error_m))
    rows.append(RealLogRow("hall", REFERENCE, 0.125, None))
    notes, references = {("hall", "majority"): "bent"}, {"hall": "9 scans"}
    return RealLogTable("t", tuple(rows), notes, references, {"hall": "graph"})


def test_numbers_by_hand() -> None:
    made = table()
    first = made.rows[0].numbers()
    assert first["error"] == pytest.approx(np.sqrt(2 * 20))
    assert first["wall_distance_mean_m"] == pytest.approx(0.2)
    assert first["doubled_wall_share"] == 0.25
    assert made.ratios("hall") == {
        "majority": 1.0, "consensus": 1.0, "weighted": 1.0, "log-odds": 0.0,
    }  # fmt: skip
    assert made.overall()["log-odds"] == {"ratio": 0.0, "worst": 0.0}
    assert "hall: log-odds -100.0 % against tinyslam, the best input." in made.sentences()
    assert "hall: the scans bear out the path of graph best." in made.sentences()


def test_tables_hold_every_map() -> None:
    sheet, left = table().sheets(details=False)
    assert [row[0] for row in sheet.rows] == [*BUILT_IN, *FUSIONS, REFERENCE]
    assert sheet.rows[-1][1:] == ("-", "-", "-", "-", "-", "-", "12.5%", "-")
    assert sheet.rows[0][-1] == "0.070"
    assert "9 scans" in sheet.note
    assert left.rows == (("hall", "majority", "bent"),)
    rows = list(csv.DictReader(io.StringIO(table().to_csv())))
    assert [row["map"] for row in rows] == [*BUILT_IN, *FUSIONS, REFERENCE]
    assert rows[-1]["error"] == ""
    assert len(table().to_json()["maps"]) == 8


@pytest.mark.full
@pytest.mark.datasets
@pytest.mark.skipif(not (DATASETS / REAL_LOGS["intel"].log).exists(), reason=ABSENT)
def test_on_intel_the_fused_map_is_near_the_best_and_doubles_fewer_walls() -> None:
    from slamfusion.compute import open_device  # noqa: PLC0415

    found = compare_on_logs(DATASETS, ["intel"], CONFIG, open_device("auto"))
    assert found.notes == {}
    assert found.ratios("intel")["majority"] < 1.15
    doubled = {row.method: row.doubled_share for row in found.rows}
    assert doubled["consensus"] < min(doubled[name] for name in BUILT_IN)
