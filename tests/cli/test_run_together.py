"""``run`` among other processes: two into one folder, an interrupt, a reader that goes away."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map, read_trajectory, save_map, write_carmen
from tests.cli.command import INSTALLED, json_of, server, tree, without_progress
from tests.cli.run_folder import MAPS_OF_FUSION, a_producer_of, files_of, outputs
from tests.slam.drives import CELL_M, draw_flat, drive

# Of one producer and saved maps; one producer alone has no path to fuse.
MADE = files_of("graph") | MAPS_OF_FUSION - {"fused.tum"}
# A test run in the background ignores Ctrl-C, and what it starts would too.
HEARING = ("env", "--default-signal=INT")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive through a flat, the first part of it, and the flat's map."""
    folder = tmp_path_factory.mktemp("place")
    write_carmen(folder / "flat.log", drive(64)[0])
    write_carmen(folder / "short.log", drive(48)[0])
    walls = np.where(draw_flat() == 1, 100, 0).astype(np.int8)
    save_map(OccupancyGrid(walls, CELL_M), folder / "saved")
    return folder


ORDERS = ("log first", "log last")
NO_PATH = "fewer than two producers have a path, so there is no fused path to draw at"
NOT_DRAWN = f"slamfusion: the fused map is not drawn, the maps vote (consensus): {NO_PATH}"


@pytest.fixture(scope="module")
def at_once(
    place: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, dict[str, Any]]]:
    """Two runs with saved maps into one folder at once: the folder, and what each of them says.

    The log of the second is shorter.
    """
    folder = tmp_path_factory.mktemp("at-once")
    save_map(load_map(place / "saved.yaml"), folder / "other" / "graph")
    logs = {"log first": place / "flat.log", "log last": place / "short.log"}
    maps = ("--inputs", place / "saved.yaml", folder / "other" / "graph.yaml")
    # One producer alone has a path, so that the maps vote all the same.
    drawn = ("--mode", "drawn", "--keep-duplicates", "--json")
    options = ("-o", folder / "out", "--producers", "graph", *drawn)
    with contextlib.ExitStack() as files:
        started = {}
        for order, log in logs.items():
            given = (log, *maps) if order == "log first" else (*maps, log)
            words = [str(word) for word in ("run", *given, *options)]
            ends = [
                files.enter_context((folder / f"{order}.{name}").open("w+"))
                for name in ("in", "out", "err")
            ]
            numbers = [file.fileno() for file in ends]
            started[order] = server().start(words, os.environ, folder, numbers), words
        said = {}
        for order, (process, words) in started.items():
            code = process.wait(180.0)
            out, err = ((folder / f"{order}.{name}").read_text("utf-8") for name in ("out", "err"))
            assert (code, without_progress(err)) == (0, f"{NOT_DRAWN}\n")
            said[order] = json_of(subprocess.CompletedProcess([INSTALLED, *words], code, out))
    return folder / "out", said


@pytest.mark.parametrize("order", ORDERS)
def test_saved_maps_vote_too(at_once: tuple[Path, dict[str, dict[str, Any]]], order: str) -> None:
    document = at_once[1][order]
    assert [item["name"] for item in document["inputs"]] == ["graph", "saved", "graph (saved)"]
    assert document["fused_count"] == 3
    assert (document["fused_mode"], document["why_voted"]) == ("consensus", NO_PATH)
    assert len(document["producers"]) == 1


def test_two_runs_at_once_leave_the_files_of_one(
    at_once: tuple[Path, dict[str, dict[str, Any]]],
) -> None:
    out, said = at_once
    assert outputs(out) == MADE
    assert "the fused map is not drawn" in (out / "report" / "report.html").read_text(
        encoding="utf-8"
    )
    assert {path.name for path in out.iterdir() if path.is_dir()} == {"report"}
    assert not list(out.rglob(".slamfusion-*"))
    record = json.loads((out / "graph.json").read_text(encoding="utf-8"))
    (document,) = (item for item in said.values() if item["log"] == record["log"])
    (made,) = record["producers"]
    assert made["scans"] == document["producers"][0]["scans"]
    assert len(read_trajectory(out / "graph.tum")) == made["scans"]
    assert Path(record["log"]).name in (out / "report" / "report.html").read_text(encoding="utf-8")


def own_words(stderr: str) -> str:
    """Return what a command itself said; a compiler of kernels that is interrupted says so, too."""
    return without_progress(stderr).removeprefix("1 error generated.\n")


def test_a_run_interrupted_in_its_producers_leaves_no_folder(place: Path, tmp_path: Path) -> None:
    started = subprocess.Popen(
        [*HEARING, INSTALLED, "run", place / "flat.log", "-o", tmp_path / "out"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    producer = a_producer_of(started.pid)
    os.killpg(started.pid, signal.SIGINT)
    _, stderr = started.communicate(timeout=60)
    assert started.returncode == 130
    assert own_words(stderr) == "slamfusion: interrupted\n"
    assert not Path(f"/proc/{producer}").exists()
    assert tree(tmp_path) == {}
