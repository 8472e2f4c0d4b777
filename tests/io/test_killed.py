"""Claims about what is there after a writer was killed, and what a reader meets beside a writer."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from slamfusion.io import load_map, save_map
from tests.io.killed import NEW, OLD, grid_of

pytestmark = pytest.mark.once

# Kills that the writer has to survive at the least: the hook works.
LEAST_STEPS = 24


def test_after_a_kill_at_any_step_no_file_is_half_written() -> None:
    # In memory where the system has such a place: each kill is followed by several syncs.
    memory = Path("/dev/shm")  # noqa: S108 - a folder of its own is made in it
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as place:
        done = subprocess.run(
            [sys.executable, "-m", "tests.io.killed", place],
            check=True,
            capture_output=True,
            text=True,
        )
    kills = [json.loads(line) for line in done.stdout.splitlines()]
    assert max(kill["step"] for kill in kills) >= LEAST_STEPS
    assert [kill["is_done"] for kill in kills].count(True) == 1
    mixed = []
    for kill in kills:
        old, new, after = kill["old"], kill["new"], kill["after"]
        assert after.keys() == old.keys()
        # Each file is the old one or the new one, and those that came first came in order.
        assert all(after[name] in (old[name], new[name]) for name in after), kill["step"]
        for name, found in kill["maps"].items():
            if isinstance(found, str):
                assert f"{name}: its picture" in found
                mixed.append(name)
            else:
                assert found in (grid_of(OLD).resolution, grid_of(NEW).resolution)
    # Between the renames of the picture and of the YAML a map is refused, and at no other step.
    assert sorted(mixed) == ["fused.yaml", "map.yaml"]
    assert (kills[0]["after"], kills[-1]["after"]) == (kills[0]["old"], kills[-1]["new"])


def test_a_map_that_is_replaced_all_the_time_is_never_mixed(tmp_path: Path) -> None:
    """Two processes write two maps in turn; every load gives one of them, whole."""
    save_map(grid_of(OLD), tmp_path / "map")
    script = (
        "import sys; from pathlib import Path; from tests.io.killed import *\n"
        "for i in range(100): write_pair(Path(sys.argv[1]), 1 + i % 2)\n"
    )
    wanted = {
        version: (grid_of(version).resolution, grid_of(version).cells.tolist())
        for version in (OLD, NEW)
    }
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command) as writer, subprocess.Popen(command) as other:
        loads = 0
        while writer.poll() is None or other.poll() is None:
            grid = load_map(tmp_path / "map.yaml")
            assert (grid.resolution, grid.cells.tolist()) in wanted.values()
            loads += 1
    assert (writer.returncode, other.returncode) == (0, 0)
    assert loads > 20
    assert len(list(tmp_path.iterdir())) == 2
