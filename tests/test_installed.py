"""Wheel and sdist, installed into an environment of their own: the commands run from there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
from pathlib import Path
from typing import Any

import pytest

from slamfusion import __version__
from slamfusion.io import write_carmen
from tests.slam.drives import drive

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "data" / "sample"

pytestmark = pytest.mark.once


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sources as they are handed on, unpacked."""
    pytest.importorskip("hatchling", reason="hatchling comes with the dev extra")
    folder = tmp_path_factory.mktemp("sdist")
    build("sdist", ROOT, folder)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        packed.extractall(folder, filter="data")
    (unpacked,) = (item for item in folder.iterdir() if item.is_dir())
    return unpacked


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel that is built of the unpacked sources alone."""
    folder = tmp_path_factory.mktemp("wheel")
    build("wheel", sdist, folder)
    (found,) = folder.glob("*.whl")
    return found


def build(target: str, sources: Path, folder: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    done = subprocess.run(command, cwd=sources, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def environment(folder: Path) -> Path:
    """Make an empty environment and return its Python."""
    venv.create(folder, with_pip=False)
    return folder / "bin" / "python"


def install(python: Path, *what: str) -> None:
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "-qq", *what]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command, from the wheel; what it stands on is that of the tests' environment."""
    python = environment(tmp_path_factory.mktemp("fresh") / "venv")
    install(python, "--no-deps", "--no-index", str(wheel))
    (site,) = python.parents[1].glob("lib/python*/site-packages")
    (site / "tests_environment.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python.with_name("slamfusion")


def run(command: Path, folder: Path, *words: str | Path) -> dict[str, Any]:
    """Run a command in a folder, without the checkout, and return its JSON document."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [command, *words, "--json"],
        cwd=folder,
        env=kept,
        check=False,
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def drive_and_fuse(command: Path, folder: Path, producers: str) -> None:
    """Run a log of some scans, which fuses its maps, and look at the installation."""
    write_carmen(folder / "flat.log", drive(30)[0])
    ran = run(command, folder, "run", "flat.log", "-o", "out", "--producers", producers)
    assert ran["fused_count"] == len(producers.split(","))
    assert (folder / "out" / "report" / "report.html").is_file()
    found = run(command, folder, "doctor")
    assert found["versions"]["slamfusion"] == __version__
    assert found["self_test"]


def test_the_sources_carry_what_a_packager_needs(sdist: Path):
    for name in (
        *("README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "pyproject.toml"),
        *("docs/conf.py", "docs/index.md", "kernels/search.cl", "tests/test_installed.py"),
        *("slamfusion/jobs/schema.json", "launch_scripts/constraints-jazzy.txt"),
    ):
        assert (sdist / name).is_file(), name
    assert sdist.name == f"slamfusion-{__version__}"


def test_the_code_is_that_of_the_wheel(installed: Path, tmp_path: Path):
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = "import slamfusion, slamfusion.compute.program as p; print(slamfusion.__file__); "
    command = [installed.with_name("python"), "-c", f"{code}print(p.kernel_folder())"]
    done = subprocess.run(
        command, cwd=tmp_path, env=kept, check=True, capture_output=True, text=True
    )
    for line in done.stdout.splitlines():
        assert Path(line).is_relative_to(installed.parents[1])


def test_the_main_commands_run_from_the_wheel(installed: Path, tmp_path: Path):
    drive_and_fuse(installed, tmp_path, "tinyslam,graph")


@pytest.mark.full
def test_the_wheel_brings_what_it_stands_on(wheel: Path, tmp_path: Path):
    """By pip alone, from the package index."""
    python = environment(tmp_path / "venv")
    install(python, f"{wheel}[report]")
    command = python.with_name("slamfusion")
    drive_and_fuse(command, tmp_path, "tinyslam,gmapping,graph")
    run(command, tmp_path, "simulate", "f16", "--lidar", "rplidar", "-o", "drive")
    maps = [SAMPLE / f"map_{letter}.yaml" for letter in "abc"]
    assert run(command, tmp_path, "fuse", *maps, "-o", "fused")["fused_count"] == 3
