"""Claims about what is there after a writer was killed, at whatever step."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import MapFileError
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, journal, load_map, map_server, save_map
from tests.io.killed import NEW, OLD, WRITERS, content, grid_of, leftovers

pytestmark = pytest.mark.once

# Kills that each writer has to survive at the least: the hook works.
LEAST_STEPS = {"one": 5, "picture": 5, "pair": 14, "legacy": 14, "set": 30}


@pytest.mark.parametrize("writer", list(WRITERS))
def test_a_kill_at_any_step_leaves_the_old_set_or_the_new(writer: str) -> None:
    # In memory where the system has such a place: each kill is followed by several syncs.
    memory = Path("/dev/shm")  # noqa: S108 - a folder of its own is made in it
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as place:
        done = subprocess.run(
            [sys.executable, "-m", "tests.io.killed", writer, place],
            check=True,
            capture_output=True,
            text=True,
        )
    kills = [json.loads(line) for line in done.stdout.splitlines()]
    assert max(kill["step"] for kill in kills) >= LEAST_STEPS[writer]
    assert [kill["is_done"] for kill in kills].count(True) == 1
    outcomes = set()
    for kill in kills:
        old, new, after = kill["old"], kill["new"], kill["after"]
        # What any reader finds right after the kill: files of the old set or of the new.
        seen = kill["before"].items()
        assert seen <= old.items() or seen <= new.items(), kill["step"]
        # What is there when one map was loaded: one set, whole.
        if writer not in {"one", "picture"}:
            assert kill["errors"] == []
        assert after in (old, new), kill["step"]
        outcomes.add("new" if after == new else "old")
        # The next writer leaves its own files alone.
        assert kill["left"] == []
    assert outcomes == {"old", "new"}
    assert kills[-1]["before"] == kills[-1]["new"]


def test_files_of_a_live_writer_are_left_alone(tmp_path: Path) -> None:
    with AtomicFiles() as slow:
        slow.add(tmp_path / "slow", b"slow")
        waiting = set(leftovers(tmp_path))
        assert len(waiting) == 2
        save_map(grid_of(NEW), tmp_path / "map")
        load_map(tmp_path / "map.yaml")
        assert set(leftovers(tmp_path)) == waiting
    assert (tmp_path / "slow").read_bytes() == b"slow"
    assert leftovers(tmp_path) == []


def half_switched(folder: Path) -> None:
    """Leave a folder as a writer does that is killed when the old files have gone."""
    save_map(grid_of(OLD), folder / "map")
    script = (
        "import os, sys; from pathlib import Path; from tests.io.killed import *\n"
        "real = Path.replace\n"
        "def replace(self, target):\n"
        "    if self.name.endswith('.tmp'): os.kill(os.getpid(), 9)\n"
        "    return real(self, target)\n"
        "Path.replace = replace\n"
        "write_pair(Path(sys.argv[1]), NEW)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(folder)], check=False)
    assert done.returncode == -9


def test_a_moved_folder_is_put_right_too(tmp_path: Path) -> None:
    place = tmp_path / "a"
    half_switched(place)
    assert content(place) == {}
    place.rename(tmp_path / "b")
    assert load_map(tmp_path / "b" / "map.yaml").resolution == grid_of(OLD).resolution
    assert leftovers(tmp_path) == []


def test_the_journal_of_a_copied_folder_is_left_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "killed").mkdir()
    half_switched(tmp_path / "killed")
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "killed", copy)
    before = leftovers(copy)
    assert len(before) >= 3
    with pytest.raises(MapFileError, match="no such file"):
        load_map(copy / "map.yaml")
    assert "written elsewhere (a copied folder?)" in caplog.text
    save_map(grid_of(NEW), copy / "other")
    assert leftovers(copy) == before


def test_a_journal_that_came_with_a_map_cannot_touch_other_files(tmp_path: Path) -> None:
    precious = tmp_path / "home" / "precious"
    precious.parent.mkdir()
    precious.write_bytes(b"mine")
    maps = tmp_path / "maps"
    maps.mkdir()
    half_switched(maps)
    (home,) = maps.glob("*.journal")
    record = json.loads(home.read_text())
    away = {"target": "../home/precious", "number": 9, "is_new": True, "was_there": False}
    record["entries"].append(away)
    record["folders"].append("../home")
    crafted = tmp_path / "crafted"
    crafted.mkdir()
    (crafted / home.name).write_text(json.dumps(record) + "\n")
    save_map(grid_of(OLD), crafted / "map")
    load_map(crafted / "map.yaml")
    assert precious.read_bytes() == b"mine"


def test_what_somebody_else_wrote_since_is_kept(tmp_path: Path) -> None:
    half_switched(tmp_path)
    save_map(OccupancyGrid(np.zeros((9, 9), np.int8), 0.5), tmp_path / "other" / "map")
    for path in list((tmp_path / "other").iterdir()):
        path.rename(tmp_path / path.name)
    assert load_map(tmp_path / "map.yaml").cells.shape == (9, 9)
    assert leftovers(tmp_path) == []


def test_while_a_set_is_switched_a_reader_waits_and_says_so_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half_switched(tmp_path)
    (path,) = tmp_path.glob("*.journal")
    monkeypatch.setattr("slamfusion.io.map_server.SWITCH_S", 0.05)
    with path.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(MapFileError, match=r"map\.yaml: another process is writing it"):
            load_map(tmp_path / "map.yaml")
    assert load_map(tmp_path / "map.yaml").resolution == grid_of(OLD).resolution


def test_a_switch_that_ends_while_a_reader_asks_about_it_is_no_missing_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half_switched(tmp_path)
    (path,) = tmp_path.glob("*.journal")
    held = os.open(path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    entries = json.loads(path.read_text())["entries"]
    asked: list[Path] = []

    def ends_just_before(folder: Path) -> bool:
        if not asked:
            for entry in entries:
                stem = path.name.removesuffix(".journal")
                (folder / f"{stem}-{entry['number']}.old").replace(folder / entry["target"])
            os.truncate(path, 0)
            os.close(held)
        asked.append(folder)
        return journal.is_switching(folder)

    monkeypatch.setattr("slamfusion.io.map_server.is_switching", ends_just_before)
    assert load_map(tmp_path / "map.yaml").resolution == grid_of(OLD).resolution
    assert asked


def test_a_writer_that_is_killed_while_a_reader_looks_leaves_no_missing_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half_switched(tmp_path)
    (path,) = tmp_path.glob("*.journal")
    alive = path.open("rb")
    fcntl.flock(alive, fcntl.LOCK_EX)
    existing = map_server.existing

    def looked_for(path: Path) -> Path:
        try:
            return existing(path)
        finally:
            alive.close()

    monkeypatch.setattr(map_server, "existing", looked_for)
    assert load_map(tmp_path / "map.yaml").resolution == grid_of(OLD).resolution
    assert leftovers(tmp_path) == []


def test_old_files_that_cannot_be_brought_back_are_kept_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half_switched(tmp_path)

    def refuse(*_: object) -> None:
        raise PermissionError(13, os.strerror(13))

    with monkeypatch.context() as patched:
        patched.setattr(journal, "move_back", refuse)
        with pytest.raises(MapFileError, match=r"killed while .* Permission denied"):
            load_map(tmp_path / "map.yaml")
        with pytest.raises(MapFileError, match="cannot write: Permission denied"):
            save_map(grid_of(NEW), tmp_path / "map")
    assert load_map(tmp_path / "map.yaml").resolution == grid_of(OLD).resolution


def test_leftovers_without_a_journal_go_when_they_are_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orphans = [tmp_path / f".slamfusion-{'0' * 16}.{end}" for end in ("tmp", "old")]
    for path in (*orphans, tmp_path / ".slamfusion-notes.txt"):
        path.write_bytes(b"x")
    save_map(grid_of(OLD), tmp_path / "map")
    assert all(path.exists() for path in orphans)
    monkeypatch.setattr(journal, "ORPHAN_S", -1.0)
    save_map(grid_of(OLD), tmp_path / "map")
    assert leftovers(tmp_path) == [".slamfusion-notes.txt"]


def test_a_map_that_is_replaced_all_the_time_is_never_mixed(tmp_path: Path) -> None:
    """Two processes write two maps in turn; every load gives one of them, whole."""
    save_map(grid_of(OLD), tmp_path / "map")
    script = (
        "import sys; from pathlib import Path; from tests.io.killed import *\n"
        "for i in range(40): write_pair(Path(sys.argv[1]), 1 + i % 2)\n"
    )
    wanted = {
        version: (grid_of(version).resolution, grid_of(version).cells.tolist())
        for version in (OLD, NEW)
    }
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command) as writer, subprocess.Popen(command) as other:
        while writer.poll() is None or other.poll() is None:
            grid = load_map(tmp_path / "map.yaml")
            assert (grid.resolution, grid.cells.tolist()) in wanted.values()
    assert (writer.returncode, other.returncode) == (0, 0)
    assert leftovers(tmp_path) == []


def test_a_reader_that_looks_into_a_new_journal_stops_no_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the making of a journal and its lock a reader may hold it, and leaves it there."""
    looks: list[Path] = []
    held: list[int] = []
    locks = journal._try_lock

    def looked_into(descriptor: int) -> bool:
        (path,) = tmp_path.glob(".slamfusion-*.journal")
        if len(looks) < 2:
            looks.append(path)
            held.append(os.open(path, os.O_RDONLY))
            fcntl.flock(held[-1], fcntl.LOCK_EX)
        return locks(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(journal, "_try_lock", looked_into)
        made = journal.Journal(tmp_path, "0123456789abcdef")
    for descriptor in held:
        os.close(descriptor)
    assert len(looks) == 2
    assert made.path.exists()
    with pytest.raises(BlockingIOError), made.path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    made.close()
    assert not list(tmp_path.iterdir())
