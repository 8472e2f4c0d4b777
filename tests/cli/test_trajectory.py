"""``slamfusion trajectory`` as a user starts it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.cli.command import json_of, run

pytestmark = pytest.mark.once


# Four poses along a bend, a second apart; the estimate's last place is 0.2 m off to its left.
TRUTH = [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (2.0, 2.0, 0.0, 0.0), (3.0, 3.0, 0.0, 0.0)]
ESTIMATE = [*TRUTH[:3], (3.0, 3.0, 0.2, 0.0)]
FIGURES = {"mean", "std", "rmse", "median", "min", "max"}


def tum(path: Path, rows: list[tuple[float, float, float, float]]) -> Path:
    lines = [
        f"{t} {x} {y} 0 0 0 {math.sin(yaw_rad / 2)} {math.cos(yaw_rad / 2)}"
        for t, x, y, yaw_rad in rows
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


def table(path: Path, rows: list[tuple[float, ...]]) -> Path:
    lines = [" ".join(f"{value:.9f}" for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
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


def test_relations_give_the_promised_keys(files: dict[str, Path]) -> None:
    done = run("trajectory", files["estimate"], *options(files, "relations"), "--json")
    assert done.returncode == 0, done.stderr
    document = json_of(done)
    assert set(document["translation"]) == set(document["rotation_deg"]) == FIGURES
    assert document["translation"]["mean"] == pytest.approx(0.1)
    assert document["translation"]["max"] == pytest.approx(0.2)
    assert (document["relations_used"], document["relations_total"]) == (2, 3)
    assert (document["tolerance_s"], document["poses"]) == (0.01, 4)
    assert document["odometry"] is None
    assert document["config"]["trajectory"]["tolerance_s"] == 0.01
    assert document["versions"]["numpy"] == np.__version__
    assert document["path_length_m"] == pytest.approx(2.0 + math.hypot(1.0, 0.2))


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


def test_truth_gives_absolute_and_relative_errors(files: dict[str, Path]) -> None:
    asked = [*options(files, "truth"), "--alignment", "none", "--json"]
    document = json_of(run("trajectory", files["estimate"], *asked))
    assert set(document["ate"]) == set(document["rpe"]) == FIGURES
    assert document["ate"]["rmse"] == pytest.approx(0.1)
    assert document["ate"]["max"] == pytest.approx(0.2)
    assert document["rpe"]["mean"] == pytest.approx(0.2 / 3)
    assert (document["rpe_pairs"], document["rpe_unit"]) == (3, "frames")
    assert (document["poses"], document["poses_matched"]) == (4, 4)


def test_options_decide_how_errors_are_counted(files: dict[str, Path]) -> None:
    asked = [*options(files, "truth"), "--rpe-unit", "m", "--rpe-delta", "1.5", "--json"]
    document = json_of(run("trajectory", files["estimate"], *asked))
    assert document["rpe_pairs"] == 1
    assert document["ate"]["rmse"] < 0.1
    assert document["alignment"]["kind"] == "se2"
    assert document["config"]["trajectory"]["rpe_unit"] == "m"
