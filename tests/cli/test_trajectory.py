"""``slamfusion trajectory`` as a user starts it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from slamfusion.io import write_tum
from slamfusion.trajectory import Trajectory
from tests.cli.command import assert_one_line_failure, json_of, run

# Four poses along a bend, a second apart; the estimate's last place is 0.2 m off to its left.
TRUTH = [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (2.0, 2.0, 0.0, 0.0), (3.0, 3.0, 0.0, 0.0)]
ESTIMATE = [*TRUTH[:3], (3.0, 3.0, 0.2, 0.0)]


def tum(path: Path, rows: list[tuple[float, float, float, float]]) -> Path:
    stamps_s, *poses = np.array(rows).T
    write_tum(path, Trajectory(stamps_s, np.stack(poses, axis=1)))
    return path


def table(path: Path, rows: list[tuple[float, ...]]) -> Path:
    np.savetxt(path, rows, fmt="%.9f")
    return path


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """An estimate, the truth, relations, and odometry with a row every half second."""
    folder = tmp_path / "in"
    folder.mkdir()
    relations = [(0, 1, 1, 0, 0, 0, 0, 0), (0, 3, 3, 0, 0, 0, 0, 0), (0, 2.5, 2.5, 0, 0, 0, 0, 0)]
    odometry = [(0.5 * index, 0.6 * index, 7.0, 0.0) for index in range(7)]
    return {
        "estimate": tum(folder / "slam.tum", ESTIMATE),
        "truth": tum(folder / "true.tum", TRUTH),
        "relations": table(folder / "run.relations", relations),
        "odometry": table(folder / "wheels.txt", odometry),
        "log": table(folder / "scans.txt", [odometry[index] for index in (0, 2, 4, 6)]),
    }


def options(files: dict[str, Path], *names: str) -> list[str | Path]:
    return [part for name in names for part in (f"--{name}", files[name])]


@pytest.mark.parametrize(("names", "by"), [(("log",), "odometry"), ((), "stamp")])
def test_odometry_lets_every_relation_count(
    files: dict[str, Path], names: tuple[str, ...], by: str
) -> None:
    asked = options(files, "relations", "odometry", *names)
    document = json_of(run("trajectory", files["estimate"], *asked, "--json"))
    assert (document["relations_used"], document["relations_total"]) == (3, 3)
    # At 2.5 s: the pose of 2 s (of two equally near the earlier), 0.6 m further by the wheels.
    assert document["translation"]["mean"] == pytest.approx((0.0 + 0.2 + 0.1) / 3)
    assert document["odometry"] == {
        "rows": 7,
        "rows_found_by": by,
        "poses_used": 4,
        "poses_without_row": 0,
    }
    assert document["poses"] == 4


def test_a_path_of_a_part_of_the_drive_shows_how_much_it_covers(files: dict[str, Path]) -> None:
    part, asked = tum(files["truth"].with_name("part.tum"), TRUTH[:2]), options(files, "truth")
    assert "2 of 2 poses met one of true within 0.01 s and cover 33% of its time" in (
        run("trajectory", part, *asked).stdout
    )
    both = run("trajectory", part, files["estimate"], *asked, *options(files, "relations"))
    heads, *rows = (line.split("\t") for line in both.stdout.splitlines() if "\t" in line)
    shares = {row[1]: dict(zip(heads, row, strict=True)) for row in rows}
    wanted = {"truth covered": ["0.333", "1.000"], "relations used": ["0.333", "0.667"]}
    for column, of_paths in wanted.items():
        assert [shares[name][f"{column}, share"] for name in ("part", "slam")] == of_paths


def test_the_truth_in_a_folder_of_paths_is_no_path(files: dict[str, Path]) -> None:
    folder = files["truth"].parent
    document = json_of(run("trajectory", folder, *options(files, "truth"), "--json"))
    assert document["estimate"] == str(files["estimate"])


def test_a_folder_without_a_path_is_named_with_what_it_holds(tmp_path: Path) -> None:
    truth = tum(tmp_path / "true.tum", TRUTH)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "map.yaml").touch()
    done = run("trajectory", tmp_path / "run", "--truth", truth)
    assert_one_line_failure(done, "wanted a folder with .tum files", "found one with map.yaml")


def test_a_truth_in_millimetres_is_named_once(tmp_path: Path) -> None:
    rows = [(0.5 * i, math.sin(0.2 * i), 1.0 - math.cos(0.2 * i), 0.2 * i) for i in range(40)]
    path = tum(tmp_path / "slam.tum", rows)
    scaled = tum(tmp_path / "mm.tum", [(t, 1e3 * x, 1e3 * y, yaw) for t, x, y, yaw in rows])
    (notice,) = run("trajectory", path, scaled, "--truth", path).stderr.splitlines()
    assert notice.startswith("slamfusion: mm is off slam by 980.9 m and")
    assert notice.endswith("multiplied by 0.001: is one of them in another unit than metres?")
