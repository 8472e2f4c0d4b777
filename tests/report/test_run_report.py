"""The page of the main job: every producer, also one that made no map, and nothing that runs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import NormalizeConfig, RunConfig
from slamfusion.evaluation import Relations, compare_to_truth, relation_errors, trajectory_errors
from slamfusion.fusion.path_check import moved_path, path_gaps
from slamfusion.geometry import Pose2
from slamfusion.palette import NAMED, OTHERS
from slamfusion.report.run_contents import ReportedPath, ReportedRun, RunReport
from slamfusion.report.run_report import write_run_report
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.trajectory import Trajectory
from tests.report.drawn import NASTY, REASON, fusion, room
from tests.report.test_reports import check_scripts, read
from tests.support.producers import DeadReckoning, room_drive

pytestmark = pytest.mark.once

CONFIG = RunConfig()
NAMES = ("room 0", "room 1", "room 2")


def produced(name: str, *, lost: bool = False) -> ProducerRun:
    """A run over a drive; the lost one matches badly many times in a row."""
    scores = dict.fromkeys(range(20, 40), 0.1) if lost else {}
    run = run_producer(DeadReckoning(scores), room_drive(60))
    return replace(run, name=name, grid=run.grid.with_name(name))


def standing(path: Trajectory) -> Relations:
    """A relation that says the robot stood still from the first pose of a path to the second."""
    return Relations(path.stamps_s[:2].reshape(1, 2), np.zeros((1, 3)))


def everything() -> RunReport:
    """Three producers of which one is lost, a fourth that died, a rejected map, all errors."""
    runs = [produced(name, lost=name == "room 1") for name in NAMES]
    truth = moved_path(runs[0].trajectory, Pose2(5.0, 1.0, 0.5))
    result = fusion()
    yardstick = room("truth", 7)
    evaluations = [
        compare_to_truth(grid, yardstick, normalize=NormalizeConfig(), tolerance_m=0.1)
        for grid in (room("room 0", 0), room("fused", 7))
    ]
    return RunReport(
        log=NASTY,
        runs=[
            ReportedRun(
                run, errors=trajectory_errors(run.trajectory, truth, CONFIG.trajectory),
                time_s=4.0, cpu_s=3.5,
            )
            for run in runs
        ],
        failed=[("gmapping", f"its process was killed {NASTY}")],
        result=result,
        grids=[record.grid for record in result.inputs],
        gaps=path_gaps(
            {
                name: moved_path(runs[0].trajectory, Pose2(0.0, 2.5 * index))
                for index, name in enumerate(NAMES)
            }
        ),
        doubled=dict.fromkeys([*NAMES, NASTY, "fused map"], 0.125),
        fused_path=ReportedPath(
            runs[0].trajectory,
            relation_errors(runs[0].trajectory, standing(runs[0].trajectory), 0.01),
            trajectory_errors(runs[0].trajectory, truth, CONFIG.trajectory),
        ),
        evaluations=evaluations,
        evaluation_alignments=[None, None],
        truth=truth,
        warnings=[("room 1:", text) for text in runs[1].warnings()],
        stages={"producers": 12.5, "fusion": 0.25},
        device="numpy",
    )  # fmt: skip


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One page with everything on it, to read only."""
    return write_run_report(everything(), tmp_path_factory.mktemp("run"), config=CONFIG)


def test_the_headline_names_who_made_no_map_who_was_rejected_and_who_is_lost(page: Path) -> None:
    text = read(page).text
    assert "Only 3 of 5 maps were fused" in text
    assert f"gmapping made no map: its process was killed {NASTY}" in text
    assert f"{NASTY} was rejected: {REASON}" in text
    assert "room 1: tracking may be lost" in text
    assert "Fused: room 0, room 1, room 2; in the frame of room 0." in text


def test_every_part_is_on_the_one_page(page: Path) -> None:
    text = read(page).text
    for part in (
        "Fused map",
        "Agreement",
        "The paths over the fused map",
        "Distance between the paths in the fused map",
        "Health over time",
        "Where each input was outvoted",
        "Alignment to room 0",
        "ATE, place m",
        "Errors of the paths",
        "Error against the truth",
        "Timings and memory",
        "processor s",
        "12.8 s",
        "for all, without this page",
        "12.50",
        "time_limit_s: null",
    ):
        assert part in text, part
    assert text.index("Fused map") < text.index("The paths over the fused map")


def test_a_name_has_one_colour_on_all_of_the_page(page: Path) -> None:
    html = page.read_text(encoding="utf-8")
    legends = re.findall(r'<li><i style="background: (rgb\([^)]*\))"></i>([^<]*)</li>', html)
    recorded = re.search(r'id="recorded">(.*?)</script>', html, re.DOTALL)
    assert recorded is not None
    messages = json.loads(recorded[1])["messages"]
    layers = [
        (f"rgb({', '.join(map(str, item['colours']['wall']))})", item["name"])
        for item in messages
        if item["type"] == "layer" and item["kind"] == "input"
    ]
    found: dict[str, set[str]] = {}
    for colour, name in (*legends, *layers):
        found.setdefault(name, set()).add(re.sub(r"[, ]+", " ", colour))
    wanted = {"fused path": NAMED["fused"], "truth, dashed": NAMED["truth"]}
    wanted |= dict(zip(NAMES, OTHERS, strict=False))
    for name, rgb in wanted.items():
        assert found[name] == {f"rgb({' '.join(map(str, rgb))})"}, name
    assert sum(name == NAMES[0] for _, name in (*legends, *layers)) >= 3


def test_the_fused_path_is_drawn_and_measured_beside_those_it_was_made_of(page: Path) -> None:
    text = read(page).text
    moved_m = float(np.hypot(*np.diff(produced(NAMES[0]).trajectory.poses[:2, :2], axis=0)[0]))
    html = page.read_text(encoding="utf-8")
    assert f"<b>{moved_m:.4f} m</b><span>fused path: error of relations</span>" in html
    assert "relations (1 of 1), translation m" in text
    assert "fused path: error along the path" in text
    assert "fused path: error of each relation" in text


def test_names_run_nothing_and_nothing_is_loaded(page: Path) -> None:
    found = read(page)
    check_scripts(found)
    assert all(source.startswith("data:image/png;base64,") for source in found.sources)
    for link in found.links:
        assert link[1:] in found.targets if link[0] == "#" else (page.parent / link).is_file()


def test_a_failed_fusion_shows_the_maps_and_why(tmp_path: Path) -> None:
    full = everything()
    report = replace(
        full, result=None, failure="no two of them align", pairs=full.result.pairs, gaps=(),
        doubled=None, evaluations=(), evaluation_alignments=(),
    )  # fmt: skip
    text = read(write_run_report(report, tmp_path, config=CONFIG)).text
    assert "Nothing was fused no two of them align" in text
    assert "All pairs" in text
    assert "room 2: its path over its map" in text
    assert "Fused map" not in text


def test_a_map_that_may_not_be_used_is_not_called_fused(tmp_path: Path) -> None:
    report = replace(everything(), failure="--require-all, but one was rejected")
    text = read(write_run_report(report, tmp_path, config=CONFIG)).text
    assert "Do not use this map --require-all, but one was rejected" in text
    assert "maps were fused" not in text
