"""What the scans say of the paths on the page of the main job: over the drive, and in words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evidence.parting import PART_M, path_gap_m
from slamfusion.evidence.verdict import PathVerdict, Verdict
from slamfusion.palette import NAMED, Rgb, colours_of
from slamfusion.report.canvas import DPI, INK, WIDTH_IN, style_axes, to_png, unit_rgb, write_note
from slamfusion.report.page import Cell, LegendEntry, Picture, Section, Table, number

__all__ = ["evidence_picture", "evidence_section"]

# Heights of the two pairs of axes, and of what stands above and below each.
_SCORE_IN, _GAP_IN, _HEAD_IN, _FOOT_IN = 1.6, 1.0, 0.3, 0.4
# Where paths have parted, the background of the scores is tinted.
_APART_OPACITY = 0.12
# Gaps below this are drawn here: a logarithmic axis has no zero.
_LEAST_GAP_M = 0.01


def evidence_section(verdict: Verdict, page: Mapping[str, Rgb] | None = None) -> Section:
    """Return the verdict, the score of each path over the drive, and its figures.

    Args:
        verdict: of one path or more.
        page: the colours of the paths elsewhere on the page, by name; default: there are none.
    """
    colours = _colours(verdict, page or {})
    picture = Picture(
        "evidence",
        evidence_picture(verdict, colours),
        "How well each path predicts what the scans saw, over the drive",
        "Above: mean log-likelihood of a hit under what other parts of the drive drew by the same "
        "path; higher is better. Below: distance from the best path, on which the others are laid "
        "where they agree most. Tinted: a path has left the best one.",
        legend=tuple(LegendEntry(name, colour) for name, colour in colours.items()),
    )
    columns = (
        *("path", "log-likelihood of a hit", "behind the best", "95 %", "p", "tied with the best"),
        *("hits judged", "seen again %", "own poses %", "from the fused path m"),
        "where it left the best path",
    )
    rows = [_row(verdict, path) for path in verdict.paths]
    note = (
        "Each hit is looked up in the map that all other parts of the drive draw by the path that "
        "is scored; what they have not seen has a fixed price. All paths are scored on the same "
        "hits, and compared by drawing parts of the drive anew. No truth is used: a fault that "
        "all paths share, or a bend that is never seen twice, does not show."
    )
    table = Table("The evidence", columns, rows, note)
    return Section(
        "Which path the scans bear out", "evidence", verdict.sentence, [picture], [table]
    )


def evidence_picture(verdict: Verdict, rgb: Mapping[str, Rgb]) -> bytes:
    """Draw the score of each path over the drive, and below it how far it is from the best.

    Args:
        verdict: of one path or more.
        rgb: the colour of each path, by name.

    Returns:
        The bytes of a PNG file.
    """
    evidence = verdict.evidence
    others = [path for path in verdict.paths if path.name != verdict.best]
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
            gap_m = np.maximum(path_gap_m(evidence, path.name, verdict.best), _LEAST_GAP_M)
            last.plot(since_s, gap_m, color=colours[path.name], lw=0.9)
        last.axhline(PART_M, color=INK, lw=0.8, ls=":")
        write_note(last, f"parted from {PART_M:g} m on")
        style_axes(last)
        last.set_yscale("log")
        last.tick_params(which="minor", colors=INK, width=0.5, length=2)
        last.set_title("from the best path", loc="left", color=INK, fontsize=7.5, pad=3)
        last.set_ylabel("m", color=INK, fontsize=7.5)
        scores.tick_params(labelbottom=False)
    last.set_xlabel("seconds since the start", color=INK, fontsize=7.5)
    return to_png(figure)


def _colours(verdict: Verdict, page: Mapping[str, Rgb]) -> dict[str, Rgb]:
    """Return the colour of each path, as elsewhere on the page."""
    names = verdict.evidence.scores
    colours = {**colours_of(names), **page}
    return {name: NAMED["fused"] if name == verdict.fused else colours[name] for name in names}


def _row(verdict: Verdict, path: PathVerdict) -> list[Cell]:
    """Return the figures of a path."""
    score, against = verdict.evidence.scores[path.name], path.against_best
    apart = [span for span in path.spans if not span.agrees]
    where = "; ".join(
        f"{span.from_s:.0f} to {span.to_s:.0f} s by {span.gap_m:.2f} m (the scans: {span.verdict})"
        for span in apart
    )
    interval = "-" if against is None else f"{against.low:.4f} to {against.high:.4f}"
    return [
        Cell(path.name),
        number(path.consistency, 4),
        number(None if against is None else against.difference, 4),
        Cell(interval, is_number=True),
        number(None if against is None else against.p_value),
        Cell("yes" if path.tied else "no", "good" if path.tied else "bad"),
        Cell(str(score.beams_judged), is_number=True),
        number(100.0 * score.seen_share, 0),
        number(100.0 * score.path.own_share, 0),
        number(verdict.from_fused_m(path.name), 3),
        Cell(where or "nowhere"),
    ]
