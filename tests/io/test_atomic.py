"""Claims about files that appear whole or not at all."""

from __future__ import annotations

import os
import resource
import signal
import socket
import stat
import tempfile
from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import MapFileError
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, save_map, write_atomic
from tests.cli.command import tree

GRID = OccupancyGrid(np.zeros((300, 300), dtype=np.int8), 0.05)


def write_set(contents: dict[Path, bytes], *, interrupt: bool = False) -> None:
    """Write several files as one set; ``interrupt`` as if Ctrl-C came before the end."""
    with AtomicFiles() as files:
        for path, data in contents.items():
            files.add(path, data)
        if interrupt:
            raise KeyboardInterrupt


def test_bytes_arrive(tmp_path: Path) -> None:
    write_atomic(tmp_path / "a", b"one")
    assert (tmp_path / "a").read_bytes() == b"one"
    assert len(list(tmp_path.iterdir())) == 1


def test_missing_folders_are_made_and_a_failure_removes_them(tmp_path: Path) -> None:
    write_atomic(tmp_path / "p" / "q" / "a", b"x")
    assert (tmp_path / "p" / "q" / "a").read_bytes() == b"x"
    before = tree(tmp_path)
    with pytest.raises(MapFileError, match="it is a folder"):
        write_set({tmp_path / "p" / "r" / "s" / "b": b"y", tmp_path / "p" / "q": b"in the way"})
    assert tree(tmp_path) == before


def test_an_exception_in_the_block_leaves_everything_as_it_was(tmp_path: Path) -> None:
    write_atomic(tmp_path / "a", b"old")
    before = tree(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        write_set({tmp_path / "a": b"new", tmp_path / "b": b"new"}, interrupt=True)
    assert tree(tmp_path) == before


def test_files_are_removed_with_the_set(tmp_path: Path) -> None:
    write_atomic(tmp_path / "old", b"old")
    with AtomicFiles() as files:
        files.add(tmp_path / "new", b"new")
        files.remove(tmp_path / "old")
        files.remove(tmp_path / "absent")
        assert (tmp_path / "old").exists()
    assert list(tree(tmp_path)) == ["new"]
    files = AtomicFiles()
    files.remove(tmp_path)
    with pytest.raises(MapFileError, match="cannot write: Is a directory"), files:
        pass


def test_permissions_follow_the_umask_or_the_old_file(tmp_path: Path) -> None:
    was = os.umask(0o027)
    try:
        write_atomic(tmp_path / "fresh", b"x")
    finally:
        os.umask(was)
    assert stat.S_IMODE((tmp_path / "fresh").stat().st_mode) == 0o640
    (tmp_path / "fresh").chmod(0o604)
    write_atomic(tmp_path / "fresh", b"y")
    assert stat.S_IMODE((tmp_path / "fresh").stat().st_mode) == 0o604


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to("real")
    write_atomic(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


@pytest.mark.parametrize("path", ["/dev/full", "/dev/null", "/dev/zero"])
def test_a_device_is_refused_and_stays(path: str) -> None:
    before = sorted(Path("/dev").iterdir())
    with pytest.raises(MapFileError, match=f"{path}: cannot write: it is a device"):
        write_atomic(path, b"x")
    assert Path(path).is_char_device()
    assert sorted(Path("/dev").iterdir()) == before


def test_pipes_sockets_and_folders_are_refused_and_stay(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as server, tempfile.TemporaryDirectory() as short:
        server.bind(f"{short}/s")
        for path in (tmp_path / "pipe", tmp_path / "folder", Path(short) / "s"):
            mode = path.stat().st_mode
            with pytest.raises(MapFileError, match=r"cannot write: it is a .*; "):
                write_atomic(path, b"x")
            assert path.stat().st_mode == mode
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    "path",
    ["/proc/slamfusion/out", "/proc/out", "/sys/out", "/etc/passwd/out", "/etc/passwd/deep/er/out"],
)
def test_a_place_where_nobody_may_write_gives_one_line(path: str) -> None:
    # Tests may run as root; not even root makes files here.
    for write in (lambda: write_atomic(path, b"x"), lambda: save_map(GRID, path)):
        with pytest.raises(MapFileError) as caught:
            write()
        message = str(caught.value)
        assert message.startswith(path)
        assert "cannot write: " in message
        assert "; " in message
        assert "\n" not in message


@pytest.mark.parametrize("name", ["x" * 300, "nul\x00byte"])
def test_a_name_the_system_cannot_hold_gives_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(MapFileError, match=r"cannot write: .*; "):
        write_atomic(tmp_path / name, b"x")
    with pytest.raises(MapFileError, match=r"cannot write: .*; "):
        save_map(GRID, tmp_path / name)
    assert tree(tmp_path) == {}


def test_a_file_size_limit_leaves_the_old_map(tmp_path: Path) -> None:
    save_map(OccupancyGrid(np.zeros((2, 2), np.int8), 0.1), tmp_path / "out")
    before = tree(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(MapFileError, match="cannot write: File too large; raise"):
            save_map(GRID, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert tree(tmp_path) == before
