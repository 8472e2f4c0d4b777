"""``slamfusion compare``: saved results against each other, with p-values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import check_picture, common_options, output_option
from slamfusion.cli.output import notice, number, print_json, print_table
from slamfusion.cli.paths import FILE
from slamfusion.cli.table_files import table_option
from slamfusion.cli.tables import NOTHING

if TYPE_CHECKING:
    from slamfusion.evaluation import Interval
    from slamfusion.jobs.compare import ComparedResults

__all__ = ["command", "print_comparison"]

# Of a table: figures of several sizes.
DIGITS = 4
MEANS = ("mean first", "mean second", "difference", "95 %")


@click.command("compare")
@click.argument("files", metavar="A.zip B.zip...", nargs=-1, required=True, type=FILE)
@output_option(
    "--plot",
    "plot_path",
    metavar="FILE",
    help="Draw the errors along the paths and the figures by case here: .png, .svg or .pdf.",
)
@common_options
@table_option
def command(files: tuple[Path, ...], plot_path: Path | None, as_json: bool) -> int:
    """Compare results that --save-results saved: differences of all figures, with p-values.

    Maps and paths of the same case and method are pairs (of the same case alone, where each file
    has one a case), and so are errors of two paths at the same times. Where nothing is the same,
    figures are compared as two samples. Of more than two files, every two are compared.
    """
    from slamfusion.jobs.compare import compare_results, write_comparison_plot  # noqa: PLC0415

    if len(files) < 2:
        message = "give two files of --save-results or more"
        raise click.UsageError(message)
    check_picture("--plot", plot_path)
    found = compare_results(files)
    if plot_path is not None:
        write_comparison_plot(found, plot_path)
    for sentence in found.sentences():
        notice(sentence)
    if as_json:
        print_json(found.to_json())
    else:
        print_comparison(found)
    return 0


def print_comparison(found: ComparedResults) -> None:
    """Print a table of the figures and one of the errors along the paths."""
    _print_figures(found)
    _print_series(found)


def _print_figures(found: ComparedResults) -> None:
    """Print every figure of every two files."""
    from slamfusion.evaluation import figure_of  # noqa: PLC0415  (loads slowly)

    has_names = len(found.results) > 2
    rows = []
    for pair in found.pairs:
        names = [pair.first.name, pair.second.name]
        for item in pair.figures:
            paired, unpaired = item.paired, item.unpaired
            rank_test = None
            if paired is not None:
                rank_test = paired.wilcoxon
            elif unpaired is not None:
                rank_test = unpaired.mann_whitney
            counts = sorted({item.count_first, item.count_second})
            rows.append(
                [
                    figure_of(item.figure).label,
                    *(names if has_names else []),
                    " and ".join(map(str, counts)),
                    *_means(item.mean_first, item.mean_second),
                    _interval(None if paired is None else paired.interval),
                    _p_value(item.p_value),
                    _p_value(rank_test),
                    NOTHING if item.better is None else names[item.better],
                ]
            )
    is_paired = any(pair.items.pairs for pair in found.pairs)
    columns = (
        "figure ",
        *(("first ", "second ") if has_names else ()),
        "pairs" if is_paired else "items",
        *MEANS,
        "p paired t" if is_paired else "p Welch",
        "p Wilcoxon" if is_paired else "p Mann-Whitney",
        "better ",
    )
    print_table(columns, rows, title=_title(found), names=3 if has_names else 1)


def _title(found: ComparedResults) -> str:
    if len(found.results) > 2:
        return f"Every two of {len(found.results)} results; p of the t-test after Holm"
    return f"{found.results[0].name} (first) against {found.results[1].name} (second)"


def _print_series(found: ComparedResults) -> None:
    """Print the errors that two paths have at the same times."""
    from slamfusion.evaluation import figure_of  # noqa: PLC0415  (loads slowly)

    pairs = [(pair, item) for pair in found.pairs for item in pair.series]
    if not pairs:
        return
    has_names = len(found.results) > 2 or len({item.first.method for _, item in pairs}) > 1
    rows = []
    for pair, item in pairs:
        own, test = item.comparison, item.comparison.paired
        names = [
            _made_by(pair.first.name, item.first.method),
            _made_by(pair.second.name, item.second.method),
        ]
        rows.append(
            [
                item.first.case,
                *(names if has_names else []),
                figure_of(own.name).label,
                str(own.common),
                *_means(own.mean_first, own.mean_second),
                _interval(None if test is None else test.interval),
                _p_value(None if test is None else test.t_test),
                _p_value(None if test is None else test.wilcoxon),
            ]
        )
    heads = ("case ", *(("first ", "second ") if has_names else ()), "errors ")
    columns = (*heads, "common", *MEANS, "p paired t", "p Wilcoxon")
    title = "Errors along the paths; the pairs of the tests are means over spans of neighbours"
    print_table(columns, rows, title=title, names=len(heads))


def _means(first: float, second: float) -> list[str]:
    """Return two means and their difference as cells."""
    return [number(value, DIGITS) for value in (first, second, first - second)]


def _made_by(name: str, method: str) -> str:
    """Return what a path is called: its file's name, and its own where that is another."""
    return name if name == method else f"{name}: {method}"


def _p_value(value: float | None) -> str:
    """Return a p-value as a cell; a dash where there is none."""
    from slamfusion.experiments.table import p_text  # noqa: PLC0415  (loads slowly)

    return NOTHING if value is None else p_text(value)


def _interval(interval: Interval | None) -> str:
    """Return an interval as a cell; a dash where there is none."""
    if interval is None:
        return NOTHING
    return f"{number(interval.low, DIGITS)} to {number(interval.high, DIGITS)}"
