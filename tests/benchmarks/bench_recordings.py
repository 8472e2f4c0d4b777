"""Paths of recorded drives that are chosen on even scans and judged on odd ones.

    python -m tests.benchmarks.bench_recordings --datasets DIR --runs out/recordings

The producers' paths are those of ``slamfusion run``, kept in the folder ``--runs`` and made where
they are missing. Everything that a choice rests on sees the even scans alone: what the scans say of
each path, how much each is believed in the fused path, and the refinement. What it is judged by
sees the odd ones: the mean translation left on the known relations, of poses at odd scans that
odometry carries to the relations' times; doubled walls of the map that the odd scans draw at each
path; and how likely a hit of an odd scan is under what other odd scans draw by the path.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.table import Table

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.measured import GroundTruth, measure_trajectory
from slamfusion.evidence.beams import judged_scans, scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.evidence.fused_path import fuse_paths, trust_in_paths
from slamfusion.evidence.path_frames import consensus_poses, lay_paths
from slamfusion.evidence.predictive import score_paths
from slamfusion.evidence.refined_path import refine_borne_out
from slamfusion.io import LogScan, open_log, read_trajectory
from slamfusion.jobs.run import run_log
from slamfusion.jobs.run_files import save_run
from slamfusion.slam.registry import BUILT_IN, loop_closers
from slamfusion.trajectory import Trajectory
from tests.benchmarks.record import add_record_option, console_for

F64 = npt.NDArray[np.float64]
RESOLUTION_M = 0.05
CONSENSUS, FUSED, REFINED = "consensus of poses", "fused", "refined"


@dataclass(frozen=True)
class Recording:
    """A recorded drive in the folder of data sets.

    Attributes:
        log: the scans.
        relations: known motions between pairs of times.
        odometry: of the whole run; empty: that of the scans.
    """

    log: str
    relations: str
    odometry: str = ""


INTEL = ("intel/intel.relations", "intel/intel-odometry-13631.txt.gz")
RECORDINGS = {
    "mit-csail": Recording("mit-csail/mit-csail.clf.gz", "mit-csail/mit-csail.relations"),
    "intel-910": Recording("intel/intel-910-raw.log.gz", *INTEL),
    "intel-2726": Recording("intel/intel-2726-raw.log.gz", *INTEL),
}


@dataclass(frozen=True)
class Row:
    """One candidate on one recording.

    Attributes:
        log, name: of them.
        is_chosen: whether the even scans bear it out best.
        even, odd: mean log-likelihood of a hit of the even and of the odd scans.
        relations_m: mean translation left on the relations.
        doubled: share of doubled walls of the map that the odd scans draw.
    """

    log: str
    name: str
    is_chosen: bool
    even: float
    odd: float
    relations_m: float
    doubled: float


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
    refined, _, _ = refine_borne_out(evidence, fused, device)
    found = {
        **paths,
        CONSENSUS: Trajectory(stamps_s, consensus_poses(laid, weights), CONSENSUS),
        FUSED: fused,
        REFINED: refined,
    }
    scored = score_paths(evidence.scans, found, device)
    return found, {name: score.consistency for name, score in scored.scores.items()}


def at_scans(path: Trajectory, stamps_s: F64) -> Trajectory:
    """Return the poses of a path at the times of some scans."""
    near, meets = path.matches(stamps_s)
    return Trajectory(path.stamps_s[near[meets]], path.poses[near[meets]], path.name)


def judge(name: str, datasets: Path, runs: Path, device: ComputeDevice) -> Iterator[Row]:
    """Yield what each candidate is worth on a recording."""
    recording, config = RECORDINGS[name], RunConfig()
    log = datasets / recording.log
    paths = producers_paths(runs / name, log)
    scans = list(open_log(log, config.log))
    even, odd = scans[::2], scans[1::2]
    found, even_scores = candidates(paths, even, device)
    chosen = max(even_scores, key=even_scores.__getitem__)
    held = GroundTruth.read(
        config,
        relations=datasets / recording.relations,
        odometry=datasets / recording.odometry if recording.odometry else None,
    )
    wheels = judged_scans(scans).odometry_path()
    odd_scans, drawn = judged_scans(odd), [*scan_hits(odd)]
    odd_scores = score_paths(odd_scans, found, device).scores
    for candidate, path in found.items():
        own = at_scans(path, odd_scans.stamps_s)
        measures = measure_trajectory(
            own, relations=held.relations, odometry=held.odometry or wheels, scans=wheels
        )
        assert measures.relations is not None
        grid = draw_map(drawn, own, device, resolution=RESOLUTION_M)
        yield Row(
            name,
            candidate,
            candidate == chosen,
            even_scores[candidate],
            odd_scores[candidate].consistency,
            measures.relations.translation.mean,
            doubled_wall_share(grid),
        )


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--datasets", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--runs", type=Path, required=True, help="keeps the producers' paths")
    parser.add_argument("--logs", default=",".join(RECORDINGS))
    parser.add_argument("--device", default="auto")
    add_record_option(parser)
    options = parser.parse_args()
    device = open_device(options.device)
    columns = ("log", "path", "chosen", "hit, even scans", "hit, odd scans", "relations m")
    table = Table(*columns, "doubled walls", title="Chosen on even scans, judged on odd ones")
    for name in options.logs.split(","):
        rows = list(judge(name, options.datasets, options.runs, device))
        least_m = min(row.relations_m for row in rows)
        least = min(row.doubled for row in rows)
        for row in rows:
            table.add_row(
                row.log,
                row.name,
                "yes" if row.is_chosen else "",
                f"{row.even:.4f}",
                f"{row.odd:.4f}",
                f"{row.relations_m:.4f}{'*' if row.relations_m == least_m else ''}",
                f"{row.doubled:.4f}{'*' if row.doubled == least else ''}",
            )
    console_for("recordings-held-out", options.record, width=120).print(table)
    print("*: the least of all on this log")


if __name__ == "__main__":
    main()
