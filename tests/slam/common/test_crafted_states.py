"""States that were changed after they were saved, and ones that no mapper can have saved."""

from __future__ import annotations

import copy
import io
import json
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import GmappingConfig, GraphConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.io.log import Skips
from slamfusion.slam.common.state import DIGEST, RECORD, digest, pack, unpack
from slamfusion.slam.gmapping.slam import Gmapping
from slamfusion.slam.graph.slam import GraphSlam
from tests.slam.drives import drive

pytestmark = pytest.mark.once

SCANS = 12
MAPPERS: dict[str, tuple[Any, Any]] = {
    "graph": (GraphSlam, GraphConfig()),
    "gmapping": (Gmapping, GmappingConfig(particles=2)),
}
GONE = object()
# No value is one of these: whole numbers are counts, poses lie on a map, words are few.
NEVER: tuple[Any, ...] = (GONE, True, -1, 1 << 70, 1e308, math.nan, math.inf, "x", [], {}, [[]])
Arrays = dict[str, npt.NDArray[Any]]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A state of each mapper that has one."""
    folder = tmp_path_factory.mktemp("states")
    scans, _ = drive(SCANS)
    made = {}
    for name, (kind, config) in MAPPERS.items():
        mapper = kind(config, NumpyDevice(), 0)
        for scan in scans:
            mapper.feed(scan.scan, scan.odometry)
        made[name] = folder / f"{name}.state"
        mapper.save_state(made[name])
    return made


def read_parts(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Return the record and the arrays of a saved state."""
    with np.load(path) as file:
        arrays = dict(file)
    del arrays[DIGEST]
    return json.loads(arrays.pop(RECORD).tobytes()), arrays


def write_parts(path: Path, record: Any, arrays: Arrays) -> None:
    """Write a record and arrays with the digest that belongs to them."""
    text = np.frombuffer(json.dumps(record).encode(), dtype=np.uint8)
    whole: dict[str, Any] = {**arrays, RECORD: text}
    whole[DIGEST] = np.frombuffer(digest(whole), dtype=np.uint8)
    with path.open("wb") as file:
        np.savez(file, **whole)


def refusal(path: Path, name: str) -> str:
    """Return the one line that a state is refused with; empty where it is taken."""
    kind, config = MAPPERS[name]
    try:
        kind.load_state(path, config, NumpyDevice(), 0)
    except SlamFusionError as error:
        message = str(error)
        assert message.startswith(f"{path}: ")
        assert "\n" not in message
        assert len(message) < len(str(path)) + 400
        return message
    return ""


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield where every value of a record is; of long lists the first ones."""
    if at:
        yield at
    if isinstance(value, dict):
        for key, item in value.items():
            yield from places(item, (*at, key))
    elif isinstance(value, list):
        for index, item in enumerate(value[:14]):
            yield from places(item, (*at, index))


def edited(record: Any, at: tuple[Any, ...], value: Any) -> Any:
    """Return a record with another value somewhere, or without it."""
    whole = copy.deepcopy(record)
    inner = whole
    for key in at[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[at[-1]]
    else:
        inner[at[-1]] = value
    return whole


@pytest.mark.parametrize("name", MAPPERS)
def test_edits_of_a_record_are_refused_or_make_a_state(
    saved: dict[str, Path], tmp_path: Path, name: str, request: pytest.FixtureRequest
) -> None:
    """Of values that are none, with the digest that belongs to them, none ends in a traceback."""
    is_full = request.config.getoption("--full")
    record, arrays = read_parts(saved[name])
    path = tmp_path / "edited"
    refused = 0
    for number, at in enumerate(places(record["state"])):
        # One place in ten meets one of the values, the places in turn all.
        for value in NEVER if is_full else NEVER[number % len(NEVER) :][: number % 10 == 0]:
            write_parts(path, edited(record, ("state", *at), value), arrays)
            refused += bool(refusal(path, name))
    assert refused > 5


@pytest.mark.parametrize(
    ("name", "where", "value"),
    [
        ("graph", ("_local_map", "submaps", 0, "_tiles", "pages"), 10_000),
        ("gmapping", ("_maps", "tiles", "pages"), -1),
        ("gmapping", ("_maps", "tiles", "pages"), 1 << 30),
        ("gmapping", ("_maps", "tiles", "corner"), 1 << 40),
    ],
)
def test_what_leads_out_of_a_map_is_refused(
    saved: dict[str, Path], tmp_path: Path, name: str, where: tuple[Any, ...], value: float
) -> None:
    """A page that is not there would let a kernel read beside its memory."""
    record, arrays = read_parts(saved[name])
    kinds = (Pose2, Skips, *MAPPERS[name][0].STATE_KINDS)
    state = unpack(record["state"], arrays, {kind.__name__: kind for kind in kinds})
    array = state
    for key in where:
        array = array[key]
    array[(-1,) * array.ndim] = value
    packed, arrays = pack(state)
    path = tmp_path / "edited"
    write_parts(path, {**record, "state": packed}, arrays)
    assert "a state that no mapper has saved" in refusal(path, name)


def test_a_state_that_was_changed_after_it_was_saved_is_refused(
    saved: dict[str, Path], tmp_path: Path
) -> None:
    with np.load(saved["graph"]) as file:
        arrays = dict(file)
    arrays["float64"] = arrays["float64"] + 1e-9
    path = tmp_path / "changed"
    with path.open("wb") as file:
        np.savez(file, **arrays)
    assert "it was changed after it was saved" in refusal(path, "graph")


def member(header: str, data: bytes) -> bytes:
    """Return an ``.npy`` file of a header and whatever follows."""
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


@pytest.mark.parametrize("packing", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
@pytest.mark.parametrize("shape", ["(1 << 50,)", "(1125899906842624,)", "(-1,)", "(2, 2)", "()"])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, packing: int, shape: str) -> None:
    path = tmp_path / "bomb"
    text = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}}}"
    with zipfile.ZipFile(path, "w", packing) as file:
        file.writestr("record.npy", member(text, bytes(1 << 20)))
    assert "not a whole state" in refusal(path, "graph")


def test_parts_that_lie_over_each_other_are_refused(tmp_path: Path) -> None:
    """A directory may name one part of a file a thousand times."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as packed:
        packed.writestr("record.npy", bytes(1000))
        info = packed.infolist()[0]
        for number in range(1000):
            other = copy.copy(info)
            other.filename = f"a{number}.npy"
            packed.filelist.append(other)
    path = tmp_path / "folded"
    path.write_bytes(file.getvalue())
    assert "not a whole state" in refusal(path, "graph")
