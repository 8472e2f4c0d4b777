"""Maps that are fused into a store: what ``fuse_maps`` makes of them, tile by tile."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, RunConfig, VoteConfig
from slamfusion.errors import AlignmentError, MapFileError
from slamfusion.fusion import lattice_vote
from slamfusion.fusion.lattice_vote import vote_in_memory
from slamfusion.fusion.pipeline import AlignedInputs
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map
from slamfusion.io.map_store import read_stored_map
from slamfusion.jobs import fuse
from slamfusion.jobs.fuse import AllRequiredError, FusedMaps, fuse_maps
from slamfusion.jobs.records import record_bytes
from slamfusion.json_values import plain
from tests.fusion.test_lattice_vote import SIZE, placed
from tests.support.documents import check_document
from tests.support.sites import many_maps
from tests.vote.rooms import moved, room

pytestmark = [
    pytest.mark.once,
    pytest.mark.skipif(not find_spec("zarr"), reason="Zarr comes with the fleet extra"),
]

CONFIG = RunConfig(fusion=FusionConfig(vote=VoteConfig("consensus", extent="union")))
SITE = many_maps(7, 0, 200).grids
# One map twice, the second time in another frame: cells that differ are no copies.
CHANGED = SITE[0].cells.copy()
CHANGED[:3] = -1
TWINS = [SITE[0], OccupancyGrid(CHANGED, SITE[0].resolution, Pose2(3.0, 1.0, 0.5), "b")]


def assert_same(stored: FusedMaps, whole: FusionResult) -> None:
    """Each store holds the map of its group, and the records are those of the vote in memory."""
    groups, results = (whole, *whole.others), (stored.result, *stored.result.others)
    assert len(stored.stores) == len(groups)
    for wanted, result, store in zip(groups, results, stored.stores, strict=True):
        for name, grid in (("fused", wanted.fused), ("agreement", wanted.agreement)):
            found = read_stored_map(store, name)
            assert np.array_equal(found.cells, grid.cells)
            assert (found.origin, found.resolution) == (grid.origin, grid.resolution)
        assert result.phantom_cells == wanted.phantom_cells
        assert (result.weights, result.bent) == (wanted.weights, wanted.bent)
        assert [(r.name, r.accepted, r.reason) for r in result.inputs] == [
            (r.name, r.accepted, r.reason) for r in wanted.inputs
        ]


def test_the_store_holds_what_fuse_makes(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fuse_maps(SITE, CONFIG, device).in_memory
    monkeypatch.setattr(lattice_vote, "TILE", 128)
    monkeypatch.setattr(fuse, "TILE", 128)
    told: list[str] = []
    stored = fuse_maps(
        SITE,
        CONFIG,
        device,
        store=tmp_path / "out.zarr",
        progress=lambda what, *_: told.append(what),
    )
    assert told.count("vote") > 4
    assert_same(stored, whole)
    for result, stem in zip((whole, *whole.others), stored.stems, strict=True):
        assert np.array_equal(load_map(f"{stem}.yaml").cells, result.fused.cells)
    document = plain(stored.document())
    check_document(plain(document), "fuse")
    assert (tmp_path / "out.json").read_bytes() == record_bytes(document)
    assert document["store"] == str(tmp_path / "out.zarr")
    assert document["fused"] == str(tmp_path / "out.yaml")
    assert document["groups"][0]["store"] == document["store"]


def test_a_map_too_large_for_a_map_server_is_in_the_store_alone(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuse, "FILES_CELLS", 100)
    stored = fuse_maps(TWINS, CONFIG, device, store=tmp_path / "out.zarr")
    assert stored.stems == (None,)
    assert [item.name for item in tmp_path.iterdir()] == ["out.zarr"]
    assert stored.document().fused is None
    with pytest.raises(MapFileError, match=r"out\.zarr exists"):
        fuse_maps(TWINS, CONFIG, device, store=tmp_path / "out.zarr")


def test_nothing_is_written_of_what_does_not_fit(tmp_path: Path, device: ComputeDevice) -> None:
    empty = OccupancyGrid(np.full((20, 20), -1, dtype=np.int8), 0.05, name="empty")
    with pytest.raises(AlignmentError, match="no two of the inputs"):
        fuse_maps([SITE[0], empty], CONFIG, device, store=tmp_path / "out.zarr")
    strict = replace(CONFIG, fusion=replace(CONFIG.fusion, require_all=True))
    with pytest.raises(AllRequiredError, match="--require-all, but rejected: empty"):
        fuse_maps([*TWINS, empty], strict, device, store=tmp_path / "out.zarr")
    assert list(tmp_path.iterdir()) == []


def test_groups_that_contradict_each_other_have_a_store_each(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = (
        OccupancyGrid(np.where(cells == 1, 100, cells).astype(np.int8), SIZE)
        for cells in (room(), moved(room(), 4, 7))
    )
    ready = placed([(one, Pose2())] * 3 + [(other, Pose2())] * 2, device, tuple("abcde"))
    groups, lattices = (ready.members,), ready.normalized.__getitem__
    aligned = AlignedInputs(groups, (), lattices, {})
    monkeypatch.setattr(fuse, "align_inputs", lambda *_, **__: aligned)
    stored = fuse_maps(ready.grids, CONFIG, device, store=tmp_path / "out.zarr")
    assert [path.name for path in stored.stores] == ["out.zarr", "out-2.zarr"]
    assert_same(stored, vote_in_memory(ready.grids, groups, lattices, {}, CONFIG.fusion, device))
