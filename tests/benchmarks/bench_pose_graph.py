"""Hold the optimiser of pose graphs against GTSAM, and against false closures.

    python -m tests.benchmarks.bench_pose_graph --part clean
    python -m tests.benchmarks.bench_pose_graph --part false --seeds 5
    python -m tests.benchmarks.bench_pose_graph --part online

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
diagonal of the clean one's box; chi-square is that of the true edges against the clean one's.

``online``: the same graphs pose by pose, as a SLAM meets them: poses are put along the odometry,
and every 20 of them, if there are new closures, the graph is solved from where it is and with the
last verdict (``optimize(start="given", weights=...)``). CPU time of one such solution.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from slamfusion.geometry import F64, compose_poses, invert_poses
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
PARTS = ("clean", "false", "online")
METHODS: tuple[Robust, ...] = ("none", "dcs", "gnc", "consensus")
KINDS = ("shuffled", "random")
WITHIN = 0.05
QR = "MULTIFRONTAL_QR"
# QR and custom factors take minutes on larger graphs.
SLOW_POSES = 5000
# Poses between two solutions of a graph that grows.
SOLVE_POSES = 20


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


def in_all(graph: PoseGraph) -> tuple[F64, int]:
    """Return our solution and the steps it took, nothing known beforehand."""
    measured = Measurements(graph.edges, graph.motions, graph.information)
    equations = NormalEquations(measured, len(graph), (0,))
    found = at_once(descend)(equations, rotations_first(equations, graph.poses))
    return found.poses, found.iterations


def clean(names: tuple[str, ...], repetitions: int) -> Table:
    """Return chi-square and time against GTSAM."""
    columns = (
        "graph, poses, edges, chi2 before, ours, steps, best known, off %, by GTSAM's own error, "
        "all ms, descent ms, GTSAM ms, all / GTSAM, descent / GTSAM"
    )
    table = Table(*columns.split(", "), title="chi-square, and CPU time against GTSAM")
    for name in names:
        graph = load(name)
        all_s, (poses, steps) = timed(partial(in_all, graph), repetitions)
        ours = float(chi2_of(graph, poses).sum())
        row = [name, str(len(graph)), str(len(graph.edges))]
        row += [f"{chi2_of(graph).sum():.6g}", f"{ours:.6g}", str(steps)]
        measured = Measurements(graph.edges, graph.motions, graph.information)
        equations = NormalEquations(measured, len(graph), (0,))
        start = rotations_first(equations, graph.poses)
        descent_s, _ = timed(partial(descend, equations, start), repetitions)
        times = [f"{1e3 * all_s:.0f}", f"{1e3 * descent_s:.0f}"]
        if has_gtsam():
            theirs_s, theirs, solver = rival(GtsamGraph(graph), start, repetitions)
            known = best_known(graph, theirs, poses)
            row += [f"{known:.6g}", f"{100.0 * (ours / known - 1.0):+.4f}"]
            row.append(f"{chi2_of(graph, theirs).sum():.6g}")
            ratios = [f"{all_s / theirs_s:.2f}", f"{descent_s / theirs_s:.2f}"]
            times += [f"{1e3 * theirs_s:.0f}{solver}", *ratios]
        else:
            row += ["-"] * 3
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


TITLES = {"false": "false closures added", "online": "graphs that grow, solved every 20 poses"}
COLUMNS = "graph, method, added, runs, within 5 %, off % mean, off % worst, true doubted, "
MORE = {
    "false": "false accepted, chi2 worst, time s",
    "online": "false accepted, solutions, median ms, p95 ms, longest ms",
}


def robustness(part: str, names: tuple[str, ...], methods: tuple[Robust, ...], seeds: int) -> Table:
    """Return how far false closures take the trajectory, of whole graphs or of growing ones."""
    table = Table(*(COLUMNS + MORE[part]).split(", "), title=TITLES[part])
    for name in names:
        graph = load(name)
        solution = optimize(graph)
        true_chi2, true = solution.chi2, len(graph.edges)
        graph = graph.with_poses(solution.poses)
        for method, share in itertools.product(methods, (0.0, 0.1, 0.3)):
            runs = [(KINDS[seed % 2], seed) for seed in range(seeds if share else 1)]
            if part == "false" and share:
                runs = list(itertools.product(KINDS, range(seeds)))
            rows, seconds = [], []
            for kind, seed in runs:
                false_too = with_false_closures(graph, share, seed, kind)
                poses, doubted, times = (whole if part == "false" else drive)(false_too, method)
                wrong = int(doubted[:true].sum()), int((~doubted[true:]).sum())
                chi2 = float(chi2_of(graph, poses).sum()) / true_chi2
                rows.append((apart(graph.poses, poses), *wrong, chi2, len(times)))
                seconds.append(times)
            off, lost, accepted, chi2s, solutions = np.array(rows).T
            each = np.concatenate(seconds)
            row = [name, method, f"{100.0 * share:.0f} %", str(len(rows))]
            row += [str(int((off <= WITHIN).sum()))]
            row += [f"{100.0 * off.mean():.3f}", f"{100.0 * off.max():.3f}"]
            row += [f"{lost.mean():.2f}", f"{accepted.mean():.2f}"]
            if part == "false":
                row += [f"{chi2s.max():.4g}", f"{each.mean():.2f}"]
            else:
                row += [f"{solutions.mean():.0f}"]
                row += [f"{1e3 * np.quantile(each, place):.1f}" for place in (0.5, 0.95, 1.0)]
            table.add_row(*row)
            progress(row)
    return table


def whole(graph: PoseGraph, method: Robust) -> tuple[F64, npt.NDArray[np.bool_], F64]:
    """Optimise at once, without any given pose; see ``drive``."""
    began = time.process_time()
    found = optimize(graph.with_poses(np.zeros_like(graph.poses)), robust=method)
    return found.poses, found.is_outlier, np.array([time.process_time() - began])


def drive(graph: PoseGraph, method: Robust) -> tuple[F64, npt.NDArray[np.bool_], F64]:
    """Add a graph's poses one by one and solve now and then.

    Returns:
        The poses; of each edge whether it is doubted at the end; the CPU times of all solutions.
    """
    last = graph.edges.max(axis=1)
    order = np.argsort(last, kind="stable")
    arrays = (graph.edges, graph.motions, graph.information, graph.is_closure)
    edges, motions, information, is_closure = (array[order] for array in arrays)
    back = invert_poses(motions)
    poses, weights, times = graph.poses[:1], np.zeros(0), []
    for pose in range(1, len(graph)):
        first, beyond = np.searchsorted(last[order], (pose, pose + 1))
        edge = first + int(np.argmin(is_closure[first:beyond]))
        is_along = edges[edge, 1] == pose
        onward = motions[edge] if is_along else back[edge]
        poses = np.concatenate((poses, compose_poses(poses[edges[edge].min()], onward)[None]))
        is_due = (pose + 1) % SOLVE_POSES == 0 or pose + 1 == len(graph)
        if is_due and is_closure[len(weights) : beyond].any():
            now = slice(beyond)
            so_far = PoseGraph(poses, edges[now], motions[now], information[now], is_closure[now])
            began = time.process_time()
            found = optimize(so_far, robust=method, start="given", weights=weights)
            times.append(time.process_time() - began)
            poses, weights = found.poses, found.weights
    doubted = np.zeros(len(edges), np.bool_)
    doubted[order[: len(weights)]] = weights < 0.5
    return poses, doubted, np.array(times)


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--part", choices=PARTS, default="clean")
    parser.add_argument("--graphs", nargs="+", choices=NAMES)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=("consensus",))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    methods = tuple(options.methods)
    is_slow = options.part == "online" or (options.part == "false" and methods != ("consensus",))
    names = tuple(options.graphs or (SMALL if is_slow else NAMES))
    if options.part == "clean":
        table = clean(names, options.repetitions)
    else:
        table = robustness(options.part, names, methods, options.seeds)
    console_for(f"pose-graphs-{options.part}", options.record, width=200).print(table)


if __name__ == "__main__":
    main()
