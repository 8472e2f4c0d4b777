"""Parts on simulated courses: slip, wrong odometry, people, outliers, and a robot that stands."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from slamfusion.config import ActionConfig, SimulateConfig
from slamfusion.evaluation import Summary
from slamfusion.io import LogScan
from slamfusion.sim import Course, Recording, named_course, simulate, with_overrides
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.trajectory import Trajectory
from tests.benchmarks.gmapping.bench import (
    OVER_SEEDS,
    WALLS,
    Bench,
    Judged,
    mean_walls,
    over_seeds,
    shown,
    times,
)
from tests.benchmarks.gmapping.recorded import recorded, relations_m
from tests.support.measures import Share, cells_of_people, false_walls
from tests.support.odometry import in_wrong_direction, joined, moments_under_way

WRONG_TIMES, WRONG_S = 3, 2.0
OUTLIER_SHARE = 0.05
STAND_S = 600.0
PATHS = ("ATE m, mean", "dev.", "worst", "farthest m")
Drive = tuple[str, Callable[[Recording, int], ProducerRun]]


def path_figures(judged: Sequence[Judged]) -> list[str]:
    """Return what ``PATHS`` names."""
    ate = Summary.of([item.path.ate.rmse for item in judged])
    farthest_m = max(item.path.ate.max for item in judged)
    return [shown(figure) for figure in (ate.mean, ate.std, ate.worst, farthest_m)]


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
    cases: dict[str, tuple[Drive, ...]] = {
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


def wrong_direction(bench: Bench) -> None:
    """Three times odometry counts backwards for two seconds, in an office and at mit-csail.

    The same drives with the right odometry are in the parts ``courses`` and ``recordings``.
    """
    title = f"odometry counts backwards for {WRONG_S:g} s, {WRONG_TIMES} times"
    table = bench.table(title, "office", *PATHS, *WALLS)
    judged = []
    for seed in bench.seeds:
        recording = drive_course(bench, named_course("office", seed))
        wrong = in_wrong_direction(recording.scans, _moments(recording.scans, seed), WRONG_S)
        judged.append(judge(bench, recording, bench.run(wrong, seed)))
        bench.keep_map(judged[-1].run.grid, seed, "office")
    table.add_row("simulated", *path_figures(judged), *mean_walls(judged))
    bench.console.print(table)

    log = recorded(bench, "mit-csail")
    table = bench.table(f"{title}; relations, metres", "mit-csail", *OVER_SEEDS)
    errors = []
    for seed in bench.seeds:
        wrong = in_wrong_direction(log.scans, _moments(log.scans, seed), WRONG_S)
        run = bench.run(wrong, seed)
        errors.append(relations_m(bench, log, run))
        bench.keep_map(run.grid, seed, "mit-csail")
    table.add_row("recorded", *over_seeds(errors))
    bench.console.print(table)


def _moments(scans: Sequence[LogScan], seed: int) -> list[float]:
    return moments_under_way(scans, WRONG_TIMES, WRONG_S, np.random.default_rng(seed))


def person(bench: Bench) -> None:
    """What people who walk through leave in the map; wanted: at most 1 % of their cells."""
    table = bench.table(
        "free cells within 0.3 m of a person's way that the map shows occupied",
        "course",
        "people",
        "cells",
        *(f"%, {name}" for name in OVER_SEEDS),
        "% of all other free cells",
        "ATE m",
    )
    for name in ("office", "hall"):
        found: list[tuple[Share, Share]] = []
        ate = []
        for seed in bench.seeds:
            recording = drive_course(bench, named_course(name, seed))
            judged = judge(bench, recording, bench.run(recording.scans, seed))
            found.append(
                cells_of_people(
                    judged.run.grid,
                    recording.world.grid,
                    recording.people,
                    judged.path.pose_truth_estimate,
                )
            )
            ate.append(judged.path.ate.rmse)
            bench.keep_map(judged.run.grid, seed, name, "with people")
        table.add_row(
            name,
            str(recording.people.shape[1]),
            str(sum(touched.cells for touched, _ in found)),
            *over_seeds([touched.percent for touched, _ in found], 2),
            f"{np.mean([others.percent for _, others in found]):.2f}",
            f"{np.mean(ate):.3f}",
        )
    bench.console.print(table)


def outliers(bench: Bench) -> None:
    """Walls where none is, by a laser of which 5 % of the readings stop short."""
    table = bench.table(
        "wall cells over 0.15 m from every true wall, of all known cells; RPLIDAR, 6 m",
        "course",
        "outliers",
        *(f"%, {name}" for name in OVER_SEEDS),
        "ATE m",
        *WALLS,
    )
    changes = SimulateConfig(lidar="rplidar", drive="differential", people=0, glass_share=0.0)
    for name, share in itertools.product(("office", "yard"), (0.0, OUTLIER_SHARE)):
        shares, items = [], []
        for seed in bench.seeds:
            course = with_overrides(named_course(name, seed), changes)
            lidar = replace(course.lidar, outlier_share=share)
            recording = drive_course(bench, replace(course, lidar=lidar))
            judged = judge(bench, recording, bench.run(recording.scans, seed))
            wrong = false_walls(
                judged.run.grid, recording.world.grid, judged.path.pose_truth_estimate
            )
            shares.append(wrong.percent)
            items.append(judged)
            bench.keep_map(judged.run.grid, seed, name, f"outliers {100 * share:g}")
        ate = np.mean([item.path.ate.rmse for item in items])
        case = f"{100.0 * share:g} %"
        table.add_row(name, case, *over_seeds(shares), f"{ate:.3f}", *mean_walls(items))
    bench.console.print(table)


def standing(bench: Bench) -> None:
    """Ten minutes without a move between two stretches of driving."""
    table = bench.table(
        f"office, hokuyo, {STAND_S:g} s of standing half way",
        "case",
        "scans",
        *PATHS,
        "way while standing m",
        *WALLS,
        "ms",
        "p95 ms",
    )
    cases: dict[str, list[tuple[Judged, float]]] = {"without": [], "with": []}
    for seed in bench.seeds:
        there, stand, back = _stretches(bench, seed)
        for case, parts in (("without", (there, back)), ("with", (there, stand, back))):
            scans, truth = joined(parts)
            run = bench.run(scans, seed)
            strayed_m = 0.0
            if case == "with":  # the path is judged by the same poses in both cases
                first, last = len(there.scans), len(there.scans) + len(stand.scans)
                still = run.trajectory.poses[first:last, :2]
                strayed_m = float(np.hypot(*(still - still[0]).T).max())
                run = replace(run, trajectory=_without(run.trajectory, first, last))
            judged = bench.judge(run, truth, there.world.grid)
            cases[case].append((judged, strayed_m))
            bench.keep_map(run.grid, seed, "office", case, "a stand")
    for case, found in cases.items():
        items = [judged for judged, _ in found]
        table.add_row(
            f"{case} the stand",
            str(items[0].run.scans),
            *path_figures(items),
            shown(max(strayed_m for _, strayed_m in found)),
            *mean_walls(items),
            *times([item.run for item in items]),
        )
    bench.console.print(table)


def _without(path: Trajectory, first: int, last: int) -> Trajectory:
    """Return a path without the poses from the first up to the last."""
    left_out = np.s_[first:last]
    stamps_s = np.delete(path.stamps_s, left_out)
    return Trajectory(stamps_s, np.delete(path.poses, left_out, axis=0), path.name)


def half_an_office(bench: Bench, seed: int) -> tuple[Recording, Course]:
    """Simulate the first half of an office drive; return it and the course of the second half.

    That one begins where the first ends, and wants another seed: else laser and odometry err twice
    in the same way.
    """
    course = replace(named_course("office", seed), people=0)
    course = replace(course, world=replace(course.world, seed=seed))
    stops = simulate(replace(course, lidar=replace(course.lidar, beams=1)), bench.device)
    waypoints = stops.course.waypoints or ()
    half = len(waypoints) // 2
    there = simulate(replace(course, waypoints=waypoints[:half]), bench.device)
    return there, replace(course, start=there.truth.pose(-1), waypoints=waypoints[half:])


def _stretches(bench: Bench, seed: int) -> tuple[Recording, Recording, Recording]:
    """Simulate half an office drive, the stand at its end, and the other half."""
    there, rest = half_an_office(bench, seed)
    wait = (ActionConfig(wait_s=STAND_S),)
    standing = replace(rest, seed=seed + 1_000_000, waypoints=None, script=wait)
    stand = simulate(standing, bench.device)
    return there, stand, simulate(replace(rest, seed=seed + 2_000_000), bench.device)
