"""Paths of recorded drives that are chosen on even scans and judged on odd ones.

    python -m tests.benchmarks.bench_recordings --runs out/recordings

The producers' paths are those of ``slamfusion run``, kept in the folder ``--runs`` and made where
they are missing. Everything that a choice rests on sees the even scans alone: what the scans say of
each path, how much each is believed in the fused path, and the refinement. What it is judged by
sees the odd ones: the mean translation left on the known relations, of poses at odd scans that
odometry carries to the relations' times; doubled walls of the map that the odd scans draw at each
path; and how likely a hit of an odd scan is under what other odd scans draw by the path.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from rich.table import Table

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.measured import GroundTruth, measure_trajectory
from slamfusion.evidence.beams import judged_scans, scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.evidence.fused_path import fuse_paths, trust_in_paths
from slamfusion.evidence.path_frames import find_modes, lay_paths
from slamfusion.evidence.predictive import score_paths
from slamfusion.evidence.refined_path import refine_borne_out
from slamfusion.geometry import F64
from slamfusion.grid import OCCUPIED
from slamfusion.io import LogScan, open_log, read_trajectory
from slamfusion.jobs.cases import case_of
from slamfusion.jobs.inputs import LogFiles
from slamfusion.jobs.run import run_log
from slamfusion.jobs.run_files import save_run
from slamfusion.slam.registry import BUILT_IN, loop_closers
from slamfusion.trajectory import Trajectory
from tests.benchmarks.record import bench_parser, console_for
from tests.support.datasets import MEASURED

RESOLUTION_M = 0.05
CONSENSUS, FUSED, REFINED = "consensus of poses", "fused", "refined"


def producers_paths(folder: Path, log: Path) -> dict[str, Trajectory]:
    """Return the paths of the producers on a log; run them where they are not kept."""
    files = {name: folder / f"{name}.tum" for name in BUILT_IN}
    if not all(path.exists() for path in files.values()):
        save_run(run_log(log), folder)
    found = {name: read_trajectory(path) for name, path in files.items()}
    return {name: Trajectory(path.stamps_s, path.poses, name) for name, path in found.items()}


def candidates(
    paths: Mapping[str, Trajectory], even: list[LogScan], device: ComputeDevice
) -> tuple[dict[str, Trajectory], dict[str, float]]:
    """Return every path that may be chosen, and what the even scans say of each."""
    evidence = score_paths(judged_scans(even), paths, device)
    stamps_s, laid, weights = lay_paths(paths)
    closers = loop_closers(paths)
    drifting = [name for name in paths if name not in closers]
    fused = fuse_paths(paths, trust_in_paths(evidence), sharing_fault=drifting, name=FUSED)
    refined, _, _ = refine_borne_out(evidence, fused)
    found = {
        **paths,
        CONSENSUS: Trajectory(stamps_s, find_modes(laid, weights), CONSENSUS),
        FUSED: fused,
        REFINED: refined,
    }
    scored = score_paths(evidence.scans, found, device)
    return found, {name: score.consistency for name, score in scored.scores.items()}


def at_scans(path: Trajectory, stamps_s: F64) -> Trajectory:
    """Return the poses of a path at the times of some scans."""
    near, meets = path.matches(stamps_s)
    return Trajectory(path.stamps_s[near[meets]], path.poses[near[meets]], path.name)


def judge(files: LogFiles, runs: Path, device: ComputeDevice) -> pd.DataFrame:
    """Return the figures of each candidate on a recording; the even scans choose the first."""
    config, name = RunConfig(), case_of(files.log)
    paths = producers_paths(runs / name, files.log)
    scans = list(open_log(files.log, config.log))
    even, odd = scans[::2], scans[1::2]
    found, even_scores = candidates(paths, even, device)
    chosen = max(even_scores, key=even_scores.__getitem__)
    held = GroundTruth.read(config, relations=files.relations, odometry=files.odometry)
    wheels = judged_scans(scans).odometry_path()
    odd_scans, drawn = judged_scans(odd), [*scan_hits(odd)]
    odd_scores = score_paths(odd_scans, found, device).scores
    rows = []
    for candidate, path in found.items():
        own = at_scans(path, odd_scans.stamps_s)
        measures = measure_trajectory(
            own, relations=held.relations, odometry=held.odometry or wheels, scans=wheels
        )
        rows.append(
            {
                "log": name,
                "path": candidate,
                "chosen": "yes" if candidate == chosen else "",
                "hit, even scans": even_scores[candidate],
                "hit, odd scans": odd_scores[candidate].consistency,
                "relations m": measures.relations.translation.mean,
                "doubled walls": doubled_wall_share(
                    draw_map(drawn, own, device, resolution=RESOLUTION_M).cells == OCCUPIED
                ),
            }
        )
    return pd.DataFrame(rows)


def main() -> None:
    """Read the options and run."""
    recorded = {case_of(files.log): files for files in MEASURED}
    parser = bench_parser(__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="keeps the producers' paths")
    parser.add_argument("--logs", default=",".join(recorded))
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    device = open_device(options.device)
    table = Table(title="Chosen on even scans, judged on odd ones; *: the least on this log")
    for name in options.logs.split(","):
        rows = judge(recorded[name], options.runs, device)
        least = rows.eq(rows[["relations m", "doubled walls"]].min())[rows.columns]
        marks = least.map(lambda is_least: "*" if is_least else "")
        shown = rows.map(lambda cell: f"{cell:.4f}" if isinstance(cell, float) else cell) + marks
        if not table.columns:
            for column in shown.columns:
                table.add_column(column)
        for cells in shown.itertuples(index=False):
            table.add_row(*cells)
    console_for("recordings-held-out", options.record, width=120).print(table)


if __name__ == "__main__":
    main()
