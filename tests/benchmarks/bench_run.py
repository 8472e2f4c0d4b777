"""Time the main job as a user starts it, and where the time goes.

    python -m tests.benchmarks.bench_run --repeat 3
    python -m tests.benchmarks.bench_run --course f16 --lidar rplidar --seeds 5 -- --unknown abstain

Without a course the recorded drive of mit-csail is mapped, with its relations. Per run: seconds on
the wall, processor seconds of the whole job, of each producer's process and of the rest (imports,
fusion, report), the errors, and the doubled walls of the fused map against the best input's. The
wall counts only where nothing else runs; the processor seconds say more on a busy machine. With a
course, one simulated drive a seed with a ground obstacle, and the map errors of each producer and
of the fused map.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.table import Table

from tests.benchmarks.record import add_record_option, console_for
from tests.support.datasets import DATASETS

CSAIL = DATASETS / "mit-csail"
COMMAND = Path(sys.executable).with_name("slamfusion")


def processor_s() -> float:
    """Processor seconds of all ended children so far, and theirs."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def run(arguments: list[str], out: Path) -> tuple[dict[str, Any], float, float]:
    """Return the job's document, its seconds on the wall and on the processors."""
    before_s, begun_s = processor_s(), time.perf_counter()
    done = subprocess.run(
        [COMMAND, "run", *arguments, "-o", out, "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    wall_s = time.perf_counter() - begun_s
    if not done.stdout:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout), wall_s, processor_s() - before_s


def time_recorded(repeat: int, extra: list[str], record: Path | None) -> None:
    """Print a row for each run on the recorded drive."""
    table = Table(title=f"mit-csail, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    columns = (
        "wall s", "processor s", "producers", "the rest", "stages, wall s", "relations m",
        "doubled: fused / best input", "paths apart m",
    )  # fmt: skip
    for column in columns:
        table.add_column(column)
    log = [str(CSAIL / "mit-csail.clf.gz"), "--relations", str(CSAIL / "mit-csail.relations")]
    for _ in range(repeat):
        with TemporaryDirectory() as folder:
            document, wall_s, cpu_s = run([*log, *extra], Path(folder) / "out")
        used = {item["name"]: item["process_cpu_s"] or 0.0 for item in document["producers"]}
        stages = ", ".join(f"{name} {value:.1f}" for name, value in document["stages_s"].items())
        errors = ", ".join(
            f"{item['name']} {item['translation']['mean']:.4f}"
            for item in document["producers"]
            if item["failed"] is None
        )
        doubled = document["doubled_wall_share"]
        best = min(doubled["inputs"].values())
        table.add_row(
            f"{wall_s:.1f}",
            f"{cpu_s:.1f}",
            ", ".join(f"{name} {value:.1f}" for name, value in used.items()),
            f"{cpu_s - sum(used.values()):.1f}",
            stages,
            errors,
            f"{doubled['fused']:.3f} / {best:.3f} = {doubled['fused'] / best:.2f}",
            f"{max(gap['median_m'] for gap in document['path_gaps']):.2f}",
        )
    console_for("run", record, width=220).print(table)


def compare_on_course(
    course: str, lidar: list[str], seeds: int, extra: list[str], record: Path | None
) -> None:
    """Print the map errors on a simulated course with a ground obstacle, a row a seed."""
    names = ("tinyslam", "gmapping", "graph", "fused")
    table = Table(title=f"{course} with a ground obstacle: error [F16], wall F1 (ATE m)")
    for column in ("seed", *names, "fused of 3", "best"):
        table.add_column(column)
    for seed in range(seeds):
        with TemporaryDirectory() as name:
            folder = Path(name)
            subprocess.run(
                [
                    COMMAND,
                    "simulate",
                    course,
                    "--obstacle",
                    *lidar,
                    "--seed",
                    str(seed),
                    "-o",
                    folder,
                ],
                check=True,
                stdout=subprocess.DEVNULL,
            )
            arguments = [
                str(folder / f"{course}.log.gz"), "--truth", str(folder / "truth.yaml"),
                "--truth-trajectory", str(folder / "truth.tum"), "--seed", str(seed), *extra,
            ]  # fmt: skip
            document, _, _ = run(arguments, folder / "out")
        ates = {
            item["name"]: item["ate"]["rmse"] for item in document["producers"] if item["scans"]
        }
        errors = {item["name"]: item for item in document["evaluations"]}
        cells = [
            f"{errors[name]['error']:.1f}, {errors[name]['wall_f1']:.3f}"
            + (f" ({ates[name]:.2f})" if name in ates else "")
            if name in errors
            else "-"
            for name in names
        ]
        best = min(errors, key=lambda name: errors[name]["error"])
        table.add_row(str(seed), *cells, str(document["fused_count"]), best)
    console_for(f"run-{course}", record, width=160).print(table)


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=1, help="runs on the recorded drive")
    parser.add_argument("--course", help="a simulated course instead")
    parser.add_argument("--lidar", help="another laser than the course's")
    parser.add_argument("--seeds", type=int, default=5, help="drives on the course")
    add_record_option(parser)
    parser.add_argument("rest", nargs="*", help="more options of run, after --")
    asked = parser.parse_args()
    lidar = ["--lidar", asked.lidar] if asked.lidar else []
    if asked.course is None:
        time_recorded(asked.repeat, asked.rest, asked.record)
    else:
        compare_on_course(asked.course, lidar, asked.seeds, asked.rest, asked.record)


if __name__ == "__main__":
    main()
