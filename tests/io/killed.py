"""Writers that are killed before each of their file system operations, one after the other.

Started as a program by ``test_killed.py``: it forks once for each kill, so that the interpreter is
loaded once. ``python -m tests.io.killed WRITER FOLDER`` prints a JSON line for every kill.
"""

from __future__ import annotations

import contextlib
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
from slamfusion.io import AtomicFiles, load_map, save_image, save_map, write_json_atomic, write_tum
from slamfusion.trajectory import Trajectory

# Audit events of operations that change the file system; fsync has none and is wrapped.
CHANGES = {"os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir", "os.chmod"}
OLD, NEW = 1, 2


def grid_of(version: int) -> OccupancyGrid:
    """Return a map that differs with the version in size, cells, resolution and origin."""
    cells = np.full((3 + version, 4), 100 if version == NEW else 0, dtype=np.int8)
    return OccupancyGrid(cells, 0.05 * version, Pose2(float(version), 0.0, 0.0))


def write_one(folder: Path, version: int) -> None:
    """Write one file."""
    write_json_atomic(folder / "only.json", {"version": version})


def write_picture(folder: Path, version: int) -> None:
    """Write one picture."""
    save_image(folder / "only.png", np.full((version, 2), 7, dtype=np.uint8))


def write_pair(folder: Path, version: int) -> None:
    """Write one map."""
    save_map(grid_of(version), folder / "map")


def write_legacy(folder: Path, version: int) -> None:
    """Write the old map as another program does, the new one as ours."""
    if version == NEW:
        save_map(grid_of(NEW), folder / "map")
        return
    save_map(grid_of(OLD), folder / "draft" / "map")
    for path in (folder / "draft").iterdir():
        shutil.move(path, folder / path.name)
    (folder / "draft").rmdir()


def write_set(folder: Path, version: int) -> None:
    """Write what a run writes: maps, a path, a page in a folder below; remove a file of the old."""
    poses = Trajectory(np.array([0.0, 1.0]), np.full((2, 3), float(version)))
    with AtomicFiles() as files:
        save_map(grid_of(version), folder / "map", files=files)
        write_tum(folder / "map.tum", poses, files=files)
        save_map(grid_of(version), folder / "fused", mode="raw", image_format="png", files=files)
        files.add(folder / "report" / "page.html", f"version {version}".encode())
        if version == OLD:
            files.add(folder / "only_old.txt", b"1")
        else:
            files.add(folder / "only_new.txt", b"2")
            files.remove(folder / "only_old.txt")


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "one": write_one,
    "picture": write_picture,
    "pair": write_pair,
    "legacy": write_legacy,
    "set": write_set,
}
# At which of its own operations the first reader after a kill is killed too; None: it is not.
READERS: dict[str, tuple[int | None, ...]] = {"pair": (None, 1), "set": (None, 2)}


def content(folder: Path) -> dict[str, str]:
    """Return every file a user sees, with its bytes."""
    return {
        str(path.relative_to(folder)): path.read_bytes().hex()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".slamfusion-")
    }


def leftovers(folder: Path) -> list[str]:
    """Return the names of waiting files and journals."""
    return sorted(path.name for path in folder.rglob(".slamfusion-*"))


def kill_at(step: int, folder: Path) -> None:
    """Let this process die before its operation of that number (from 0) in the folder."""
    count = 0

    def look(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
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


def look_at(folder: Path, recover: int | None) -> dict[str, Any]:
    """Load the maps as a user does (killed too, where asked), and say what is there."""
    before = content(folder)
    errors = []

    def load() -> None:
        if recover is not None:
            kill_at(recover, folder)
        with contextlib.suppress(SlamFusionError):
            load_map(folder / "map.yaml")

    is_whole = in_child(load)
    for name in ("map", "fused"):
        if (folder / f"{name}.yaml").exists() or name == "map":
            try:
                load_map(folder / f"{name}.yaml")
            except SlamFusionError as error:
                errors.append(str(error))
    return {
        "before": before,
        "after": content(folder),
        "errors": errors,
        "is_load_whole": is_whole,
    }


def main(name: str, place: Path) -> None:
    """Kill a writer at every step, and say what is there each time."""
    write, step = WRITERS[name], 0
    while True:
        for recover in READERS.get(name, (None,)):
            folder = place / f"{step}-{recover}"
            folder.mkdir()
            write(folder, OLD)
            old = content(folder)

            def work(folder: Path = folder, step: int = step) -> None:
                kill_at(step, folder)
                write(folder, NEW)

            is_done = in_child(work)
            seen = look_at(folder, recover)
            write(folder, NEW)
            seen |= {"step": step, "old": old, "is_done": is_done}
            seen |= {"new": content(folder), "left": leftovers(folder)}
            print(json.dumps(seen))
            shutil.rmtree(folder)
            if is_done:
                break
        if is_done:
            return
        step += 1


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
