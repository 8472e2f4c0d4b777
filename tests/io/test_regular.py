"""Readers open regular files and wait for nothing else; what is packed has a budget."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from slamfusion.errors import LogError, MemoryBudgetError, SlamFusionError
from slamfusion.evaluation.distances import load_distances
from slamfusion.evaluation.relations import read_relations
from slamfusion.io import load_map, open_log, read_trajectory
from slamfusion.io.files import open_regular
from slamfusion.io.scan_odometry import read_scan_odometry
from slamfusion.pose_graph.g2o import read_g2o
from slamfusion.sim.courses import load_course
from slamfusion.slam.registry import load_config

READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "map": (load_map, ".yaml"),
    "picture": (lambda path: load_map(path, resolution=0.05), ".pgm"),
    "settings": (load_config, ".yaml"),
    "course": (load_course, ".yaml"),
    "distances": (load_distances, ".yaml"),
    "table of distances": (load_distances, ".csv"),
    "log": (open_log, ".log"),
    "recording": (open_log, ".dat"),
    "bag": (open_log, ".mcap"),
    "trajectory": (read_trajectory, ".tum"),
    "relations": (read_relations, ".txt"),
    "scan odometry": (lambda path: read_scan_odometry(path, path, []), ".csv"),
    "graph": (read_g2o, ".g2o"),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "folder"])
def test_no_reader_waits_for_what_is_no_file(tmp_path: Path, name: str, kind: str) -> None:
    read, suffix = READERS[name]
    path = tmp_path / f"a{suffix}"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    with pytest.raises(SlamFusionError) as caught:
        read(path)
    if kind == "folder" and name in {"log", "recording", "bag", "trajectory"}:
        assert "ROS 2 bag" in str(caught.value)
    else:
        assert f"wanted a file, found a {kind}" in str(caught.value)


@pytest.mark.parametrize("name", READERS)
def test_links_that_lead_in_a_circle_are_one_error(tmp_path: Path, name: str) -> None:
    read, suffix = READERS[name]
    path = tmp_path / f"a{suffix}"
    path.symlink_to(path)
    with pytest.raises((SlamFusionError, OSError)) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_a_file_that_becomes_a_pipe_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, pipe = tmp_path / "file", tmp_path / "pipe"
    file.write_bytes(b"1")
    os.mkfifo(pipe)
    regular = file.stat()
    monkeypatch.setattr(Path, "stat", lambda _: regular)
    with pytest.raises(LogError, match="found a pipe"):
        open_regular(pipe, LogError)


def test_rows_that_would_not_fit_into_memory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.tum"
    path.write_bytes(b"1 2 3 4\n" * 150_000)
    monkeypatch.setattr("slamfusion.io.files.available_memory", lambda: 1 << 20)
    with pytest.raises(MemoryBudgetError, match=r"a\.tum: keeping \d+ lines needs"):
        read_trajectory(path)


def test_a_bomb_in_a_bag_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bags = pytest.importorskip("tests.io.bags")
    monkeypatch.setattr("slamfusion.io.bags.storage.PIECE_BYTES", 1 << 16)
    bag = bags.Bag()
    for number in range(20):
        bag.scan(1.0 + 0.1 * number, [1.0] * 20_000)
    paths = []
    for kind in ("ros1-bz2", "ros1-lz4"):
        (tmp_path / kind).mkdir()
        paths.append(bag.write(tmp_path / kind, kind))
    paths += [bag.write(tmp_path, packed=mode) for mode in ("STORAGE", "MESSAGE")]
    for path in paths:
        with pytest.raises(LogError, match=r"a piece unpacks to more than 64\.0 KiB"):
            list(open_log(path))


@pytest.mark.parametrize("mode", ["STORAGE", "FILE", "MESSAGE"])
def test_packed_bags_of_ordinary_size_are_read(tmp_path: Path, mode: str) -> None:
    bags = pytest.importorskip("tests.io.bags")
    bag = bags.Bag()
    for number in range(20):
        bag.scan(1.0 + 0.1 * number, [1.0] * 2000, angle_increment=0.003)
    assert sum(1 for _ in open_log(bag.write(tmp_path, packed=mode))) == 20
