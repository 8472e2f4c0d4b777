"""Parts on simulated floors: long loops, look-alikes, and what may happen to a robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.evaluation import (
    MapError,
    TrajectoryErrors,
    compare_to_truth,
    doubled_wall_share,
    trajectory_errors,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.sim import Recording, named_course, simulate
from slamfusion.slam.common.runner import ProducerRun, run_producer, skipped_scans
from slamfusion.slam.graph import GraphSlam
from slamfusion.slam.registry import settings_of
from slamfusion.trajectory import Trajectory
from tests.benchmarks.gmapping.bench import WALLS, Bench, Judged, mean_walls, shown
from tests.benchmarks.gmapping.simulated import (
    PATHS,
    drive_course,
    half_an_office,
    judge,
    path_figures,
)
from tests.benchmarks.graph.recorded import BELIEVED, TIMES, chosen, times
from tests.support.events import (
    Drive,
    begun_later,
    closure_errors,
    is_false,
    loops,
    with_odometry_set_to_zero,
    with_pause,
)
from tests.support.odometry import joined

FLOORS = ("ring-100", "ring-300", "wings", "pillars", "rooms", "corridor", "office")
STAND_S = 3600.0
# A log that starts in mid-loop lacks this share of its scans.
LATER_SHARE = 0.35
# A pose that is so far off is that of a robot elsewhere.
AWAY_M = 1.0


@dataclass(frozen=True)
class Loops:
    """What a graph's closures are worth against the truth.

    Attributes:
        believed: how many have at least half of their weight.
        false: of these, how many join two places that are not one.
        doubted_false: the false ones that have less.
        worst_m: greatest error of a believed one, metres; NaN without one.
    """

    believed: int
    false: int
    doubted_false: int
    worst_m: float

    @classmethod
    def of(cls, slam: GraphSlam, truth: Trajectory) -> Loops:
        """Hold a graph's closures against the truth."""
        closures = loops(slam.closures())
        errors = closure_errors(closures, truth)
        believed = np.array([item.weight >= BELIEVED for item in closures], dtype=np.bool_)
        false = is_false(errors)
        return cls(
            int(believed.sum()),
            int((believed & false).sum()),
            int((~believed & false).sum()),
            float(errors[believed, 0].max()) if believed.any() else float("nan"),
        )


def run_graph(bench: Bench, drive: Drive, seed: int) -> tuple[ProducerRun, Loops]:
    """Run a fresh graph on a drive, and judge its closures."""
    slam = GraphSlam(settings_of(bench.config, "graph"), bench.device, seed)
    scans, truth = drive
    return run_producer(slam, scans), Loops.of(slam, truth)


def floors(bench: Bench, only: Sequence[str] = ()) -> None:
    """Errors of path and map, and closures that are false: another course with every seed."""
    table = bench.table(
        "simulated floors",
        *("floor", "path m", "odometry, ATE m", *PATHS, "online, mean"),
        *("closures", "false", "of a seed", "false, doubted", "worst m", *WALLS, *TIMES),
    )
    for name in chosen(FLOORS, only):
        judged: list[Judged] = []
        found: list[Loops] = []
        odometry, online = [], []
        for seed in bench.seeds:
            recording = drive_course(bench, named_course(name, seed))
            run, seen = run_graph(bench, (recording.scans, recording.truth), seed)
            judged.append(judge(bench, recording, run))
            found.append(seen)
            bench.keep_map(run.grid, seed, name)
            config = bench.config.trajectory
            paths = (recording.odometry(), run.online_path() or run.trajectory)
            ates = [trajectory_errors(path, recording.truth, config).ate.rmse for path in paths]
            odometry.append(ates[0])
            online.append(ates[1])
        table.add_row(
            name,
            f"{recording.truth.path_length_m():.0f}",
            shown(float(np.mean(odometry))),
            *path_figures(judged),
            shown(float(np.mean(online))),
            str(sum(item.believed for item in found)),
            str(sum(item.false for item in found)),
            " ".join(str(item.false) for item in found),
            str(sum(item.doubted_false for item in found)),
            shown(float(np.nanmax([item.worst_m for item in found], initial=0.0)), 2),
            *mean_walls(judged),
            *times([item.run for item in judged]),
        )
    bench.console.print(table)


@dataclass(frozen=True)
class _Event:
    """A drive to which something happens.

    Attributes:
        name: of the event.
        drive: the whole of it.
        first: index of the first scan after the event.
        world: the true map.
    """

    name: str
    drive: Drive
    first: int
    world: OccupancyGrid


def events(bench: Bench, only: Sequence[str] = ()) -> None:
    """Stand an hour, be carried to another room, begin in mid-loop: what map and record say.

    Path and map after the event are held against the truth where the path before it lies on it;
    the map of the drive up to the event shows what the old map was worth.
    """
    table = bench.table(
        "office: ATE before the event, distances to the truth after it, metres",
        *("event", "before", "median after", "s over 1 m off", "at the end"),
        *("F1 before", "F1 after", "precision before", "after", "doubled % before", "after"),
        *("closures", "false", "restarts", "times the record names it"),
    )
    rows: dict[str, list[tuple[float, ...]]] = {}
    for seed in bench.seeds:
        for event in _events(bench, seed):
            if chosen((event.name,), only):
                rows.setdefault(event.name, []).append(_event_row(bench, event, seed))
    for name, found in rows.items():
        means = np.nanmean(np.array(found), axis=0)
        counts = np.nansum(np.array(found)[:, -4:], axis=0)
        table.add_row(
            name,
            *(shown(float(value)) for value in means[:-4]),
            *(f"{count:.0f}" for count in counts),
        )
    bench.console.print(table)


def _events(bench: Bench, seed: int) -> Iterator[_Event]:
    """Simulate the office and let things happen in it."""
    there, back, elsewhere = _stretches(bench, seed)
    first, world = len(there.scans), there.world.grid
    drive = joined((there, back))
    yield _Event("none", drive, first, world)
    yield _Event("an hour standing", with_pause(drive, first, STAND_S), first, world)
    carried = joined((there, elsewhere))
    yield _Event("carried, odometry goes on", carried, first, world)
    zero = with_odometry_set_to_zero(carried, first)
    yield _Event("carried, odometry at zero", zero, first, world)
    later = round(LATER_SHARE * len(drive[0]))
    yield _Event("begun in mid-loop", begun_later(drive, later), first - later, world)


def _stretches(bench: Bench, seed: int) -> tuple[Recording, Recording, Recording]:
    """Simulate half an office drive, and the other half from its end or from another room."""
    there, rest = half_an_office(bench, seed)
    back = simulate(replace(rest, seed=seed + 1_000_000), bench.device)
    # The room that was seen first and lies farthest away.
    end, waypoints = there.truth.pose(-1), there.course.waypoints or ()
    seen = waypoints[: len(waypoints) // 2 + 1]
    x, y = max(seen, key=lambda stop: float(np.hypot(stop[0] - end.x, stop[1] - end.y)))
    start = Pose2(x, y, end.yaw_rad + 2.0)
    elsewhere = simulate(replace(rest, seed=seed + 2_000_000, start=start), bench.device)
    return there, back, elsewhere


def _event_row(bench: Bench, event: _Event, seed: int) -> tuple[float, ...]:
    """Run on the drive up to the event and on all of it."""
    scans, truth = event.drive
    before, _ = run_graph(bench, (scans[: event.first], truth), seed)
    run, seen = run_graph(bench, event.drive, seed)
    bench.keep_map(run.grid, seed, event.name)
    parts = [np.s_[: event.first], np.s_[event.first :]]
    old, new = (_part(run.trajectory, part) for part in parts)
    errors = trajectory_errors(old, _part(truth, parts[0]), bench.config.trajectory)
    placed = errors.pose_truth_estimate
    away = np.hypot(*(placed.transform(new.poses[:, :2]) - truth.poses[parts[1], :2]).T)
    alone = trajectory_errors(before.trajectory, truth, bench.config.trajectory)
    walls = [
        _walls(bench, item.grid, event.world, found)
        for item, found in ((before, alone), (run, errors))
    ]
    graph = run.health.to_json().get("graph", {})
    said = skipped_scans(run.health)
    line = f"{event.name}, seed {seed}: {graph}; {'; '.join((*said, *run.warnings())) or 'no word'}"
    bench.console.print(line, highlight=False, soft_wrap=True)
    figures = [getattr(item, name) for name in ("wall_f1", "wall_precision") for item in walls]
    return (
        alone.ate.rmse,
        float(np.median(away)),
        float(np.count_nonzero(away > AWAY_M) * np.median(np.diff(truth.stamps_s))),
        float(away[-1]),
        *(np.nan if value is None else float(value) for value in figures),
        *(100.0 * doubled_wall_share(item.grid) for item in (before, run)),
        float(seen.believed),
        float(seen.false),
        float(graph.get("restarts", 0)),
        float(len(said)),
    )


def _part(path: Trajectory, part: slice) -> Trajectory:
    return Trajectory(path.stamps_s[part], path.poses[part], path.name)


def _walls(
    bench: Bench, grid: OccupancyGrid, truth: OccupancyGrid, found: TrajectoryErrors
) -> MapError:
    return compare_to_truth(
        grid,
        truth,
        found.pose_truth_estimate,
        normalize=bench.config.fusion.normalize,
        tolerance_m=bench.config.evaluate.tolerance_m,
    )
