"""The report of maps against a truth, and the difference image alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from slamfusion.align.records import Alignment
from slamfusion.config import PICTURE_FORMS, RunConfig
from slamfusion.errors import MapFileError
from slamfusion.evaluation import MapError
from slamfusion.io.files import AtomicFiles, write_atomic
from slamfusion.report.canvas import to_form
from slamfusion.report.layers import error_layers
from slamfusion.report.maps import alignment_table, difference_picture, error_section, yaw_pictures
from slamfusion.report.page import Banner, Fact, Page, Section, write_page


def write_evaluation_report(
    evaluations: Sequence[MapError],
    directory: str | Path,
    *,
    config: RunConfig,
    alignments: Sequence[Alignment | None] = (),
    device: str = "",
    files: AtomicFiles | None = None,
) -> Path:
    """Write how maps differ from a truth as one self-contained page with its pictures.

    Args:
        evaluations: at least one map, all against one truth.
        directory, files: see ``write_page``, also for what is returned and raised.
        alignments: the alignment with the truth that each evaluation rests on, in the same order,
            None if the map was not moved; a rejected one is named at the top.

    Raises:
        ValueError: there is no evaluation.
    """
    if not evaluations:
        raise ValueError("an evaluation report needs at least one evaluated map")
    section = error_section(evaluations, alignments)
    sections = [replace(section, layers=error_layers(evaluations))]
    searched = [alignment for alignment in alignments if alignment is not None]
    if searched:
        tables = alignment_table("Alignment to the truth", searched)
        sections.append(Section("Alignment", "", yaw_pictures(searched), tables))
    lost = [
        (f"{alignment.moving} could not be aligned:", alignment.reason)
        for alignment in searched
        if not alignment.accepted
    ]
    best, truth = min(evaluations, key=lambda item: item.error), evaluations[0].truth
    is_one = len(evaluations) == 1
    headline = f"{best.name} against {truth}" if is_one else f"{best.name} is nearest to {truth}"
    facts = [
        Fact(
            f"{item.error:.2f}",
            f"error of {item.name} [F16]",
            "good" if item.error == best.error and not is_one else "plain",
        )
        for item in evaluations
    ]
    banner = Banner("warn" if lost else "good", headline, lost)
    page = Page("SLAMfusion evaluation", banner, facts, sections, config, device)
    return write_page(page, directory, files)


def write_difference_image(
    evaluation: MapError, path: str | Path, files: AtomicFiles | None = None
) -> None:
    """Write the difference to the truth as one picture, in the colours of the report.

    Args:
        path: of the picture; its suffix says the form.

    Raises:
        MapFileError: the file is not called ``.png``, ``.svg`` or ``.pdf``, or cannot be written.
    """
    path = Path(path)
    form = path.suffix.lower().removeprefix(".")
    if form not in PICTURE_FORMS:
        raise MapFileError(f"{path}: wanted a name that ends in .{', .'.join(PICTURE_FORMS)}")
    picture = difference_picture(evaluation, None)
    write_atomic(path, to_form(picture.figure, form), files=files)
