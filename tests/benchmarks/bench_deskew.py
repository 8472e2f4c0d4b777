"""Maps and paths of a turning lidar, deskewed and not, on simulated drives.

    python -m tests.benchmarks.bench_deskew --record

Each drive is recorded by a lidar whose beams are measured one after the other, and mapped by
``slam`` with and without deskewing. The figures do not depend on the machine's load.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.progress import track
from rich.table import Table

from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.bench_modes import slamfusion
from tests.benchmarks.record import bench_parser, console_for


def figures(log: Path, truth: Path, out: Path, deskew: str) -> list[str]:
    """Return each path's error, metres, then the doubled walls of the maps, per cent."""
    held = ("--truth", truth / "truth.tum", "--truth-map", truth / "truth.yaml")
    made = [
        slamfusion("slam", name, log, *held, "--deskew", deskew, "-o", out / name)["producers"][0]
        for name in BUILT_IN
    ]
    return [
        *(f"{item['ate']['rmse']:.3f}" for item in made),
        *(f"{100.0 * item['map_error']['doubled_wall_share']:.1f}" for item in made),
    ]


def main() -> None:
    """Read the options and run."""
    parser = bench_parser(__doc__)
    parser.add_argument("--courses", nargs="+", default=["f16", "atrium"])
    parser.add_argument("--lidars", nargs="+", default=["rplidar", "lds01"])
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    names = ("tinySLAM", "gmapping", "graph")
    ates, doubled = (f"{name} ATE m" for name in names), (f"{name} doubled %" for name in names)
    table = Table("course, lidar", "deskewed", *ates, *doubled)
    drives = [(course, lidar) for course in options.courses for lidar in options.lidars]
    for course, lidar in track(drives, disable=not sys.stderr.isatty()):
        with TemporaryDirectory() as name:
            drive = Path(name) / "drive"
            words = ("--lidar", lidar, "--seed", str(options.seed), "-o", drive)
            slamfusion("simulate", course, *words)
            log = drive / f"{course}.log.gz"
            for deskew, shown in (("no", "no"), ("auto", "yes")):
                cells = figures(log, drive, Path(name) / deskew, deskew)
                table.add_row(f"{course}, {lidar}", shown, *cells)
    console_for("deskewing", options.record, width=120).print(table)


if __name__ == "__main__":
    main()
