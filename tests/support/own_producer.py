"""A Python that has a package with a producer of its own, ``dead_reckoning``, beside slamfusion."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent / "dead_reckoning"
NAME = "dead_reckoning"


def with_own_producer(folder: Path) -> Path:
    """Return the Python of a new venv that sees what the suite's has, with the package installed.

    Args:
        folder: empty; the venv is made here.
    """
    pytest.importorskip("hatchling", reason="hatchling is absent: the dev extra installs it")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    site = next(folder.glob("lib/python*/site-packages"))
    suite = sysconfig.get_paths()["purelib"]
    (site / "suite.pth").write_text(f"import site; site.addsitedir({suite!r})\n")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "--python", str(python), "install", "-q"),
            *("--no-deps", "--no-build-isolation", "--disable-pip-version-check", str(PACKAGE)),
        ],
        capture_output=True,
        text=True,
        check=False,
        timeout=120.0,
    )
    assert done.returncode == 0, done.stderr
    return python
