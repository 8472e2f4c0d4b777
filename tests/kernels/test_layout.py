"""What kernels and host agree on is written once; a family is one module and one file."""

from __future__ import annotations

import re

import pytest

from slamfusion.compute import layout
from slamfusion.compute.compute_device import ComputeDevice, NumpyDevice
from slamfusion.compute.opencl import OpenCLDevice, kernel_folder
from tests.kernels.checks import CHECKS

pytestmark = pytest.mark.once

SOURCES = {path.name: path.read_text(encoding="utf-8") for path in kernel_folder().iterdir()}
# Numbers that one kernel alone knows; no twin and no host code does.
OWN = {
    "POINTS_BETWEEN",  # how often a bound looks whether it can stop
    "AHEAD",  # cells of a walk that are fetched together
    "WARP_CELLS",  # cells that a resampling passes over together
    "WALL_LANES",  # cells that are passed over together where none is a wall
    "FIT_LANES",  # points of a fit that are done at once
    "FIT_TERMS",  # of its normal equations
    "MODEL_BASE",  # a flag of two values, False in Python
    "CORNERS",  # work items of a climb that try a step
    "BLOCK",  # cells of a row that a wall reaches, at once
}
# The classes that have the operations, without the devices and what all devices have.
FAMILIES = ComputeDevice.__bases__
# The largest number that may stand in a kernel as such: a byte's, or a number of bits.
LARGEST = 200


def code(source: str) -> str:
    """Return a kernel's source without comments."""
    return re.sub(r"/\*.*?\*/", " ", source, flags=re.DOTALL)


def operations(family: type) -> set[str]:
    """Return the public methods that a family itself has."""
    return {name for name in vars(family) if not name.startswith("_")}


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


def test_kernels_get_the_numbers_of_the_layout():
    given = dict(option.removeprefix("-D").split("=") for option in layout.kernel_options())
    assert given["EACH_LANE"] == "72340172838076673ul"
    assert given["MEAN_HALF"] == "524288"
    assert {name: int(value.removesuffix("ul")) for name, value in given.items()} == {
        name: getattr(layout, name) for name in given
    }


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_is_a_module_and_a_file_of_kernels(family: type):
    name = family.__module__.rpartition(".")[2]
    assert operations(family)
    assert f"slamfusion/compute/{name}.py" in SOURCES[f"{name}.cl"]


def test_every_operation_is_of_one_family_and_has_a_check():
    families = [operations(family) for family in FAMILIES]
    every = set().union(*families)
    assert sum(map(len, families)) == len(every)
    # A check may be of several operations, and of one kind of map.
    assert {word for name in CHECKS for word in name.split(" of ")[0].split(", ")} == every
    assert {f"{family.__module__.rpartition('.')[2]}.cl" for family in FAMILIES} == {
        name for name in SOURCES if name.endswith(".cl")
    }
    for device in (NumpyDevice, OpenCLDevice):
        assert not every & set(vars(device))
