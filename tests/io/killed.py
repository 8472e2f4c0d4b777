"""A writer that is killed before each of its file system operations, one after the other.

Started as a program by ``test_killed.py``: it forks once for each kill, so that the interpreter is
loaded once. ``python -m tests.io.killed FOLDER`` prints a JSON line for every kill.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, load_map, save_map, write_tum
from slamfusion.trajectory import Trajectory

# Audit events of operations that change the file system; fsync has none and is wrapped.
CHANGES = {"os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir", "os.chmod"}
OLD, NEW = 1, 2


def grid_of(version: int) -> OccupancyGrid:
    """Return a map that differs with the version in size, cells, resolution and origin."""
    cells = np.full((3 + version, 4), 100 if version == NEW else 0, dtype=np.int8)
    return OccupancyGrid(cells, 0.05 * version, Pose2(float(version), 0.0, 0.0))


def write_pair(folder: Path, version: int) -> None:
    """Write one map."""
    save_map(grid_of(version), folder / "map")


def write_set(folder: Path, version: int) -> None:
    """Write what a run writes: maps, a path, a page in a folder below."""
    poses = Trajectory(np.array([0.0, 1.0]), np.full((2, 3), float(version)))
    with AtomicFiles() as files:
        save_map(grid_of(version), folder / "map")
        write_tum(folder / "map.tum", poses)
        save_map(grid_of(version), folder / "fused", mode="raw", image_format="png")
        files.add(folder / "report" / "page.html", f"version {version}".encode())


def content(folder: Path) -> dict[str, str]:
    """Return every file a user sees, with its bytes."""
    return {
        str(path.relative_to(folder)): path.read_bytes().hex()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".slamfusion-")
    }


def kill_at(step: int, folder: Path) -> None:
    """Let this process die before its operation of that number (from 0) in the folder."""
    count = 0

    def look(event: str, arguments: tuple[Any, ...]) -> None:
        is_change = event in CHANGES or (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & 0o103
        )
        named = arguments[0] if arguments else ""
        is_here = isinstance(named, int) or os.fspath(named).startswith(str(folder))
        if is_change and is_here:
            tick()

    def tick() -> None:
        nonlocal count
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1

    real = os.fsync

    def fsync(descriptor: int) -> None:
        tick()
        real(descriptor)

    os.fsync = fsync
    sys.addaudithook(look)


def in_child(work: Callable[[], None]) -> bool:
    """Do work in a fork of this process; whether it came to its end."""
    child = os.fork()
    if child == 0:
        work()
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == 0


def loaded(folder: Path) -> dict[str, float | str]:
    """Return the cell size of each map of the folder, or why it cannot be loaded."""
    found: dict[str, float | str] = {}
    for path in sorted(folder.glob("*.yaml")):
        try:
            grid = load_map(path)
        except SlamFusionError as error:
            found[path.name] = str(error)
        else:
            assert np.array_equal(grid.cells, grid_of(round(grid.resolution / 0.05)).cells)
            found[path.name] = grid.resolution
    return found


def main(place: Path) -> None:
    """Kill the writer at every step, and say what is there each time."""
    step, is_done = 0, False
    while not is_done:
        folder = place / str(step)
        folder.mkdir()
        write_set(folder, OLD)
        old = content(folder)

        def work(folder: Path = folder, step: int = step) -> None:
            kill_at(step, folder)
            write_set(folder, NEW)

        is_done = in_child(work)
        seen = {"after": content(folder), "maps": loaded(folder)}
        write_set(folder, NEW)
        seen |= {"step": step, "old": old, "is_done": is_done, "new": content(folder)}
        print(json.dumps(seen))
        shutil.rmtree(folder)
        step += 1


if __name__ == "__main__":
    main(Path(sys.argv[1]))
