"""How well the scans support each path of a drive: when each was off, and in numbers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evidence.parting import PART_M, path_gap_m
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.palette import DISAGREEMENT_RGB, NAMED, Rgb, colours_of
from slamfusion.report.canvas import (
    INK,
    PLACE_LOOK,
    label_axes,
    plain_text,
    stacked_axes,
    unit_rgb,
    write_note,
)
from slamfusion.report.page import Picture, Section, tables

# Gaps below this are drawn here: a logarithmic axis has no zero.
_LEAST_GAP_M = 0.01


def evidence_section(
    answer: Recommendation, evidence: PathEvidence, page: Mapping[str, Rgb] | None = None
) -> Section:
    """Return the reasons of a recommendation, in the colours that the page gives the paths."""
    colours = path_colours(answer, evidence, page or {})
    picture = Picture(
        "evidence",
        evidence_picture(answer, evidence, colours),
        "How well each path predicts the scans, over the drive",
        "Above: mean log-likelihood of a hit under what other parts of the drive drew by the same "
        "path; higher is better. Below: distance from the recommended path, after each path is "
        "aligned with it where they agree most. Tinted: a path has left the recommended one.",
        legend=colours,
    )
    return Section("Why this path", answer.headline + ".", [picture], tables().scores(answer.paths))


def place_lines(answer: Recommendation) -> list[tuple[str, str]]:
    """Return what stands below the headline: the places to check by number, as on the maps."""
    lines = [line for line in answer.lines() if line[0] != "Check:"]
    return lines + [
        (f"Place {number}:", f"near ({place.x:.1f}, {place.y:.1f}) m: {place.what}")
        for number, place in enumerate(answer.check, start=1)
    ]


def strip_picture(answer: Recommendation, colours: Mapping[str, Rgb]) -> Picture:
    """Draw who was off when: a bar for each path, and the places to check across them."""
    names = [path.name for path in answer.paths]
    figure, (axes,) = stacked_axes(1, 0.16 + 0.2 * len(names))
    for row, path in enumerate(answer.paths):
        for span in path.spans:
            colour = colours[path.name] if span.agrees else DISAGREEMENT_RGB
            extent = [(span.from_s, span.to_s - span.from_s)]
            axes.broken_barh(extent, (row - 0.3, 0.6), facecolor=unit_rgb(colour))
    for nth, place in enumerate(answer.check, start=1):
        axes.axvspan(place.from_s, place.to_s, color=INK, alpha=0.2, lw=0)
        middle_s = 0.5 * (place.from_s + place.to_s)
        axes.annotate(str(nth), (middle_s, -0.62), annotation_clip=False, **PLACE_LOOK)
    axes.set_ylim(len(names) - 0.5, -0.62)
    axes.set_yticks(range(len(names)), [plain_text(name)[:10] for name in names])
    axes.margins(x=0.0)
    label_axes(axes, x="time since the start [s]")
    legend = {f"{PART_M:g} m or more from the recommended path": DISAGREEMENT_RGB}
    caption = "Numbers and grey bands: the places to check."
    return Picture("who-was-off", figure, "Who was off when", caption, legend=legend)


def evidence_picture(
    answer: Recommendation, evidence: PathEvidence, rgb: Mapping[str, Rgb]
) -> Figure:
    """Draw the score of each path over the drive, and below how far it is from the recommended."""
    best, *others = answer.paths
    figure, axes = stacked_axes(2, (1.6, 1.0)) if others else stacked_axes(1, 1.6)
    start_s = float(evidence.scans.stamps_s[0])
    colours = {name: unit_rgb(colour) for name, colour in rgb.items()}
    for name, colour in colours.items():
        times_s, mean, _, _ = evidence.over_time(name)
        axes[0].plot(times_s - start_s, mean, color=colour, lw=1.1, marker="o", ms=2.0)
    label_axes(axes[0], "log-likelihood of a hit")
    if others:
        last = axes[1]
        since_s = evidence.scans.stamps_s[evidence.is_judged] - start_s
        for path in others:
            gap_m = np.maximum(path_gap_m(evidence, path.name, best.name), _LEAST_GAP_M)
            last.plot(since_s, gap_m, color=colours[path.name], lw=0.9)
        last.axhline(PART_M, color=INK, lw=0.8, ls=":")
        write_note(last, f"dotted: parted, {PART_M:g} m")
        last.set_yscale("log")
        last.tick_params(which="minor", colors=INK, width=0.5, length=2)
        label_axes(last, "distance from the recommended path", y="[m]")
    label_axes(axes[-1], x="time since the start [s]")
    return figure


def path_colours(
    answer: Recommendation, evidence: PathEvidence, page: Mapping[str, Rgb]
) -> dict[str, Rgb]:
    """Return the colour of each path, as elsewhere on the page."""
    colours = {**colours_of(evidence.scores), **page}
    is_fused = any(path.from_fused_m is not None for path in answer.paths)
    fused = answer.paths[0].name if is_fused else None
    return {name: NAMED["fused"] if name == fused else colours[name] for name in evidence.scores}
