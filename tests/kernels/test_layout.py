"""What kernels and host agree on stands once; a family is one protocol, its twins, one file."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

from slamfusion.compute import layout
from slamfusion.compute.arrays import ArrayDevice
from slamfusion.compute.compute_device import FAMILIES, ComputeDevice, NumpyDevice
from slamfusion.compute.opencl import OpenCLDevice
from slamfusion.compute.program import kernel_folder
from tests.kernels.checks import CHECKS

pytestmark = pytest.mark.once

PACKAGE = Path(inspect.getfile(layout)).parents[1]
SOURCES = {path.name: path.read_text(encoding="utf-8") for path in kernel_folder().iterdir()}
# Numbers that one kernel alone knows; no twin and no host code does.
OWN = {
    "POINTS_BETWEEN",  # how often a bound looks whether it can stop
    "AHEAD",  # cells of a walk that are fetched together
    "VECTORS",  # blocks in a row that are looked at together
    "WARP_CELLS",  # cells that a resampling passes over together
    "REFINE_LANES",  # points of a fit that are done at once
    "MODEL_BASE",  # a flag of two values, False in Python
}
# The largest number that may stand in a kernel as such: a byte's, or a number of bits.
LARGEST = 200


def code(source: str) -> str:
    """Return a kernel's source without comments."""
    return re.sub(r"/\*.*?\*/", " ", source, flags=re.DOTALL)


def operations(protocol: type) -> set[str]:
    """Return the public methods that a protocol itself has."""
    return {name for name in vars(protocol) if not name.startswith("_")}


def test_no_number_is_defined_in_a_kernel_and_in_python():
    numbers = re.compile(
        r"#define\s+(\w+)[ \t]+\(?-?(?:0[xX][0-9a-fA-F]+|\d[\d.]*)[uUlLf]*\)?\s*$", re.MULTILINE
    )
    defined = {name for source in SOURCES.values() for name in numbers.findall(code(source))}
    assert defined == OWN
    every = {name for source in SOURCES.values() for name in re.findall(r"#define\s+(\w+)", source)}
    assert not every & {name for name in vars(layout) if name.isupper()}


@pytest.mark.parametrize("name", SOURCES)
def test_large_numbers_come_from_the_layout(name: str):
    words = code(SOURCES[name])
    found = {
        int(number, 0)
        for number in re.findall(r"(?<![\w.])(0[xX][0-9a-fA-F]+|\d+)(?=[uUlL]*\b)(?!\.)", words)
    }
    assert max(found, default=0) <= LARGEST


def test_kernels_use_what_they_are_given():
    words = {word for source in SOURCES.values() for word in re.findall(r"\w+", code(source))}
    assert set(layout.KERNEL_CONSTANTS) <= words
    given = dict(option.removeprefix("-D").split("=") for option in layout.kernel_options())
    assert given.pop("EACH_LANE") == "72340172838076673ul"
    assert {name: int(value) for name, value in given.items()} == {
        name: getattr(layout, name) for name in given
    }


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_is_a_small_protocol_its_twins_and_its_kernels(family: str):
    twins = importlib.import_module(f"slamfusion.compute.{family}.numpy")
    device = importlib.import_module(f"slamfusion.compute.{family}.opencl")
    (opencl,) = (getattr(device, name) for name in device.__all__)
    protocol = FAMILIES[family]
    assert ArrayDevice in protocol.__mro__
    names = operations(protocol)
    assert 1 <= len(names) <= 9
    assert names <= operations(opencl)
    for name in names:
        wanted = list(inspect.signature(getattr(protocol, name)).parameters.values())[1:]
        found = list(inspect.signature(getattr(opencl, name)).parameters.values())[1:]
        twin = list(inspect.signature(getattr(twins, name)).parameters.values())
        for other in (found, twin):
            assert [(p.name, p.kind, p.default) for p in other] == [
                (p.name, p.kind, p.default) for p in wanted
            ], name
        assert getattr(NumpyDevice, name) is getattr(twins, name)
    assert f"slamfusion/compute/{family}/numpy.py" in SOURCES[f"{family}.cl"]
    assert {path.stem for path in kernel_folder().glob("*.cl")} == set(FAMILIES)


def test_every_operation_is_of_one_family_and_has_a_check():
    families = [operations(protocol) for protocol in FAMILIES.values()]
    every = set().union(*families)
    assert sum(map(len, families)) == len(every)
    assert set(CHECKS) == every
    assert every <= {name for name in dir(OpenCLDevice) if not name.startswith("_")}
    assert set(FAMILIES.values()) <= set(ComputeDevice.__mro__)


def imports(path: Path) -> set[str]:
    """Return the modules that a file imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_production_code_does_not_need_the_twins():
    own = PACKAGE / "compute"
    for path in PACKAGE.rglob("*.py"):
        found = imports(path)
        assert not {name for name in found if name.split(".")[-1].endswith("reference")}, path
        if own not in path.parents:
            assert not {n for n in found if re.match(r"slamfusion\.compute\.\w+\.numpy", n)}, path
        if (own / "self_test") not in path.parents and path.name != "doctor.py":
            assert not {n for n in found if n.startswith("tests.kernels.checks")}, path
