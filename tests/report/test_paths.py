"""The pictures of paths: what lies where, in which colour, and that odd paths can be drawn."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import ReportConfig, RunConfig, TrajectoryConfig
from slamfusion.evaluation.measured import GroundTruth, Measures
from slamfusion.evaluation.relations import RelationErrors
from slamfusion.evaluation.trajectory_error import trajectory_errors
from slamfusion.geometry import compose_poses
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.cases import Placed
from slamfusion.jobs.inputs import LogFiles
from slamfusion.jobs.map_log import SlamProducer, write_slam_report
from slamfusion.jobs.trajectory import MeasuredTrajectory, write_trajectories
from slamfusion.palette import END_RGB, NAMED, OTHERS, START_RGB
from slamfusion.report import paths
from slamfusion.report.errors import distribution_figure
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.trajectory import Trajectory
from tests.report.drawn import NASTY, centre, near, pixels, room, run_of

pytestmark = pytest.mark.once

CONFIG = RunConfig()
# The colour of a path that nobody knows by its name, and of what else it may have been.
ESTIMATE, OTHER = OTHERS[:2]


def path_of(places: list[tuple[float, float]]) -> Trajectory:
    poses = np.column_stack((np.array(places), np.zeros(len(places))))
    return Trajectory(np.arange(len(places), dtype=np.float64), poses, "path")


def corner() -> Trajectory:
    """Ten metres to the right, then ten up."""
    right = [(float(x), 0.0) for x in range(11)]
    return path_of([*right, *[(10.0, float(y)) for y in range(1, 11)]])


def own_map() -> OccupancyGrid:
    """A room of 3 m x 2 m whose corner is at (-3, 500)."""
    return room("room", 1)


def in_room(wrong: float = 0.0) -> Trajectory:
    """A round in the room of ``own_map``."""
    turn = np.linspace(0.0, 2.0 * np.pi, 60)
    errors = wrong * np.sin(5.0 * turn)
    poses = np.column_stack(
        (-1.5 + np.cos(turn) + errors, 501.0 + 0.5 * np.sin(turn) - errors, turn + np.pi / 2)
    )
    return Trajectory(np.arange(60.0), poses, "round")


def relations_of_round() -> RelationErrors:
    return RelationErrors(
        relations_total=99,
        tolerance_s=0.01,
        poses=9,
        name="a",
        relations="b",
        stamps_s=np.array([[0.0, 1.0], [2.0, 50.0]]),
        translation_m=np.array([0.1, 0.2]),
        rotation_rad=np.array([0.01, 0.02]),
    )


def test_up_is_up_and_both_ends_are_marked() -> None:
    image = pixels(paths.path_picture(corner()))
    start, end = centre(image, START_RGB), centre(image, END_RGB)
    assert start[0] < 0.3
    assert end[0] > 0.6
    assert end[1] < 0.3
    assert start[1] > 0.6


def test_every_path_has_its_colour() -> None:
    truth = Trajectory(corner().stamps_s, compose_poses((0.0, 2.0, 0.0), corner().poses))
    wheels = Trajectory(corner().stamps_s, compose_poses((0.0, -2.0, 0.0), corner().poses))
    own = paths.Line(corner(), "estimate", ESTIMATE)
    lines = [paths.odometry_line(wheels), own, paths.truth_line(truth)]
    image = pixels(paths.paths_picture(lines, corner()))
    image = image[25:-100, 125:-25]  # without the lettering, whose grey is much like odometry's
    heights = [centre(image, colour)[1] for colour in (NAMED["truth"], ESTIMATE, NAMED["odometry"])]
    assert heights == sorted(heights)
    # Dashed: of the same path less is drawn.
    assert near(image, NAMED["truth"]).sum() < 0.75 * near(image, ESTIMATE).sum()
    legend = list(paths.paths_legend(lines))
    assert legend[:3] == ["truth, dashed", "estimate", "raw odometry"]


@pytest.mark.parametrize(
    "places",
    [
        [(7.0, 8.0)],
        [(7.0, 8.0)] * 5,
        [(0.0, 0.0), (1000.0, 0.0)],
        [(0.0, 0.0), (0.0, 1000.0)],
        [(1e6, -1e6), (1e6 + 1.0, -1e6)],
    ],
)
def test_odd_paths_can_be_drawn(places: list[tuple[float, float]]) -> None:
    for png in (
        paths.path_picture(path_of(places)),
        paths.path_picture(path_of(places), values=np.zeros(len(places))),
        paths.paths_picture([paths.truth_line(path_of(places))], path_of(places)),
    ):
        assert max(pixels(png).shape) < 2000


def result_of(run: ProducerRun, measures: Measures) -> SlamProducer:
    return SlamProducer(
        run=run, measures=measures, map_error=None, device="a device", resumed_from=None
    )


def test_the_report_of_a_run_has_all_parts(tmp_path: Path) -> None:
    truth = Trajectory(in_room().stamps_s, compose_poses((5.0, 6.0, 1.0), in_room().poses), "true")
    run = run_of(
        NASTY, own_map(), in_room(wrong=0.1), odometry=in_room(wrong=0.3), low_scores_in_a_row=8
    )
    errors = trajectory_errors(run.trajectory, truth, CONFIG.trajectory)
    result = result_of(run, Measures(errors, relations_of_round()))
    page = write_slam_report(result, tmp_path, CONFIG, truth).read_text(encoding="utf-8")
    for words in (
        f"{run.scans_used} of {run.scans}",
        "tracking may be lost",
        "8 of them in a row",
        "The path over the map",
        "The path and others",
        "Error against the truth over the drive",
        "Error against the truth, distribution",
        "Where the error is",
        "Error on known relations over the drive",
        "ATE rmse",
        "a device",
        "its map may be wrong (60 poses",
    ):
        assert words in page
    assert "<script>alert" not in page
    used = page.index("scans used")
    assert page.index("tracking may be lost") < page.index("ATE rmse") < used


def test_the_report_of_a_run_shows_its_series_and_other_paths(tmp_path: Path) -> None:
    stamps = np.arange(60.0)
    run = run_of(
        "filter",
        own_map(),
        in_room(),
        series=(
            Series("effective particles", "", stamps, stamps, limit=15.0),
            Series("map", "MB", stamps, stamps),
            Series("nothing yet", "", stamps[:0], stamps[:0]),
        ),
        other_paths=(in_room(wrong=0.1), in_room(wrong=0.2)),
    )
    page = write_slam_report(result_of(run, Measures()), tmp_path, CONFIG).read_text(
        encoding="utf-8"
    )
    assert "From the top: effective particles, map." in page
    assert page.index("The path and others") < page.index("Over the run")
    names = sorted(path.name for path in tmp_path.glob("*.png"))
    assert names[2:] == ["03-paths.png", "04-over-time.png"]


def measured(name: str, wrong: float) -> MeasuredTrajectory:
    path, truth = in_room(wrong=wrong), in_room()
    errors = trajectory_errors(path, truth, TrajectoryConfig(alignment="none"))
    return MeasuredTrajectory(
        trajectory=path,
        measures=Measures(errors, relations_of_round()),
        file=Path(f"{name}.tum"),
        ground_truth=GroundTruth(truth=truth),
        duration_s=59.0,
        files=LogFiles(),
        placed=Placed("round", name, Path()),
    )


def test_the_report_of_a_trajectory_says_what_its_numbers_rest_on(tmp_path: Path) -> None:
    page = write_trajectories([measured("graph", 0.1)], tmp_path, CONFIG).read_text("utf-8")
    assert "60 of 60 poses met one of round within 0.01 s and cover 100% of its time, " in page
    assert " of its time, not aligned; 59 pairs." in page
    assert "2 of 99 relations used, poses within 0.01 s of both times; " in page
    assert "revisits, translation m" in page


def test_several_paths_share_their_figures_and_the_nearest_leads(tmp_path: Path) -> None:
    """One page: all paths over the truth, their errors in one figure, and their distribution."""
    config = replace(CONFIG, report=ReportConfig(("svg",)))
    page = write_trajectories([measured("far", 0.3), measured(NASTY, 0.1)], tmp_path, config)
    text = page.read_text("utf-8")
    assert re.search(r"<h1>&lt;script.*the nearest of 2</h1>", text)
    stems = ["error", "error-distribution", "relations", "relations-distribution"]
    assert [path.stem for path in sorted(tmp_path.glob("*.svg"))] == [
        f"{number:02d}-{stem}" for number, stem in enumerate(["round-paths", *stems], start=1)
    ]
    for path in tmp_path.glob("*.svg"):
        assert ">far<" in path.read_text("utf-8"), path


def test_a_distribution_shows_the_bulk_and_a_box_for_each_path() -> None:
    errors = {"a": np.append(np.linspace(0.0, 1.0, 999), 50.0), "b": np.linspace(1.0, 2.0, 100)}
    colours = {"a": NAMED["graph"], "b": NAMED["gmapping"]}
    above, below = distribution_figure(errors, colours).axes
    assert above.get_xlim()[1] == pytest.approx(1.05 * 1.99)  # not the one error of 50 m
    assert [name.get_text() for name in below.texts] == ["a", "b"]
    assert below.get_xlim() == above.get_xlim()
