"""The package as it is shipped: kernels in the wheel, imports that point one way."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CORE = (
    "slamfusion.config",
    "slamfusion.evaluation",
    "slamfusion.fusion",
    "slamfusion.io",
    "slamfusion.sim",
    "slamfusion.cli.main",
)
LAYERS = {  # what a package may not import, directly
    "fusion": ("cli", "report", "ros", "evaluation"),
    "evaluation": ("cli", "report", "ros", "fusion"),
    "compute": ("cli", "report", "ros", "evaluation", "fusion", "io"),
    "io": ("cli", "report", "ros", "evaluation", "fusion", "compute"),
    "sim": ("cli", "report", "ros", "fusion", "experiments"),
    "slam": ("cli", "report", "ros", "fusion", "evaluation", "sim", "experiments"),
    "report": ("cli", "ros", "experiments"),
    "jobs": ("cli", "ros", "experiments"),
    "experiments": ("cli", "ros", "report"),
}


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
    assert {"slamfusion/py.typed", "slamfusion/jobs/schema.json"} <= inside
    assert not any(name.startswith("tests/") for name in inside)


@pytest.mark.parametrize("module", CORE)
def test_the_core_needs_no_opencl_plots_or_ros(module: str):
    script = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True, timeout=60
    )
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & {"pyopencl", "matplotlib", "rclpy"}


@pytest.mark.parametrize("package", sorted(LAYERS))
def test_imports_point_down(package: str):
    for path in (ROOT / "slamfusion" / package).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for other in LAYERS[package]:
            assert f"from slamfusion.{other}" not in text, f"{path} imports slamfusion.{other}"
            assert f"import slamfusion.{other}" not in text, f"{path} imports slamfusion.{other}"
