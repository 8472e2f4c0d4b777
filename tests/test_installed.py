"""Wheel and sdist, installed beside a package with a producer of its own: commands run there."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from slamfusion import __version__
from slamfusion.io import write_carmen
from slamfusion.slam.registry import BUILT_IN
from tests.slam.drives import drive
from tests.support.own_producer import NAME, PACKAGE

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
    (site_of(python) / "tests_environment.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install(python, "--no-deps", "--no-build-isolation", str(PACKAGE))
    return python.with_name("slamfusion")


def site_of(python: Path) -> Path:
    """Return the folder that an environment's packages are installed into."""
    (site,) = python.parents[1].glob("lib/python*/site-packages")
    return site


def printed(command: Path, folder: Path, *words: str | Path) -> str:
    """Run a command in a folder, without the checkout, and return what it printed."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [command, *words],
        cwd=folder,
        env={**kept, "COLUMNS": "200"},
        check=False,
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    assert "slamfusion: error" not in done.stderr
    return done.stdout


def run(command: Path, folder: Path, *words: str | Path) -> dict[str, Any]:
    """Run a command and return its JSON document."""
    document: dict[str, Any] = json.loads(printed(command, folder, *words, "--json"))
    return document


def drive_and_fuse(command: Path, folder: Path, producers: str, *options: str) -> None:
    """Run a log of some scans, which fuses its maps, and look at the installation."""
    write_carmen(folder / "flat.log", drive(30)[0])
    ran = run(command, folder, "run", "flat.log", "-o", "out", "--producers", producers, *options)
    assert [item["name"] for item in ran["inputs"]] == producers.split(",")
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


def test_the_wheel_carries_kernels_types_and_pages(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    kernels = {f"slamfusion/kernels/{path.name}" for path in (ROOT / "kernels").iterdir()}
    assert kernels
    data = ("py.typed", "__init__.pyi", "jobs/schema.json", "web/static/index.html")
    assert kernels | {f"slamfusion/{name}" for name in data} <= inside
    assert not any(name.startswith("tests/") for name in inside)


def test_the_code_is_that_of_the_wheel(installed: Path, tmp_path: Path):
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = "import slamfusion, slamfusion.compute.opencl as p; print(slamfusion.__file__); "
    command = [installed.with_name("python"), "-c", f"{code}print(p.kernel_folder())"]
    done = subprocess.run(
        command, cwd=tmp_path, env=kept, check=True, capture_output=True, text=True
    )
    for line in done.stdout.splitlines():
        assert Path(line).is_relative_to(installed.parents[1])


def test_the_main_commands_run_from_the_wheel(installed: Path, tmp_path: Path):
    """The producer of another package takes part by its name alone."""
    settings = tmp_path / "run.yaml"
    settings.write_text(f"producers: {{{NAME}: {{usable_range_m: 8.0}}}}\n", encoding="utf-8")
    drive_and_fuse(installed, tmp_path, f"tinyslam,{NAME}", "--config", str(settings))
    assert (tmp_path / "out" / f"{NAME}.yaml").is_file()


@pytest.fixture
def broken(installed: Path) -> Iterator[str]:
    """The installed entry point of a package that cannot be imported."""
    folder = site_of(installed) / "broken_producer-1.0.dist-info"
    folder.mkdir()
    about = "Metadata-Version: 2.1\nName: broken-producer\nVersion: 1.0\n"
    (folder / "METADATA").write_text(about, encoding="utf-8")
    points = "[slamfusion.producers]\nbroken = no_such_package:PRODUCER\n"
    (folder / "entry_points.txt").write_text(points, encoding="utf-8")
    yield "broken"
    shutil.rmtree(folder)


def test_help_names_producers_of_other_packages_and_broken_ones(
    installed: Path, broken: str, tmp_path: Path
):
    listed = printed(installed, tmp_path, "slam", "--help")
    said = f"{broken} BROKEN: the producer 'broken' cannot be loaded from no_such_package:PRODUCER"
    assert said in " ".join(listed.split())
    for name in (*BUILT_IN, NAME):
        assert f"\n  {name} " in listed
    own = printed(installed, tmp_path, "slam", NAME, "--help-all")
    assert "scans drawn where the odometry says they are" in " ".join(own.split())
    assert "--usable-range-m" in own
    assert "--save-state" not in own


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
