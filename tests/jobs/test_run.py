"""``run_log`` as a library: the main job, its files, and what ends it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from slamfusion.compute import NumpyDevice
from slamfusion.errors import AlignmentError, ConfigError, SlamFusionError, StartError
from slamfusion.evaluation.distances import wall_centres
from slamfusion.evidence.beams import judged_scans, scan_hits
from slamfusion.evidence.predictive import score_paths
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, OccupancyGrid
from slamfusion.io import load_map, open_log, read_trajectory, save_map, write_carmen, write_tum
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.fused_path import FusedPath
from slamfusion.jobs.inputs import RUN_DEFAULTS
from slamfusion.jobs.run import WHOLE, draw_run, fuse_drive, run_log, score_all_paths
from slamfusion.jobs.run_files import (
    DriveFusion,
    FailedProducer,
    LogRun,
    RunProducer,
    SavedMaps,
    save_run,
)
from slamfusion.jobs.run_many import LogTask, outcome
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, recorded
from tests.fusion.drawings import building
from tests.jobs.maps import CONFIG, device
from tests.slam.drives import CELL_M, draw_flat
from tests.support.documents import check_document
from tests.support.written_maps import fits, written_map

TWO = replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("tinyslam", "graph")))


@pytest.fixture(scope="module")
def told_run(place: Path) -> tuple[LogRun, list[tuple[str, float, int]]]:
    """The main job of two producers, and its progress."""
    vote = replace(TWO.fusion.vote, mode="consensus")
    config = replace(TWO, run=replace(TWO.run, draw=True), fusion=replace(TWO.fusion, vote=vote))
    told: list[tuple[str, float, int]] = []
    run = run_log(
        place / "flat.log", config, truth=place / "truth.tum",
        progress=lambda *words: told.append(words), prepare=lambda: told.append(("ready", 0, 0)),
    )  # fmt: skip
    return run, told


def test_the_main_job_from_a_log_to_files(
    told_run: tuple[LogRun, list[tuple[str, float, int]]], tmp_path: Path
) -> None:
    run, told = told_run
    assert [stage for stage, _, _ in told].count("ready") == 1
    assert {"tinyslam", "graph"} <= {stage for stage, _, _ in told}
    whole = [done for stage, done, _ in told if stage == WHOLE]
    assert whole == sorted(whole)
    assert len(set(whole)) > 5
    assert (whole[0], round(whole[-1], 2)) == (0, 0.92)  # the report follows
    assert [grid.name for grid in run.grids] == ["tinyslam", "graph"]
    assert run.error is None
    saved = save_run(run, tmp_path / "out")
    check_document(plain(saved), "run")
    assert saved.folder == tmp_path / "out"
    wanted = ["producers", "evidence", "path", "fusion", "drawing", "errors", "report"]
    assert list(saved.stages_s) == wanted
    answer = run.recommendation
    assert saved.recommendation is answer
    assert (answer.use, answer.path) == ("fused", "fused")
    assert answer.best_single in {"tinyslam", "graph"}
    assert {item.name for item in saved.path_evidence} == {"tinyslam", "graph", "fused"}
    page = (tmp_path / "out" / "report" / "report.html").read_text(encoding="utf-8")
    assert f"<h1>{answer.headline}</h1>" in page
    assert page.index("<strong>Single SLAM:</strong>") < page.index("maps were fused")
    assert list((tmp_path / "out" / "report").glob("*-evidence.png"))
    assert load_map(tmp_path / "out" / "fused.yaml").cells.tolist() == run.grid.cells.tolist()
    assert_path_and_drawing_lie_on_the_fused_map(saved, tmp_path / "out")

    assert_all_that_is_doubtful_is_told(saved)


def assert_all_that_is_doubtful_is_told(run: LogRun) -> None:
    """Of several logs as of one: what the job says of this run, had it gone less well."""
    first, second = run.usable.inputs
    left_out = [
        replace(first, accepted=False, reason="it fits nothing"),
        replace(second, copy_of=first.name, reason="a copy"),
    ]
    fusion = replace(run.fusion, result=replace(run.usable, inputs=left_out))
    producers = [
        replace(item, run=replace(item.run, low_scores_in_a_row=8))
        for item in run.producers
        if isinstance(item, RunProducer)
    ]
    died = FailedProducer(
        name="gmapping", failed="it was killed", process_time_s=1.0, process_cpu_s=None
    )
    less = replace(
        run,
        producers=(*producers, died),
        fusion=fusion,
        no_verdict="no scan saw a wall twice",
        why_voted="there is no path",
        not_measured=("the fused path: no pose in time",),
    )
    task = LogTask(Path("flat.log"), run.folder)
    found = outcome(task, less, ["flat.yaml: it is odd"])
    assert found.not_measured == less.not_measured
    assert (found.recommendation, found.error) == (run.recommendation, None)
    (stopped,) = [text for text in found.warnings if "tracking may be lost" in text]
    assert stopped.startswith("tinyslam, graph: ")
    assert [text for text in found.warnings if text != stopped] == [
        "flat.yaml: it is odd",
        "gmapping made no map: it was killed",
        f"{first.name} was rejected: it fits nothing",
        f"{second.name} is a copy: a copy; --keep-duplicates counts each",
        "the scans could not be asked about the paths: no scan saw a wall twice",
        "the fused map is not drawn, the maps vote (consensus): there is no path",
    ]


def assert_path_and_drawing_lie_on_the_fused_map(run: LogRun, out: Path) -> None:
    # Near the producers' paths as these were laid into it.
    path = read_trajectory(out / "fused.tum")
    told = run.fused_path
    assert told.file == out / "fused.tum"
    assert (told.poses, set(told.trust)) == (32, {"tinyslam", "graph"})
    assert max(told.trust.values()) == 1.0
    assert told.measures.truth.ate.rmse < 0.05
    for record in run.usable.accepted:
        made = run.results[record.name].run.trajectory
        if record.alignment is not None:
            made = made.moved(record.alignment.transform)
        assert np.hypot(*(made.poses - path.poses)[:, :2].T).max() < 0.15

    # The drawn map lies on the lattice of the fused one, and shows the same place.
    drawn = load_map(out / "drawn.yaml")
    written = run.drawn_map
    assert written.file == out / "drawn.yaml"
    assert written.wall_thickness_m.median < 0.2
    assert drawn.resolution == run.grid.resolution
    normalize = run.made_with.config.fusion.normalize
    walls, voted = (wall_centres(grid.classified(normalize)) for grid in (drawn, run.grid))
    assert np.median(KDTree(voted).query(walls)[0]) < 0.06


def test_a_main_job_that_cannot_begin_is_an_error(place: Path, tmp_path: Path) -> None:
    nobody = replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("nobody",)))
    with pytest.raises(ConfigError, match="nobody"):
        run_log(place / "flat.log", nobody)
    alone = replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("graph",)))
    with pytest.raises(ConfigError, match="found that of graph alone; "):
        run_log(place / "flat.log", alone)
    with pytest.raises(OSError, match=r"absent\.log"):
        run_log(tmp_path / "absent.log")


def test_a_start_that_names_no_input_ends_the_run_before_any_work(place: Path) -> None:
    """The producers' names and those of the saved maps are inputs, and no others."""
    saved = [place / "lab.yaml", place / "graph.yaml"]
    for start, words in (
        ({"hall": (0.0, 0.0, 0.0)}, r"'hall', .* are tinyslam, gmapping, graph, lab, graph \(s"),
        ({"karto": (0.0, 0.0, 0.0), "lab": (0.0, 0.0, 0.0)}, "'karto', which is no input"),
    ):
        with pytest.raises(StartError, match=words):
            run_log(place / "flat.log", replace(RUN_DEFAULTS, start=start), saved_maps=saved)


@pytest.mark.once
def test_a_saved_map_is_searched_around_its_start_in_the_frame_of_the_drive(
    place: Path, told_run: tuple[LogRun, list[tuple[str, float, int]]]
) -> None:
    """The producers, which begin in one frame, are searched everywhere all the same.

    Where it fits it votes beside the drawn map, which keeps all that it knows.
    """
    drawn = told_run[0].drawn_map
    grid = drawn.grid
    moved = Pose2(6.0, -2.0, 1.0)
    save_map(replace(grid, origin=moved.compose(grid.origin)), place / "saved")
    right = moved.inverse()
    config = replace(TWO, start={"saved": (right.x + 0.5, right.y, right.yaw_rad)})
    run = run_log(place / "flat.log", config, saved_maps=[place / "saved.yaml"])
    became = {record.name: record.accepted for record in run.usable.inputs}
    assert became == {"tinyslam": True, "graph": True, "saved": True}
    assert (run.fused_mode, run.why_voted, run.drawn_map) == ("drawn", None, None)
    assert set(run.usable.weights) == {"drawn", "saved"}
    (saved,) = (record for record in run.usable.inputs if record.name == "saved")
    known = int((saved.grid.cells >= 0).sum())
    # Turned onto another lattice some cells are read twice, and some not at all.
    assert (saved.aligned >= 0).sum() == pytest.approx(known, rel=0.02)
    assert (run.usable.fused.cells[saved.aligned == 0] >= 0).all()


@pytest.mark.once
def test_a_saved_map_brings_its_path(place: Path, tmp_path: Path) -> None:
    """It is in a frame of its own, and has a pose for each third scan."""
    moved = Pose2(6.0, -2.0, 1.0)
    walls = np.where(draw_flat() == 1, 100, 0).astype(np.int8)
    save_map(OccupancyGrid(walls, CELL_M, moved), tmp_path / "karto" / "map")
    save_map(OccupancyGrid(np.full_like(walls, -1), CELL_M, moved), tmp_path / "blank")
    truth = read_trajectory(place / "truth.tum").moved(moved)
    write_tum(tmp_path / "karto" / "poses.tum", Trajectory(truth.stamps_s[::3], truth.poses[::3]))
    config = replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("graph",)))
    run = run_log(
        place / "flat.log", config, truth=place / "truth.tum",
        saved_maps=[tmp_path / "karto" / "map.yaml", tmp_path / "blank.yaml"],
        saved_paths=[
            CaseFile(tmp_path / "karto" / "poses.tum", "map"),
            CaseFile(place / "truth.tum", "blank"),
        ],
    )  # fmt: skip
    assert not run.not_measured
    assert {path.name for path in run.recommendation.paths} == {"graph", "map", "blank", "fused"}
    assert run.recommendation.best_single in {"graph", "map"}
    # With one producer alone there would be no fused path, and nothing to draw at.
    assert set(run.fused_path.trust) == {"graph", "map", "blank"}
    assert run.fused_mode == "drawn"
    assert set(run.usable.weights) == {"drawn"}, "its path holds all that its map knows"
    (gap,) = run.fusion.gaps
    assert {gap.a, gap.b} == {"graph", "map"}
    assert gap.median_m < 0.1
    saved = save_run(run, tmp_path / "out")
    check_document(plain(saved), "run")
    told, _ = saved.saved_paths
    assert (told.name, told.poses) == ("map", 11)
    assert told.measures.truth.ate.rmse == pytest.approx(0.0, abs=1e-6)
    own = next(item for item in saved.path_evidence if item.name == "map")
    assert own.own_poses_share == pytest.approx(1.0 / 3.0, abs=0.05)
    assert own.covered_share > 0.9
    page = (tmp_path / "out" / "report" / "report.html").read_text(encoding="utf-8")
    assert '<td class="plain">map</td><td class="plain">ATE, translation [m]</td>' in page


@pytest.mark.once
def test_a_mirrored_path_of_a_saved_map_is_named(tmp_path: Path) -> None:
    yaws = [[0.0, 0.0, math.sin(2.0 * stamp_s)] for stamp_s in circuit().stamps_s]
    truth = replace(circuit(), poses=circuit().poses + yaws)
    write_carmen(tmp_path / "drive.log", recorded(truth))
    write_tum(tmp_path / "karto.tum", replace(truth, poses=truth.poses * (1.0, -1.0, -1.0)))
    cells = np.zeros((40, 60), np.int8)
    cells[5] = OCCUPIED
    save_map(OccupancyGrid(cells, CELL_M), tmp_path / "karto")
    run = run_log(
        tmp_path / "drive.log",
        replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("tinyslam",))),
        saved_maps=[tmp_path / "karto.yaml"],
        saved_paths=[CaseFile(tmp_path / "karto.tum")],
    )
    assert run.recommendation.path == "tinyslam"
    assert "karto: the path is mirrored: negate its y and yaw" in run.sentences()
    assert run.recommendation.laser_fault is None


def test_a_path_that_cannot_be_used_is_told_and_the_map_votes(tmp_path: Path) -> None:
    truth = circuit()
    write_carmen(tmp_path / "drive.log", recorded(truth))
    scans = judged_scans(open_log(tmp_path / "drive.log"))
    evidence = score_paths(scans, {"graph": truth}, NumpyDevice())
    paths, troubles = {"graph": truth}, []
    begin = Trajectory(truth.stamps_s[:4], truth.poses[:4])
    late = Trajectory(truth.stamps_s + 1e6, truth.poses)
    found, reason = score_all_paths(
        lambda: scans,
        paths,
        {"begin": begin, "late": late, "whole": truth},
        NumpyDevice(),
        lambda name, why: troubles.append(f"{name}: {why}"),
    )
    assert reason is None
    assert set(found.scores) == {"graph", "whole"}
    assert set(paths) == {"graph", "whole"}
    assert found.scores["graph"].consistency == evidence.scores["graph"].consistency
    short, never = troubles
    assert short.startswith("begin: it has poses for ")
    assert "wanted 50%" in short
    assert never.startswith("late: it has poses for 0% of the scans")


def test_a_path_belongs_to_a_saved_map(place: Path) -> None:
    path = CaseFile(place / "truth.tum")
    with pytest.raises(ConfigError, match="the path needs its map; give it with --inputs"):
        run_log(place / "flat.log", saved_paths=[path])
    maps = ["a/map.yaml", "b/map.yaml"]
    found = SavedMaps.of(maps, [CaseFile(Path("b/map.tum"))])
    assert found.paths == {"b/map": Path("b/map.tum")}
    with pytest.raises(ConfigError, match="says none of the cases a/map, b/map"):
        SavedMaps.of(maps, [path])
    assert SavedMaps.of(["graph.yaml"], [path]).paths == {"graph (saved)": path.path}


def test_where_nothing_can_be_drawn_the_maps_vote(place: Path) -> None:
    scans = [*scan_hits(open_log(place / "flat.log"))]
    a_map = written_map("a", "|#..#|")
    vote = DriveFusion((), fits(a_map, a_map.with_name("b")))
    late = Trajectory(np.array([1e6, 1e6 + 1.0]), np.zeros((2, 3)), "fused")
    no_scan = FusedPath(trajectory=late, trust={})
    for path, why in (
        (None, "fewer than two producers have a path"),
        (no_scan, "give a path of this"),
    ):
        *made, told = draw_run(lambda: scans, path, vote, (), RUN_DEFAULTS, NumpyDevice())
        assert made == [vote, None]
        assert why in str(told)
    voted = replace(RUN_DEFAULTS.fusion.vote, mode="majority")
    other = replace(RUN_DEFAULTS, fusion=replace(RUN_DEFAULTS.fusion, vote=voted))
    assert draw_run(lambda: scans, None, vote, (), other, NumpyDevice())[2] is None


def test_what_goes_wrong_while_preparing_ends_the_run(place: Path) -> None:
    def prepare() -> None:
        raise SlamFusionError("no plots here")

    with pytest.raises(SlamFusionError, match="no plots here"):
        run_log(place / "flat.log", prepare=prepare)


def test_where_nothing_is_fused_a_map_to_go_on_with_is_named() -> None:
    grids = [building(3).with_name("a"), building(4).with_name("b")]
    paths = {
        name: Trajectory(np.arange(2.0), np.array([[0.0, 0, 0], [9.0 * index, 0, 0]]))
        for index, name in enumerate("ab")
    }
    none = fuse_drive([], {}, CONFIG, device(), shared_frame=True)
    assert (none.result, none.fallback) == (None, None)
    assert "needs at least 2 maps, found 0" in str(none.failure)
    single = fuse_drive(grids[:1], paths, CONFIG, device(), shared_frame=True)
    assert single.fallback is grids[0]
    apart = fuse_drive(grids, paths, CONFIG, device(), shared_frame=False)
    assert apart.result is None
    assert apart.fallback in grids
    assert len(apart.pairs) == 1
    assert isinstance(apart.failure, AlignmentError)
