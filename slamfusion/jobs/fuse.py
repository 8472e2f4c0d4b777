"""Saved maps of one place become one: align, vote, measure, and the files of what came of it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.evaluation import doubled_wall_share, fused_doubled_shares
from slamfusion.fleet import Scheduler
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.records import (
    Alignment,
    AlignmentJson,
    Fusion,
    FusionResult,
    InputRecord,
    StoredFusion,
)
from slamfusion.fusion.start import place_starts
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, save_map
from slamfusion.jobs.documents import circumstances, path_text, record_bytes
from slamfusion.jobs.evaluate import Evaluation, evaluate_maps
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
    AGREEMENT_END,
    FAILED,
    failure_folder,
    group_stem,
    record_file,
    remove_empty,
    report_files,
)
from slamfusion.jobs.records import (
    DoubledWallsJson,
    FailedFuseDocument,
    FusedGroupJson,
    FuseDocument,
    FusionJson,
    NoAlignmentJson,
    UnalignedInputJson,
)

__all__ = [
    "AllRequiredError",
    "DoubledWalls",
    "FusedMaps",
    "check_count",
    "failed_fuse_document",
    "failure_document",
    "fuse_document",
    "fuse_maps",
    "fusion_document",
    "fusion_sentences",
    "group_document",
    "group_stems",
    "save_fused_maps",
    "write_failed_fusion",
]

_LOG = logging.getLogger(__name__)

NO_ALIGNMENT: NoAlignmentJson = {
    "dx_m": None,
    "dy_m": None,
    "yaw_rad": None,
    "score": None,
    "overlap": None,
    "error": None,
    "runner_up": None,
    "bound_gap": None,
    "time_s": None,
}


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


@dataclass(frozen=True)
class DoubledWalls:
    """Shares of the wall cells that have a parallel wall close by, the trace of a slip.

    Attributes:
        inputs: by name, of each input as it was given.
        fused: of the fused map.
        added: of the fused map, doubled there and in no input.
    """

    inputs: dict[str, float]
    fused: float
    added: float

    @classmethod
    def of(cls, result: FusionResult, config: RunConfig) -> DoubledWalls:
        """Measure a fusion."""
        normalize = config.fusion.normalize
        shares = {
            record.name: doubled_wall_share(record.grid, normalize=normalize)
            for record in result.inputs
        }
        layers = (record.layer for record in result.accepted if record.layer is not None)
        aligned = ((layer.cells, layer.box) for layer in layers)
        return cls(shares, *fused_doubled_shares(np.sign(result.fused.cells), aligned))

    def to_json(self) -> DoubledWallsJson:
        """Return the shares for a JSON document."""
        return {"inputs": self.inputs, "fused": self.fused, "added_by_fusion": self.added}


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
    scheduler: Scheduler | None = None,
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
        scheduler: aligns the pairs, see ``slamfusion.fleet``; default: they are aligned here.
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
    result = fuse_grids(grids, config.fusion, device, progress, starts=starts, scheduler=scheduler)
    if config.fusion.require_all and result.rejected:
        raise AllRequiredError(result)
    evaluations: tuple[Evaluation, ...] = ()
    if true_grid is not None:
        measured = [*grids, result.fused.with_name("fused")]
        evaluations = evaluate_maps(measured, true_grid, config, device, progress=progress)
    doubled = DoubledWalls.of(result, config)
    given = given or GivenMaps.of(maps, resolution)
    return FusedMaps(config, result, doubled, evaluations, given)


# --- files ------------------------------------------------------------------------------------


def all_groups(result: FusionResult) -> tuple[FusionResult, ...]:
    """Return the fusion of each group of inputs that share ground, the largest first."""
    return (result, *result.others)


def group_stems(result: FusionResult, stem: Path) -> list[Path]:
    """Return the path, without suffix, of each group's fused map: OUT, OUT-2, OUT-3 ..."""
    return [stem, *(group_stem(stem, n) for n in range(2, 2 + len(result.others)))]


def agreement_stem(stem: Path) -> Path:
    """Return the path, without suffix, of the agreement map beside a fused map."""
    return stem.with_name(stem.name + AGREEMENT_END)


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
    stems = group_stems(fused.result, stem)
    for result, path in zip(all_groups(fused.result), stems, strict=True):
        save_map(result.fused, path, files=files)
        save_map(result.agreement, agreement_stem(path), mode="raw", files=files)
    if folder is not None:
        from slamfusion.report import write_fusion_report  # noqa: PLC0415  (an extra)

        errors = [evaluation.error for evaluation in fused.evaluations]
        write_fusion_report(
            fused.result, folder, config=fused.config, evaluations=errors, files=files
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
    result = fused.result
    return {
        **fusion_document(result, fused.doubled),
        "fused": f"{stem}.yaml",
        "agreement": f"{agreement_stem(stem)}.yaml",
        "store": None,
        "groups": [
            group_document(item, own)
            for item, own in zip(all_groups(result), group_stems(result, stem), strict=True)
        ],
        "evaluations": [evaluation.to_json() for evaluation in fused.evaluations],
        **fused.given.to_json(),
        **circumstances(fused.config, result.device),
        "time_s": result.time_s,
    }


def failed_fuse_document(
    error: AlignmentError,
    grids: Sequence[OccupancyGrid],
    config: RunConfig,
    device: str,
    given: GivenMaps = NO_FILES,
) -> FailedFuseDocument:
    """Return what ``slamfusion fuse`` prints as JSON where nothing was fused.

    Args:
        error: why not.
        grids: the inputs.
        config: the settings in effect.
        device: what computed, in words.
        given: the files of the inputs.
    """
    return {
        **failure_document(grids, error.pairs, str(error)),
        "fused": None,
        "agreement": None,
        "store": None,
        "groups": [],
        "evaluations": [],
        **given.to_json(),
        "error": str(error),
        **circumstances(config, device),
        "time_s": None,
    }


def fusion_document(
    result: FusionResult | StoredFusion, doubled: DoubledWalls | None
) -> FusionJson:
    """Return what a JSON document says of a fusion; doubled walls where they were measured."""
    return {
        "inputs": [_input(record, result.reference) for record in result.inputs],
        "reference": result.reference,
        "fused_count": len(result.accepted),
        "phantom_cells": result.phantom_cells,
        "wall_backs": result.wall_backs,
        "doubled_wall_share": None if doubled is None else doubled.to_json(),
        "weights": result.weights,
        "pairs": [pair.to_json() for pair in result.pairs],
        "copies": {
            record.name: record.copy_of for record in result.copies if record.copy_of is not None
        },
    }


def failure_document(
    grids: Sequence[OccupancyGrid], pairs: Sequence[Alignment], reason: str
) -> FusionJson:
    """Return the same keys where nothing was fused.

    Args:
        grids: the inputs.
        pairs: every pair that was aligned; may be empty.
        reason: why nothing was fused; that of an input in no pair.
    """
    return {
        "inputs": [
            {
                **NO_ALIGNMENT,
                "name": grid.name,
                "reference": None,
                "accepted": False,
                "reason": _reason(grid.name, pairs, reason),
            }
            for grid in grids
        ],
        "reference": None,
        "fused_count": 0,
        "phantom_cells": None,
        "wall_backs": None,
        "doubled_wall_share": None,
        "weights": {},
        "pairs": [pair.to_json() for pair in pairs],
        "copies": {},
    }


def fusion_sentences(
    result: FusionResult | StoredFusion, doubled: DoubledWalls | None
) -> tuple[str, ...]:
    """Say how many inputs were fused, what became of the others, and what the vote added."""
    text = f"fused {len(result.accepted)} of {len(result.inputs)} inputs"
    if result.rejected:
        reasons = ", ".join(f"{record.name}: {record.reason}" for record in result.rejected)
        text += f"; rejected: {reasons}"
    for record in result.copies:
        text += f"; {record.name}: {record.reason}"
    if result.others:
        text += f"; {further_groups(result)}"
    share = "" if doubled is None else f"{doubled.added:.1%} of the walls doubled by the fusion, "
    added = (
        f"{result.phantom_cells} phantom cells, {result.wall_backs} cells behind walls filled, "
        f"{share}{result.time_s:.2f} s"
    )
    return text, added


def further_groups(result: FusionResult | StoredFusion) -> str:
    """Say which inputs are fused apart from the largest group."""
    groups = [", ".join(record.name for record in other.accepted) for other in result.others]
    return "fused apart, as they share nothing with these: " + "; ".join(groups)


def group_document(result: Fusion, stem: Path | None, store: Path | None = None) -> FusedGroupJson:
    """Return what is said of one group.

    Args:
        result: the fusion.
        stem: path of its map without suffix; None: it has no such files.
        store: that holds it; None: none does.
    """
    return {
        "fused": None if stem is None else f"{stem}.yaml",
        "agreement": None if stem is None else f"{agreement_stem(stem)}.yaml",
        "store": path_text(store),
        "reference": result.reference,
        "inputs": [
            record.alignment.to_json() for record in result.accepted if record.alignment is not None
        ],
        "weights": result.weights,
    }


def _input(record: InputRecord, reference: str | None) -> AlignmentJson | UnalignedInputJson:
    """Return one input's record: its alignment, and what became of it."""
    if record.alignment is None:
        return {
            **NO_ALIGNMENT,
            "name": record.name,
            "reference": reference,
            "accepted": record.accepted,
            "reason": record.reason,
        }
    return {
        **record.alignment.to_json(),
        "name": record.name,
        "accepted": record.accepted,
        "reason": record.reason,
    }


def _reason(name: str, pairs: Sequence[Alignment], otherwise: str) -> str:
    """Return why an input found no partner: the reason of its best rejected pair."""
    rejected = [
        pair for pair in pairs if name in {pair.reference, pair.moving} and not pair.accepted
    ]
    if not rejected:
        return otherwise
    best = max(rejected, key=lambda pair: pair.score)
    other = best.reference if best.moving == name else best.moving
    return f"against {other}: {best.reason}"
