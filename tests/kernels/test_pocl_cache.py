"""PoCL keeps kernels where it can: in its own cache, a temporary one, or NumPy computes."""

from __future__ import annotations

import os
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamfusion.compute import open_device, pocl_cache
from slamfusion.errors import DeviceError
from tests.cli.command import MAPS, json_of, run

pytestmark = pytest.mark.once

FOLDERS = ("POCL_CACHE_DIR", "XDG_CACHE_HOME")


@pytest.fixture(autouse=True)
def _fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Find the folder again, and leave the process's as it was."""
    for name in FOLDERS:
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    pocl_cache.find_cache.cache_clear()
    yield
    pocl_cache.find_cache.cache_clear()


def test_a_cache_that_can_be_written_is_pocls_own(tmp_path: Path) -> None:
    assert not pocl_cache.find_cache()
    assert [os.environ[name] for name in FOLDERS] == [str(tmp_path / name) for name in FOLDERS]
    assert all(path.is_dir() for path in tmp_path.iterdir())


@pytest.mark.parametrize("name", FOLDERS)
def test_without_a_cache_kernels_are_kept_for_the_process(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    full = tmp_path / name
    full.write_bytes(b"")
    assert not pocl_cache.find_cache()
    (record,) = caplog.records
    assert f"PoCL's cache {full} cannot be written (File exists): kernels are" in record.message
    assert {Path(os.environ[name]).parent for name in FOLDERS} == {tmp_path}
    assert all(Path(os.environ[name]).is_dir() for name in FOLDERS)


def test_without_any_folder_any_device_is_numpy_and_a_named_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FOLDERS[0]).write_bytes(b"")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / FOLDERS[0]))
    assert open_device("auto").name.startswith("NumPy")
    (record,) = caplog.records
    assert "no temporary folder either (Not a directory): NumPy computes instead" in record.message
    with pytest.raises(DeviceError, match=r"\(Not a directory\); free some space, or run with"):
        open_device("pthread")


def test_a_process_that_may_write_no_large_file_ends_well(tmp_path: Path) -> None:
    """Before, PoCL said that there is no device."""
    done = run(
        "evaluate", MAPS[0], "--truth", MAPS[1], "--no-align", "--json",
        env={"TMPDIR": str(tmp_path), "POCL_CACHE_DIR": str(tmp_path)},
        limits={resource.RLIMIT_FSIZE: 4096},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) <= 1
    assert len(json_of(done)["maps"]) == 1
    assert not list(tmp_path.glob("slamfusion-*"))


def test_kernels_that_are_damaged_in_the_cache_are_named(tmp_path: Path) -> None:
    folder = str(tmp_path / FOLDERS[0])
    command = ("evaluate", MAPS[0], "--truth", MAPS[1], "--no-align", "--device", "pthread")
    assert run(*command, env={FOLDERS[0]: folder}).returncode == 0
    (program,) = Path(folder).rglob("program.bc")
    program.write_bytes(b"")  # as the power went out
    done = run(*command, env={FOLDERS[0]: folder})
    assert done.returncode != 0
    assert f"PoCL's cache {folder} are damaged; delete that folder" in done.stderr
