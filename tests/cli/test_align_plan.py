"""``align --scale`` and what it saves."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from slamfusion.io.images import encode_image
from slamfusion.io.map_server import load_map
from tests.cli.command import MAPS, SAMPLE, json_of, run, tree

# The true map's picture alone, with twice its cells: they are found to be half as large.
PLAN = ("--resolution", "0.1", "--scale", "0.04:0.065")


def test_a_plan_gets_its_resolution_and_the_map_lies_in_its_frame(tmp_path: Path) -> None:
    placed = tmp_path / "placed"
    done = run("align", MAPS[1], SAMPLE / "truth.pgm", *PLAN, "-o", placed, "--json")
    found = json_of(done)
    assert found["resolution"] == pytest.approx(0.05, rel=0.01)
    assert found["scale"] == pytest.approx(0.5, rel=0.01)
    assert sorted(tree(placed)) == [
        "map.png", "map.yaml", "overlay.png", "plan.pgw", "plan.png", "plan.yaml",
    ]  # fmt: skip
    plan, seen = load_map(placed / "plan.yaml"), load_map(placed / "map.yaml")
    assert plan.resolution == found["resolution"]
    assert seen.origin.yaw_rad == 0.0
    # Most walls of the map, now in the plan's frame, are on or next to walls of the plan.
    rows, cols = np.nonzero(seen.cells == 100)
    x, y = (seen.cell_centres(rows, cols) / plan.resolution).astype(int).T
    near = np.pad(plan.cells == 100, 4)
    wide = np.any([np.roll(near, (i, j), (0, 1)) for i in (-2, 0, 2) for j in (-2, 0, 2)], axis=0)
    height, width = wide.shape
    met = wide[np.clip(y + 4, 0, height - 1), np.clip(x + 4, 0, width - 1)]
    assert np.mean(met) > 0.8
    # The world file places the picture in the map's frame: a row to the right, a row down.
    lines = (placed / "plan.pgw").read_text().splitlines()
    along, across, down_x, down_y = (float(line) for line in lines[:4])
    assert np.hypot(along, across) == pytest.approx(found["resolution"])
    assert (down_x, down_y) == (across, -along)
    assert np.arctan2(across, along) == pytest.approx(found["yaw_rad"], abs=1e-6)


def test_a_plan_serves_as_truth_before_its_scale_is_known(tmp_path: Path) -> None:
    truth = ("--truth", SAMPLE / "truth.pgm", *PLAN)
    (own,) = json_of(run("evaluate", MAPS[1], *truth, "--json"))["maps"]
    (known,) = json_of(run("evaluate", MAPS[1], "--truth", SAMPLE / "truth.yaml", "--json"))["maps"]
    assert own["aligned"]
    assert known["mapped"] is None
    assert own["mapped"] == pytest.approx(known["wall_recall"], abs=0.05)
    assert own["wall_f1"] == pytest.approx(known["wall_f1"], abs=0.05)
    fused = run("fuse", *MAPS[:2], "-o", tmp_path / "fused", *truth)
    assert "fused has seen" in fused.stdout
    assert "of the walls of truth, at 0.0" in fused.stdout
    # All maps are compared with a plan of one size.
    assert len(set(re.findall(r"at (\S+) m per pixel", fused.stdout))) == 1


def test_of_a_plan_of_another_place_nothing_is_seen(tmp_path: Path) -> None:
    cells = np.full((300, 300), 254, np.uint8)
    cells[::30] = cells[:, 40:44] = 0
    (tmp_path / "plan.pgm").write_bytes(encode_image(cells, "pgm"))
    done = run("evaluate", MAPS[1], "--truth", tmp_path / "plan.pgm", *PLAN)
    assert "not aligned: map_b: " in done.stderr
    assert "has seen" not in done.stdout
