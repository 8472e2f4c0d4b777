"""PoCL builds kernels also where its compiler does not know the processor, or says what to do."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from slamfusion.compute import device as device_module
from slamfusion.compute.device import choose_device
from slamfusion.compute.pocl import FUNCTION_BYTES, SWITCH, WHEEL, PoclState, wheel_library
from slamfusion.errors import DeviceError
from tests.kernels.conftest import WHEELS_EXIST
from tests.support.fresh import run_python

needs_wheels = pytest.mark.skipif(not WHEELS_EXIST, reason="no PoCL wheel here")
ROOT = Path(__file__).resolve().parents[2]
# In an interpreter in which PoCL was not loaded yet.
run = partial(run_python, **{SWITCH: ""})
FIRST_BYTES = bytes.fromhex("55534883ec08e8058ab003")

# PoCL asks the library's own function. Whatever it says of this processor counts here as not
# knowing it; what it says, and the function's bytes, are compared before and after.
UNKNOWN_PROCESSOR = """
import ctypes, logging, sys
import slamfusion.compute.pocl as pocl
logging.getLogger("slamfusion").addHandler(logging.StreamHandler())
function = ctypes.CDLL(str(pocl.wheel_library())).pocl_get_llvm_cpu_name
function.restype = ctypes.c_char_p
address = ctypes.cast(function, ctypes.c_void_p).value
def seen():
    return function(), ctypes.string_at(address, pocl.FUNCTION_BYTES)
first = seen()
pocl.UNKNOWN = first[0]
"""
NAME_PROCESSOR = """
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
KERNELS = """
from slamfusion.compute import open_device
print(open_device("portable computing").program.kernel_names)
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


@pytest.mark.once
@needs_wheels
def test_kernels_build_and_the_process_ends_well(tmp_path: Path):
    log = "logging.getLogger('slamfusion').setLevel(logging.INFO)"
    done = run(UNKNOWN_PROCESSOR + log + NAME_PROCESSOR + BUILD, XDG_CACHE_HOME=str(tmp_path))
    assert done.returncode == 0, done.stderr
    state, detail, built = done.stdout.splitlines()
    assert state.startswith("patched ")
    assert "does not know this processor" in detail
    assert "SLAMFUSION_PATCH_POCL=0" in detail
    assert "built on OpenCL" in built
    assert done.stderr.splitlines() == [detail]


@pytest.mark.once
@needs_wheels
def test_kernels_are_read_back_from_the_cache_on_the_narrowest_registers(tmp_path: Path):
    code = f"{UNKNOWN_PROCESSOR}pocl.PROCESSORS = {{'x86-64': ''}}{NAME_PROCESSOR}{KERNELS}"
    built, read = (run(code, XDG_CACHE_HOME=str(tmp_path)) for _ in range(2))
    assert built.stdout.splitlines()[-1].count(";") > 20, built.stderr
    assert read.stdout == built.stdout
    assert read.returncode == 0, read.stderr


REFUSALS = {
    "code that is not opened": (DENY.format(rights=7), "mprotect does not open its code"),
    "code that is not closed": (DENY.format(rights=5), "mprotect does not close its code"),
    "switched off": ("import os; os.environ['SLAMFUSION_PATCH_POCL'] = '0'", f"{SWITCH}=0 says"),
    "another function": ("", "its function is not that of pocl-binary-distribution 3.0"),
}


@pytest.mark.once
@needs_wheels
@pytest.mark.parametrize("name", REFUSALS)
def test_a_library_that_must_not_be_changed_stays_as_it_is(name: str, tmp_path: Path):
    before, reason = REFUSALS[name]
    paths = [str(ROOT)]
    if name == "another function":
        paths.insert(0, str(tmp_path))
        _change_function(tmp_path / "pyopencl")
    done = run(UNKNOWN_PROCESSOR + before + NAME_PROCESSOR, PYTHONPATH=os.pathsep.join(paths))
    if done.returncode == 77:
        pytest.skip("this machine lets no process filter its system calls")
    assert done.returncode == 0, done.stderr
    state, detail = done.stdout.splitlines()
    assert state == "refused unchanged"
    assert reason in detail
    assert "apt install pocl-opencl-icd" in detail
    assert "slamfusion[intel]" in detail
    assert not done.stderr


def _change_function(package: Path) -> None:
    """Copy the library to a package, with another last byte of the function."""
    library = wheel_library()
    (package / ".libs").mkdir(parents=True)
    (package / "__init__.py").touch()
    needed = library.parents[2] / "pocl_binary_distribution"
    (package.parent / needed.name).symlink_to(needed)
    code = bytearray(library.read_bytes())
    code[code.index(FIRST_BYTES) + FUNCTION_BYTES - 1] ^= 1
    (package / ".libs" / library.name).write_bytes(code)


@pytest.mark.once
@needs_wheels
def test_commands_say_what_to_install_where_the_library_is_refused():
    """The wheel's devices are shown as not usable, and none of them is chosen."""
    command = (
        UNKNOWN_PROCESSOR.replace("StreamHandler", "NullHandler")
        + "from slamfusion.cli.main import main\n"
        "main([{arguments}])\n"
    )
    environment = {"SLAMFUSION_PATCH_POCL": "0", "PYOPENCL_CTX": ""}
    listed = run(command.format(arguments="'devices'"), **environment)
    assert (listed.returncode, listed.stderr) == (0, "")
    assert listed.stdout.count("never: does not know this processor") == 2
    asked = run(command.format(arguments="'doctor', '--device', 'pthread'"), **environment)
    assert asked.returncode == 1
    assert "PoCL: libpocl" in asked.stdout
    assert "apt install pocl-opencl-icd" in asked.stdout


def test_the_wheel_is_pinned_to_what_was_checked():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    pinned = re.findall(r'"pocl-binary-distribution([^;"]*)', project)
    assert pinned == [f"=={WHEEL}"]


@pytest.fixture
def refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let devices named pthread be those of a library that was refused."""
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    monkeypatch.setattr(device_module, "is_refused", lambda one: one.name.startswith("pthread"))
    state = PoclState("refused", "left as it is; install another")
    monkeypatch.setattr(device_module, "name_processor", lambda: state)


def cpu(name: str) -> SimpleNamespace:
    platform = SimpleNamespace(name="Maker")
    return SimpleNamespace(name=name, type=1 << 1, platform=platform, available=True)


@pytest.mark.usefixtures("refusal")
def test_a_refused_device_is_passed_over(monkeypatch: pytest.MonkeyPatch):
    refused, other = cpu("pthread-new"), cpu("other new")
    monkeypatch.setattr(device_module, "find_devices", lambda: [refused, other])
    assert choose_device() is other
    assert choose_device("new") is other
    for wanted in ("pthread", "0"):
        with pytest.raises(DeviceError, match="left as it is; install another"):
            choose_device(wanted)
    monkeypatch.setattr(device_module, "find_devices", lambda: [refused])
    with pytest.raises(DeviceError, match="left as it is; install another"):
        choose_device()
