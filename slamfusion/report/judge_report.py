"""The report on which of several paths the scans of a log support, without a fusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.io.files import AtomicFiles
from slamfusion.report.evidence import evidence_section, path_colours, place_lines, strip_picture
from slamfusion.report.page import Banner, Cell, Fact, Page, Section, Table, number, write_page


def write_judge_report(
    answer: Recommendation,
    evidence: PathEvidence,
    directory: str | Path,
    *,
    log: str,
    config: RunConfig,
    errors_m: Mapping[str, Mapping[str, float]] | None = None,
    not_measured: Sequence[str] = (),
    device: str = "",
    files: AtomicFiles | None = None,
) -> Path:
    """Write which path to use as one self-contained page with its pictures.

    Args:
        directory, files: see ``write_page``, also for what is returned and raised.
        errors_m: by what they are (ATE, relations), the errors of the paths by name, metres; a path
            that could not be measured is missing.
        not_measured: what could not be measured, a sentence each.
    """
    strip = strip_picture(answer, path_colours(answer, evidence, {}))
    sections = [Section("Over the drive", "", [strip]), evidence_section(answer, evidence)]
    known = {name: errors for name, errors in (errors_m or {}).items() if errors}
    if known:
        sections.append(_errors_section(answer, known))
    lines = place_lines(answer)
    lines += [("Not measured:", sentence) for sentence in not_measured]
    banner = Banner(answer.tone, answer.headline, [*lines, ("Log:", log)])
    facts = [
        Fact(
            f"{path.consistency:.3f}",
            f"log-likelihood of a hit, {path.name}",
            "good" if path.behind_95 is None else "plain",
        )
        for path in answer.paths
    ]
    page = Page("SLAMfusion judge", banner, facts, sections, config, device)
    return write_page(page, directory, files)


def _errors_section(answer: Recommendation, errors_m: Mapping[str, Mapping[str, float]]) -> Section:
    """Return the errors of the paths, in the order that the scans put them in."""
    ranks = {name: sorted(errors, key=errors.__getitem__) for name, errors in errors_m.items()}
    columns = ["path", *(word for name in errors_m for word in (f"{name} [m]", "rank"))]
    rows = []
    for path in answer.paths:
        row = [Cell(path.name)]
        for name, errors in errors_m.items():
            row.append(number(errors.get(path.name), 4))
            rank = ranks[name].index(path.name) + 1 if path.name in errors else None
            row.append(number(rank, 0))
        rows.append(row)
    table = Table("Errors of the paths", columns, rows, "The recommended path first.")
    what = "The order by the scans next to the errors against the truth or known relations."
    return Section("Compared with what is known", what, tables=[table])
