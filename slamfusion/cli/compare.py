"""``slamfusion compare``: saved results against each other, with p-values."""

from __future__ import annotations

from pathlib import Path

import click

from slamfusion import evaluation, jobs
from slamfusion.cli import options
from slamfusion.cli.help import Command
from slamfusion.cli.output import NOTHING, Table, notice, print_facts, print_if_json
from slamfusion.cli.paths import FILE
from slamfusion.cli.results import print_by_case, table_option
from slamfusion.config import PICTURE_FORMS
from slamfusion.jobs.records import number, p_text

# Of a table: figures of several sizes.
DIGITS = 4
# Figures that have a table by case, where there are several seeds.
LEADING = ("error", "wall_f1", "ate_rmse_m", "relations_mean_m", "consistency")


@click.command(
    "compare",
    cls=Command,
    examples=["compare graph.zip gmapping.zip", "compare all.zip --plot errors.pdf"],
)
@click.argument("files", metavar="A.zip [B.zip...]", nargs=-1, required=True, type=FILE)
@options.output(
    "--plot",
    "plot_path",
    ends=[f".{form}" for form in PICTURE_FORMS],
    needs=options.REPORT,
    metavar="FILE",
    help="Draw the errors along the paths and by case: .png, .svg or .pdf.",
)
@options.common
@table_option
def command(files: tuple[Path, ...], plot_path: Path | None) -> None:
    """Compare saved results, with p-values.

    The files come from --save-results. Every two files are compared. If a file holds several
    methods of a case that no other file holds, its methods are compared. Results with the same
    case, seed and method form pairs. If each file has one method, results with the same case and
    seed form pairs; if the seeds differ, the means over the seeds do. Without a common case the
    results are compared as two independent samples.
    """
    found = jobs.compare.compare_results(files)
    if plot_path is not None:
        jobs.compare.write_comparison_plot(found, plot_path)
    notice(*found.notes)
    if print_if_json(found):
        return
    print_comparison(found)
    print_facts(("plot", plot_path))


def print_comparison(found: jobs.compare.ComparedResults) -> None:
    """Print a table of the figures, then those of each case over its seeds."""
    import pandas as pd  # noqa: PLC0415  (an extra)

    _print_figures(found)
    if not any((item.table["seed"] != "").any() for item in found.results):
        return
    by_seed = {
        item.name: jobs.results.means_of(jobs.results.figures_of(item.table), ["case", "seed"])
        for item in found.results
    }
    figures = pd.concat(by_seed, names=["method"]).reorder_levels(jobs.results.KEYS)
    print_by_case(figures, "results", LEADING)


def _print_figures(found: jobs.compare.ComparedResults) -> None:
    has_names = len(found.results) > 2
    rows = [
        [
            evaluation.measured.figure_of(item.figure).label,
            *([item.first, item.second] if has_names else []),
            *_numbers(item.mean_first, item.mean_second, item.difference),
            item.better or NOTHING,
            p_text(item.p_holm),
            _interval(item),
            p_text(item.p_rank),
            *_numbers(item.std_first, item.std_second),
            " and ".join(map(str, dict.fromkeys((item.count_first, item.count_second)))),
        ]
        for item in found.figures
    ]
    tests = ("items", "p t-test", "p rank test")
    if len(found.is_paired) == 1:
        paired = ("pairs", "p paired t", "p Wilcoxon")
        tests = paired if True in found.is_paired else ("items", "p Welch", "p Mann-Whitney")
    names = ("first ", "second ") if has_names else ()
    means = ("mean first", "mean second", "difference")
    corrected = ", Holm" if has_names else ""
    columns = ("figure ", *names, *means, "better ", tests[1] + corrected)
    columns = (*columns, "95 % interval" + corrected, tests[2])
    title = f"{found.results[0].name} (first) and {found.results[1].name} (second)"
    if has_names:
        title = f"Every two of {len(found.results)} results; better: p below 0.05"
    sentences = found.pairings
    same = {sentence.partition(": ")[2] for sentence in sentences} if has_names else set()
    title = "; ".join((title, *(same if len(same) == 1 else sentences)))
    columns = (*columns, "std first", "std second", tests[0])
    Table(columns, rows, title=title, names=1 + len(names)).print()


def _numbers(*values: float | None) -> list[str]:
    return [number(value, DIGITS) for value in values]


def _interval(item: jobs.compare.Comparison) -> str:
    """Return the interval of the difference as a cell; a dash where there is none."""
    low, high = _numbers(item.low, item.high)
    return NOTHING if low == NOTHING else f"{low} to {high}"
