"""Claims about what memory there is and when work is refused."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import psutil
import pytest

from slamfusion.errors import MemoryBudgetError
from slamfusion.io import available_memory, check_memory, files


def test_no_more_is_available_than_the_machine_has() -> None:
    assert 0 < available_memory() <= psutil.virtual_memory().total


def test_what_fits_passes_and_what_does_not_is_refused_with_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(files, "available_memory", lambda: 3 * 2**30)
    check_memory(3 * 2**30, "a map", "here.yaml")
    with pytest.raises(MemoryBudgetError) as caught:
        check_memory(5 * 2**30, "fusing 3 maps", "here.yaml")
    assert str(caught.value) == (
        "here.yaml: fusing 3 maps needs 5.0 GiB of memory, but only 3.0 GiB is available; "
        "free memory, crop it or use a coarser cell"
    )


COUNT_HEAPS = """
import ctypes, sys, threading
from slamfusion.io.files import use_one_arena
use_one_arena()
together = threading.Barrier(4)
def allocate():
    together.wait()
    bytes(100_000)
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(4)]
[one.start() for one in threads], [one.join() for one in threads]
ctypes.CDLL(None).malloc_info(0, ctypes.c_void_p.in_dll(ctypes.CDLL(None), "stdout"))
ctypes.CDLL(None).fflush(None)
"""
COUNT_THREADS = """
import contextlib, os
from slamfusion.cli.main import main
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(None):
    main(["--version"])
import numpy, scipy.linalg
ones = numpy.ones(20_000)
ones @ ones, scipy.linalg.blas.ddot(ones, ones)
print(len(os.listdir("/proc/self/task")))
"""


def run(code: str) -> str:
    """Return what a fresh interpreter prints, without a variable that helps."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "O"))}
    return subprocess.run(
        [sys.executable, "-c", code], env=kept, check=True, capture_output=True, text=True
    ).stdout


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are of glibc")
def test_threads_share_one_heap() -> None:
    assert run(COUNT_HEAPS).count("<heap nr=") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_a_command_starts_no_threads_of_blas() -> None:
    assert int(run(COUNT_THREADS)) == 1
