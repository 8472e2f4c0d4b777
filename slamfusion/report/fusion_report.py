"""The report of a fusion: which maps vote, how they lie, where they differ, and what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slamfusion.align.records import Alignment, FusionResult, InputRecord
from slamfusion.config import RunConfig
from slamfusion.evaluation import MapError
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.io.files import AtomicFiles
from slamfusion.palette import DISAGREEMENT_RGB
from slamfusion.report import plots
from slamfusion.report.canvas import Classes, crop_box
from slamfusion.report.layers import fusion_layers
from slamfusion.report.maps import (
    alignment_table,
    error_section,
    input_colours,
    input_picture,
    layer_legend,
    pair_overlay,
    pairs_section,
    statistics_table,
    yaw_pictures,
)
from slamfusion.report.page import (
    Banner,
    Cell,
    Fact,
    LegendEntry,
    Page,
    Picture,
    Section,
    Table,
    number,
    write_page,
)
from slamfusion.trajectory import Trajectory

# Overlays of failed pairs.
_MOST_OVERLAYS = 12


def write_fusion_report(
    result: FusionResult,
    directory: str | Path,
    *,
    config: RunConfig,
    evaluations: Sequence[MapError] = (),
    failure: str | None = None,
    files: AtomicFiles | None = None,
) -> Path:
    """Write the report of a fusion as one self-contained page with its pictures beside it.

    Args:
        result: what was fused; rejected inputs are shown with their reasons.
        directory, files: see ``write_page``, also for what is returned and raised.
        config: the settings in effect.
        evaluations: errors against a truth, of the inputs, the fused map, or both.
        failure: why the result must not be used all the same, e.g. ``--require-all``.
    """
    box = shown_box(result)
    sections = [fused_section(result, box), *group_sections(result)]
    sections.append(inputs_section(result, config))
    if any(record.dissent is not None for record in result.accepted):
        sections.append(dissent_section(result, box))
    if evaluations:
        sections.append(error_section(evaluations))
    sections.append(alignment_section(result))
    sections.append(statistics_section(result, config))
    banner, facts = _banner(result, failure), _facts(result, evaluations)
    page = Page("SLAMfusion report", banner, facts, sections, config, result.device)
    return write_page(page, directory, files)


def write_failure_report(
    grids: Sequence[OccupancyGrid],
    pairs: Sequence[Alignment],
    reason: str,
    directory: str | Path,
    *,
    config: RunConfig,
    device: str = "",
) -> Path:
    """Write the report of maps that could not be fused: each map, each pair, and why.

    Args:
        grids: the inputs, as given.
        pairs: every pair that was aligned; may be empty.
        reason: why nothing was fused.
        directory: see ``write_page``, also for what is returned and raised.
        config: the settings in effect.
        device: the device that computed, in words.
    """
    normalize = config.fusion.normalize
    sections = [
        Section(
            "Inputs",
            "inputs",
            "The maps as they were given.",
            [input_picture(grid, normalize) for grid in grids],
            [statistics_table(grids, normalize)] if grids else [],
        )
    ]
    if pairs:
        sections.append(pairs_section(grids, pairs, normalize, most_overlays=_MOST_OVERLAYS))
        curves = yaw_pictures(pairs)
        if curves:
            sections.append(Section("Score over yaw", "yaw", _YAW_TEXT, curves))
    banner = Banner("bad", "Nothing was fused", [("", reason)])
    facts = [
        Fact(f"0 of {len(grids)}", "maps fused", "bad"),
        Fact(str(sum(pair.accepted for pair in pairs)), f"of {len(pairs)} pairs accepted"),
    ]
    page = Page("SLAMfusion report", banner, facts, sections, config, device)
    return write_page(page, directory)


_YAW_TEXT = (
    "The best coarse score at each yaw of the moving map. One sharp peak means that the place "
    "looks like itself in one way only; a rival of nearly the same height is a symmetry, and a "
    "reason for doubt."
)


def _banner(result: FusionResult, failure: str | None) -> Banner:
    """Say first which maps vote, and loudest which do not."""
    accepted = ", ".join(record.name for record in result.accepted)
    lines = doubtful_lines(result)
    lines.append(("Fused:", f"{accepted or 'none'}; in the frame of {result.reference}."))
    total, fused = len(result.inputs) - len(result.copies), len(result.accepted)
    if failure is not None:
        return Banner("bad", "Do not use this map", [("", failure), *lines])
    if fused < 2:
        return Banner("bad", f"Not a vote: only {fused} of {total} maps remains", lines)
    if result.rejected:
        return Banner("warn", f"Only {fused} of {total} maps were fused", lines)
    tone = "warn" if _weak(result) else "good"
    return Banner(tone, f"{'Both' if total == 2 else f'All {total}'} maps were fused", lines)


def doubtful_lines(result: FusionResult) -> list[tuple[str, str]]:
    """Return which inputs are left out, weak matches or bent, and what the fused map leaves out."""
    return [
        *((f"{record.name} was rejected:", record.reason) for record in result.rejected),
        *((f"{record.name} is a copy:", record.reason) for record in result.copies),
        *((f"{name} may not belong here:", reason) for name, reason in _weak(result)),
        *(("", words) for group in (result, *result.others) for words in group.bent_sentences),
        *(
            (f"Left out, outside the box of {group.reference}:", f"{area:.1f} m² of {name}.")
            for group in (result, *result.others)
            for name, area in group.left_out_m2.items()
        ),
    ]


def _weak(result: FusionResult) -> list[tuple[str, str]]:
    """Return the inputs that vote though much contradicts them, each with its reason."""
    return [
        (record.name, record.reason)
        for record in result.accepted
        if record.alignment is not None and record.alignment.strength == "weak"
    ]


def _facts(result: FusionResult, evaluations: Sequence[MapError]) -> list[Fact]:
    """Return the numbers at the top."""
    total, fused = len(result.inputs) - len(result.copies), len(result.accepted)
    cells = result.fused.cells
    area = float(np.count_nonzero(cells != -1)) * result.fused.resolution**2
    agreement = result.agreement.cells[result.agreement.cells >= 0]
    facts = [
        Fact(f"{fused} of {total}", "maps fused", "good" if fused == total else "bad"),
        Fact(f"{area:.1f} m²", "known in the fused map"),
        Fact(
            str(result.phantom_cells),
            "phantom cells: walls that no input has",
            "bad" if result.phantom_cells else "plain",
        ),
    ]
    if agreement.size:
        unanimous = 100.0 * float(np.mean(agreement == 100))
        facts.append(Fact(f"{unanimous:.1f} %", "of the voted cells are unanimous"))
    facts += [
        Fact(f"{evaluation.error:.2f}", "error of the fused map [F16]")
        for evaluation in evaluations
        if evaluation.name in {result.fused.name, "fused"}
    ]
    facts.append(Fact(f"{result.time_s:.2f} s", f"on {result.device}"))
    return facts


def fused_section(
    result: FusionResult, box: CellBox, paths: Mapping[str, Trajectory] | None = None
) -> Section:
    """Return the fused map, the inputs over each other, and where they agree.

    Args:
        result: what was fused.
        box: cells of the fused lattice to draw.
        paths: see ``fusion_layers``.
    """
    fused, agreement = result.fused, result.agreement
    pictures = [
        Picture(
            "fused",
            plots.map_picture(_classes(fused), fused.resolution, fused.origin, box),
            "Fused map",
            f"{fused.width} x {fused.height} cells of {fused.resolution:g} m, in the frame of "
            f"{result.reference}.",
            tone="good" if len(result.accepted) > 1 else "bad",
        )
    ]
    aligned = [record for record in result.accepted if record.aligned is not None]
    layers = [record.aligned for record in aligned if record.aligned is not None]
    colours = input_colours([record.name for record in result.inputs])
    if layers:
        pictures.append(
            Picture(
                "overlay",
                plots.overlay_picture(
                    layers,
                    [colours[record.name] for record in aligned],
                    fused.resolution,
                    fused.origin,
                    box,
                ),
                "The aligned inputs over each other",
                "Walls in the colour of their map, darker where more have one, black where all "
                "do. A coloured double of a black wall is a slip.",
                legend=layer_legend([record.name for record in aligned], colours),
            )
        )
    pictures.append(
        Picture(
            "agreement",
            plots.agreement_picture(agreement.cells, agreement.resolution, agreement.origin, box),
            "Agreement",
            "Share of votes for the winner of each cell. A block of cells shows its worst.",
            legend=tuple(
                LegendEntry(f"{percent} %", plots.agreement_colour(percent))
                for percent in _agreement_steps(result)
            ),
        )
    )
    return Section("Fused map", "fused", "", pictures, layers=fusion_layers(result, paths))


def group_sections(result: FusionResult) -> list[Section]:
    """Return the fused maps of further groups; empty without any."""
    if not result.others:
        return []
    pictures = []
    for place, other in enumerate(result.others, start=2):
        names = ", ".join(record.name for record in other.accepted)
        fused = other.fused
        pictures.append(
            Picture(
                f"group-{place}",
                plots.map_picture(_classes(fused), fused.resolution, fused.origin),
                f"Group {place}",
                f"{names}; in the frame of {other.reference}.",
            )
        )
    text = "Maps that fit each other, and share no ground with the others or contradict them."
    return [Section("Further groups", "groups", text, pictures)]


def shown_box(result: FusionResult) -> CellBox:
    """Return what any voter knows: one crop for all pictures on the fused lattice."""
    shown = (result.fused.cells != -1) | (result.agreement.cells != -1)
    for record in result.accepted:
        if record.aligned is not None:
            shown = shown | (record.aligned != -1)
    return crop_box(shown)


def _agreement_steps(result: FusionResult) -> list[int]:
    """Return the shares of votes that occur, at most six of them."""
    steps = [int(value) for value in np.unique(result.agreement.cells) if value >= 0]
    if len(steps) <= 6:
        return steps[::-1]
    chosen = np.linspace(0, len(steps) - 1, 6).round().astype(int)
    return [steps[index] for index in chosen][::-1]


def inputs_section(result: FusionResult, config: RunConfig) -> Section:
    """Return every input, and for a rejected one also how it would have lain."""
    normalize = config.fusion.normalize
    grids = {record.name: record.grid for record in result.inputs}
    colours = input_colours(list(grids))
    pictures: list[Picture] = []
    for record in result.inputs:
        role = "Reference." if record.name == result.reference else ""
        if record.copy_of is not None:
            continue
        caption = role if record.accepted else f"Rejected: {record.reason}"
        pictures.append(
            input_picture(record.grid, normalize, caption=caption, accepted=record.accepted)
        )
        alignment = record.alignment
        if not record.accepted and alignment is not None and alignment.reference in grids:
            overlay = pair_overlay(
                grids[alignment.reference], record.grid, alignment, normalize, colours
            )
            if overlay is not None:
                pictures.append(overlay)
    return Section("Inputs", "inputs", "The maps as they were given, each in its frame.", pictures)


def dissent_section(result: FusionResult, box: CellBox) -> Section:
    """Return where each input was outvoted."""
    fused = result.fused
    classes = _classes(fused)
    pictures = []
    for record in result.accepted:
        if record.dissent is None:
            continue
        pictures.append(
            Picture(
                f"outvoted-{record.name}",
                plots.dissent_picture(
                    classes, record.dissent, fused.resolution, fused.origin, box=box
                ),
                record.name,
                f"Outvoted in {_outvoted(record)}.",
                legend=(LegendEntry("outvoted", DISAGREEMENT_RGB),),
            )
        )
    return Section(
        "Where each input was outvoted",
        "outvoted",
        "Cells in which the others decided against this map. Scattered specks are noise; a whole "
        "wall in colour is a place where this map, or all the others, are wrong.",
        pictures,
    )


def _outvoted(record: InputRecord) -> str:
    """Say in how many cells an input was outvoted."""
    if record.dissent is None or record.aligned is None:
        return "no cell"
    cells = int(np.count_nonzero(record.dissent))
    known = record.aligned != -1
    inside = int(np.count_nonzero(known))
    if not inside:
        return f"{cells} cells"
    share = 100.0 * int(np.count_nonzero(record.dissent & known)) / inside
    return f"{cells} cells; {share:.1f} % of those it knows"


def alignment_section(result: FusionResult, *, only_doubtful: bool = False) -> Section:
    """Return transforms, scores over yaw, and the table of all pairs.

    Args:
        result: the fusion.
        only_doubtful: draw the scores over yaw of rejected pairs alone.
    """
    to_reference = [
        record.alignment
        for record in result.inputs
        if record.alignment is not None
        and record.name != result.reference
        and record.copy_of is None
    ]
    shown = {(item.moving, item.reference) for item in to_reference}
    others = [pair for pair in result.pairs if (pair.moving, pair.reference) not in shown]
    tables = [
        *alignment_table(f"Alignment to {result.reference}", to_reference),
        *alignment_table("All other pairs", others, folded=True),
    ]
    drawn = [item for item in (*to_reference, *others) if not (only_doubtful and item.accepted)]
    curves = yaw_pictures(drawn)
    return Section("Alignment", "alignment", _YAW_TEXT if curves else "", curves, tables)


def statistics_section(
    result: FusionResult, config: RunConfig, doubled: Mapping[str, float] | None = None
) -> Section:
    """Return who voted with which weight, whose walls agree, and the maps in numbers.

    Args:
        result: the fusion.
        config: what counts as wall and as free.
        doubled: shares of doubled walls by name, that of the fused map as ``fused map``, where
            they are known already.
    """
    roles = {True: Cell("fused", "good"), False: Cell("rejected", "bad")}
    votes = Table.of(
        "Votes",
        result.inputs,
        {
            "map": lambda own: own.name,
            "": lambda own: roles[own.accepted] if own.copy_of is None else "copy",
            "weight": lambda own: number(result.weights.get(own.name)),
            "walls that agree": lambda own: number(result.wall_agreement.get(own.name)),
            "outvoted in": lambda own: _outvoted(own) if own.accepted else "-",
            "reason": lambda own: own.reason,
        },
    )
    grids = [record.grid for record in result.inputs]
    shown = [*grids, result.fused.with_name("fused map")]
    table = statistics_table(shown, config.fusion.normalize, doubled)
    return Section("Votes and maps in numbers", "numbers", "", tables=[votes, table])


def _classes(grid: OccupancyGrid) -> Classes:
    """Return the classes of a fused grid, whose cells are -1, 0 or 100."""
    return np.sign(grid.cells).astype(np.int8)
