"""Tables that several commands print: fusions, errors of maps and paths, recommendations."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from slamfusion import evaluation, jobs
from slamfusion.cli.output import Table, is_verbose, say, wrapped
from slamfusion.errors import counted
from slamfusion.jobs.records import number

if TYPE_CHECKING:
    from slamfusion.align.records import Alignment, Fusion, InputRecord
    from slamfusion.evidence.recommendation import Recommendation
    from slamfusion.trajectory import Trajectory

PAIR_COLUMNS = (
    "reference ",
    "input ",
    "accepted ",
    "dx [m]",
    "dy [m]",
    "yaw [deg]",
    "score",
    "overlap",
    "runner-up ratio",
)


def print_fusion(
    result: Fusion, doubled: jobs.fuse_documents.DoubledWalls | None, wanted: str | None
) -> None:
    """Print the pose of each input, their number and the frame; verbose: reasons and starts."""
    Table(
        PAIR_COLUMNS[1:],
        [_row(record, result.reference) for record in result.inputs],
        notes=[
            "" if record.accepted and not is_verbose() else record.reason
            for record in result.inputs
        ],
        title=f"Alignment to {result.reference}" + (f", on {result.device}" * is_verbose()),
    ).print()
    fused, added = jobs.fuse_documents.fusion_sentences(result, doubled, wanted)
    say(fused)
    if not is_verbose():
        return
    say(added)
    for group in (result, *result.others):
        print(f"poses of the inputs in the frame of {group.reference}, as starts:")
        print("   " + "".join(f" {_start_words(pair)}" for pair in _alignments(group)))
        print("and as transforms:")
        for pair in _alignments(group):
            if pair.moving != pair.reference:
                print(f"    {_transform_words(pair)}")


def _alignments(result: Fusion) -> list[Alignment]:
    found = [record.alignment for record in result.accepted]
    return [pair for pair in found if pair is not None]


def _start_words(pair: Alignment) -> str:
    """Return the option ``--start`` that expects a map where it was found."""
    motion = pair.transform
    x, y, yaw = number(motion.x), number(motion.y), number(math.degrees(motion.yaw_rad), 2)
    return shlex.join(["--start", f"{pair.moving}={x},{y},{yaw}deg"])


def _transform_words(pair: Alignment) -> str:
    motion = pair.transform
    return shlex.join(
        [
            *("ros2", "run", "tf2_ros", "static_transform_publisher"),
            *("--x", f"{motion.x:.4f}", "--y", f"{motion.y:.4f}"),
            *("--yaw", f"{motion.yaw_rad:.6f}"),
            *("--frame-id", pair.reference, "--child-frame-id", pair.moving),
        ]
    )


def print_pairs(pairs: Sequence[Alignment], device: str) -> None:
    """Print the pairs of maps of which nothing was fused."""
    Table(
        PAIR_COLUMNS,
        [[pair.reference, *_cells(pair, _accepted(pair))] for pair in pairs],
        notes=[pair.reason for pair in pairs],
        title=f"Nothing was fused (on {device})",
    ).print()


def _accepted(found: Alignment) -> str:
    """Return whether an alignment is accepted, and if so how good it is, where that is known."""
    return found.strength or ("yes" if found.accepted else "NO")


def _row(record: InputRecord, reference: str) -> list[str]:
    accepted = "yes" if record.accepted else "NO"
    if record.accepted and record.alignment is not None:
        accepted = _accepted(record.alignment)
    if record.name == reference:
        accepted = "reference"
    if record.copy_of is not None:
        accepted = "copy"
    if record.alignment is None:
        return [record.name, accepted, *["-"] * (len(PAIR_COLUMNS) - 3)]
    return [record.name, *_cells(record.alignment, accepted)[1:]]


def _cells(found: Alignment, accepted: str) -> list[str]:
    return [
        found.moving,
        accepted,
        number(found.transform.x),
        number(found.transform.y),
        number(math.degrees(found.transform.yaw_rad), 2),
        number(found.score),
        number(found.overlap),
        number(None if found.runner_up is None else found.runner_up.ratio, 2),
    ]


def print_evaluations(evaluations: Sequence[jobs.fuse_documents.Evaluation]) -> None:
    """Print the errors of each map; ``--verbose`` adds figures that do not reward thick walls."""
    first = evaluations[0]
    print_figures(
        ("map ", "aligned "),
        [
            (item.name, "as is" if item.alignment is None else "yes" if item.aligned else "NO")
            for item in evaluations
        ],
        list(map(evaluation.measured.shown_figures, evaluations)),
        f"Errors against {first.truth} (walls within {first.tolerance_m:g} m)",
    )
    for item in evaluations:
        if item.mapped is not None and item.aligned:
            print(
                f"{item.name} has seen {item.mapped:.0%} of the walls of {item.truth}, at "
                f"{item.resolution:.4g} m per pixel"
            )
    if is_verbose():
        print_figures(
            ("map ",),
            [(item.name,) for item in evaluations],
            list(map(evaluation.measured.face_figures, evaluations)),
            "Faces of walls: wall cells next to free cells, so that thick walls gain nothing",
        )


def print_figures(
    heads: Sequence[str],
    names: Sequence[Sequence[str]],
    figures: Sequence[Sequence[tuple[evaluation.measured.Figure, float | None]]],
    title: str,
) -> None:
    """Print a row of figures for each map or path, after its names under their heads."""
    columns = (*heads, *(figure.label for figure, _ in figures[0]))
    rows = [
        [*name, *(number(value, figure.digits) for figure, value in own)]
        for name, own in zip(names, figures, strict=True)
    ]
    Table(columns, rows, title=title, names=len(heads)).print()


def print_measures(estimate: Trajectory, measures: evaluation.measured.Measures) -> None:
    """Print one row for each kind of error, then how it was counted."""
    figures = evaluation.measured.FIGURES
    rows = [
        [f"{kind}{which}", *(number(getattr(errors, name, None), digits) for name in figures)]
        for own, which in ((measures, ""), (measures.as_first_reported, ", as first reported"))
        if own is not None
        for kind, errors, digits in own.kinds()
    ]
    title = f"{estimate.name}: {counted(len(estimate), 'pose')}, {estimate.path_length_m():.1f} m"
    Table(("error ", *figures), rows, title=title).print()
    for note in measures.how_counted():
        say(note)


def print_recommendation(answer: Recommendation) -> None:
    """Print what to use and what to check; green, amber or red on a terminal."""
    colour = {"good": "green", "warn": "yellow", "bad": "red"}.get(answer.tone)
    click.secho(wrapped(f"{answer.headline}.", sys.stdout), fg=colour, bold=True)
    for subject, text in answer.lines():
        say(f"{subject:<13}{text}", indent=13)


def path_table(answer: Recommendation) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of how well the scans support each path."""
    columns = ["path ", "log-likelihood per hit, mean", "behind the recommended path"]
    columns += ["95 % interval", "apart from it [s]", "at most [m]"]
    rows = []
    for path in answer.paths:
        interval = path.behind_95
        apart = [span for span in path.spans if not span.agrees]
        rows.append([
            path.name,
            number(path.consistency, 4),
            number(None if interval is None else path.behind, 4),
            "-" if interval is None else f"{interval[0]:.4f} to {interval[1]:.4f}",
            number(sum(span.to_s - span.from_s for span in apart), 0),
            number(max((span.gap_m for span in apart), default=None), 2),
        ])  # fmt: skip
    if answer.is_of_fused:
        columns.append("from fused, rms [m]")
        for row, path in zip(rows, answer.paths, strict=True):
            row.append(number(path.from_fused_m, 3))
    return columns, rows
