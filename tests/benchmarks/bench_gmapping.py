"""Measure gmapping on recorded and on simulated drives: accuracy and time.

    python -m tests.benchmarks.bench_gmapping --part recordings --seeds 5 --maps out/bench_gmapping

Of a recorded drive the error is the mean translation over all its relations [K09]; of a simulated
one the root mean square of the absolute trajectory error. A simulated part drives another course
with every seed. With --maps the first seed's maps are written as PNG, to be looked at: --first-seed
chooses which. --config takes a YAML file of settings, as the command line does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from rich.table import Table

from slamfusion.experiments.tinyslam import RELATIONS, Drive, read_drive
from slamfusion.sim import Course, Recording, named_course, simulate
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.bench_slam import MEASURED, error, floor, scan_odometry
from tests.benchmarks.producer_bench import (
    OVER_SEEDS,
    PRODUCER,
    WALLS,
    Bench,
    Judged,
    Parts,
    mean_walls,
    measure,
    over_seeds,
    parser_of,
    shown,
    times,
)
from tests.support.datasets import ABSENT

NAMES = ("mit-csail", "intel-910-raw")
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
    raise SystemExit(f"{name} is none of the measured drives")


def relations_m(bench: Bench, drive: Drive, run: ProducerRun) -> float:
    """Return the mean translation error over all relations, metres."""
    return drive.errors(run.trajectory, bench.config)[RELATIONS]


def _rows(bench: Bench, table: Table, cases: Sequence[tuple[str, Run]]) -> None:
    """Add a row for each drive and case."""
    for name in NAMES:
        drive = recorded(bench, name)
        best = floor(drive, bench.config)
        raw = error(drive, scan_odometry(drive), bench.config)
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


PATHS = ("ATE m, mean", "dev.", "worst", "farthest m")
Way = tuple[str, Callable[[Recording, int], ProducerRun]]


def path_figures(judged: Sequence[Judged]) -> list[str]:
    """Return what ``PATHS`` names."""
    mean, deviation, _, worst = over_seeds([item.path.ate.rmse for item in judged])
    return [mean, deviation, worst, shown(max(item.path.ate.max for item in judged))]


def drive_course(bench: Bench, course: Course) -> Recording:
    """Simulate a course, and keep its truth to be looked at."""
    recording = simulate(course, bench.device)
    bench.keep_map(recording.world.grid, course.seed, course.name, "truth")
    return recording


def judge(bench: Bench, recording: Recording, run: ProducerRun) -> Judged:
    """Compare a run with what was simulated."""
    return bench.judge(run, recording.truth, recording.world.grid)


def courses(bench: Bench) -> None:
    """Slipping tracks, a bicycle and an office, by the odometry and by the laser alone."""

    def with_(**settings: str | float) -> Callable[[Recording, int], ProducerRun]:
        config = bench.configured(**settings) if bench.is_filter else bench.config
        return lambda recording, seed: bench.run(recording.scans, seed, config)

    def alone(recording: Recording, seed: int) -> ProducerRun:
        return bench.run_without_odometry(recording.scans, seed)

    wheelbase_m = named_course("yard", 0).drive.wheelbase_m
    bicycle = with_(motion_model="bicycle", wheel_base=wheelbase_m)
    as_given, none = ("as given", with_()), ("no odometry", alone)
    cases: dict[str, tuple[Way, ...]] = {
        "yard-tracks": (as_given, none),
        "yard": (as_given, none),
        "office": (as_given,),
    }
    if bench.is_filter:
        cases["yard"] = (as_given, ("bicycle", bicycle), none)
    columns = (*PATHS, "end m", "worst", "end deg", "worst", *WALLS, "ms", "p95 ms")
    table = bench.table("simulated courses", "course", "case", *columns)
    for name, ways in cases.items():
        recordings = {seed: drive_course(bench, named_course(name, seed)) for seed in bench.seeds}
        for case, run in ways:
            judged = []
            for seed, recording in recordings.items():
                judged.append(judge(bench, recording, run(recording, seed)))
                bench.keep_map(judged[-1].run.grid, seed, name, case)
            ends = [np.array(values) for values in zip(*(j.closure for j in judged), strict=True)]
            table.add_row(
                name,
                case,
                *path_figures(judged),
                *(shown(float(figure), 2) for end in ends for figure in (end.mean(), end.max())),
                *mean_walls(judged),
                *times([item.run for item in judged]),
            )
    bench.console.print(table)


PARTS: Parts = {"recordings": (recordings, 5), "courses": (courses, 5)}


def main() -> None:
    parser = parser_of(PARTS, __doc__, "5")
    parser.add_argument(
        "--producer", choices=tuple(dict.fromkeys((PRODUCER, *BUILT_IN))), default=PRODUCER
    )
    options = parser.parse_args()
    measure(PARTS, options, options.producer, 190)


if __name__ == "__main__":
    main()
