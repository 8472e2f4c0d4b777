"""PoCL builds kernels also where its compiler does not know the processor, or says what to do."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from slamfusion.compute import device as device_module
from slamfusion.compute.device import choose_device
from slamfusion.compute.pocl import CHECKED, SWITCH
from slamfusion.errors import DeviceError
from tests.kernels.conftest import WHEELS_EXIST

needs_wheels = pytest.mark.skipif(not WHEELS_EXIST, reason="no PoCL wheel here")
ROOT = Path(__file__).resolve().parents[2]

# PoCL asks the library's own function. Whatever it says of this processor counts here as not
# knowing it; what it says, and the function's first bytes, are printed before and after.
UNKNOWN_PROCESSOR = """
import ctypes, os, shutil, sys
from dataclasses import replace
from pathlib import Path
import slamfusion.compute.pocl as pocl
library = pocl._library()
{before}
function = ctypes.CDLL(str(library)).pocl_get_llvm_cpu_name
function.restype = ctypes.c_char_p
address = ctypes.cast(function, ctypes.c_void_p).value
def seen():
    return function(), ctypes.string_at(address, 32)
first = seen()
pocl.UNKNOWN = first[0]
{deny}
state = pocl.name_processor()
assert pocl.name_processor() is state
print(state.state, "unchanged" if seen() == first else seen()[0].decode())
print(state.detail)
"""
BUILD = """
from slamfusion.compute import open_device
from slamfusion.compute.self_test import self_test
device = open_device("portable computing")
assert all(passed for _, passed, _ in self_test(device))
print("built on", device.device.version)
"""
# The kernel refuses what this thread asks of mprotect with these rights, as a hardened system does.
DENY = """
import struct
process = ctypes.CDLL(None, use_errno=True)
steps = struct.pack(
    "HBBI" * 6,
    0x20, 0, 0, 0,            # load the number of the system call
    0x15, 0, 3, 10,           # go on with mprotect
    0x20, 0, 0, 32,           # load its third argument
    0x15, 0, 1, {rights},     # go on with these rights
    0x06, 0, 0, 0x00050001,   # refuse: EPERM
    0x06, 0, 0, 0x7FFF0000,   # allow
)
text = ctypes.create_string_buffer(steps)
program = struct.pack("HxxxxxxQ", 6, ctypes.addressof(text))
assert process.prctl(38, 1, 0, 0, 0) == 0
if process.prctl(22, 2, ctypes.c_char_p(program)) != 0:
    sys.exit(77)
"""


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter, in which PoCL was not loaded yet."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, SWITCH: "", **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.once
@needs_wheels
def test_kernels_build_and_the_process_ends_well(tmp_path: Path):
    code, caches = UNKNOWN_PROCESSOR.format(before="", deny=""), str(tmp_path)
    agreed = run(code, XDG_CACHE_HOME=caches, **{SWITCH: "1"})
    assert (agreed.returncode, agreed.stderr) == (0, "")
    done = run(code + BUILD, XDG_CACHE_HOME=caches)
    assert done.returncode == 0, done.stderr
    assert "built on OpenCL" in done.stdout
    assert done.stdout.startswith("patched ")
    # The first command of an installation reports it in a line, later ones do not.
    assert done.stderr.count("\n") == 1
    assert "does not know this processor" in done.stderr
    assert "SLAMFUSION_PATCH_POCL=0" in done.stderr
    assert not run(code, XDG_CACHE_HOME=caches).stderr


# A byte more at the end of the file: the same code, another digest. What the library needs lies
# beside the wheel's and is loaded by that one.
ANOTHER_LIBRARY = """
ctypes.CDLL(str(library))
library = Path(shutil.copy(library, {folder!r}))
with library.open("ab") as file:
    file.write(b"more")
pocl._library = lambda: library
"""
ANOTHER_FUNCTION = """
pocl.CHECKED = (replace(pocl.CHECKED[0], function=pocl.CHECKED[0].function[:-1] + b"?"),)
"""
OFF = "os.environ['SLAMFUSION_PATCH_POCL'] = '0'"
REFUSALS = {
    "another library": (ANOTHER_LIBRARY, "", "not the library that was checked (pocl-binary"),
    "another function": (ANOTHER_FUNCTION, "", "its function does not begin as it did"),
    "code that is not opened": ("", DENY.format(rights=7), "mprotect does not open its code"),
    "code that is not closed": ("", DENY.format(rights=5), "mprotect does not close its code"),
    "switched off": (OFF, "", "SLAMFUSION_PATCH_POCL=0"),
}


@pytest.mark.once
@needs_wheels
@pytest.mark.parametrize("name", REFUSALS)
def test_a_library_that_must_not_be_changed_stays_as_it_is(name: str, tmp_path: Path):
    before, deny, reason = REFUSALS[name]
    done = run(UNKNOWN_PROCESSOR.format(before=before.format(folder=str(tmp_path)), deny=deny))
    if done.returncode == 77:
        pytest.skip("this machine lets no process filter its system calls")
    assert done.returncode == 0, done.stderr
    state, detail = done.stdout.splitlines()
    assert state == "refused unchanged"
    assert reason in detail
    assert "apt install pocl-opencl-icd" in detail
    assert "slamfusion[intel]" in detail
    assert done.stderr.splitlines() == [detail]


@pytest.mark.once
@needs_wheels
def test_commands_say_what_to_install_where_the_library_is_refused():
    """The wheel's devices are shown as not usable, and none of them is chosen."""
    command = (
        "import pyopencl, slamfusion.compute.pocl as pocl\n"
        "import ctypes\n"
        "function = ctypes.CDLL(str(pocl._library())).pocl_get_llvm_cpu_name\n"
        "function.restype = ctypes.c_char_p\n"
        "pocl.UNKNOWN = function()\n"
        "from slamfusion.cli.main import main\n"
        "main([{arguments}])\n"
    )
    environment = {"SLAMFUSION_PATCH_POCL": "0", "PYOPENCL_CTX": ""}
    listed = run(command.format(arguments="'devices'"), **environment)
    assert listed.returncode == 0
    assert listed.stdout.count("never: does not know this processor") == 2
    assert listed.stderr.count("SLAMFUSION_PATCH_POCL=0") == 1
    asked = run(command.format(arguments="'doctor', '--device', 'pthread'"), **environment)
    assert asked.returncode == 1
    assert "PoCL: libpocl" in asked.stdout
    assert "apt install pocl-opencl-icd" in asked.stdout


def test_the_wheel_is_pinned_to_what_was_checked():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    pinned = re.findall(r'"pocl-binary-distribution([^;"]*)', project)
    assert pinned == [f"=={CHECKED[-1].wheel}"]


@pytest.fixture
def refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let devices named pthread be those of a library that was refused."""
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    monkeypatch.setattr(device_module, "is_refused", lambda one: one.name.startswith("pthread"))
    state = SimpleNamespace(detail="left as it is; install another")
    monkeypatch.setattr(device_module, "name_processor", lambda: state)


def cpu(name: str) -> SimpleNamespace:
    platform = SimpleNamespace(name="Maker")
    return SimpleNamespace(name=name, type=1 << 1, platform=platform, available=True)


@pytest.mark.usefixtures("refusal")
def test_a_refused_device_is_passed_over(monkeypatch: pytest.MonkeyPatch):
    refused, other = cpu("pthread-new"), cpu("other new")
    monkeypatch.setattr(device_module, "find_devices", lambda: [refused, other])
    assert choose_device()[0] is other
    assert choose_device("new")[0] is other
    for wanted in ("pthread", "0"):
        with pytest.raises(DeviceError, match="left as it is; install another"):
            choose_device(wanted)
    monkeypatch.setattr(device_module, "find_devices", lambda: [refused])
    with pytest.raises(DeviceError, match="left as it is; install another"):
        choose_device()
