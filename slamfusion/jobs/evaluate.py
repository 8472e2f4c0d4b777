"""How far maps are from the truth, and from distances measured in the building."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamfusion.align.align import align_each
from slamfusion.align.normalize import check_ratio
from slamfusion.align.records import Alignment
from slamfusion.align.scale import explained
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.evaluation.distances import (
    DistanceComparison,
    MeasuredDistance,
    compare_distances,
    load_distances,
)
from slamfusion.evaluation.map_error import compare_to_truth
from slamfusion.evaluation.measured import Row, map_figures, result_rows
from slamfusion.geometry import Pose2
from slamfusion.io import AtomicFiles
from slamfusion.jobs import inputs
from slamfusion.jobs.align import AlignedPlan, align_plan
from slamfusion.jobs.cases import CaseFile, Placed, case_names, place_files
from slamfusion.jobs.fuse_documents import Evaluation, unaligned_sentences
from slamfusion.jobs.records import Settings, Summaries
from slamfusion.json_values import FLAT


@dataclass(frozen=True, eq=False)
class EvaluatedMap:
    """A map against the truth of its case."""

    evaluation: Evaluation = field(metadata=FLAT)
    placed: Placed = field(metadata=FLAT)


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluatedMaps:
    """``slamfusion evaluate``: maps against the truths of their cases, or distances."""

    files: Sequence[CaseFile] = field(default=(), repr=False)
    """The maps' files, as they were given."""
    maps: Sequence[EvaluatedMap] = ()
    """The maps in the order given, each against the truth of its case; empty without --truth."""
    summaries: Summaries | None = field(default=None, metadata=FLAT)
    distances: Sequence[DistanceComparison] = ()
    """The maps against measured distances; empty without --distances."""
    truth: Path | None = None
    """The true map's file; null without --truth and with several."""
    truths: Mapping[str, Path] = field(default_factory=dict)
    """The true maps' files, by case."""
    device: str | None
    """What computed the alignments, in words; null where none was."""
    seed: int
    """Seed of every random number."""
    settings: Settings = field(metadata=FLAT)

    def rows(self) -> list[Row]:
        """Return the figures against the truths as rows of a table of results."""
        return [
            row
            for item in self.maps
            for row in result_rows(*item.placed.keys, map_figures(item.evaluation))
        ]

    def distance_rows(self) -> list[Row]:
        """Return the figures against measured distances, a case of their own, as rows."""
        if not self.distances:
            return []
        files = [CaseFile(item.path) for item in self.files]
        pairs = zip(place_files(["measured distances"], files), self.distances, strict=True)
        return [
            row
            for item, found in pairs
            for row in result_rows(
                *item.keys, {"distance_error_mean_m": found.mean_absolute_error_m}
            )
        ]

    def write(self, report: Path) -> list[Path]:
        """Write a report of the maps of each case, all or none, and return the pages."""
        config, device = self.settings.config, self.device or ""
        own: dict[str, list[Evaluation]] = {}
        for item in self.maps:
            own.setdefault(item.placed.case, []).append(item.evaluation)
        with AtomicFiles():
            return [
                write_evaluation(
                    own[case], report if len(self.truths) == 1 else report / case, config, device
                )
                for case in self.truths
                if case in own
            ]


def evaluate_maps(
    maps: Sequence[inputs.MapInput],
    truth: inputs.MapInput,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    align: bool = True,
    scale: inputs.PixelSizes | None = None,
    resolution: float | None = None,
    progress: inputs.Progress | None = None,
) -> tuple[Evaluation, ...]:
    """Compare each map with the truth, aligned first.

    A map whose alignment is rejected is still measured at the best transform found; this error is a
    lower bound, and ``aligned`` is false. The alignment with the truth is part of the measure, so
    it ignores ``fusion.align.step``.

    Args:
        maps: in memory, map_server YAML files, or bare images.
        align: search the pose of each map in the truth; else both frames are the same.
        scale: the truth is a floor plan with pixels of this size, which is searched; parts that a
            map has not seen do not count. None: the truth is a map.

    Raises:
        MapFileError: a map cannot be read.
        GridError: a map has no known cell, or does not fit the truth.
    """
    config = config or RunConfig()
    grids = inputs.load_maps(maps, config, resolution=resolution, measured=True)
    true_grid = inputs.load_truth(truth, config, resolution=resolution, scale=scale)
    device = inputs.device_for(config, device)
    search = replace(config.fusion, align=replace(config.fusion.align, step=None))
    plans: list[AlignedPlan] = []
    if scale is not None:
        # The maps show one place: the scale at which the plan fits one holds for those before it.
        searched = replace(config, fusion=search)
        for grid in reversed(grids):
            plan = align_plan(grid, true_grid, searched, device, scale=scale)
            if plan.alignment.accepted:
                scale = plan.plan.resolution, plan.plan.resolution
            plans.insert(0, plan)
    truths = [true_grid] * len(grids)
    found: Iterable[Alignment | None] = [None] * len(grids)
    if plans:
        truths, found = [plan.plan for plan in plans], [plan.of_map for plan in plans]
    elif align:
        each = align_each(true_grid, grids, search, device)
        found = (
            explained(alignment, true_grid, grid, search, device)
            for grid, alignment in zip(grids, each, strict=True)
        )
    else:
        for grid in grids:
            check_ratio(grid, true_grid.resolution)
    evaluations, tell = [], progress or (lambda *_: None)
    for done, (grid, shown, alignment) in enumerate(zip(grids, truths, found, strict=True)):
        tell("evaluate", done, len(grids))
        error = compare_to_truth(
            grid,
            shown,
            Pose2() if alignment is None else alignment.transform,
            config,
            is_plan=bool(plans),
        )
        aligned = alignment is None or alignment.accepted
        evaluations.append(Evaluation(**vars(error), aligned=aligned, alignment=alignment))
    tell("evaluate", len(grids), len(grids))
    return tuple(evaluations)


def measure_distances(
    maps: Sequence[inputs.MapInput],
    distances: str | Path | Sequence[MeasuredDistance],
    config: RunConfig | None = None,
    *,
    resolution: float | None = None,
) -> tuple[DistanceComparison, ...]:
    """Compare distances measured in the building with those in each map.

    Args:
        maps: in memory, map_server YAML files, or bare images.
        distances: CSV or YAML, or its rows; see ``load_distances``.

    Raises:
        MapFileError, OSError: a map or the file of distances cannot be read.
    """
    config = config or RunConfig()
    rows = load_distances(distances) if isinstance(distances, (str, Path)) else distances
    return tuple(
        compare_distances(grid, rows, config.fusion.normalize)
        for grid in inputs.load_maps(maps, config, resolution=resolution)
    )


def evaluate_cases(
    maps: tuple[CaseFile, ...],
    truths: Sequence[CaseFile],
    config: RunConfig,
    *,
    distances: Path | None = None,
    align: bool = True,
    scale: inputs.PixelSizes | None = None,
    resolution: float | None = None,
    progress: inputs.Progress | None = None,
    warn: inputs.Warn = inputs.log_warning,
) -> EvaluatedMaps:
    """Compare maps with the truths of their cases and with measured distances.

    Raises:
        ConfigError: a map belongs to no case, or to several.
        MapFileError, GridError: see ``evaluate_maps``.
    """
    cases = case_names(truths)
    placed = place_files(cases, maps) if cases else []
    paths = [item.path for item in maps]
    grids = inputs.load_maps(paths, config, resolution=resolution, warn=warn, measured=True)
    if len(cases) > 1:
        grids = [grid.with_name(own.name) for grid, own in zip(grids, placed, strict=True)]
    true_grids = [
        inputs.load_truth(item.path, config, resolution=resolution, scale=scale, warn=warn)
        for item in truths
    ]
    device = inputs.device_for(config) if cases else None
    found: dict[int, Evaluation] = {}
    for case, truth in zip(cases, true_grids, strict=True):
        rows = [row for row, own in enumerate(placed) if own.case == case]
        evaluations = evaluate_maps(
            [grids[row] for row in rows],
            truth if len(cases) == 1 else truth.with_name(case),
            config,
            device,
            align=align,
            scale=scale,
            progress=progress,
        )
        found.update(zip(rows, evaluations, strict=True))
    result = EvaluatedMaps(
        files=maps,
        maps=[EvaluatedMap(found[row], own) for row, own in enumerate(placed)],
        distances=() if distances is None else measure_distances(grids, distances, config),
        truth=truths[0].path if len(truths) == 1 else None,
        truths={case: item.path for case, item in zip(cases, truths, strict=True)},
        device=None if device is None else device.name,
        seed=config.seed,
        settings=Settings(config),
    )
    if len(cases) < 2:
        return result
    from slamfusion.jobs.results import summaries  # noqa: PLC0415  (pandas is an extra)

    return replace(result, summaries=summaries(result.rows()))


def write_evaluation(
    evaluations: Sequence[Evaluation],
    directory: str | Path,
    config: RunConfig | None = None,
    device: str = "",
) -> Path:
    """Write the report of the differences of maps to one truth; rejected ones are at the top.

    See ``slamfusion.report.page.write_page``; ``device``: what computed the alignments, in words.
    """
    from slamfusion.report import layers, maps, page  # noqa: PLC0415  (an extra)

    config = config or RunConfig()
    alignments = [evaluation.alignment for evaluation in evaluations]
    section = maps.error_section(evaluations, alignments)
    sections = [replace(section, layers=layers.error_layers(evaluations))]
    searched = [alignment for alignment in alignments if alignment is not None]
    if searched:
        table = page.tables().alignments("Alignment to the truth", searched)
        sections.append(page.Section("Alignment", "", maps.yaw_pictures(searched), table))
    lost = [("", sentence) for sentence in unaligned_sentences(evaluations)]
    best, truth = min(evaluations, key=lambda item: item.error), evaluations[0].truth
    is_one = len(evaluations) == 1
    headline = f"{best.name} against {truth}" if is_one else f"{best.name} is nearest to {truth}"
    facts = [
        page.Fact(
            f"{item.error:.2f}",
            f"error of {item.name} [F16]",
            "good" if item.error == best.error and not is_one else "plain",
        )
        for item in evaluations
    ]
    banner = page.Banner("warn" if lost else "good", headline, lost)
    report = page.Page("SLAMfusion evaluation", banner, facts, sections, config, device)
    return page.write_page(report, directory)
