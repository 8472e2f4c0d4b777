"""The package: imports point one way, and the core starts light."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.support.fresh import run_python

pytestmark = pytest.mark.once

ROOT = Path(__file__).resolve().parents[1]
# What none of the core loads, and what each part of it can do without, too.
EDGES = {"pyopencl", "matplotlib", "rclpy"}
# Parts of SciPy that take longer to load than all else together.
SLOW = {f"scipy.{name}" for name in ("fft", "linalg", "ndimage", "sparse", "spatial", "stats")}
LATE = {"cv2", "numpy", "psutil", "rich", "scipy", "yaml"}
CORE = {
    "slamfusion.config": {"numpy"},
    "slamfusion.cli.program": LATE,
    "slamfusion.cli.run": LATE,
    "slamfusion.slam.registry": LATE,
    "slamfusion.io": {"scipy"},
    "slamfusion.jobs.fuse": SLOW,
    "slamfusion.jobs.run": SLOW,
    "slamfusion.evaluation": set[str](),
    "slamfusion.fusion": set[str](),
    "slamfusion.sim": set[str](),
}
LINT = "from importlinter.cli import lint_imports_command; lint_imports_command(['--no-cache'])"


def test_the_core_loads_no_opencl_plots_or_ros_and_jobs_start_light():
    """Imported one after the other, those that may load least first."""
    script = "import sys\n" + "".join(f"import {name}; print(*sys.modules)\n" for name in CORE)
    done = run_python(script)
    for (name, others), loaded in zip(CORE.items(), done.stdout.splitlines(), strict=True):
        assert not set(loaded.split()) & (EDGES | others), name


HELP = """
import click, sys
from slamfusion.cli.program import cli, run_program

def walk(command, *names):
    run_program([*names, "--help"])
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            walk(command.get_command(context, name), *names, name)

walk(cli)
print(*sys.modules, file=sys.stderr)
"""


def test_no_help_loads_numpy_or_what_else_is_slow() -> None:
    done = run_python(HELP)
    assert "slamfusion node fusion" in done.stdout
    assert not set(done.stderr.split()) & (EDGES | LATE)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="import-linter needs Python 3.11")
def test_imports_point_down():
    pytest.importorskip("importlinter", reason="import-linter comes with the dev extra")
    done = run_python(LINT, ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout
