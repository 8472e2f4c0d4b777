"""Fuse saved maps of one place: in memory, or tile by tile in a Zarr store with the same cells."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from slamfusion.align.records import Alignment, Fusion, FusionResult, InputRecord
from slamfusion.align.starts import place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.grouping import FusionSetup
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.lattice_vote import contradicting, decide_tile, prepare_votes
from slamfusion.fusion.pipeline import align_inputs
from slamfusion.grid import OCCUPIED, OccupancyGrid
from slamfusion.io import AtomicFiles, save_map, write_atomic
from slamfusion.io.map_store import MapStore, check_store, read_stored_map
from slamfusion.jobs import inputs, outputs
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse_documents import (
    DoubledWalls,
    Evaluation,
    FusedGroup,
    FuseDocument,
    FusionRecord,
    agreement_stem,
)
from slamfusion.jobs.records import Circumstances, record_bytes
from slamfusion.vote.tiles import TILE

# Arrays of a store: the fused map is called as a run calls it.
AGREEMENT_ARRAY = "agreement"
# Cells of a fused map that is also written as files of a map server: 11585 x 11585. Larger ones no
# map server loads within a GiB.
FILES_CELLS = 1 << 27


class AllRequiredError(AlignmentError):
    """A fusion that had to leave an input out, where ``--require-all`` forbids it.

    Attributes:
        result: what would have been fused; None where the vote was not held.
    """

    def __init__(
        self,
        rejected: Sequence[InputRecord],
        pairs: tuple[Alignment, ...],
        result: FusionResult | None = None,
    ) -> None:
        words = ", ".join(f"{record.name} ({record.reason})" for record in rejected)
        super().__init__(f"--require-all, but rejected: {words}; nothing was fused", pairs)
        self.result = result


@dataclass(frozen=True, eq=False)
class FusedMaps:
    """Maps that were fused, and what was measured of them.

    Attributes:
        result: the fused map, or where it is, what became of each input, and every alignment.
        doubled: the doubled walls of the inputs and of the fused map; None for a store.
        evaluations: errors of the inputs and, last, of the fused map; empty without a true map.
        stores: of each group of inputs, the largest first; empty where the maps are in memory.
        stems: the files of a map server beside each store, paths without suffix; None: the map is
            too large.
    """

    config: RunConfig
    result: Fusion
    doubled: DoubledWalls | None
    evaluations: tuple[Evaluation, ...] = ()
    given: inputs.GivenMaps = inputs.NO_FILES
    stores: tuple[Path, ...] = ()
    stems: tuple[Path | None, ...] = ()

    @property
    def in_memory(self) -> FusionResult:
        """The fusion with its map.

        Raises:
            SlamFusionError: the map is in a store.
        """
        if isinstance(self.result, FusionResult):
            return self.result
        raise SlamFusionError(f"{self.stores[0]}: the fused map is there and not in memory")

    @property
    def grid(self) -> OccupancyGrid:
        """The fused map: cells in {-1, 0, 100}, frame and lattice of the reference input."""
        return self.in_memory.fused

    @property
    def agreement(self) -> OccupancyGrid:
        """Share of the voters that agree, cells 0..100 or -1, on the same lattice."""
        return self.in_memory.agreement

    def document(self, stems: Sequence[Path | None] = ()) -> FuseDocument:
        """Return what ``slamfusion fuse`` prints as JSON.

        Args:
            stems: the files of maps that are in memory, paths without suffix.
        """
        result, stems = self.result, self.stems or stems
        stores = self.stores or [None] * len(stems)
        groups = [*map(FusedGroup.of, (result, *result.others), stems, stores)]
        return FuseDocument(
            fusion=FusionRecord.of(result, self.doubled),
            fused=groups[0].fused,
            agreement=groups[0].agreement,
            store=groups[0].store,
            groups=groups,
            evaluations=self.evaluations,
            given=self.given,
            circumstances=Circumstances(result.device, self.config),
            time_s=result.time_s,
        )


def fuse_maps(
    maps: Sequence[inputs.MapInput],
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    truth: inputs.MapInput | None = None,
    scale: inputs.PixelSizes | None = None,
    resolution: float | None = None,
    store: str | Path | None = None,
    executor: Executor | None = None,
    progress: inputs.Progress | None = None,
    warn: inputs.Warn = inputs.log_warning,
) -> FusedMaps:
    """Align maps of one place and fuse them by vote.

    Args:
        maps: two or more, in memory, map_server YAML files, or bare images; those in memory have
            distinct names.
        truth: the true map: errors of every input and of the fused map. Not used with a store.
        scale: the truth is a floor plan with pixels of this size; see ``evaluate_maps``.
        store: ``OUT.zarr``, a Zarr store to which the fused map is written tile by tile, so that it
            need not fit into memory; further groups go to ``OUT-2.zarr`` ... None may exist. It has
            the arrays ``fused`` (-1, 0, 100) and ``agreement`` (-1, 0 to 100). Maps of up to
            ``FILES_CELLS`` cells are also written as files of a map server next to it.
        executor: aligns the pairs and decides tiles for a store, see ``slamfusion.fleet``.

    Raises:
        AlignmentError: fewer than two maps agree; it has the maps and the alignments.
            ``AllRequiredError``: a required map was left out.
        MapFileError: a map cannot be read, a store exists, or Zarr is not installed.
        ConfigError: the configured reference is not an input. ``StartError``: a start names no
            input, or a single start does not define the others.
        MemoryBudgetError: the maps are too large for the free memory.
        FleetError: the scheduler is gone.
        SlamFusionError: there is only one map.
    """
    config = config or RunConfig()
    if len(maps) < LEAST_FUSED:
        name = "no map was given"
        for only in maps:
            shown = only.name if isinstance(only, OccupancyGrid) else only
            name = f"{shown}: one map alone cannot be fused"
        raise SlamFusionError(f"{name}; fuse needs at least two")
    if store is not None:
        for path in group_stores(Path(store), len(maps) // 2):
            check_store(path)
    grids = inputs.load_maps(maps, config, resolution=resolution, warn=warn)
    given = inputs.GivenMaps.of(maps, resolution)
    names = [grid.name for grid in grids]
    starts = place_starts(config.start, names, config.fusion.reference)
    true_grid = None
    if truth is not None:
        true_grid = inputs.load_truth(truth, config, resolution=resolution, scale=scale, warn=warn)
    device = inputs.device_for(config, device)
    try:
        if store is not None:
            setup = FusionSetup(
                config.fusion, device, progress, None, starts, executor, is_stored=True
            )
            return _fuse_into(Path(store), grids, config, setup, given)
        result = fuse_grids(
            grids, config.fusion, device, progress, starts=starts, executor=executor
        )
        if config.fusion.require_all and result.rejected:
            raise AllRequiredError(result.rejected, result.pairs, result)
    except AlignmentError as error:
        error.grids = tuple(grids)
        raise
    evaluations: tuple[Evaluation, ...] = ()
    if true_grid is not None:
        measured = [*grids, result.fused.with_name("fused")]
        evaluations = evaluate_maps(
            measured, true_grid, config, device, scale=scale, progress=progress
        )
    # The last evaluation is of the fused map.
    known = {found.name: found.doubled_wall_share for found in evaluations[:-1]}
    doubled = DoubledWalls.of(result, config, known)
    return FusedMaps(config, result, doubled, evaluations, given)


def _fuse_into(
    store: Path,
    grids: Sequence[OccupancyGrid],
    config: RunConfig,
    setup: FusionSetup,
    given: inputs.GivenMaps,
) -> FusedMaps:
    """Fuse maps tile by tile into a store; in memory are the inputs and a few tiles."""
    began_s = time.perf_counter()
    aligned = align_inputs(grids, setup)
    left_out = [aligned.others[grid.name] for grid in grids if grid.name in aligned.others]
    rejected = [item for item in left_out if not item.accepted and item.copy_of is None]
    if config.fusion.require_all and rejected:
        raise AllRequiredError(rejected, aligned.pairs)
    votes = prepare_votes(aligned.groups, aligned.lattices, setup)
    others = {**aligned.others, **contradicting(grids, aligned.groups[0], votes[0], votes[1:])}
    stores, task = group_stores(store, len(votes)), partial(decide_tile, device=setup.device)
    results: list[Fusion] = []
    # Each store is put in place when all are written.
    with ExitStack() as open_stores:
        for vote, path in zip(votes, stores, strict=True):
            lattice, shape = vote.lattice, vote.voter.whole.shape
            size, origin = lattice.resolution, lattice.origin
            facts = {"reference": vote.group.reference, "inputs": list(vote.group.alignments)}
            arrays = MapStore(
                path, (outputs.FUSED, AGREEMENT_ARRAY), shape, TILE, size, origin, facts
            )
            opened, phantom_cells, worst = open_stores.enter_context(arrays), 0, []
            for box, decided in vote.each(task, "vote", setup):
                if decided is not None:
                    cells = np.where(decided.fused == 1, np.int8(OCCUPIED), decided.fused)
                    opened.write(outputs.FUSED, box, cells)
                    opened.write(AGREEMENT_ARRAY, box, decided.agreement)
                    phantom_cells += decided.phantom_cells
                    worst.append(decided.worst)
            records = vote.records(grids, {} if results else others)
            results.append(Fusion(**vote.outcome(records, phantom_cells, worst, setup)))
    stems = tuple(
        path.with_suffix("") if vote.voter.whole.area <= FILES_CELLS else None
        for vote, path in zip(votes, stores, strict=True)
    )
    for path, stem in zip(stores, stems, strict=True):
        if stem is not None:
            with AtomicFiles():
                save_map(read_stored_map(path, outputs.FUSED), stem)
                agreement = read_stored_map(path, AGREEMENT_ARRAY)
                save_map(agreement, agreement_stem(stem), mode="raw")
    time_s = time.perf_counter() - began_s
    whole = replace(results[0], pairs=aligned.pairs, others=tuple(results[1:]), time_s=time_s)
    fused = FusedMaps(config, whole, None, (), given, stores, stems)
    if stems[0] is not None:
        write_atomic(Path(f"{stems[0]}.json"), record_bytes(fused.document()))
    return fused


def group_stores(store: Path, count: int) -> tuple[Path, ...]:
    """Return the stores of groups: OUT.zarr, OUT-2.zarr ..."""
    stems = outputs.group_stems(store.with_suffix(""), count)
    return tuple(stem.with_name(stem.name + store.suffix) for stem in stems)


def save_fused_maps(
    fused: FusedMaps,
    stem: str | Path,
    *,
    report: str | Path | None = None,
    image_format: str = "pgm",
) -> FuseDocument:
    """Write the fused map, the agreement, their record ``STEM.json`` and the report, all or none.

    Args:
        stem: the fused map's path without suffix.
        report: folder for ``report.html`` and its pictures; None: no report.
        image_format: of the maps' pictures, ``pgm`` or ``png``.

    Returns:
        The record of the fusion, which names the files.

    Raises:
        SlamFusionError: a file cannot be written, or matplotlib is missing.
    """
    stem, folder = Path(stem), None if report is None else Path(report)
    groups = (fused.in_memory, *fused.in_memory.others)
    stems = outputs.group_stems(stem, len(groups))
    document = fused.document(stems)
    with AtomicFiles() as files:
        for result, path in zip(groups, stems, strict=True):
            save_map(result.fused, path, image_format=image_format)
            agreement = agreement_stem(path)
            save_map(result.agreement, agreement, mode="raw", image_format=image_format)
        if folder is not None:
            from slamfusion.report.page import report_files  # noqa: PLC0415  (an extra)

            write_fusion_report(fused, folder)
            files.remove(*report_files(folder / outputs.FAILED))
        write_atomic(Path(f"{stem}.json"), record_bytes(document))
    if folder is not None:
        outputs.remove_empty(folder / outputs.FAILED)
    return document


def write_fusion_report(
    fused: FusedMaps, directory: str | Path, failure: str | None = None
) -> Path:
    """Write the report of maps in memory; see ``slamfusion.report.page.write_page``.

    Args:
        failure: why the result must not be used, e.g. ``--require-all``.
    """
    from slamfusion.report import fusion_report, maps, page  # noqa: PLC0415  (an extra)

    result, config = fused.in_memory, fused.config
    sections = [
        fusion_report.fused_section(result),
        *fusion_report.group_sections(result),
        fusion_report.inputs_section(result, config),
    ]
    if fused.evaluations:
        alignments = [item.alignment for item in fused.evaluations]
        sections.append(maps.error_section(fused.evaluations, alignments))
    sections.append(fusion_report.alignment_section(result))
    doubled = None if fused.doubled is None else fused.doubled.of_maps(fusion_report.FUSED_MAP)
    sections.append(fusion_report.statistics_section(result, config, doubled))
    banner = fusion_report.fusion_banner(result, failure)
    facts = fusion_report.saved_maps_facts(result, fused.evaluations)
    report = page.Page("SLAMfusion report", banner, facts, sections, config, result.device)
    return page.write_page(report, directory)


def write_failed_fusion(
    error: AlignmentError, config: RunConfig, directory: Path, *, device: str
) -> Path:
    """Write the report of maps that were not fused, return its path; an earlier fusion's stays."""
    from slamfusion.report import maps, page  # noqa: PLC0415  (an extra)

    folder, pairs = outputs.failure_folder(directory, page.report_files(directory)), error.pairs
    if isinstance(error, AllRequiredError) and error.result is not None:
        return write_fusion_report(FusedMaps(config, error.result, None), folder, str(error))
    grids = [grid.classified(config.fusion.normalize) for grid in error.grids]
    pictures = [maps.input_picture(grid) for grid in grids]
    statistics = maps.map_statistics(grids) if grids else page.NO_TABLES
    sections = [page.Section("Inputs", "The maps as they were given.", pictures, statistics)]
    if pairs:
        sections.append(maps.pairs_section(grids, pairs))
        if curves := maps.yaw_pictures(pairs):
            sections.append(page.Section("Score over yaw", maps.YAW_TEXT, curves))
    facts = [
        page.Fact(f"0 of {len(grids)}", "maps fused", "bad"),
        page.Fact(f"{sum(one.accepted for one in pairs)} of {len(pairs)}", "pairs accepted"),
    ]
    banner = page.Banner("bad", "Nothing was fused", [("", str(error))])
    report = page.Page("SLAMfusion report", banner, facts, sections, config, device)
    return page.write_page(report, folder)
