"""Commands whose address space is limited end in one line, or take what fits."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from slamfusion.cli import address_space
from slamfusion.cli.program import OUT_OF_MEMORY, _is_out_of_memory
from slamfusion.grid import CellBox
from slamfusion.io import save_map
from tests.cli.command import MAPS, assert_one_line_failure, json_of, run, tree
from tests.fusion.drawings import building

pytestmark = pytest.mark.once

MIB = 2**20
# With these the needs are those of one thread of OpenBLAS and of many of PoCL, on any machine.
THREADS = {"OPENBLAS_NUM_THREADS": "1", "POCL_MAX_PTHREAD_COUNT": "64"}


@pytest.mark.parametrize("command", ["align", "evaluate", "fuse", "run", "simulate", "slam"])
def test_without_room_for_the_libraries_nothing_is_begun(tmp_path: Path, command: str) -> None:
    """Before, OpenBLAS tried for ever, or the process was ended by a signal."""
    done = run(command, MAPS[0], "-o", "out", cwd=tmp_path, limits={resource.RLIMIT_AS: 200 * MIB})
    assert_one_line_failure(
        done, "out of memory", "limited to 200 MiB", "wanted at least", "raise the limit (ulimit"
    )
    assert done.stdout == ""
    assert tree(tmp_path) == {}


def test_json_has_the_reason() -> None:
    done = run("fuse", *MAPS, "--json", limits={resource.RLIMIT_AS: 200 * MIB})
    assert "limited to 200 MiB" in json_of(done)["error"]


def test_without_room_for_opencl_numpy_computes(tmp_path: Path) -> None:
    """Before, PoCL ended the process."""
    # Small ones: the twins take their time.
    whole = building(1, 7.0, 6.0)
    save_map(whole, tmp_path / "a")
    save_map(whole.crop(CellBox(0, 0, whole.height, whole.width - 6)), tmp_path / "b")
    arguments = ("fuse", tmp_path / "a.yaml", tmp_path / "b.yaml", "-o", tmp_path / "out")
    limits = {resource.RLIMIT_AS: 1024 * MIB}
    done = run(*arguments, env=THREADS, limits=limits)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("OpenCL needs 5120 MiB of address space, but only ")
    assert "raise the limit (ulimit -v unlimited), set POCL_MAX_PTHREAD_COUNT=1: NumPy" in line
    assert len(tree(tmp_path)) == 4 + 5
    done = run(*arguments, "--device", "pthread", env=THREADS, limits=limits)
    assert_one_line_failure(done, "OpenCL needs 5120 MiB", "run with `--device numpy`")
    assert len(tree(tmp_path)) == 4 + 5


@pytest.mark.parametrize(("told", "threads"), [("1", 1), ("64", 4), ("", 4), ("0", 4), ("x", 4)])
def test_each_thread_of_openblas_needs_room(
    monkeypatch: pytest.MonkeyPatch, told: str, threads: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)))
    monkeypatch.setenv(address_space.THREADS, told)
    needed = address_space.ONE_THREAD_BYTES + (threads - 1) * address_space.THREAD_BYTES
    assert address_space.needed_bytes() == needed
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed, needed))
    assert address_space.shortage() == ""
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed - 1, needed))
    assert ("or set OPENBLAS_NUM_THREADS=1" in address_space.shortage()) == (threads > 1)


class OpenCVError(Exception):
    """As ``cv2.error``, which cannot be made with a code."""

    def __init__(self, code: int) -> None:
        super().__init__("OpenCV")
        self.code = code


@pytest.mark.parametrize(
    ("error", "is_memory"),
    [
        (ImportError("libx.so: failed to map segment from shared object"), True),
        (ImportError("libx.so: cannot allocate memory in static TLS block"), True),
        (ImportError("No module named 'x'"), False),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("a bug"), False),
        (OpenCVError(-4), True),
        (OpenCVError(-215), False),
        (ValueError("Cannot allocate memory"), False),
    ],
)
def test_what_libraries_say_without_memory_is_known(error: Exception, is_memory: bool) -> None:
    assert _is_out_of_memory(error) == is_memory
    assert OUT_OF_MEMORY.startswith("out of memory; ")
