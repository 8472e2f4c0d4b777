"""Maps that are fused into a store: what ``fuse_maps`` makes of them, tile by tile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import FusionConfig, RunConfig, VoteConfig
from slamfusion.errors import AlignmentError, MapFileError, MemoryBudgetError
from slamfusion.fusion import stored_vote
from slamfusion.fusion.groups import AlignedGroup
from slamfusion.fusion.lattice_vote import vote_on_lattice
from slamfusion.fusion.pipeline import AlignedInputs, align_inputs
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map
from slamfusion.io.map_store import read_stored_map
from slamfusion.jobs import fuse_store
from slamfusion.jobs.documents import record_bytes
from slamfusion.jobs.fuse import AllRequiredError, fuse_maps
from slamfusion.jobs.fuse_store import check_stores, fuse_into_store
from slamfusion.json_values import plain
from tests.fusion.test_lattice_vote import SIZE, placed
from tests.support.documents import check_document
from tests.support.sites import many_maps
from tests.vote.rooms import moved, room

pytest.importorskip("zarr", reason="Zarr comes with the fleet extra")
pytestmark = pytest.mark.once

CONFIG = RunConfig(fusion=FusionConfig(vote=VoteConfig("consensus", extent="union")))
SITE = many_maps(7, 0, 200).grids
# One map twice, the second time in another frame: cells that differ are no copies.
CHANGED = SITE[0].cells.copy()
CHANGED[:3] = -1
TWINS = [SITE[0], OccupancyGrid(CHANGED, SITE[0].resolution, Pose2(3.0, 1.0, 0.5), "b")]


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


def test_the_store_holds_what_fuse_makes(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[AlignedInputs] = []

    def align(*given: Any, **named: Any) -> AlignedInputs:
        found.append(align_inputs(*given, **named))
        return found[0]

    monkeypatch.setattr(fuse_store, "align_inputs", align)
    monkeypatch.setattr(stored_vote, "TILE", 128)
    monkeypatch.setattr(fuse_store, "TILE", 128)
    told: list[str] = []
    stored = fuse_into_store(
        SITE, tmp_path / "out.zarr", CONFIG, device, progress=lambda what, *_: told.append(what)
    )
    assert told.count("vote") > 4
    (aligned,) = found
    groups = [
        vote_on_lattice(
            SITE if members is aligned.group else aligned.grids_of(members),
            members,
            aligned.lattices,
            aligned.others if members is aligned.group else {},
            CONFIG.fusion,
            device,
        )
        for members in (aligned.group, *aligned.group.others)
    ]
    assert len(stored.stores) == len(groups)
    for whole, result, store, stem in zip(
        groups, (stored.result, *stored.result.others), stored.stores, stored.stems, strict=True
    ):
        for name, grid in (("fused", whole.fused), ("agreement", whole.agreement)):
            found = read_stored_map(store, name)
            assert np.array_equal(found.cells, grid.cells)
            assert (found.origin, found.resolution) == (grid.origin, grid.resolution)
        assert result.phantom_cells == whole.phantom_cells
        assert (result.weights, result.bent) == (whole.weights, whole.bent)
        assert [(r.name, r.accepted, r.reason) for r in result.inputs] == [
            (r.name, r.accepted, r.reason) for r in whole.inputs
        ]
        assert stem is not None
        assert np.array_equal(load_map(f"{stem}.yaml").cells, whole.fused.cells)
    document = stored.to_json()
    check_document(plain(document), "fuse")
    assert (tmp_path / "out.json").read_bytes() == record_bytes(document)
    assert document["store"] == str(tmp_path / "out.zarr")
    assert document["fused"] == str(tmp_path / "out.yaml")
    assert document["groups"][0]["store"] == document["store"]


def test_a_map_too_large_for_a_map_server_is_in_the_store_alone(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuse_store, "FILES_CELLS", 100)
    stored = fuse_into_store(TWINS, tmp_path / "out.zarr", CONFIG, device)
    assert stored.stems == (None,)
    assert [item.name for item in tmp_path.iterdir()] == ["out.zarr"]
    assert stored.to_json()["fused"] is None
    with pytest.raises(MapFileError, match=r"out\.zarr exists"):
        fuse_into_store(TWINS, tmp_path / "out.zarr", CONFIG, device)


def test_the_store_of_another_group_is_found_before_any_work(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where this fusion has no such group it would look like one."""
    monkeypatch.setattr(fuse_store, "align_inputs", pytest.fail)
    for number, maps in ((2, SITE[:4]), (3, SITE)):
        other = tmp_path / f"out-{number}.zarr"
        other.mkdir()
        with pytest.raises(MapFileError, match=rf"out-{number}\.zarr exists"):
            fuse_into_store(maps, tmp_path / "out.zarr", CONFIG, device)
        other.rmdir()
    (tmp_path / "out-3.zarr").mkdir()
    check_stores(tmp_path / "out.zarr", 5)  # no more than two groups


def test_nothing_is_written_of_what_does_not_fit(tmp_path: Path, device: ComputeDevice) -> None:
    empty = OccupancyGrid(np.full((20, 20), -1, dtype=np.int8), 0.05, name="empty")
    with pytest.raises(AlignmentError, match="no two of the inputs"):
        fuse_into_store([SITE[0], empty], tmp_path / "out.zarr", CONFIG, device)
    strict = replace(CONFIG, fusion=replace(CONFIG.fusion, require_all=True))
    with pytest.raises(AllRequiredError, match="--require-all, but rejected: empty"):
        fuse_into_store([*TWINS, empty], tmp_path / "out.zarr", strict, device)
    assert list(tmp_path.iterdir()) == []


def test_a_union_that_exceeds_memory_is_told_with_numbers_and_the_way_out(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slamfusion.fusion.lattice_vote.VOTED_BYTES", 1 << 40)
    with pytest.raises(MemoryBudgetError, match=r"needs .* TiB .* is available; .*-o OUT\.zarr"):
        fuse_maps(TWINS, CONFIG, device)


def test_groups_that_contradict_each_other_have_a_store_each(
    tmp_path: Path, device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = (
        OccupancyGrid(np.where(cells == 1, 100, cells).astype(np.int8), SIZE)
        for cells in (room(), moved(room(), 4, 7))
    )
    ready = placed([(one, Pose2())] * 3 + [(other, Pose2())] * 2, device, tuple("abcde"))
    group = AlignedGroup(ready.members.reference, ready.members.alignments, {}, ())
    aligned = AlignedInputs(tuple(ready.grids), group, ready.normalized.__getitem__, {})
    monkeypatch.setattr(fuse_store, "align_inputs", lambda *_, **__: aligned)
    stored = fuse_into_store(ready.grids, tmp_path / "out.zarr", CONFIG, device)
    assert [path.name for path in stored.stores] == ["out.zarr", "out-2.zarr"]
    whole = vote_on_lattice(ready.grids, group, aligned.lattices, {}, CONFIG.fusion, device)
    for result, wanted, path in zip(
        (stored.result, *stored.result.others), (whole, *whole.others), stored.stores, strict=True
    ):
        assert np.array_equal(read_stored_map(path, "fused").cells, wanted.fused.cells)
        assert [(r.name, r.accepted, r.reason) for r in result.inputs] == [
            (r.name, r.accepted, r.reason) for r in wanted.inputs
        ]
