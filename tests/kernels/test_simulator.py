"""The Oclgrind simulator finds no race and no access out of bounds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.kernels.conftest import WHEELS_EXIST

pytestmark = [
    pytest.mark.once,
    pytest.mark.skipif(not WHEELS_EXIST, reason="Oclgrind's wheel is for x86-64 Linux"),
]
ROOT = Path(__file__).resolve().parents[2]


def simulate(what: str, log: Path) -> str:
    """Run ``tests.kernels.simulated`` with race detection; return what the simulator reports."""
    # Bounds are always checked. Not asked for: OCLGRIND_UNINITIALIZED, which mistakes vector
    # conversions for reads of nothing and then crashes (release 21.10).
    switches = {"OCLGRIND_LOG": str(log), "OCLGRIND_DATA_RACES": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.kernels.simulated", what],
        cwd=ROOT,
        env=os.environ | switches,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert log.exists(), "Oclgrind did not open its log: it did not run"
    return log.read_text(encoding="utf-8", errors="replace")


@pytest.mark.parametrize("what", ["checks", pytest.param("sizes", marks=pytest.mark.full)])
def test_kernels_are_clean(tmp_path: Path, what: str):
    assert not simulate(what, tmp_path / "log")


def test_what_toys_do_wrong_is_reported(tmp_path: Path):
    said = simulate("toys", tmp_path / "log")
    assert "Invalid write of size 4" in said
    assert "data race" in said.lower()
    assert "sound" not in said
