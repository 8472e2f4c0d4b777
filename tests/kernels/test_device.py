"""Which device is chosen, and what is said where none is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl  # noqa: TID251 - device types
import pytest

from slamfusion.compute import device as device_module
from slamfusion.compute import list_devices, open_device, opencl
from slamfusion.compute.device import NO_DEVICE, choose_device
from slamfusion.errors import DeviceError
from tests.kernels.conftest import POCL, SIMULATOR, WHEELS_EXIST
from tests.support.fresh import run_python

pytestmark = pytest.mark.once

GPU, CPU = cl.device_type.GPU, cl.device_type.CPU
needs_wheels = pytest.mark.skipif(not WHEELS_EXIST, reason="no PoCL or Oclgrind wheel here")


def fake(name: str, kind: int, platform: str = "Maker", *, available: bool = True):
    """A device that can be chosen but not opened."""
    return SimpleNamespace(
        name=name, type=kind, platform=SimpleNamespace(name=platform), available=available
    )


FAMILIES = sorted(path.stem for path in opencl.kernel_folder().glob("*.cl"))
SIMULATED = fake("Oclgrind Simulator", GPU | CPU, "Oclgrind")
Machine = Callable[..., None]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    """Set what devices there are."""
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)

    def has(*devices: object) -> None:
        monkeypatch.setattr(device_module, "find_devices", lambda: list(devices))

    return has


@pytest.mark.parametrize(
    ("devices", "wanted"),
    [
        ((SIMULATED, fake("cpu", CPU), fake("gpu 1", GPU), fake("gpu 2", GPU)), "gpu 1"),
        ((SIMULATED, fake("cpu 1", CPU), fake("cpu 2", CPU)), "cpu 1"),
        ((fake("gone", GPU, available=False), fake("cpu", CPU)), "cpu"),
    ],
)
def test_the_first_gpu_that_is_available_is_chosen_and_else_the_first_cpu(
    machine: Machine, devices: tuple[object, ...], wanted: str
):
    machine(*devices)
    assert choose_device().name == wanted


def test_simulator_is_never_chosen_unasked(machine: Machine):
    machine(SIMULATED)
    with pytest.raises(DeviceError, match="no OpenCL device found"):
        choose_device()


@pytest.mark.parametrize("wanted", ["oclgrind", "OCLGRIND", "1"])
def test_simulator_is_chosen_by_name_or_index(machine: Machine, wanted: str):
    machine(fake("cpu", CPU), SIMULATED)
    assert choose_device(wanted) is SIMULATED


@pytest.mark.parametrize("wanted", ["nvidia", "2", "17"])
def test_unknown_name_lists_the_devices(machine: Machine, wanted: str):
    machine(fake("first", CPU), fake("second", GPU))
    with pytest.raises(DeviceError) as caught:
        choose_device(wanted)
    words = str(caught.value)
    assert f"no OpenCL device fits {wanted!r}" in words
    assert "0: first; 1: second" in words
    assert "--device numpy" in words


def test_no_device_names_the_package_and_the_numpy_path(machine: Machine):
    machine()
    for wanted in ("auto", "0", "pocl"):
        with pytest.raises(DeviceError, match="pocl-binary-distribution") as caught:
            choose_device(wanted)
        assert str(caught.value) == NO_DEVICE


@needs_wheels
@pytest.mark.parametrize("name", [POCL, SIMULATOR])
def test_environment_names_a_device(monkeypatch: pytest.MonkeyPatch, name: str):
    platforms = [platform.name.lower() for platform in cl.get_platforms()]
    place = next(n for n, platform in enumerate(platforms) if name in platform)
    monkeypatch.setenv("PYOPENCL_CTX", str(place))
    assert name in choose_device().platform.name.lower()


@needs_wheels
def test_list_marks_the_simulator():
    notes = [(info.platform.lower(), info.note) for info in list_devices()]
    assert dict(notes)[SIMULATOR].startswith("simulator")
    assert not next(note for platform, note in notes if POCL in platform)
    assert [info.index for info in list_devices()] == list(range(len(list_devices())))


def test_no_platform_at_all_is_one_line(tmp_path: Path):
    code = (
        "from slamfusion.compute import list_devices, open_device\n"
        "from slamfusion.errors import DeviceError\n"
        "assert list_devices() == []\n"
        "try: open_device()\n"
        "except DeviceError as error: print(error)\n"
    )
    done = run_python(code, OCL_ICD_VENDORS=str(tmp_path / "none"))
    assert (done.returncode, done.stdout.strip()) == (0, NO_DEVICE)


def test_without_pyopencl_the_twins_remain():
    hide = "import sys; sys.modules['pyopencl'] = None\n"
    code = (
        "from slamfusion.compute import list_devices, open_device\n"
        "from slamfusion.errors import DeviceError\n"
        "assert list_devices() == []\n"
        "assert not open_device('numpy').opencl\n"
        "try: open_device()\n"
        "except DeviceError as error: print(error)\n"
    )
    done = run_python(hide + code)
    assert done.returncode == 0, done.stderr
    assert "pyopencl cannot be imported" in done.stdout
    assert "--device numpy" in done.stdout


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package without kernels."""
    compute = tmp_path / "site" / "slamfusion" / "compute"
    compute.mkdir(parents=True)
    monkeypatch.setattr(opencl, "__file__", str(compute / "opencl.py"))
    return compute.parent


@pytest.mark.parametrize("place", ["slamfusion/kernels", "kernels"])
def test_kernels_are_found_in_the_wheel_and_beside_a_checkout(package: Path, place: str):
    folder = package.parent / place
    folder.mkdir()
    (folder / "common.h").touch()
    assert opencl.kernel_folder() == folder


@needs_wheels
def test_source_that_does_not_build_is_one_error_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "common.h").write_text("/* of\nthree\nlines */\n", encoding="utf-8")
    for family in FAMILIES:
        text = (
            '/* first */\n#include "common.h"\n__kernel void broken( {' if family == "votes" else ""
        )
        (tmp_path / f"{family}.cl").write_text(text, encoding="utf-8")
    monkeypatch.setattr(opencl, "kernel_folder", lambda: tmp_path)
    with pytest.raises(DeviceError, match="do not build on") as caught:
        open_device(POCL)
    assert "\n" not in str(caught.value)
    assert "votes.cl:3:" in str(caught.value)


SINGLE_THREAD, THREADED = fake("basic-AMD EPYC", CPU), fake("pthread-AMD EPYC", CPU)


@pytest.mark.parametrize("devices", [(SINGLE_THREAD, THREADED), (THREADED, SINGLE_THREAD)])
def test_the_single_thread_device_is_for_small_kernels_only(
    machine: Machine, devices: tuple[object, ...]
):
    machine(*devices)
    assert choose_device() is THREADED
    assert choose_device(small_kernels=True) is SINGLE_THREAD
    machine(*devices, fake("gpu", GPU))
    assert choose_device(small_kernels=True).name == "gpu"


@needs_wheels
@pytest.mark.parametrize(
    ("threads", "of_gmapping"), [("3", "pthread"), ("2", "basic"), ("1", "basic")]
)
def test_a_small_producer_and_one_of_few_threads_get_the_single_thread_device_of_the_wheel(
    threads: str, of_gmapping: str
):
    """In a process of its own, since a process lists its devices once."""
    env = {"POCL_DEVICES": None, "PYOPENCL_CTX": None, "POCL_MAX_PTHREAD_COUNT": threads}
    code = (
        "from slamfusion.compute import list_devices\n"
        "from slamfusion.config import RunConfig\n"
        "from slamfusion.slam.registry import open_producer_device\n"
        "config = RunConfig()\n"
        "for name in ('tinyslam', 'gmapping', 'graph'):\n"
        "    print(open_producer_device(name, config).name.split('-')[0])\n"
        "print([one.note for one in list_devices() if one.name.startswith('basic')])\n"
    )
    found = run_python(code, **env)
    assert found.stdout.split("\n")[:3] == ["basic", of_gmapping, "basic"]
    assert "one thread; for many small kernels" in found.stdout
