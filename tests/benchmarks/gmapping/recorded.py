"""Parts on recorded drives: accuracy, no odometry, and what a scan costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from rich.table import Table

from slamfusion.evaluation import Summary
from slamfusion.experiments.drives import RELATIONS, Drive, read_drive
from slamfusion.slam.common.runner import ProducerRun
from tests.benchmarks.bench_slam import MEASURED, error, floor
from tests.benchmarks.gmapping.bench import OVER_SEEDS, Bench, over_seeds, shown, times
from tests.support.datasets import ABSENT

NAMES = ("mit-csail", "intel-910-raw")
TIMED_SCANS = 200
TIMED_PARTICLES = (10, 30, 80, 300)
Run = Callable[[Drive, int], ProducerRun]


def recorded(bench: Bench, name: str) -> Drive:
    """Read one of the drives of ``bench_slam``.

    Raises:
        SystemExit: the recordings are not there.
    """
    for files in MEASURED:
        if files.log.name.startswith(name):
            if not files.log.exists():
                raise SystemExit(ABSENT)
            return read_drive(files, bench.config)
    message = f"{name} is none of the measured drives"
    raise SystemExit(message)


def relations_m(bench: Bench, drive: Drive, run: ProducerRun) -> float:
    """Return the mean translation error over all relations, metres."""
    return drive.errors(run.trajectory, bench.config.trajectory)[RELATIONS]


def _rows(bench: Bench, table: Table, cases: Sequence[tuple[str, Run]]) -> None:
    """Add a row for each drive and case."""
    for name in NAMES:
        drive = recorded(bench, name)
        best = floor(drive, bench.config)
        raw = error(drive, drive.scan_odometry(), bench.config)
        for case, run in cases:
            runs = [run(drive, seed) for seed in bench.seeds]
            bench.keep_map(runs[0].grid, bench.seeds[0], drive.name, case)
            table.add_row(
                drive.name,
                case,
                str(len(drive.scans)),
                shown(raw),
                shown(best),
                *over_seeds([relations_m(bench, drive, item) for item in runs]),
                *times(runs),
                f"{max(item.peak_memory_bytes for item in runs) / 1e6:.1f}",
                f"{max(item.low_in_a_row for item in runs)}",
            )


COLUMNS = ("scans", "odometry m", "floor m", *OVER_SEEDS, "ms", "p95 ms", "map MB", "low in a row")


def recordings(bench: Bench) -> None:
    """Mean translation over all relations, with both profiles."""

    def by_profile(profile: str) -> Run:
        config = bench.configured(profile=profile)
        return lambda drive, seed: bench.run(drive.scans, seed, config)

    profiles = ("own", "published") if bench.is_filter else ("own",)
    table = bench.table("relations, metres", "drive", "profile", *COLUMNS)
    _rows(bench, table, [(profile, by_profile(profile)) for profile in profiles])
    bench.console.print(table)


def no_odometry(bench: Bench) -> None:
    """The same by the laser alone."""
    table = bench.table("relations without odometry, metres", "drive", "odometry", *COLUMNS)
    run: Run = lambda drive, seed: bench.run_without_odometry(drive.scans, seed)  # noqa: E731
    _rows(bench, table, [("none", run)])
    bench.console.print(table)


def particles(bench: Bench) -> None:
    """Time for a scan by the number of particles; the seeds are the repetitions."""
    scans = recorded(bench, "intel-910-raw").scans[:TIMED_SCANS]
    table = bench.table(
        f"intel-910-raw, first {TIMED_SCANS} scans, median over the seeds",
        "particles",
        "ms",
        "p95 ms",
        "to the first",
        "the same a particle",
        "peak MB",
        "worst ms of a seed",
    )
    bench.run(scans[:20], bench.seeds[0])  # kernels are built, pages are touched
    first_ms = 0.0
    for count in TIMED_PARTICLES:
        config = bench.configured(particles=count)
        runs = [bench.run(scans, seed, config) for seed in bench.seeds]
        every = Summary.of([run.time_per_scan_ms()["mean"] for run in runs])
        first_ms = first_ms or every.median
        ratio = every.median / first_ms
        table.add_row(
            str(count),
            *times(runs),
            f"{ratio:.2f}",
            f"{ratio * TIMED_PARTICLES[0] / count:.2f}",
            f"{np.max([run.peak_memory_bytes for run in runs]) / 1e6:.1f}",
            f"{every.worst:.2f}",
        )
    bench.console.print(table)
