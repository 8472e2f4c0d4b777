"""Saved maps of one place become one: align, vote, measure, and the files of what came of it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from slamfusion.align.records import (
    Fusion,
    FusionResult,
)
from slamfusion.align.starts import place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, save_map
from slamfusion.jobs.documents import circumstances, record_bytes
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse_documents import (
    DoubledWalls,
    agreement_stem,
    fusion_document,
    group_document,
)
from slamfusion.jobs.inputs import (
    NO_FILES,
    GivenMaps,
    MapInput,
    Progress,
    Warn,
    as_grids,
    device_for,
)
from slamfusion.jobs.outputs import (
    FAILED,
    failure_folder,
    group_stems,
    record_file,
    remove_empty,
    report_files,
)
from slamfusion.jobs.records import (
    Evaluation,
    FuseDocument,
)

__all__ = [
    "AllRequiredError",
    "FusedMaps",
    "check_count",
    "fuse_document",
    "fuse_maps",
    "save_fused_maps",
    "write_failed_fusion",
]

_LOG = logging.getLogger(__name__)


class AllRequiredError(AlignmentError):
    """A fusion that had to leave an input out, where ``--require-all`` forbids it.

    Attributes:
        result: what would have been fused.
    """

    def __init__(self, result: Fusion) -> None:
        rejected = ", ".join(f"{record.name} ({record.reason})" for record in result.rejected)
        super().__init__(f"--require-all, but rejected: {rejected}; nothing was fused")
        self.pairs = result.pairs
        self.result = result


@dataclass(frozen=True, eq=False)
class FusedMaps:
    """Maps that were fused, and what was measured of them.

    Attributes:
        config: the settings in effect.
        result: the fused map, what became of each input, and every alignment.
        doubled: the doubled walls of the inputs and of the fused map.
        evaluations: errors of the inputs and, last, of the fused map; empty without a true map.
        given: the files of the inputs.
    """

    config: RunConfig
    result: FusionResult
    doubled: DoubledWalls
    evaluations: tuple[Evaluation, ...] = ()
    given: GivenMaps = NO_FILES

    @property
    def grid(self) -> OccupancyGrid:
        """The fused map: cells in {-1, 0, 100}, frame and lattice of the reference input."""
        return self.result.fused

    @property
    def agreement(self) -> OccupancyGrid:
        """Share of the voters that agree, cells 0..100 or -1, on the same lattice."""
        return self.result.agreement


def check_count(maps: Sequence[object]) -> None:
    """Refuse a fusion of one map.

    Raises:
        SlamFusionError: there is one map alone, or none.
    """
    if len(maps) < LEAST_FUSED:
        name = "no map was given"
        if maps:
            only = maps[0]
            name = f"{only.name if isinstance(only, OccupancyGrid) else only}: one map alone"
            name += " cannot be fused"
        message = f"{name}; fuse needs at least two"
        raise SlamFusionError(message)


def fuse_maps(
    maps: Sequence[MapInput],
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    truth: MapInput | None = None,
    resolution: float | None = None,
    given: GivenMaps | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    warn: Warn = _LOG.warning,
) -> FusedMaps:
    """Align maps of one place and fuse them by vote.

    Args:
        maps: two or more, in memory, map_server YAML files, or bare images; those in memory have
            distinct names.
        config: ``fusion``, ``start``, ``evaluate`` and ``map_files`` are used; default: the
            defaults.
        device: computes; default: the one that the settings name.
        truth: the true map: errors of every input and of the fused map.
        resolution: metres per cell of bare images.
        given: the files of maps that are in memory; default: those that are read.
        executor: aligns the pairs, see ``slamfusion.fleet``; default: they are aligned here.
        progress: told the stage, and how much of it is done.
        warn: told in a sentence what is doubtful about a map.

    Raises:
        AlignmentError: fewer than two of the maps agree, so nothing may be fused; its ``pairs``
            hold the alignments. ``AllRequiredError``: one was left out that had to be in.
        MapFileError: a map cannot be read.
        ConfigError: the reference named in the settings is none of the inputs. ``StartError``: a
            start names none, or is one alone that says nothing of the others.
        MemoryBudgetError: the maps are too large for the memory that is free.
        DeviceError: the device cannot be opened.
        FleetError: who was to align the pairs is gone.
        SlamFusionError: there is one map alone.
    """
    config = config or RunConfig()
    check_count(maps)
    grids = as_grids(maps, config, resolution=resolution, warn=warn)
    names = [grid.name for grid in grids]
    starts = place_starts(config.start, names, config.fusion.reference)
    true_grid = None
    if truth is not None:
        (true_grid,) = as_grids([truth], config, resolution=resolution, warn=warn)
    device = device_for(config, device)
    result = fuse_grids(grids, config.fusion, device, progress, starts=starts, executor=executor)
    if config.fusion.require_all and result.rejected:
        raise AllRequiredError(result)
    evaluations: tuple[Evaluation, ...] = ()
    if true_grid is not None:
        measured = [*grids, result.fused.with_name("fused")]
        evaluations = evaluate_maps(measured, true_grid, config, device, progress=progress)
    # The last evaluation is of the fused map.
    known = {found.name: found.doubled_wall_share for found in evaluations[:-1]}
    doubled = DoubledWalls.of(result, config, device, known)
    given = given or GivenMaps.of(maps, resolution)
    return FusedMaps(config, result, doubled, evaluations, given)


# --- files ------------------------------------------------------------------------------------


def all_groups(result: FusionResult) -> tuple[FusionResult, ...]:
    """Return the fusion of each group of inputs that share ground, the largest first."""
    return (result, *result.others)


def save_fused_maps(
    fused: FusedMaps,
    stem: str | Path,
    *,
    report: str | Path | None = None,
    files: AtomicFiles | None = None,
) -> FuseDocument:
    """Write the fused map, the agreement, the record of both and the report, all or none.

    Args:
        fused: what was fused.
        stem: the fused map's path without suffix.
        report: folder for ``report.html`` and its pictures; None: no report.
        files: the set of files to join; default: one of its own.

    Returns:
        The record of the fusion, which names the files; it stands in ``STEM.json``.

    Raises:
        SlamFusionError: a file cannot be written, or matplotlib is missing.
    """
    stem, folder = Path(stem), None if report is None else Path(report)
    if files is None:
        with AtomicFiles() as own:
            document = save_fused_maps(fused, stem, report=folder, files=own)
        if folder is not None:
            remove_empty(folder / FAILED)
        return document
    groups = all_groups(fused.result)
    for result, path in zip(groups, group_stems(stem, len(groups)), strict=True):
        save_map(result.fused, path, files=files)
        save_map(result.agreement, agreement_stem(path), mode="raw", files=files)
    if folder is not None:
        from slamfusion.report import write_fusion_report  # noqa: PLC0415  (an extra)

        write_fusion_report(
            fused.result, folder, config=fused.config, evaluations=fused.evaluations, files=files
        )
        for page in report_files(folder / FAILED):
            files.remove(page)
    document = fuse_document(fused, stem)
    files.add(record_file(stem), record_bytes(document))
    return document


def write_failed_fusion(
    error: AlignmentError,
    grids: Sequence[OccupancyGrid],
    config: RunConfig,
    directory: Path,
    *,
    device: str,
) -> Path:
    """Write the report of maps that were not fused; that of an earlier fusion stays.

    Args:
        error: why not.
        grids: the inputs.
        config: the effective configuration, written out in full.
        directory: for the report; it goes into ``failed`` there where one lies in it already.
        device: what computed, in words.

    Returns:
        The path of ``report.html``.

    Raises:
        SlamFusionError: matplotlib is missing, or a file cannot be written.
    """
    from slamfusion.report import write_failure_report, write_fusion_report  # noqa: PLC0415

    folder = failure_folder(directory, report_files(directory))
    if isinstance(error, AllRequiredError) and isinstance(error.result, FusionResult):
        return write_fusion_report(error.result, folder, config=config, failure=str(error))
    return write_failure_report(
        grids, error.pairs, str(error), folder, config=config, device=device
    )


# --- what is said -----------------------------------------------------------------------------


def fuse_document(fused: FusedMaps, stem: Path) -> FuseDocument:
    """Return what ``slamfusion fuse`` prints as JSON.

    Args:
        fused: what was fused.
        stem: the fused map's path without suffix.
    """
    result, groups = fused.result, all_groups(fused.result)
    return {
        **fusion_document(result, fused.doubled),
        "fused": f"{stem}.yaml",
        "agreement": f"{agreement_stem(stem)}.yaml",
        "store": None,
        "groups": [
            group_document(item, own)
            for item, own in zip(groups, group_stems(stem, len(groups)), strict=True)
        ],
        "evaluations": fused.evaluations,
        **fused.given.to_json(),
        **circumstances(fused.config, result.device),
        "time_s": result.time_s,
    }
