"""PoCL builds kernels also where its compiler does not know the processor."""

from __future__ import annotations

import subprocess
import sys

import pytest

from slamfusion.compute.pocl import PROCESSORS, _processor_flags, processor_name
from tests.kernels.conftest import WHEELS_EXIST

# PoCL asks the library's own function; it is made to say what an unknown processor makes it say.
UNKNOWN_PROCESSOR = """
import ctypes
from pathlib import Path
import pyopencl
import slamfusion.compute.pocl as pocl
if {force}:  # whatever PoCL says of this processor counts as not knowing it
    (library,) = Path(pyopencl.__file__).parent.glob(".libs/libpocl*.so*")
    function = ctypes.CDLL(str(library)).pocl_get_llvm_cpu_name
    function.restype = ctypes.c_char_p
    pocl.UNKNOWN = function()
    assert pocl.name_processor() is not None
from slamfusion.compute import open_backend
from slamfusion.compute.self_test import self_test
backend = open_backend("portable computing")
assert all(passed for _, passed, _ in self_test(backend))
print("built on", backend.device.version)
"""


@pytest.mark.once
@pytest.mark.skipif(not WHEELS_EXIST, reason="no PoCL wheel here")
@pytest.mark.parametrize("force", [False, True])
def test_kernels_build_and_the_process_ends_well(force: bool):
    script = UNKNOWN_PROCESSOR.format(force=force)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "built on OpenCL" in done.stdout
    assert done.stderr == ""


def test_the_best_name_that_fits():
    everything = {flag for _, needed in PROCESSORS for flag in needed.split()}
    assert processor_name(everything) == "skylake-avx512"
    assert processor_name(everything - {"avx512vl"}) == "haswell"
    assert processor_name(everything - {"avx512vl", "avx2"}) == "sandybridge"
    assert processor_name({"sse2"}) == "x86-64"


def test_flags_of_the_first_processor():
    text = "processor : 0\nflags\t\t: fpu avx2 fma\n\nprocessor : 1\nflags : fpu\n"
    assert _processor_flags(text) == {"fpu", "avx2", "fma"}
    assert _processor_flags("") == set()
