"""Each SLAM's map and each vote of them, on simulated drives: errors [F16] against true maps.

    python -m tests.benchmarks.bench_modes --record

One drive of each course, 541 beams, without obstacle: the three producers' maps by ``run``, then
voted on by ``fuse --shared-frame`` in every mode. All are compared with the true map of solid walls
and with that of thin ones. Less is better; the best of a row is bold. The errors do not depend on
the machine's load.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.progress import track
from rich.table import Table

from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.record import bench_parser, console_for

COURSES = ("office", "hall", "corridor")
TRUTHS = {"solid": "truth.yaml", "thin": "truth_thin.yaml"}
MODES = ("consensus", "majority")


def slamfusion(*words: str | Path) -> dict[str, Any]:
    """Run a command and return its JSON document."""
    command = [sys.executable, "-m", "slamfusion", *map(str, words), "--json"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def errors_on(course: str, seed: int, folder: Path) -> dict[str, dict[str, float]]:
    """Return, by the walls of the true map, the error of each producer's map and of each mode's."""
    drive, made = folder / "drive", folder / "run"
    slamfusion("simulate", course, "--lidar", "hokuyo", "--seed", str(seed), "-o", drive)
    slamfusion("run", drive / f"{course}.log.gz", "-o", made)
    maps = [made / f"{name}.yaml" for name in BUILT_IN]
    for mode in MODES:
        vote = ("--shared-frame", "--mode", mode)
        slamfusion("fuse", *maps, *vote, "-o", folder / mode)
    judged = [*maps, *(folder / f"{mode}.yaml" for mode in MODES)]
    errors = {}
    for walls, truth in TRUTHS.items():
        found = slamfusion("evaluate", *judged, "--truth", drive / truth)["maps"]
        errors[walls] = {path.stem: item["error"] for path, item in zip(judged, found, strict=True)}
    return errors


def row(course: str, walls: str, errors: dict[str, float]) -> Sequence[str]:
    """Return a row of the table, the least error bold."""
    best = min(errors.values())
    shown = {name: f"{error:.1f}" for name, error in errors.items()}
    cells = [f"**{shown[name]}**" if errors[name] == best else shown[name] for name in errors]
    return [course, walls, *cells]


def main() -> None:
    """Read the options and run."""
    parser = bench_parser(__doc__)
    parser.add_argument("--courses", nargs="+", default=COURSES)
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    table = Table("course", "true walls", "tinySLAM", "gmapping", "graph", *MODES)
    for course in track(options.courses, disable=not sys.stderr.isatty()):
        with TemporaryDirectory() as name:
            for walls, errors in errors_on(course, options.seed, Path(name)).items():
                table.add_row(*row(course, walls, errors))
    console_for("modes", options.record, width=120).print(table)


if __name__ == "__main__":
    main()
