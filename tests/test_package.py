"""The package as it is shipped: kernels in the wheel, imports that point one way."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

ROOT = Path(__file__).resolve().parents[1]
# What none of the core loads, and what each part of it can do without, too.
EDGES = {"pyopencl", "matplotlib", "rclpy"}
# Parts of SciPy that take longer to load than all else together.
SLOW = {f"scipy.{name}" for name in ("fft", "linalg", "ndimage", "sparse", "spatial", "stats")}
CORE = {
    "slamfusion.config": {"numpy"},
    "slamfusion.evaluation": set[str](),
    "slamfusion.fusion": set[str](),
    "slamfusion.io": {"scipy"},
    "slamfusion.sim": set[str](),
    "slamfusion.cli.program": {"cv2", "numpy", "psutil", "rich", "scipy", "yaml"},
    "slamfusion.cli.run": {"cv2", "numpy", "psutil", "rich", "scipy", "yaml"},
    "slamfusion.jobs.fuse": SLOW,
    "slamfusion.jobs.run": SLOW,
}
LINT = "from importlinter.cli import lint_imports_command; lint_imports_command()"


def test_the_wheel_carries_every_kernel(tmp_path: Path):
    pytest.importorskip("hatchling", reason="hatchling comes with the dev extra")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    sources = {f"slamfusion/kernels/{path.name}" for path in (ROOT / "kernels").iterdir()}
    assert sources
    assert sources <= inside
    data = ("py.typed", "__init__.pyi", "jobs/schema.json")
    assert {f"slamfusion/{name}" for name in data} <= inside
    assert {"slamfusion/viewer/static/stage.js", "slamfusion/page/static/index.html"} <= inside
    assert not any(name.startswith("tests/") for name in inside)


@pytest.mark.parametrize(("module", "others"), CORE.items())
def test_the_core_loads_no_opencl_plots_or_ros_and_jobs_start_light(module: str, others: set[str]):
    script = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True, timeout=60
    )
    assert not set(done.stdout.split()) & (EDGES | others)


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
@pytest.mark.parametrize(
    ("module", "line", "broken"),
    [
        ("io/log.py", "from slamfusion.align import decide", "imports point down"),
        ("grid.py", "import rclpy.node", "only slamfusion.ros imports rclpy"),
        ("cli/main.py", "def f() -> None:\n    import matplotlib", "only slamfusion.report"),
    ],
)
def test_an_import_that_points_up_is_noticed(tmp_path: Path, module: str, line: str, broken: str):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    sources = shutil.ignore_patterns("__pycache__", "*.json", "*.html", "*.css", "*.js")
    shutil.copytree(ROOT / "slamfusion", tmp_path / "slamfusion", ignore=sources)
    with (tmp_path / "slamfusion" / module).open("a", encoding="utf-8") as file:
        file.write(f"\n{line}\n")
    done = contracts(tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    (found,) = (row for row in done.stdout.splitlines() if row.endswith(" BROKEN"))
    assert found.startswith(broken)
