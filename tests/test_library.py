"""The package as a library: light to import, all names there, a whole job in a few lines."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import slamfusion
from slamfusion.io import write_carmen
from tests.slam.drives import drive

pytestmark = pytest.mark.once

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "sample"
# What takes long to load, or is not there everywhere.
HEAVY = {"numpy", "scipy", "pandas", "cv2", "yaml", "pyopencl", "matplotlib", "rclpy", "click"}
PUBLIC = [name for name in slamfusion.__all__ if name != "__version__"]


def modules_after(script: str) -> set[str]:
    """The top packages that a fresh interpreter has loaded after a script."""
    done = subprocess.run(
        [sys.executable, "-c", f"{script}; import sys; print(*sys.modules)"],
        check=True, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    return {name.split(".")[0] for name in done.stdout.split()}


def test_the_import_loads_nothing_that_is_not_asked_for() -> None:
    assert not modules_after("import slamfusion; slamfusion.__version__") & HEAVY
    # A grid needs NumPy; naming the jobs opens no OpenCL and draws nothing.
    assert "numpy" in modules_after("from slamfusion import OccupancyGrid")
    jobs = ", ".join(name for name in PUBLIC if name.islower())
    assert not modules_after(f"from slamfusion import {jobs}") & {"pyopencl", "matplotlib", "rclpy"}


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_is_there(name: str) -> None:
    value = getattr(slamfusion, name)
    assert value is getattr(slamfusion, name)
    assert name in dir(slamfusion)
    if callable(value):
        assert value.__doc__


def test_a_name_that_is_not_there_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'fuse_everything'"):
        slamfusion.fuse_everything  # noqa: B018
    with pytest.raises(ImportError, match="fuse_everything"):
        from slamfusion import fuse_everything  # noqa: F401, PLC0415


def test_saved_maps_are_fused() -> None:
    from slamfusion import fuse_maps, load_map  # noqa: PLC0415

    fused = fuse_maps(sorted(SAMPLE.glob("map_*.yaml")), truth=SAMPLE / "truth.yaml")
    assert [record.name for record in fused.result.accepted] == ["map_a", "map_b", "map_c"]
    *inputs, last = fused.evaluations
    assert last.name == "fused"
    assert last.error <= 1.1 * min(item.error for item in inputs)
    assert fused.grid.resolution == load_map(SAMPLE / "truth.yaml").resolution


def test_from_a_log_to_a_fused_map(tmp_path: Path) -> None:
    from slamfusion import fuse_maps, load_map, map_log, save_fused_maps  # noqa: PLC0415

    write_carmen(tmp_path / "flat.log", drive(64)[0])

    made = [map_log(tmp_path / "flat.log", name).grid for name in ("tinyslam", "graph")]
    fused = fuse_maps(made)
    save_fused_maps(fused, tmp_path / "out" / "fused")

    np.testing.assert_array_equal(load_map(tmp_path / "out" / "fused.yaml").cells, fused.grid.cells)
    walls = np.count_nonzero(fused.grid.cells == slamfusion.OCCUPIED)
    assert walls > 0.5 * min(np.count_nonzero(grid.cells >= 65) for grid in made)


def test_the_file_of_settings_that_the_commands_read_is_read_here_too(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("producers: {graph: {resolution: 0.1}}\n", encoding="utf-8")
    assert slamfusion.load_config(path).producers["graph"].resolution == 0.1
