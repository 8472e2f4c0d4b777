"""``slamfusion graph``: pose graphs in files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.help import Group
from slamfusion.cli.options import common_options, output_option, with_config
from slamfusion.cli.output import notice, print_json, print_table
from slamfusion.cli.paths import FILE
from slamfusion.config import RunConfig
from slamfusion.jobs.documents import number

if TYPE_CHECKING:
    from slamfusion.jobs.graph import OptimizedGraph
    from slamfusion.pose_graph import GraphFile

# Outliers that the table names.
NAMED = 10


@click.group("graph", cls=Group)
def command() -> None:
    """Optimise a pose graph in a file."""


@command.command("optimize")
@click.argument("path", metavar="FILE", type=FILE)
@output_option(
    "-o",
    "--output",
    "out",
    metavar="OUT.g2o",
    help="Write the graph with its new poses and all edges.",
)
@output_option(
    "--tum",
    "tum_path",
    metavar="OUT.tum",
    help="Write the new poses, with the vertex ids as times.",
)
@with_config("graph_optimizer")
@common_options
def optimize_command(
    path: Path, out: Path | None, tum_path: Path | None, config: RunConfig, as_json: bool
) -> int:
    """Find the poses that fit the edges of a pose graph best.

    FILE is a g2o or TORO file, plain or gzip. Edges between consecutive vertices are odometry.
    Loop closures that are outliers are ignored.
    """
    from slamfusion.jobs.graph import optimize_graph, save_optimized_graph  # noqa: PLC0415

    graph = optimize_graph(path, config)
    if graph.file.skipped:
        notice(f"{path}: lines not understood: {_kinds(graph.file.skipped)}")
    if not graph.found.is_converged:
        notice(f"{path}: not converged; raise graph_optimizer.max_iterations")
    document = save_optimized_graph(graph, out, tum=tum_path)
    if as_json:
        print_json(document)
    else:
        _print_result(graph)
    return 0


def _print_result(optimized: OptimizedGraph) -> None:
    """Print the figures as two columns."""
    file, found = optimized.file, optimized.found
    graph, outliers = file.graph, optimized.outliers()
    rows = [
        ["nodes", str(len(graph))],
        ["edges", str(len(graph.edges))],
        ["closures", str(int(graph.is_closure.sum()))],
        ["chi-square before", f"{found.chi2_start:.8g}" + _of_odometry(file)],
        ["chi-square after", f"{found.chi2:.8g}"],
    ]
    if optimized.config.graph_optimizer.robust != "none":
        rows.append(["outliers", _named(outliers)])
    if outliers:
        rows.append(["chi-square with them", f"{found.chi2_all:.8g}"])
    rows += [
        ["iterations", str(found.iterations) + ("" if found.is_converged else ", not converged")],
        ["time", f"{number(found.time_s)} s"],
    ]
    print_table((" ", " "), rows, title=optimized.path.name, header=False)


def _of_odometry(file: GraphFile) -> str:
    return "" if file.has_poses else " (along the odometry; the file has no vertices)"


def _named(outliers: list[tuple[int, int]]) -> str:
    """Return how many closures are outliers and which, the first few by name."""
    if not outliers:
        return "0"
    names = ", ".join(f"{start} to {end}" for start, end in outliers[:NAMED])
    return f"{len(outliers)}: {names}" + (", ..." if len(outliers) > NAMED else "")


def _kinds(skipped: dict[str, int]) -> str:
    """Return how many lines of which kind were not understood."""
    kinds = sorted(skipped.items(), key=lambda item: (-item[1], item[0]))
    named = ", ".join(f"{count} {kind[:40]}" for kind, count in kinds[:NAMED])
    return named + (", ..." if len(kinds) > NAMED else "")
