"""data/sample is what data/make_sample.py makes, small, and true."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED
from slamfusion.io.map_server import load_map

DATA = Path(__file__).resolve().parents[2] / "data"
SAMPLE = DATA / "sample"


def test_script_makes_the_same_bytes_again(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "data.make_sample", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, timeout=120, cwd=DATA.parent)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    kept = {path.name: path.read_bytes() for path in SAMPLE.iterdir()}
    assert made.keys() == kept.keys()
    assert [name for name in made if made[name] != kept[name]] == []


def test_sample_is_small() -> None:
    assert sum(path.stat().st_size for path in SAMPLE.iterdir()) < 300_000


def test_transforms_lay_walls_on_walls() -> None:
    truth = load_map(SAMPLE / "truth.yaml")
    near = np.pad(truth.cells == OCCUPIED, 2)
    near = np.any(
        [np.roll(near, (row, col), (0, 1)) for row in (-1, 0, 1) for col in (-1, 0, 1)], axis=0
    )
    transforms = yaml.safe_load((SAMPLE / "transforms.yaml").read_text(encoding="utf-8"))
    assert sorted(transforms) == ["map_a", "map_b", "map_c"]
    for name, values in transforms.items():
        grid = load_map(SAMPLE / f"{name}.yaml")
        pose = Pose2(values["dx_m"], values["dy_m"], values["yaw_rad"])
        walls = grid.cell_centres(*np.nonzero(grid.cells == OCCUPIED))
        row, col = truth.cell_indices(pose.transform(walls))
        row, col = np.clip(row, -2, truth.height + 1), np.clip(col, -2, truth.width + 1)
        assert np.mean(near[row + 2, col + 2]) > 0.75, "the rest are flipped cells"
