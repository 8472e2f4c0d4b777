"""Intel's CPU device of the extra ``intel`` is shown beside the others and computes the same."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from slamfusion.compute import device as devices
from tests.kernels.conftest import WHEELS_EXIST
from tests.support.fresh import run_python

VENDORS = "OCL_ICD_VENDORS"
needs_intel = pytest.mark.skipif(
    devices.intel_library() is None,
    reason="Intel's OpenCL is not installed: pip install '.[intel]' (225 MB)",
)


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file where the extra would have its library; no variable says what to show."""
    path = tmp_path / "libintelocl.so"
    path.touch()
    monkeypatch.setattr(devices, "intel_library", lambda: path)
    monkeypatch.delenv(VENDORS, raising=False)
    return path


def test_the_loader_sees_what_it_saw_and_intel(
    library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    usual = tmp_path / "vendors"
    usual.mkdir()
    (usual / "maker.icd").write_text("libmaker.so.1\n", encoding="utf-8")
    monkeypatch.setenv("OPENCL_VENDOR_PATH", str(usual))
    with devices.intel_shown():
        folder = Path(os.environ[VENDORS])
        shown = {entry.read_text(encoding="utf-8").strip() for entry in folder.glob("*.icd")}
    assert shown == {"libmaker.so.1", str(library)}
    assert VENDORS not in os.environ
    assert not folder.exists()


def run(code: str) -> list[str]:
    """Run code in a fresh interpreter, without a variable that helps; return its lines."""
    done = run_python(code, LD_LIBRARY_PATH=None, PYOPENCL_CTX=None, **{VENDORS: None})
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@needs_intel
def test_intel_is_shown_last_and_equals_the_twins():
    code = (
        "import os\n"
        "from slamfusion.compute import list_devices, open_device\n"
        "from slamfusion.compute.self_test import self_test\n"
        "print([one.platform for one in list_devices() if one.usable])\n"
        "device = open_device('intel')\n"
        "print(device.name)\n"
        "print([name for name, passed, _ in self_test(device) if not passed])\n"
        f"print({VENDORS!r} in os.environ)\n"
    )
    platforms, name, failed, is_left = run(code)
    assert platforms.endswith("'Intel(R) OpenCL']")
    assert "Intel(R) OpenCL" in name
    assert (failed, is_left) == ("[]", "False")
    if WHEELS_EXIST:  # both of PoCL's devices, none of them twice
        assert platforms.count("Portable Computing Language") == 2


@needs_intel
@pytest.mark.skipif(not WHEELS_EXIST, reason="no PoCL wheel here")
def test_intel_steps_in_where_pocl_is_refused():
    choose = (
        "from slamfusion.compute.device import choose_device\n"
        "print(choose_device().platform.name)\n"
    )
    unknown = (
        "import ctypes, os, slamfusion.compute.pocl as pocl\n"
        "os.environ['SLAMFUSION_PATCH_POCL'] = '0'\n"
        "function = ctypes.CDLL(str(pocl.wheel_library())).pocl_get_llvm_cpu_name\n"
        "function.restype = ctypes.c_char_p\n"
        "pocl.UNKNOWN = function()\n"
    )
    assert run(choose) == ["Portable Computing Language"]
    assert run(unknown + choose) == ["Intel(R) OpenCL"]
