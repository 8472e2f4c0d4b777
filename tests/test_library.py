"""The package as a library: light to import, all names there, a whole job in a few lines."""

from __future__ import annotations

from pathlib import Path

import pytest

import slamfusion
from tests.support.fresh import run_python

pytestmark = pytest.mark.once

# What takes long to load, or is not there everywhere.
HEAVY = {"numpy", "scipy", "pandas", "cv2", "yaml", "pyopencl", "matplotlib", "rclpy", "click"}
PUBLIC = [name for name in slamfusion.__all__ if name != "__version__"]


def test_the_import_loads_nothing_that_is_not_asked_for() -> None:
    """A grid needs NumPy; naming the jobs opens no OpenCL and draws nothing."""
    jobs = ", ".join(name for name in PUBLIC if name.islower())
    script = "import sys\n" + "".join(
        f"{line}; print(*(name.split('.')[0] for name in sys.modules))\n"
        for line in (
            "import slamfusion; slamfusion.__version__",
            "from slamfusion import OccupancyGrid",
            f"from slamfusion import {jobs}",
        )
    )
    done = run_python(script)
    bare, grid, whole = (set(line.split()) for line in done.stdout.splitlines())
    assert not bare & HEAVY
    assert "numpy" in grid
    assert not whole & {"pyopencl", "matplotlib", "rclpy"}


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


def test_the_file_of_settings_that_the_commands_read_is_read_here_too(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("producers: {graph: {resolution: 0.1}}\n", encoding="utf-8")
    assert slamfusion.load_config(path).producers["graph"].resolution == 0.1
