"""The package: imports point one way, and the core starts light."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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
LINT = "from importlinter.cli import lint_imports_command; lint_imports_command()"


def test_the_core_loads_no_opencl_plots_or_ros_and_jobs_start_light():
    """Imported one after the other, those that may load least first."""
    script = "import sys\n" + "".join(f"import {name}; print(*sys.modules)\n" for name in CORE)
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True, timeout=60
    )
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
    done = subprocess.run(
        [sys.executable, "-c", HELP], check=True, capture_output=True, text=True, timeout=60
    )
    assert "slamfusion node fusion" in done.stdout
    assert not set(done.stderr.split()) & (EDGES | LATE)


@pytest.fixture
def import_linter() -> None:
    if sys.version_info < (3, 11):
        pytest.skip("import-linter needs Python 3.11")
    pytest.importorskip("importlinter", reason="import-linter comes with the dev extra")


def contracts(folder: Path) -> subprocess.CompletedProcess[str]:
    """Hold the package in a folder against the contracts in its pyproject.toml."""
    lint = [sys.executable, "-c", LINT, "--no-cache"]
    return subprocess.run(lint, cwd=folder, check=False, capture_output=True, text=True, timeout=60)


@pytest.mark.usefixtures("import_linter")
def test_imports_point_down():
    done = contracts(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


@pytest.mark.usefixtures("import_linter")
def test_imports_that_point_up_are_noticed(tmp_path: Path):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    sources = shutil.ignore_patterns("__pycache__", "*.json", "*.html", "*.css", "*.js")
    shutil.copytree(ROOT / "slamfusion", tmp_path / "slamfusion", ignore=sources)
    for module, line in (
        ("io/log.py", "from slamfusion.align import decide"),
        ("grid.py", "import rclpy.node"),
        ("cli/main.py", "def f() -> None:\n    import matplotlib"),
    ):
        with (tmp_path / "slamfusion" / module).open("a", encoding="utf-8") as file:
            file.write(f"\n{line}\n")
    done = contracts(tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    broken = [row for row in done.stdout.splitlines() if row.endswith(" BROKEN")]
    contract = ("imports point down", "only slamfusion.ros imports", "only slamfusion.report")
    assert all(row.startswith(words) for row, words in zip(broken, contract, strict=True)), broken
