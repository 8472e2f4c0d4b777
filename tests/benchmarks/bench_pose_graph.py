"""Compare the optimiser of pose graphs with GTSAM, and with itself under false closures.

    python -m tests.benchmarks.bench_pose_graph --part clean
    python -m tests.benchmarks.bench_pose_graph --part false --seeds 5

``clean``: chi-square at the end. GTSAM 4.3 takes the logarithm of an error where g2o takes its
coordinates, so its own factors have another least; the best known is therefore the least that its
Levenberg and Marquardt finds with g2o's error as a custom factor, from where its own factors ended
and from where we ended (on the two largest graphs, where that takes many minutes: where its own
factors end from either). Times are CPU times, medians of some repetitions: ours in all (pattern,
start, descent); ours and GTSAM's own factors from the same start. It factorises by Cholesky or,
where that fails, by QR. Its graph is built before the clock starts.

``false``: closures between random poses are added, 10 % and 30 % of the true ones, with the motion
and information of another closure (shuffled) or with a random motion. How far the trajectory is off
the clean one is the root mean square distance after the best rigid motion, as a share of the
diagonal of the clean one's box; the worst run counts. No pose is given.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from slamfusion.geometry import F64
from slamfusion.pose_graph.g2o import read_g2o
from slamfusion.pose_graph.graph import PoseGraph
from slamfusion.pose_graph.least_squares import (
    Measurements,
    NormalEquations,
    at_once,
    descend,
    rotations_first,
)
from slamfusion.pose_graph.optimize import Robust, optimize
from tests.benchmarks.record import bench_parser, console_for
from tests.pose_graph.graphs import POSE_GRAPHS, apart, chi2_of, with_false_closures
from tests.pose_graph.gtsam_oracle import GtsamGraph, has_gtsam

T = TypeVar("T")

NAMES = ("INTEL_1228", "intel", "MIT", "CSAIL", "M3500", "ais2klinik", "city10000")
# Where all closures at once still finish, true and false.
SMALL = ("INTEL_1228", "intel", "MIT", "CSAIL")
PARTS = ("clean", "false")
METHODS: tuple[Robust, ...] = ("none", "dcs", "gnc", "consensus")
KINDS = ("shuffled", "random")
SHARES = (0.1, 0.3)
QR = "MULTIFRONTAL_QR"
# QR and custom factors take minutes on larger graphs.
SLOW_POSES = 5000


def timed(work: Callable[[], T], repetitions: int) -> tuple[float, T]:
    """Return the median CPU time of some repetitions, in seconds, and the last result."""
    seconds = []
    for _ in range(repetitions):
        began = time.process_time()
        result = work()
        seconds.append(time.process_time() - began)
    return float(np.median(seconds)), result


def load(name: str) -> PoseGraph:
    return read_g2o(POSE_GRAPHS / f"{name}.g2o.gz").graph


def in_all(graph: PoseGraph) -> F64:
    """Return our solution, nothing known beforehand."""
    measured = Measurements(graph.edges, graph.motions, graph.information)
    equations = NormalEquations(measured, len(graph), (0,))
    return at_once(descend)(equations, rotations_first(equations, graph.poses)).poses


def clean(names: tuple[str, ...], repetitions: int) -> Table:
    """Return chi-square and time against GTSAM."""
    columns = (
        "graph, poses, edges, chi2 before, ours, best known, off %, "
        "all ms, descent ms, GTSAM ms, all / GTSAM, descent / GTSAM"
    )
    table = Table(*columns.split(", "), title="chi-square, and CPU time against GTSAM")
    for name in names:
        graph = load(name)
        all_s, poses = timed(partial(in_all, graph), repetitions)
        ours = float(chi2_of(graph, poses).sum())
        row = [name, str(len(graph)), str(len(graph.edges))]
        row += [f"{chi2_of(graph).sum():.6g}", f"{ours:.6g}"]
        measured = Measurements(graph.edges, graph.motions, graph.information)
        equations = NormalEquations(measured, len(graph), (0,))
        start = rotations_first(equations, graph.poses)
        descent_s, _ = timed(partial(at_once(descend), equations, start), repetitions)
        times = [f"{1e3 * all_s:.0f}", f"{1e3 * descent_s:.0f}"]
        if has_gtsam():
            theirs_s, theirs, solver = rival(GtsamGraph(graph), start, repetitions)
            known = best_known(graph, theirs, poses)
            row += [f"{known:.6g}", f"{100.0 * (ours / known - 1.0):+.4f}"]
            ratios = [f"{all_s / theirs_s:.2f}", f"{descent_s / theirs_s:.2f}"]
            times += [f"{1e3 * theirs_s:.0f}{solver}", *ratios]
        else:
            row += ["-"] * 2
            times += ["-"] * 3
        table.add_row(*row, *times)
        progress(row, times)
    return table


def progress(*words: object) -> None:
    """Say on stderr what is done: the whole takes long."""
    Console(stderr=True, width=200).print(*words)


def best_known(graph: PoseGraph, *starts: F64) -> float:
    """Return the least chi-square, g2o's, that GTSAM finds from some starts."""
    rival_graph = GtsamGraph(graph, like_g2o=len(graph) <= SLOW_POSES)
    return min(float(chi2_of(graph, rival_graph.optimize(start)).sum()) for start in starts)


def rival(graph: GtsamGraph, start: F64, repetitions: int) -> tuple[float, F64, str]:
    """Return GTSAM's time and poses, and by which solver where it is not the usual one."""
    theirs_s, found = timed(partial(graph.optimize, start), repetitions)
    if len(start) > SLOW_POSES:
        return theirs_s, found, ""
    by_qr_s, by_qr = timed(partial(graph.optimize, start, QR), 1)
    if graph.chi2(found) <= 1.001 * graph.chi2(by_qr):
        return theirs_s, found, ""
    return by_qr_s, by_qr, " (QR)"


def robustness(names: tuple[str, ...], methods: tuple[Robust, ...], seeds: int) -> Table:
    """Return how far false closures take the trajectory at most, in per cent, by each method."""
    table = Table("graph", "added", *methods, title="false closures added: off %, worst")
    for name in names:
        graph = load(name)
        graph = graph.with_poses(optimize(graph).poses)
        for share in SHARES:
            row = [name, f"{100.0 * share:.0f} %"]
            for method in methods:
                off = []
                for kind, seed in itertools.product(KINDS, range(seeds)):
                    false_too = with_false_closures(graph, share, seed, kind)
                    nowhere = false_too.with_poses(np.zeros_like(graph.poses))
                    off.append(apart(graph.poses, optimize(nowhere, robust=method).poses))
                row.append(f"{100.0 * max(off):.1f}")
            table.add_row(*row)
            progress(row)
    return table


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--part", choices=PARTS, default="clean")
    parser.add_argument("--graphs", nargs="+", choices=NAMES)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=("consensus",))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    methods = tuple(options.methods)
    is_slow = options.part == "false" and methods != ("consensus",)
    names = tuple(options.graphs or (SMALL if is_slow else NAMES))
    if options.part == "clean":
        table = clean(names, options.repetitions)
    else:
        table = robustness(names, methods, options.seeds)
    console_for(f"pose-graphs-{options.part}", options.record, width=200).print(table)


if __name__ == "__main__":
    main()
