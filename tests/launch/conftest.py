"""The fixtures of the ROS tests, and a workspace that colcon has built."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.command import ROOT
from tests.ros.conftest import domain, observer, processes

__all__ = ["colcon", "domain", "observer", "processes", "workspace"]

# colcon and what of it a ROS installation has; setuptools as old as that of Jazzy's Ubuntu or so.
PACKAGES = [
    *("colcon-core", "colcon-ros", "colcon-bash", "colcon-library-path", "colcon-output"),
    *("colcon-recursive-crawl", "colcon-metadata", "colcon-package-information"),
    *("colcon-package-selection", "colcon-python-setup-py", "setuptools<80"),
]
COLCON = ROOT / ".venv-colcon"


@pytest.fixture(scope="session")
def colcon() -> Path:
    """The command, in an environment of its own that is kept."""
    stamp, wanted = COLCON / ".installed", " ".join([sys.version, *PACKAGES])
    COLCON.mkdir(exist_ok=True)
    with (COLCON / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not stamp.is_file() or stamp.read_text() != wanted:
            # The pip of the tests installs, and compiles nothing ahead: half the time.
            subprocess.run([sys.executable, "-m", "venv", "--without-pip", COLCON], check=True)
            pip = [sys.executable, "-m", "pip", "--python", str(COLCON / "bin" / "python")]
            pip += ["install", "-qq", "--no-compile", *PACKAGES]
            done = subprocess.run(pip, capture_output=True, text=True, check=False)
            if done.returncode:
                pytest.skip(f"colcon cannot be installed here: {done.stderr.strip()[-300:]}")
            stamp.write_text(wanted)
    return COLCON / "bin" / "colcon"


@pytest.fixture(scope="module", params=["copied", "linked"])
def workspace(
    request: pytest.FixtureRequest, colcon: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """A workspace with a checkout below ``src``, built; ``linked`` is ``--symlink-install``."""
    folder = tmp_path_factory.mktemp(f"ws_{request.param}")
    checkout = folder / "src" / "slamfusion"
    shutil.copytree(
        ROOT,
        checkout,
        symlinks=True,
        ignore=shutil.ignore_patterns(".*", "out", "build", "tests", "__pycache__", "data"),
    )
    before = sorted(item.relative_to(checkout) for item in checkout.rglob("*"))
    options = ["--symlink-install"] if request.param == "linked" else []
    # The Python that colcon runs with must not see those of the tests.
    hidden = {"PYTHONPATH", "AMENT_PREFIX_PATH", "LD_LIBRARY_PATH"}
    done = subprocess.run(
        [str(colcon), "build", *options],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name not in hidden},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "1 package finished" in done.stdout
    assert sorted(item.relative_to(checkout) for item in checkout.rglob("*")) == before
    assert {item.name for item in folder.iterdir()} == {"src", "build", "install", "log"}
    yield folder
    shutil.rmtree(folder)
