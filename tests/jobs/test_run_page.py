"""The page of the main job: every producer, also one that made no map, and nothing that runs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation.measured import Measures
from slamfusion.evaluation.relations import Relations, relation_errors
from slamfusion.evaluation.trajectory_error import trajectory_errors
from slamfusion.fusion.path_check import path_gaps
from slamfusion.geometry import Pose2
from slamfusion.jobs.fuse_documents import DoubledWalls
from slamfusion.jobs.fused_path import FusedPath
from slamfusion.jobs.records import Circumstances
from slamfusion.jobs.run_files import DriveFusion, FailedProducer, LogRun, RunFiles, RunProducer
from slamfusion.jobs.run_page import run_page
from slamfusion.palette import NAMED, OTHERS
from slamfusion.report.page import write_page
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.trajectory import Trajectory
from tests.report.drawn import NASTY, REASON, evaluations, fusion
from tests.report.test_reports import read
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


@cache
def everything() -> LogRun:
    """Three producers of which one is lost, a fourth that died, a rejected map, all errors."""
    runs = [produced(name, lost=name == "room 1") for name in NAMES]
    path = runs[0].trajectory
    truth = path.moved(Pose2(5.0, 1.0, 0.5))
    result = fusion()
    grids = tuple(record.grid for record in result.inputs)
    gaps = path_gaps(
        {name: path.moved(Pose2(0.0, 2.5 * index)) for index, name in enumerate(NAMES)}
    )
    why = f"its process was killed {NASTY}"
    died = FailedProducer(name="gmapping", failed=why, process_time_s=1.0, process_cpu_s=None)
    producers = [
        RunProducer(
            run=run,
            measures=Measures(truth=trajectory_errors(run.trajectory, truth, CONFIG.trajectory)),
            map_error=None,
            device="numpy",
            process_time_s=4.0,
            process_cpu_s=3.5,
        )
        for run in runs
    ]
    errors = trajectory_errors(path, truth, CONFIG.trajectory)
    return LogRun(
        files=RunFiles(Path(NASTY)),
        saved_paths=(),
        made_with=Circumstances("numpy", CONFIG),
        producers=(*producers, died),
        fusion=DriveFusion(
            grids,
            result,
            gaps,
            doubled=DoubledWalls(dict.fromkeys([*NAMES, NASTY], 0.125), 0.125, 0.0),
        ),
        fused_mode="consensus",
        path_gaps=gaps,
        path_evidence=(),
        best_founded=None,
        fused_path=FusedPath(
            trajectory=path,
            trust={},
            measures=Measures(errors, relation_errors(path, standing(path), 0.01)),
        ),
        drawn_map=None,
        why_voted=None,
        evaluations=tuple(evaluations()),
        recommendation=None,
        evidence=None,
        no_verdict=None,
        error=None,
        not_measured=(),
        stages_s={"producers": 12.5, "fusion": 0.25},
        begun_s=0.0,
        true_path=truth,
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One page with everything on it, to read only."""
    return write_page(run_page(everything()), tmp_path_factory.mktemp("run"))


def test_the_headline_names_who_made_no_map_who_was_rejected_and_who_is_lost(page: Path) -> None:
    text = read(page).text
    assert "Only 3 of 5 maps were fused" in text
    assert f"gmapping made no map: its process was killed {NASTY}" in text
    assert f"{NASTY} was rejected: {REASON}" in text
    assert "room 1: tracking may be lost" in text
    how = "by vote (consensus)"
    assert f"Fused: room 0, room 1, room 2; {how}; in the frame of room 0." in text


def test_every_part_is_on_the_one_page(page: Path) -> None:
    text = read(page).text
    for part in (
        "Fused map",
        "Agreement",
        "The paths over the fused map",
        "Distance between the paths in the fused map",
        "Over the drive",
        "room 1, aligned",
        "Alignment to room 0",
        "ATE, translation [m]",
        "Errors of the paths",
        "Error against the truth",
        "Health, times and memory",
        "4.0 s, 3.5 s of processor",
        "12.8 s",
        "for all, without this page",
        "12.50",
        "time_limit_s: null",
    ):
        assert part in text, part
    assert text.index("Fused map") < text.index("The paths over the fused map")


def test_a_name_has_one_colour_on_all_of_the_page(page: Path) -> None:
    html = page.read_text(encoding="utf-8")
    legends = [
        (f"rgb{rgb}", name)
        for section in run_page(everything()).sections
        for picture in section.pictures
        for name, rgb in picture.legend.items()
    ]
    recorded = re.search(r'id="recorded">(.*?)</script>', html, re.DOTALL)
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
    assert f"{moved_m:.4f} m" in html
    assert "error of relations, mean, fused path" in html
    assert "relations, translation [m]" in text
    assert "Error against the truth, distribution" in text
    assert "Error on known relations over the drive" in text


def test_a_failed_fusion_shows_the_maps_and_why(tmp_path: Path) -> None:
    full = everything()
    report = replace(
        full,
        fusion=DriveFusion(
            full.grids,
            pairs=full.fusion.result.pairs,
            failure=SlamFusionError("no two of them align"),
        ),
        error="no two of them align",
        path_gaps=(),
        evaluations=(),
    )
    text = read(write_page(run_page(report), tmp_path)).text
    assert "Nothing was fused no two of them align" in text
    assert "All pairs" in text
    assert "room 2: its path over its map" in text
    assert "Fused map" not in text


def test_a_map_that_may_not_be_used_is_not_called_fused() -> None:
    failure = SlamFusionError("--require-all, but one was rejected")
    full = everything()
    report = replace(full, fusion=replace(full.fusion, failure=failure), error=str(failure))
    banner = run_page(report).banner
    assert (banner.tone, banner.headline) == ("bad", "Do not use this map")
    said = "\n".join(words for line in banner.lines for words in line)
    assert "--require-all, but one was rejected" in said
    assert "maps were fused" not in said
