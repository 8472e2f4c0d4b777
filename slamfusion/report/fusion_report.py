"""The parts of the report of a fusion: which maps vote, where they are and where they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from slamfusion.align.records import FusionResult, InputRecord
from slamfusion.config import RunConfig
from slamfusion.errors import counted
from slamfusion.evaluation.map_error import MapError
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.palette import DISAGREEMENT_RGB
from slamfusion.report import maps, page
from slamfusion.report.canvas import Classes, crop_box, draw_places
from slamfusion.report.layers import fusion_layers
from slamfusion.trajectory import Trajectory

# What tables call the map that was fused.
FUSED_MAP = "fused map"


def fusion_banner(result: FusionResult, failure: str | None) -> page.Banner:
    """Say first which maps vote, and loudest which do not."""
    accepted = ", ".join(record.name for record in result.accepted)
    fused = ("Fused:", f"{accepted or 'none'}; in the frame of {result.reference}.")
    lines = [*result.remarks, fused]
    if failure is not None:
        return page.Banner("bad", "Do not use this map", [("", failure), *lines])
    tone = "warn" if result.rejected or result.doubtful else "good"
    return page.Banner(tone, how_many_fused(result), lines)


def how_many_fused(result: FusionResult, failed: int = 0) -> str:
    """Say how many maps, without copies, were fused; ``failed`` were not made."""
    total, fused = len(result.inputs) - len(result.copies) + failed, len(result.accepted)
    every = "Both" if total == 2 else f"All {total}"
    return f"{every if fused == total else f'Only {fused} of {total}'} maps were fused"


def fusion_facts(result: FusionResult, failed: int = 0) -> list[page.Fact]:
    """Return how many maps, without copies, were fused of all and of the failed ones."""
    total, fused = len(result.inputs) - len(result.copies) + failed, len(result.accepted)
    area = float(np.count_nonzero(result.fused.cells != -1)) * result.fused.resolution**2
    agreement = result.agreement.cells[result.agreement.cells >= 0]
    facts = [
        page.Fact(f"{fused} of {total}", "maps fused", "good" if fused == total else "bad"),
        page.Fact(f"{area:.0f} m²", "known in the fused map"),
    ]
    if agreement.size:
        unanimous = 100.0 * float(np.mean(agreement == 100))
        facts.append(page.Fact(f"{unanimous:.0f} %", "of the voted cells are unanimous"))
    return facts


def saved_maps_facts(result: FusionResult, evaluations: Sequence[MapError]) -> list[page.Fact]:
    """Return the numbers at the top of the report of a fusion of saved maps."""
    facts = fusion_facts(result)
    facts += [
        page.Fact(f"{evaluation.error:.2f}", "error of the fused map [F16]")
        for evaluation in evaluations
        if evaluation.name in {result.fused.name, "fused"}
    ]
    phantoms = "phantom cells: walls that no input has"
    tone = "bad" if result.phantom_cells else "plain"
    facts.append(page.Fact(str(result.phantom_cells), phantoms, tone))
    facts.append(page.Fact(f"{result.time_s:.2f} s", f"on {result.device}"))
    return facts


def fused_section(
    result: FusionResult,
    paths: Mapping[str, Trajectory] | None = None,
    places: Sequence[tuple[float, float]] = (),
) -> page.Section:
    """Return the fused map with numbered places, the overlay of the inputs, and their agreement."""
    fused, box = result.fused, _shown_box(result)
    drawn = maps.map_picture(_classes(fused), fused.resolution, fused.origin, box)
    draw_places(drawn, places)
    size = f"{fused.width} x {fused.height} cells of {fused.resolution:g} m"
    caption = f"{size}, in the frame of {result.reference}."
    tone = "good" if len(result.accepted) > 1 else "bad"
    pictures = [page.Picture("fused", drawn, "Fused map", caption, tone, legend=maps.MAP_LEGEND)]
    layers = {own.name: own.aligned for own in result.accepted if own.aligned is not None}
    if layers:
        colours = maps.input_colours([record.name for record in result.inputs])
        legend = {name: colours[name] for name in layers}
        overlay = maps.overlay_picture(
            list(layers.values()), list(legend.values()), fused.resolution, fused.origin, box
        )
        title = "The aligned inputs over each other"
        caption = (
            "A wall has the colour of its map; it is darker where more maps have it, and black "
            "where all do. A coloured copy next to a black wall shows a slip."
        )
        pictures.append(page.Picture("overlay", overlay, title, caption, legend=legend))
    shares = maps.agreement_picture(result.agreement, box)
    caption = "Share of votes for the winner of each cell. A block of cells shows its worst."
    legend = {f"{share} %": maps.agreement_colour(share) for share in (100, 75, 50, 25)}
    pictures.append(page.Picture("agreement", shares, "Agreement", caption, legend=legend))
    return page.Section("Fused map", "", pictures, layers=fusion_layers(result, paths, places))


def group_sections(result: FusionResult) -> list[page.Section]:
    """Return the fused maps of further groups; empty without any."""
    if not result.others:
        return []
    pictures = []
    for place, other in enumerate(result.others, start=2):
        names = ", ".join(record.name for record in other.accepted)
        fused = other.fused
        pictures.append(
            page.Picture(
                f"group-{place}",
                maps.map_picture(_classes(fused), fused.resolution, fused.origin),
                f"Group {place}",
                f"{names}; in the frame of {other.reference}.",
            )
        )
    text = "Maps that fit each other, and share no ground with the others or contradict them."
    return [page.Section("Further groups", text, pictures)]


def _shown_box(result: FusionResult) -> CellBox:
    """Return what any voter knows: one crop for all pictures on the fused lattice."""
    shown = np.maximum(result.fused.cells, result.agreement.cells)
    for record in result.accepted:
        if record.aligned is not None:
            shown = np.maximum(shown, record.aligned)
    return crop_box(shown)


def inputs_section(result: FusionResult, config: RunConfig) -> page.Section:
    """Return every input: one that votes aligned, a rejected one also at its best alignment."""
    normalize, fused = config.fusion.normalize, result.fused
    grids = {record.name: record.grid.classified(normalize) for record in result.inputs}
    colours, box = maps.input_colours(list(grids)), _shown_box(result)
    pictures: list[page.Picture | None] = []
    for record in result.inputs:
        alignment = record.alignment
        if record.copy_of is not None:
            continue
        if record.aligned is not None:
            drawn = maps.map_picture(
                record.aligned, fused.resolution, fused.origin, box, record.dissent
            )
            role = "Reference. " if record.name == result.reference else ""
            caption = f"{role}Outvoted in {_outvoted(record)}."
            legend = {**maps.MAP_LEGEND, "outvoted": DISAGREEMENT_RGB}
            stem, title = f"input-{record.name}", f"{record.name}, aligned"
            pictures.append(page.Picture(stem, drawn, title, caption, legend=legend))
            continue
        rejected = None if record.accepted else record.reason
        pictures.append(maps.input_picture(grids[record.name], rejected))
        if not record.accepted and alignment is not None and alignment.reference in grids:
            pair = grids[alignment.reference], grids[record.name]
            pictures.append(maps.pair_overlay(*pair, alignment, colours))
    text = (
        "The inputs that vote, aligned with the fused map; a rejected one is in its own frame. "
        "Scattered outvoted cells are noise; at a whole outvoted wall this map or all others are "
        "wrong."
    )
    return page.Section("Inputs", text, [picture for picture in pictures if picture is not None])


def _outvoted(record: InputRecord) -> str:
    """Say in how many cells an input was outvoted."""
    if record.dissent is None or record.aligned is None:
        return "no cell"
    cells = int(np.count_nonzero(record.dissent))
    known = record.aligned != -1
    inside = int(np.count_nonzero(known))
    if not inside:
        return counted(cells, "cell")
    share = 100.0 * int(np.count_nonzero(record.dissent & known)) / inside
    return f"{counted(cells, 'cell')}; {share:.1f} % of those it knows"


def alignment_section(result: FusionResult) -> page.Section:
    """Return transforms, the table of all pairs, and the scores over yaw of rejected ones."""
    to_reference = [
        record.alignment
        for record in result.inputs
        if record.alignment is not None
        and record.name != result.reference
        and record.copy_of is None
    ]
    shown = {(item.moving, item.reference) for item in to_reference}
    others = [pair for pair in result.pairs if (pair.moving, pair.reference) not in shown]
    table = page.tables().alignments
    found = table(f"Alignment to {result.reference}", to_reference)
    found += table("All other pairs", others, True)
    curves = maps.yaw_pictures([item for item in (*to_reference, *others) if not item.accepted])
    return page.Section("Alignment", maps.YAW_TEXT if curves else "", curves, found)


def statistics_section(
    result: FusionResult, config: RunConfig, doubled: Mapping[str, float] | None = None
) -> page.Section:
    """Return the weights of the voters, the agreement of walls, and the maps in numbers.

    Args:
        doubled: known shares of doubled walls by name; the fused map's is ``FUSED_MAP``.
    """
    grids = [*(record.grid for record in result.inputs), result.fused.with_name(FUSED_MAP)]
    found = page.tables().votes(result, _outvoted)
    classified = [grid.classified(config.fusion.normalize) for grid in grids]
    found += maps.map_statistics(classified, doubled or {})
    return page.Section("Votes and maps in numbers", tables=found)


def _classes(grid: OccupancyGrid) -> Classes:
    """Return the classes of a fused grid, whose cells are -1, 0 or 100."""
    return np.sign(grid.cells).astype(np.int8)
