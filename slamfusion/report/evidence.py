"""What the scans say of the paths on the page of the main job: over the drive, and in numbers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evidence.parting import PART_M, path_gap_m
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import RankedPath, Recommendation
from slamfusion.palette import NAMED, Rgb, colours_of
from slamfusion.report.canvas import DPI, INK, WIDTH_IN, style_axes, to_png, unit_rgb, write_note
from slamfusion.report.page import Cell, LegendEntry, Picture, Section, Table, number

# Heights of the two pairs of axes, and of what stands above and below each.
_SCORE_IN, _GAP_IN, _HEAD_IN, _FOOT_IN = 1.6, 1.0, 0.3, 0.4
# Where paths have parted, the background of the scores is tinted.
_APART_OPACITY = 0.12
# Gaps below this are drawn here: a logarithmic axis has no zero.
_LEAST_GAP_M = 0.01


def evidence_section(
    answer: Recommendation, evidence: PathEvidence, page: Mapping[str, Rgb] | None = None
) -> Section:
    """Return the reasons of a recommendation: each path's score over the drive, and its figures.

    Args:
        answer: of one path or more.
        evidence: that it rests on.
        page: the colours of the paths elsewhere on the page, by name; default: there are none.
    """
    colours = _colours(answer, evidence, page or {})
    picture = Picture(
        "evidence",
        evidence_picture(answer, evidence, colours),
        "How well each path predicts what the scans saw, over the drive",
        "Above: mean log-likelihood of a hit under what other parts of the drive drew by the same "
        "path; higher is better. Below: distance from the recommended path, after each path is "
        "aligned with it where they agree most. Tinted: a path has left the recommended one.",
        legend=tuple(LegendEntry(name, colour) for name, colour in colours.items()),
    )
    note = (
        "Each hit is looked up in the map that all other parts of the drive draw by the path that "
        "is scored; what they have not seen has a fixed price. All paths are scored on the same "
        "hits, and compared by drawing parts of the drive anew. No truth is used: a fault that "
        "all paths share, or a bend that is never seen twice, does not show."
    )
    table = Table.of(
        "The scores",
        answer.paths,
        {
            "path": lambda own: Cell(own.name, "best" if own.behind_95 is None else "plain"),
            "log-likelihood of a hit": lambda own: number(own.consistency, 4),
            "behind the recommended path": lambda own: number(own.behind_95 and own.behind, 4),
            "95 %": lambda own: Cell(
                "{:.4f} to {:.4f}".format(*own.behind_95) if own.behind_95 else "-", is_number=True
            ),
            "p": lambda own: number(own.p_value),
            "hits judged": lambda own: own.beams_judged,
            "seen again %": lambda own: number(100.0 * own.seen_share, 0),
            "own poses %": lambda own: number(100.0 * own.own_poses_share, 0),
            "from the fused path m": lambda own: number(own.from_fused_m, 3),
            "where it left the recommended path": _partings,
        },
        note,
        folded=True,
    )
    return Section("Why this path", "evidence", answer.headline + ".", [picture], [table])


def evidence_picture(
    answer: Recommendation, evidence: PathEvidence, rgb: Mapping[str, Rgb]
) -> bytes:
    """Draw the score of each path over the drive, and below how far it is from the recommended.

    Args:
        answer: of one path or more.
        evidence: that it rests on.
        rgb: the colour of each path, by name.

    Returns:
        The bytes of a PNG file.
    """
    best, *others = answer.paths
    gap_in = _HEAD_IN + _GAP_IN if others else 0.0
    tall_in = _HEAD_IN + _SCORE_IN + gap_in + _FOOT_IN
    figure = Figure(figsize=(WIDTH_IN, tall_in), dpi=DPI)
    scores = figure.add_axes((0.155, (_FOOT_IN + gap_in) / tall_in, 0.825, _SCORE_IN / tall_in))
    start_s = float(evidence.scans.stamps_s[0])
    colours = {name: unit_rgb(colour) for name, colour in rgb.items()}
    for name, colour in colours.items():
        times_s, mean, _ = evidence.over_time(name)
        scores.plot(times_s - start_s, mean, color=colour, lw=1.1, marker="o", ms=2.0)
    for path in others:
        for span in path.spans:
            if not span.agrees:
                scores.axvspan(
                    span.from_s, span.to_s, color=colours[path.name], alpha=_APART_OPACITY, lw=0
                )
    scores.set_title("log-likelihood of a hit", loc="left", color=INK, fontsize=7.5, pad=3)
    style_axes(scores)
    last = scores
    if others:
        last = figure.add_axes((0.155, _FOOT_IN / tall_in, 0.825, _GAP_IN / tall_in), sharex=scores)
        since_s = evidence.scans.stamps_s[evidence.is_judged] - start_s
        for path in others:
            gap_m = np.maximum(path_gap_m(evidence, path.name, best.name), _LEAST_GAP_M)
            last.plot(since_s, gap_m, color=colours[path.name], lw=0.9)
        last.axhline(PART_M, color=INK, lw=0.8, ls=":")
        write_note(last, f"parted from {PART_M:g} m on")
        style_axes(last)
        last.set_yscale("log")
        last.tick_params(which="minor", colors=INK, width=0.5, length=2)
        last.set_title("from the recommended path", loc="left", color=INK, fontsize=7.5, pad=3)
        last.set_ylabel("m", color=INK, fontsize=7.5)
        scores.tick_params(labelbottom=False)
    last.set_xlabel("seconds since the start", color=INK, fontsize=7.5)
    return to_png(figure)


def _colours(
    answer: Recommendation, evidence: PathEvidence, page: Mapping[str, Rgb]
) -> dict[str, Rgb]:
    """Return the colour of each path, as elsewhere on the page."""
    colours = {**colours_of(evidence.scores), **page}
    is_fused = any(path.from_fused_m is not None for path in answer.paths)
    fused = answer.paths[0].name if is_fused else None
    return {name: NAMED["fused"] if name == fused else colours[name] for name in evidence.scores}


def _partings(path: RankedPath) -> str:
    """Return where a path has left the recommended one, and how far."""
    where = "; ".join(
        f"{span.from_s:.0f} to {span.to_s:.0f} s by {span.gap_m:.2f} m"
        for span in path.spans
        if not span.agrees
    )
    return where or "nowhere"
