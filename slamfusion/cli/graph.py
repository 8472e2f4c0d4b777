"""``slamfusion graph``: pose graphs in files."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import click

from slamfusion import jobs
from slamfusion.cli import options
from slamfusion.cli.help import Group
from slamfusion.cli.output import Table, notice, print_facts, print_if_json
from slamfusion.cli.paths import FILE
from slamfusion.config import RunConfig
from slamfusion.jobs.records import number

# Outliers that the table names.
NAMED = 10


@click.group("graph", cls=Group)
def command() -> None:
    """Optimise a pose graph in a file."""


@command.command("optimize")
@click.argument("path", metavar="FILE", type=FILE)
@options.output(
    "-o",
    "--output",
    "out",
    metavar="OUT.g2o",
    help="Write the graph with its new poses and all edges.",
)
@options.output(
    "--tum",
    "tum_path",
    metavar="OUT.tum",
    help="Write the new poses, with the vertex ids as times.",
)
@options.settings("graph_optimizer")
@options.common
def optimize_command(
    path: Path, out: Path | None, tum_path: Path | None, config: RunConfig
) -> None:
    """Find the poses that fit the edges of a pose graph best.

    FILE is a g2o or TORO file, plain or gzip. Edges between consecutive vertices are odometry.
    Loop closures that are outliers are ignored.
    """
    graph = jobs.graph.optimize_graph(path, config)
    given, found = graph.graph, graph.found
    if given.skipped_lines:
        kinds = sorted(given.skipped_lines.items(), key=lambda item: (-item[1], item[0]))
        words = _first_few(f"{count} {kind[:40]}" for kind, count in kinds)
        notice(f"{path}: lines not understood: {words}")
    if not found.is_converged:
        notice(f"{path}: not converged; try another --start")
    graph = jobs.graph.save_optimized_graph(graph, out, tum=tum_path)
    if print_if_json(graph):
        return
    along = "" if given.has_poses else " (along the odometry; the file has no vertices)"
    rows = [
        ["nodes", str(graph.nodes)],
        ["edges", str(graph.edges)],
        ["closures", str(graph.closures)],
        ["chi-square before", f"{found.chi2_start:.8g}{along}"],
        ["chi-square after", f"{found.chi2:.8g}"],
    ]
    doubted = graph.doubted
    if doubted:
        names = _first_few(f"{start} to {end}" for start, end in doubted)
        rows.append(["outliers", f"{len(doubted)}: {names}"])
        rows.append(["chi-square with them", f"{found.chi2_all:.8g}"])
    elif config.graph_optimizer.robust != "none":
        rows.append(["outliers", "0"])
    rows += [
        ["iterations", str(found.iterations) + ("" if found.is_converged else ", not converged")],
        ["time", f"{number(found.time_s)} s"],
    ]
    Table((" ", " "), rows, title=path.name, has_head=False).print()
    print_facts(("graph", out), ("poses", tum_path))


def _first_few(names: Iterable[str]) -> str:
    first = list(islice(names, NAMED + 1))
    return ", ".join([*first[:NAMED], *["..."] * (len(first) > NAMED)])
