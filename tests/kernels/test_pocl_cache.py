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

FULL = os.strerror(28)


@pytest.fixture(autouse=True)
def _anew(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Find the folder anew, and leave the process's as it was."""
    for name in (pocl_cache.FOLDER, pocl_cache.CACHES):
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    pocl_cache.find_cache.cache_clear()
    yield
    pocl_cache.find_cache.cache_clear()


def test_a_cache_that_can_be_written_is_pocls_own(tmp_path: Path) -> None:
    found = pocl_cache.find_cache()
    assert found == pocl_cache.PoclCache(tmp_path / pocl_cache.FOLDER)
    assert os.environ[pocl_cache.FOLDER] == str(found.folder)


def test_without_a_cache_kernels_are_kept_for_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    own = tmp_path / "file"
    own.write_bytes(b"")
    monkeypatch.setenv(pocl_cache.FOLDER, str(own))
    found = pocl_cache.find_cache()
    assert found.folder is not None
    assert found.folder.parent == tmp_path
    assert os.environ[pocl_cache.FOLDER] == str(found.folder)
    (record,) = caplog.records
    assert record.message == found.detail
    assert f"PoCL's cache {own} cannot be written (File exists): kernels are" in found.detail
    pocl_cache._remove(found.folder, os.getpid() + 1)
    assert found.folder.is_dir()
    pocl_cache._remove(found.folder, os.getpid())
    assert not found.folder.exists()


def test_without_any_folder_any_device_is_numpy_and_a_named_one_is_refused(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(pocl_cache, "_why_not", lambda _: FULL)
    monkeypatch.setattr("slamfusion.compute.device.find_devices", list)
    assert open_device("auto").name.startswith("NumPy")
    (record,) = caplog.records
    assert record.message.endswith(f"neither ({FULL}): NumPy computes instead, which takes longer")
    with pytest.raises(DeviceError, match=rf"neither \({FULL}\); free some space, or run with"):
        open_device("pthread")


def test_a_process_that_may_write_no_large_file_ends_well(tmp_path: Path) -> None:
    """Before, PoCL said that there is no device."""
    done = run(
        "evaluate", MAPS[0], "--truth", MAPS[1], "--no-align", "--json",
        env={"TMPDIR": str(tmp_path), pocl_cache.FOLDER: str(tmp_path)},
        limits={resource.RLIMIT_FSIZE: 4096},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) <= 1
    assert len(json_of(done)["maps"]) == 1
