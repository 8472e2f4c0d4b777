"""``slamfusion compare``: saved results against each other, with p-values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import check_picture, common_options, output_option
from slamfusion.cli.output import notice, number, print_json, print_table
from slamfusion.cli.paths import FILE
from slamfusion.cli.results import print_by_case
from slamfusion.cli.table_files import table_option
from slamfusion.cli.tables import NOTHING
from slamfusion.jobs.documents import p_text

if TYPE_CHECKING:
    from slamfusion.jobs.compare import ComparedFigureJson, ComparedResults, ComparedSeriesJson

__all__ = ["command", "print_comparison"]

# Of a table: figures of several sizes.
DIGITS = 4
# Figures that have a table by case, where there are several seeds.
LEADING = ("error", "wall_f1", "ate_rmse_m", "relations_mean_m", "consistency")


@click.command("compare")
@click.argument("files", metavar="A.zip [B.zip...]", nargs=-1, required=True, type=FILE)
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

    Files are compared, every two of them; if a file has several methods in a case and no other file
    has one of these, its methods are. Maps and paths of the same case, seed and method are pairs;
    those of the same case and seed are, if each has one method; if the seeds differ, the means over
    them are the pairs. If no case is the same, figures are compared as two samples.
    """
    from slamfusion.jobs.compare import compare_results, write_comparison_plot  # noqa: PLC0415

    check_picture("--plot", plot_path)
    found = compare_results(files)
    if plot_path is not None:
        write_comparison_plot(found, plot_path)
    for sentence in found.document["notes"]:
        notice(sentence)
    if as_json:
        print_json(found.document)
    else:
        print_comparison(found)
    return 0


def print_comparison(found: ComparedResults) -> None:
    """Print a table of the figures with what was paired, and what is behind them.

    These are the figures over the seeds of each case; without seeds, the errors along the paths.
    """
    import pandas as pd  # noqa: PLC0415  (an extra)

    _print_figures(found)
    table = pd.concat([item.table.assign(method=item.name) for item in found.results])
    if table["seed"].any():
        print_by_case(table, "results", LEADING)
    else:
        _print_series(found)


def _print_figures(found: ComparedResults) -> None:
    """Print every figure of every two results."""
    from slamfusion.evaluation import figure_of  # noqa: PLC0415  (loads slowly)

    document, has_names = found.document, len(found.results) > 2
    rows = []
    for item in document["figures"]:
        rank_test = None
        if item["paired"] is not None:
            rank_test = item["paired"]["wilcoxon"]
        elif item["unpaired"] is not None:
            rank_test = item["unpaired"]["mann_whitney"]
        counts = dict.fromkeys((item["items_first"], item["items_second"]))
        rows.append(
            [
                figure_of(item["figure"]).label,
                *([item["first"], item["second"]] if has_names else []),
                " and ".join(map(str, counts)),
                *_numbers(item["mean_first"], item["std_first"]),
                *_numbers(item["mean_second"], item["std_second"], item["difference"]),
                _interval(item),
                p_text(item["p_value"]),
                p_text(rank_test),
                item["better"] or NOTHING,
            ]
        )
    is_paired = {bool(pairing["by"]) for pairing in document["pairings"]}
    tests = {
        (True,): ("pairs", "p paired t", "p Wilcoxon"),
        (False,): ("items", "p Welch", "p Mann-Whitney"),
        (False, True): ("items", "p t-test", "p rank test"),
    }[tuple(sorted(is_paired))]
    names = ("first ", "second ") if has_names else ()
    means = ("mean first", "std first", "mean second", "std second", "difference", "95 %")
    columns = ("figure ", *names, tests[0], *means, *tests[1:], "better ")
    title = f"{found.results[0].name} (first) against {found.results[1].name} (second)"
    if has_names:
        title = f"Every two of {len(found.results)} results; p of the t-test after Holm"
    sentences = list(dict.fromkeys(pairing["sentence"] for pairing in document["pairings"]))
    if len(sentences) > 1:
        sentences = ["{first} and {second}: {sentence}".format(**p) for p in document["pairings"]]
    title = "; ".join((title, *sentences))
    print_table(columns, rows, title=title, names=1 + len(names))


def _print_series(found: ComparedResults) -> None:
    """Print the errors that two paths have at the same times."""
    from slamfusion.evaluation import figure_of  # noqa: PLC0415  (loads slowly)

    document = found.document
    if not document["series"]:
        return
    has_names = (
        len(found.results) > 2 or len({item["method_first"] for item in document["series"]}) > 1
    )
    rows = []
    for item in document["series"]:
        test = item["paired"]
        first, second = item["mean_first"], item["mean_second"]
        rows.append(
            [
                item["case"],
                *(_made_by(item) if has_names else []),
                figure_of(item["series"]).label,
                str(item["common"]),
                *_numbers(first, second, first - second),
                _interval(item),
                p_text(None if test is None else test["t_test"]),
                p_text(None if test is None else test["wilcoxon"]),
            ]
        )
    names = ("first ", "second ") if has_names else ()
    heads = ("case ", *names, "errors ")
    means = ("mean first", "mean second", "difference", "95 %")
    columns = (*heads, "common", *means, "p paired t", "p Wilcoxon")
    title = "Errors along the paths; the pairs of the tests are means over spans of neighbours"
    print_table(columns, rows, title=title, names=len(heads))


def _made_by(item: ComparedSeriesJson) -> Sequence[str]:
    """Return what two paths are called: their results' names, and their own where they differ."""
    both = ((item["first"], item["method_first"]), (item["second"], item["method_second"]))
    return [name if name == method else f"{name}: {method}" for name, method in both]


def _numbers(*values: float | None) -> list[str]:
    """Return numbers as cells."""
    return [number(value, DIGITS) for value in values]


def _interval(item: ComparedFigureJson | ComparedSeriesJson) -> str:
    """Return the interval of the mean difference as a cell; a dash where nothing is paired."""
    if item["paired"] is None:
        return NOTHING
    return " to ".join(_numbers(*item["paired"]["interval"]))
