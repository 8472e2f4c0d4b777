"""Saved maps become one that need not fit into memory: a Zarr store, voted on tile by tile."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.align.records import Fusion, InputRecord, StoredFusion
from slamfusion.align.starts import place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.fusion.groups import Members
from slamfusion.fusion.lattice_vote import (
    bent_maps,
    contradicting,
    parts_of,
    wall_agreement_of,
    weights_of,
)
from slamfusion.fusion.pipeline import AlignedInputs, align_inputs, left_out_areas
from slamfusion.fusion.stored_vote import StoredVote, prepare_stored_vote
from slamfusion.grid import OCCUPIED
from slamfusion.io import AtomicFiles, save_map
from slamfusion.io.atomic import write_atomic
from slamfusion.io.map_store import MapStore, check_store, read_stored_map
from slamfusion.jobs.documents import circumstances, record_bytes
from slamfusion.jobs.fuse import AllRequiredError, check_count
from slamfusion.jobs.fuse_documents import agreement_stem, fusion_document, group_document
from slamfusion.jobs.inputs import GivenMaps, MapInput, Progress, Warn, as_grids, device_for
from slamfusion.jobs.outputs import FUSED, group_stems, record_file
from slamfusion.jobs.records import FuseDocument
from slamfusion.vote.lattice import Extent, Lattice
from slamfusion.vote.tiles import TILE

_LOG = logging.getLogger(__name__)

# Arrays of a store: the fused map is called as a run calls it.
AGREEMENT_ARRAY = "agreement"
# Cells of a fused map that is also written as files of a map server: 11585 x 11585. Larger ones no
# map server loads within a GiB.
FILES_CELLS = 1 << 27


@dataclass(frozen=True, eq=False)
class StoredMaps:
    """Maps that were fused into stores.

    Attributes:
        config: the settings in effect.
        result: what became of the inputs of the largest group, and in ``others`` of further ones.
        stores: of each group, the largest first.
        stems: the files of a map server beside each, paths without suffix; None: the map is too
            large.
        given: the files of the inputs.
    """

    config: RunConfig
    result: StoredFusion
    stores: tuple[Path, ...]
    stems: tuple[Path | None, ...]
    given: GivenMaps

    def to_json(self) -> FuseDocument:
        """Return what ``slamfusion fuse`` prints as JSON."""
        groups = [
            group_document(result, stem, store)
            for result, stem, store in zip(
                (self.result, *self.result.others), self.stems, self.stores, strict=True
            )
        ]
        return {
            **fusion_document(self.result, None),
            "fused": groups[0]["fused"],
            "agreement": groups[0]["agreement"],
            "store": groups[0]["store"],
            "groups": groups,
            "evaluations": [],
            **self.given.to_json(),
            **circumstances(self.config, self.result.device),
            "time_s": self.result.time_s,
        }


def fuse_into_store(
    maps: Sequence[MapInput],
    store: str | Path,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    resolution: float | None = None,
    given: GivenMaps | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    warn: Warn = _LOG.warning,
) -> StoredMaps:
    """Align maps of one place and fuse them tile by tile into a Zarr store.

    The cells are those of ``fuse_maps``. In memory are the inputs and a few tiles, never the fused
    map. The store has the arrays ``fused`` (-1, 0, 100) and ``agreement`` (-1, 0 to 100); maps of
    up to ``FILES_CELLS`` cells are also written as files of a map server beside it.

    Args:
        maps, config, device, resolution, given, executor, progress, warn: see ``fuse_maps``; the
            executor decides tiles, too.
        store: ``OUT.zarr``; further groups go to ``OUT-2.zarr`` ... Nothing may be at any of them;
            see ``check_stores``.

    Raises:
        MapFileError: something is there, Zarr is not installed, or a map cannot be read or written.
        AlignmentError, ConfigError, MemoryBudgetError, DeviceError, FleetError, SlamFusionError:
            see ``fuse_maps``.
    """
    began_s = time.perf_counter()
    store, config = Path(store), config or RunConfig()
    check_count(maps)
    check_stores(store, len(maps))
    grids = as_grids(maps, config, resolution=resolution, warn=warn)
    names = [grid.name for grid in grids]
    starts = place_starts(config.start, names, config.fusion.reference)
    device = device_for(config, device)
    aligned = align_inputs(
        grids, config.fusion, device, progress, starts=starts, executor=executor, is_stored=True
    )
    if config.fusion.require_all:
        _check_all(aligned, device)
    votes = [
        vote
        for members in (aligned.group, *aligned.group.others)
        for vote in _votes_of(aligned, members, config, device, executor, progress)
    ]
    (first, _), *others = votes
    left_out = aligned.others
    for members, _ in others:
        if members.reference in aligned.group.alignments:
            left_out = {**left_out, **contradicting(grids, first, members)}
    stems = group_stems(store.with_suffix(""), len(votes))
    stores = group_stores(store, len(votes))
    with ExitStack() as open_stores:
        results = [
            _vote_into(
                open_stores,
                vote,
                members,
                _records(aligned, members, left_out if members is first else {}),
                path,
                config,
                device,
                executor,
                progress,
            )
            for (members, vote), path in zip(votes, stores, strict=True)
        ]
    written: list[Path | None] = []
    for result, path, own in zip(results, stores, stems, strict=True):
        is_small = result.shape[0] * result.shape[1] <= FILES_CELLS
        written.append(own if is_small else None)
        if is_small:
            _write_files(path, own)
    whole = replace(
        results[0],
        pairs=aligned.group.pairs,
        others=tuple(results[1:]),
        time_s=time.perf_counter() - began_s,
    )
    given = given or GivenMaps.of(maps, resolution)
    stored = StoredMaps(config, whole, stores, tuple(written), given)
    if written[0] is not None:
        write_atomic(record_file(stems[0]), record_bytes(stored.to_json()))
    return stored


def check_stores(store: Path, count: int) -> None:
    """Refuse a fusion into stores of which one is there, before any work.

    One of an earlier fusion that this one does not write would look like a group of it.

    Args:
        store: ``OUT.zarr``.
        count: maps that are fused; a group has two or more.

    Raises:
        MapFileError: something is at one of them, or Zarr is not installed.
    """
    for path in group_stores(store, count // 2):
        check_store(path)


def group_stores(store: Path, count: int) -> tuple[Path, ...]:
    """Return the stores of groups: OUT.zarr, OUT-2.zarr ..."""
    stems = group_stems(store.with_suffix(""), count)
    return tuple(stem.with_name(stem.name + store.suffix) for stem in stems)


def _check_all(aligned: AlignedInputs, device: ComputeDevice) -> None:
    """Refuse a fusion that has to leave an input out."""
    so_far = Fusion(
        reference=aligned.group.reference,
        inputs=_records(aligned, aligned.group, aligned.others),
        pairs=aligned.group.pairs,
        phantom_cells=0,
        weights={},
        device=device.name,
        time_s=0.0,
    )
    if so_far.rejected:
        raise AllRequiredError(so_far)


def _votes_of(
    aligned: AlignedInputs,
    members: Members,
    config: RunConfig,
    device: ComputeDevice,
    executor: Executor | None,
    progress: Progress | None,
) -> Iterator[tuple[Members, StoredVote]]:
    """Yield the vote of a group, or those of two that contradict each other."""
    vote = prepare_stored_vote(members, aligned.lattices, config.fusion)
    vote = vote.trusting(device, executor, progress)
    parts = parts_of(members, vote.voter.trust)
    if len(parts) == 1:
        yield members, vote
        return
    for part in parts:
        yield from _votes_of(aligned, part, config, device, executor, progress)


def _vote_into(
    open_stores: ExitStack,
    vote: StoredVote,
    members: Members,
    inputs: tuple[InputRecord, ...],
    path: Path,
    config: RunConfig,
    device: ComputeDevice,
    executor: Executor | None,
    progress: Progress | None,
) -> StoredFusion:
    """Hold the vote of a group; its store is put in place when all are written."""
    opened = open_stores.enter_context(
        MapStore(
            path,
            (FUSED, AGREEMENT_ARRAY),
            vote.shape,
            TILE,
            vote.voter.resolution,
            vote.origin,
            {"reference": members.reference, "inputs": list(members.alignments)},
        )
    )
    phantom_cells, worst = 0, []
    for box, decided in vote.decide(device, executor, progress):
        fused = np.where(decided.fused == 1, np.int8(OCCUPIED), decided.fused)
        opened.write(FUSED, box, fused)
        opened.write(AGREEMENT_ARRAY, box, decided.agreement)
        phantom_cells += decided.phantom_cells
        worst.append(decided.worst)
    extent = Extent(Lattice(vote.voter.resolution, vote.origin), vote.shape)
    trust = vote.voter.trust
    return StoredFusion(
        reference=members.reference,
        inputs=inputs,
        pairs=(),
        phantom_cells=phantom_cells,
        weights=weights_of(tuple(members.alignments), trust),
        wall_agreement=wall_agreement_of(trust),
        bent=bent_maps(trust, worst, extent.lattice),
        device=device.name,
        time_s=0.0,
        shape=vote.shape,
        resolution=vote.voter.resolution,
        origin=vote.origin,
        left_out_m2=left_out_areas(inputs, extent, config.fusion),
    )


def _records(
    aligned: AlignedInputs, members: Members, others: Mapping[str, InputRecord]
) -> tuple[InputRecord, ...]:
    """Return the records of a group, and of those that are in none, in the order of the inputs."""
    found = []
    for grid in aligned.grids:
        pair = members.alignments.get(grid.name)
        if pair is not None:
            found.append(InputRecord(grid, pair, True, pair.reason))
        elif grid.name in others:
            found.append(others[grid.name])
    return tuple(found)


def _write_files(store: Path, stem: Path) -> None:
    """Write the maps of a store as files of a map server."""
    with AtomicFiles() as files:
        save_map(read_stored_map(store, FUSED), stem, files=files)
        agreement = read_stored_map(store, AGREEMENT_ARRAY)
        save_map(agreement, agreement_stem(stem), mode="raw", files=files)
