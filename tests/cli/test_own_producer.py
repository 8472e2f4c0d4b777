"""A producer of another package takes part by its name alone: ``tests/support/dead_reckoning``."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamfusion.io import write_carmen
from slamfusion.slam.registry import BUILT_IN
from tests.cli.command import run
from tests.slam.drives import drive
from tests.support.own_producer import NAME, with_own_producer

pytestmark = pytest.mark.once


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return with_own_producer(tmp_path_factory.mktemp("venv"))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a short drive."""
    path = tmp_path_factory.mktemp("drive") / "flat.log"
    write_carmen(path, drive(30)[0])
    return path


def slamfusion(python: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(python), "-m", "slamfusion", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=180.0,
        env={**os.environ, "COLUMNS": "200"},
    )


def test_it_is_listed_and_has_its_own_options(python: Path) -> None:
    listed = slamfusion(python, "slam", "--help")
    assert NAME in listed.stdout, listed.stderr
    told = slamfusion(python, "slam", NAME, "--help").stdout
    assert "Map a log with dead reckoning: scans drawn where the odometry says they are." in told
    assert "--usable-range-m" in told
    assert "--save-state" not in told
    absent = run("slam", NAME, "--help")
    assert absent.returncode == 2, "it is installed where it should not be"


def test_it_takes_part_in_a_run_beside_one_that_is_built_in(
    python: Path, log: Path, tmp_path: Path
) -> None:
    config = tmp_path / "run.yaml"
    config.write_text(f"producers: {{{NAME}: {{usable_range_m: 8.0}}}}\n")
    out = tmp_path / "out"
    names = f"tinyslam,{NAME}"
    done = slamfusion(
        python, "run", log, "-o", out, "--producers", names, "--config", config, "--json"
    )
    document = json.loads(done.stdout)
    assert [item["name"] for item in document["producers"]] == names.split(","), done.stderr
    assert [item["failed"] for item in document["producers"]] == [None, None]
    assert document["config"]["producers"][NAME]["usable_range_m"] == 8.0
    folder = out if document["fused"] else Path(document["producers"][0]["files"][0]).parent
    assert (folder / f"{NAME}.yaml").is_file()
    assert {item["name"] for item in document["inputs"]} == set(names.split(","))


@pytest.fixture
def broken(python: Path) -> Iterator[str]:
    """Beside it, the installed entry point of a package that cannot be imported."""
    site = next(python.parents[1].glob("lib/python*/site-packages"))
    folder = site / "broken_producer-1.0.dist-info"
    folder.mkdir()
    about = "Metadata-Version: 2.1\nName: broken-producer\nVersion: 1.0\n"
    (folder / "METADATA").write_text(about, encoding="utf-8")
    points = "[slamfusion.producers]\nbroken = no_such_package:PRODUCER\n"
    (folder / "entry_points.txt").write_text(points, encoding="utf-8")
    yield "broken"
    shutil.rmtree(folder)


def test_a_broken_package_is_named_in_help_and_takes_no_other_along(
    python: Path, broken: str
) -> None:
    done = slamfusion(python, "slam", "--help")
    assert done.returncode == 0, done.stderr
    said = (
        f"{broken} BROKEN: the producer 'broken' cannot be loaded from no_such_package:PRODUCER: "
    )
    assert said in " ".join(done.stdout.split())
    for name in (*BUILT_IN, NAME):
        assert f"\n  {name} " in done.stdout
    assert "slamfusion: error" not in done.stderr
