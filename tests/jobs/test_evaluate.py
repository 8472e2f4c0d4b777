"""Maps against the truth and against measured distances, as a library."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.cli.program import run_program
from slamfusion.errors import GridError
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, OccupancyGrid
from slamfusion.io import save_map
from slamfusion.jobs.cases import CaseFile, Placed
from slamfusion.jobs.evaluate import (
    EvaluatedMap,
    EvaluatedMaps,
    evaluate_cases,
    evaluate_maps,
    measure_distances,
)
from slamfusion.jobs.records import Settings
from slamfusion.json_values import plain
from tests.fusion.drawings import fusion_config
from tests.jobs.maps import CONFIG, device, moved
from tests.support.documents import check_document


def test_maps_are_measured_where_they_lie_or_aligned(tmp_path: Path) -> None:
    truth, grid, _ = moved()
    told: list[tuple[str, int, int]] = []
    aligned, itself = evaluate_maps(
        [grid, truth], truth, CONFIG, device(), progress=lambda *words: told.append(words)
    )
    (as_it_lies,) = evaluate_maps([grid], truth, CONFIG, device(), align=False)
    assert aligned.aligned
    assert as_it_lies.alignment is None
    assert itself.error == 0.0
    assert 0.0 < aligned.error < 0.5 * as_it_lies.error
    assert told == [("evaluate", 0, 2), ("evaluate", 1, 2), ("evaluate", 2, 2)]

    document = EvaluatedMaps(
        maps=[EvaluatedMap(aligned, Placed("t", "moving", Path()))],
        truth=Path("t.yaml"),
        truths={"t": Path("t.yaml")},
        device="numpy",
        seed=0,
        settings=Settings(CONFIG),
    )
    check_document(plain(document), "evaluate")
    assert document.write(tmp_path / "report") == [tmp_path / "report" / "report.html"]


def test_cells_in_another_unit_are_refused_with_and_without_alignment() -> None:
    truth, grid, _ = moved()
    in_cm = replace(truth, resolution=100.0 * truth.resolution, name="t_cm")
    for align in (True, False):
        with pytest.raises(GridError, match=r"moving: cells of .* are 100 times finer"):
            evaluate_maps([grid], in_cm, CONFIG, device(), align=align)


def test_the_fixed_step_search_never_lays_a_map_onto_the_truth() -> None:
    truth, grid, _ = moved()
    stepped = replace(CONFIG, fusion=fusion_config(step=8))
    (plain_search,) = evaluate_maps([grid], truth, CONFIG, device())
    (with_step,) = evaluate_maps([grid], truth, stepped, device())
    assert with_step.alignment.transform == plain_search.alignment.transform
    assert with_step.alignment.reason == plain_search.alignment.reason
    assert with_step.error == plain_search.error


def test_measured_distances_are_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = np.zeros((23, 40), dtype=np.int8)
    cells[[1, 21]] = OCCUPIED  # two walls, 20 cells of 0.1 m apart
    corridor = OccupancyGrid(cells, 0.1, Pose2(0.0, -1.15), "corridor")
    measured = tmp_path / "measured.csv"
    measured.write_text("name,x1,y1,x2,y2,distance_m\nwidth,2.05,-0.9,2.05,1.2,1.9\n")
    (found,) = measure_distances([corridor], measured)
    assert found.mean_absolute_error_m == pytest.approx(0.1)
    save_map(corridor, tmp_path / "corridor")
    maps = (CaseFile(tmp_path / "corridor.yaml"),)
    cases = evaluate_cases(maps, [], CONFIG, distances=measured)
    ((case, _, method, figure, value, *_),) = cases.distance_rows()
    assert (case, method, figure) == ("measured distances", "corridor", "distance_error_mean_m")
    assert (value, cases.rows()) == (pytest.approx(0.1), [])
    measured.write_text("name,x1,y1,x2,y2,distance_m\nwidth,50,-0.9,50,1.2,1.9\n")
    command = ["evaluate", str(tmp_path / "corridor.yaml"), "--distances", str(measured)]
    assert run_program(command) == 1
    assert "no distance could be measured in corridor: no wall near" in capsys.readouterr().err
    with pytest.raises(FileNotFoundError, match="absent"):
        measure_distances([corridor], tmp_path / "absent.csv")
