"""The commands on the bundled maps, started as a user starts them."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, CellBox, OccupancyGrid
from slamfusion.io import load_map, save_map
from tests.cli.command import MAPS, TRUTH, json_of, run, run_here, tree

pytestmark = pytest.mark.usefixtures("remembered_searches")


def pose_of(record: dict[str, Any]) -> Pose2:
    return Pose2(record["dx_m"], record["dy_m"], record["yaw_rad"])


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of another place: a big empty hall with a zigzag through it."""
    folder = tmp_path_factory.mktemp("stranger")
    cells = np.zeros((240, 240), dtype=np.int8)
    cells[[0, -1]] = OCCUPIED
    cells[:, [0, -1]] = OCCUPIED
    for step in range(0, 200, 2):
        fold = abs(step % 80 - 40)
        cells[20 + step : 23 + step, 60 + 3 * fold : 64 + 3 * fold] = OCCUPIED
    return save_map(OccupancyGrid(cells[::-1], 0.05), folder / "stranger")[0]


def test_transforms_are_printed_ready_to_paste(tmp_path: Path) -> None:
    """Also of a map whose name a shell would take apart."""
    for path in (Path(MAPS[1]), Path(MAPS[1]).with_suffix(".pgm")):
        shutil.copy(path, tmp_path)
    odd = (tmp_path / "map_b.yaml").rename(tmp_path / "map b's.yaml")
    maps = (MAPS[0], odd)
    first = run_here("fuse", *maps, "-o", tmp_path / "first", "--verbose")
    assert "\nFused 2 of 2 maps in the frame of map_a (the first map given).\n" in first.stdout
    (starts,) = (shlex.split(line) for line in first.stdout.splitlines() if "--start" in line)
    (transform,) = (shlex.split(line) for line in first.stdout.splitlines() if "--yaw" in line)
    document = json_of(run_here("fuse", *maps, "-o", tmp_path / "again", *starts, "--json"))
    assert document["config"]["start"]["map_a"] == [0.0, 0.0, 0.0]
    found = pose_of(document["inputs"][1])
    assert document["config"]["start"]["map b's"] == pytest.approx(
        [found.x, found.y, found.yaw_rad], abs=1e-2
    )
    assert transform[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    options = dict(zip(transform[4::2], transform[5::2], strict=True))
    assert (options["--frame-id"], options["--child-frame-id"]) == ("map_a", "map b's")
    numbers = [float(options[name]) for name in ("--x", "--y", "--yaw")]
    assert numbers == pytest.approx([found.x, found.y, found.yaw_rad], abs=1e-2)


def test_the_frame_is_that_of_the_first_map_that_is_fused(tmp_path: Path, stranger: Path) -> None:
    done = run_here("fuse", stranger, *MAPS[:2], "-o", tmp_path / "out")
    assert "in the frame of map_a (the first map that fits; before it: stranger)." in done.stdout


def test_like_paper_names_what_the_box_of_the_smallest_map_leaves_out(tmp_path: Path) -> None:
    large = load_map(TRUTH)
    save_map(large.crop(CellBox(0, 0, large.height, large.width // 2)), tmp_path / "half")
    asked = ("fuse", TRUTH, tmp_path / "half.yaml", "-o", tmp_path / "out", "--like-paper")
    report = tmp_path / "report"
    done = run_here(*asked, "--report", report, "--json")
    document = json_of(done)
    assert document["reference"] == "half"
    assert document["config"]["fusion"]["vote"]["unknown"] == "value"
    outside = np.count_nonzero(large.cells[:, large.width // 2 :] >= 0) * large.resolution**2
    assert document["left_out_m2"] == pytest.approx({"truth": outside}, rel=0.01)
    assert document["groups"][0]["left_out_m2"] == document["left_out_m2"]
    area = f"{document['left_out_m2']['truth']:.1f}"
    assert f"the box of half leaves out: {area} m2 of truth; --extent union keeps it" in done.stderr
    assert f"{area} m2 of truth" in (report / "report.html").read_text(encoding="utf-8")
    document = json_of(run_here(*asked, "--extent", "union", "--json"))
    assert document["left_out_m2"] == {}


def test_a_fusion_that_fails_leaves_the_earlier_map_and_report(
    tmp_path: Path, stranger: Path
) -> None:
    options = ("-o", tmp_path / "out", "--report", tmp_path / "report")
    assert run_here("fuse", *MAPS[:2], *options).returncode == 0
    before = tree(tmp_path)
    assert run_here("fuse", MAPS[0], stranger, *options).returncode == 1
    after = tree(tmp_path)
    assert after.items() >= before.items()
    assert after["report/failed/report.html"]
    assert all(name.startswith("report/failed") for name in set(after) - set(before))


def test_options_override_the_config_file(tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(
        "seed: 7\nfusion: {vote: {unknown: abstain}, align: {coarse_cells: 50}}\n", encoding="utf-8"
    )
    arguments = ("fuse", *MAPS[:2], "-o", tmp_path / "out", "--config", config)
    done = run_here(*arguments, "--unknown", "value", "--json")
    assert done.returncode == 0, done.stderr
    effective = json_of(done)["config"]
    assert effective["seed"] == 7
    assert effective["fusion"]["vote"]["unknown"] == "value"
    assert effective["fusion"]["align"]["coarse_cells"] == 50


def test_devices_lists_each_with_its_index() -> None:
    devices = json_of(run("devices", "--json"))["devices"]
    assert [device["index"] for device in devices] == list(range(len(devices)))
    assert run("devices").returncode == 0


def test_doctor_passes_where_the_tests_run() -> None:
    done = run("doctor", "--json", env={"ROS_DISTRO": ""})
    document = json_of(done)
    assert done.returncode == 0, document["problems"]
    assert document["ok"] is True
    assert document["self_test"]
    assert all(test["passed"] for test in document["self_test"])


def test_maps_that_are_mirrored_against_the_truth_are_named(tmp_path: Path) -> None:
    truth = load_map(TRUTH)
    image = OccupancyGrid(truth.cells[:, ::-1], truth.resolution, truth.origin, "image")
    save_map(image, tmp_path / "image")
    done = run_here("fuse", *MAPS, "-o", tmp_path / "fused", "--truth", tmp_path / "image.yaml")
    assert done.returncode == 0
    assert "not aligned: fused: its mirror image fits" in done.stderr


def test_maps_that_are_used_as_they_are_do_not_count_as_aligned() -> None:
    for options, shown in (((), "yes"), (("--no-align",), "as is")):
        done = run_here("evaluate", MAPS[0], "--truth", MAPS[0], *options)
        assert f"\nmap_a\t{shown}\t0.00\t" in done.stdout


SQUARE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 1.5
VERTEX_SE2 2 1 1.2 3.1
VERTEX_SE2 3 0 1 -1.6
EDGE_SE2 0 1 1 0 1.5707963267948966 100 0 0 100 0 400
EDGE_SE2 1 2 1 0 1.5707963267948966 100 0 0 100 0 400
EDGE_SE2 2 3 1 0 1.5707963267948966 100 0 0 100 0 400
EDGE_SE2 3 0 1 0 1.5707963267948966 100 0 0 100 0 400
"""


def test_a_square_is_straightened_and_written(tmp_path: Path):
    graph, out, tum = (tmp_path / name for name in ("square.g2o", "out.g2o", "out.tum"))
    graph.write_text(SQUARE)
    done = run("graph", "optimize", graph, "-o", out, "--tum", tum, "--json")
    assert done.returncode == 0, done.stderr
    json_of(done)
    again = run("graph", "optimize", out, "--json")
    assert again.returncode == 0
    corners = [line.split()[2:4] for line in out.read_text().splitlines() if "VERTEX" in line]
    wanted = [(0, 0), (1, 0), (1, 1), (0, 1)]
    np.testing.assert_allclose(np.array(corners, dtype=float), wanted, atol=1e-6)
    assert len(tum.read_text().splitlines()) >= 4
