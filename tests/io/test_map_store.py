"""Zarr stores of maps: written in chunks, in place at the end, and read in parts."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import MapFileError
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox
from slamfusion.io.map_store import MapStore, read_stored_map

pytestmark = pytest.mark.skipif(not find_spec("zarr"), reason="Zarr comes with the fleet extra")

ORIGIN = Pose2(1.0, -2.0, 0.5)
CELLS = np.random.default_rng(0).integers(-1, 101, (50, 70)).astype(np.int8)


def opened(path: Path) -> MapStore:
    return MapStore(path, ("fused", "agreement"), (50, 70), 32, 0.05, ORIGIN, {"reference": "a"})


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "map.zarr"
    with opened(path) as store:
        for box in (CellBox(0, 0, 32, 32), CellBox(32, 32, 50, 64)):
            window = np.s_[box.row0 : box.row1, box.col0 : box.col1]
            store.write("fused", box, CELLS[window])
        assert not path.exists()
    wanted = np.full_like(CELLS, -1)
    wanted[:32, :32], wanted[32:, 32:64] = CELLS[:32, :32], CELLS[32:, 32:64]
    whole = read_stored_map(path, "fused")
    assert np.array_equal(whole.cells, wanted)
    assert (whole.origin, whole.resolution, whole.name) == (ORIGIN, 0.05, "fused")
    assert (read_stored_map(path, "agreement").cells == -1).all()


def test_the_files_are_those_of_format_2_and_what_is_unknown_takes_none(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    with opened(path) as store:
        store.write("fused", CellBox(0, 32, 32, 64), CELLS[:32, 32:64])
    files = {str(item.relative_to(path)) for item in path.rglob("*") if item.is_file()}
    array = {".zarray", ".zattrs"}
    arrays = {f"{name}/{file}" for name in ("fused", "agreement") for file in array}
    assert files == {".zgroup", ".zattrs", *arrays, "fused/0.1"}
    kept = json.loads((path / "fused" / ".zarray").read_text())
    assert (kept["zarr_format"], kept["dtype"], kept["fill_value"]) == (2, "|i1", -1)
    told = json.loads((path / ".zattrs").read_text())
    assert told == {"reference": "a", "resolution": 0.05, "origin": [1.0, -2.0, 0.5]}


def test_nothing_is_left_of_one_that_fails(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    with pytest.raises(KeyError), opened(path) as store:
        store.write("absent", CellBox(0, 0, 32, 32), CELLS[:32, :32])
    assert list(tmp_path.iterdir()) == []
    # Somebody else was faster.
    with pytest.raises(MapFileError, match="exists"), opened(path):
        path.mkdir()
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_of_one_that_zarr_refuses_or_that_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.zarr"
    with pytest.raises(TypeError):
        MapStore(path, ("fused",), (50, 70), 32, 0.05, ORIGIN, {"reference": object()})
    assert list(tmp_path.iterdir()) == []
    store = opened(path)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "rename", interrupt)
    with pytest.raises(KeyboardInterrupt), store:
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    path.write_text("mine")
    with pytest.raises(MapFileError, match=r"map\.zarr exists, and a store is not overwritten"):
        opened(path)
    assert path.read_text() == "mine"
    with pytest.raises(MapFileError, match="cannot write: Not a directory"):
        opened(path / "map.zarr")


def test_what_is_no_store_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"none\.zarr: no store with a map 'fused'"):
        read_stored_map(tmp_path / "none.zarr", "fused")
    path = tmp_path / "map.zarr"
    with opened(path):
        pass
    with pytest.raises(MapFileError, match="no store with a map 'drawn'"):
        read_stored_map(path, "drawn")
