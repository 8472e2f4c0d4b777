"""Trials of the fusion on simulated drives: one drive, three producers, and every map's error.

``ground-obstacle`` is Tables I to III of [F16]: the robot turns by 360 degrees, drives forward,
with or without an obstacle, and turns by 360 degrees again, with a Kinect's narrow view. One seed
gives the same noise and the same producers in both cases.

``failures`` drives each course with each laser; with a Kinect most of them in a small place.
Broken odometry and an upside-down laser affect one producer, other faults all of them.

Source: Fernandes and Alexandre, *SLAMfusion: Fusing SLAM Methods for Improved Robustness*, 2016.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.compute import ComputeDevice, shared_device
from slamfusion.config import FailuresConfig, GroundObstacleConfig, PlaceName, RunConfig
from slamfusion.cores import usable_cores
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.evaluation.measured import map_figures, result_rows
from slamfusion.experiments import fusions
from slamfusion.experiments.page import Experiment, percent
from slamfusion.experiments.runs import RunResult, Setup, Tell, packed_maps, run_all
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan
from slamfusion.jobs.inputs import RUN_VOTE
from slamfusion.jobs.outputs import DRAWN
from slamfusion.sim import Course, named_course
from slamfusion.sim.simulate import Recording, simulate
from slamfusion.sim.world import LIDARS
from slamfusion.slam.registry import BUILT_IN, with_settings
from slamfusion.trajectory import Trajectory

# Drives of ``failures`` are fast, and long-range lasers sweep slowly, to save scans.
RATE_HZ = 5.0
HOKUYO_BEAMS = 361
# A Kinect sees 4 m: except for the loop it drives in [F16]'s atrium, with at most four people.
SMALL_WORLD: PlaceName = "atrium"
SMALL_CROWD = 4


@dataclass(frozen=True)
class Trial:
    """One repetition.

    Attributes:
        condition: case of its rows: a course, with or without an obstacle.
        course: with the seeds of the drive and of the place.
        fault: of ``FAULTS``, applied to the scans; empty: none.
        harmed: the producer with the fault; empty: all.
        is_example: keep its maps' differences to the truth for display.
        draws: also draw maps from the scans at each producer's path and the fused one.
    """

    condition: str
    course: Course
    fault: str = ""
    harmed: str = ""
    is_example: bool = False
    draws: bool = False

    @property
    def key(self) -> str:
        """Name of its files: condition, world and seed."""
        return f"{self.condition.replace(' ', '-')}-{self.repetition}"

    @property
    def repetition(self) -> str:
        """The seed of its rows: world and seed."""
        return f"w{self.course.world.seed}-s{self.course.seed}"


# Failures: a course of ``COURSES``, and fault and harmed producer of a ``Trial``.
FAILURES: dict[str, tuple[str, str, str]] = {
    "corridor loop": ("loop", "", ""),
    "glass": ("glass", "", ""),
    "people": ("crowd", "", ""),
    "slip": ("slip", "", ""),
    "kidnapping": ("loop", "kidnap", ""),
    "broken odometry": ("loop", "break_odometry", "gmapping"),
    "lost for good": ("loop", "lose", "tinyslam"),
}


def obstacle_trials(config: RunConfig) -> list[Trial]:
    """Return every drive of ``ground-obstacle``; the first of each condition is the example."""
    settings = config.experiment.ground_obstacle
    return [
        Trial(
            condition,
            replace(_in_world(named_course("f16", seed), world), obstacles=is_over),
            is_example=number == 0,
            draws=settings.draw,
        )
        for condition, is_over in {"no obstacle": False, "obstacle": True}.items()
        for number, (world, seed) in enumerate(_repetitions(config, settings))
    ]


def failure_trials(config: RunConfig) -> list[Trial]:
    """Return every drive of ``failures``; ConfigError for an unknown course."""
    settings = config.experiment.failures
    names = tuple(FAILURES) if settings.courses == ("all",) else dict.fromkeys(settings.courses)
    for name in names:
        if name not in FAILURES:
            message = f"no course {name!r}; wanted some of {', '.join(FAILURES)}, with commas"
            raise ConfigError(message)
    trials: list[Trial] = []
    for name, lidar in itertools.product(names, dict.fromkeys(settings.lidars)):
        course, fault, harmed = FAILURES[name]
        for number, (world, seed) in enumerate(_repetitions(config, settings)):
            seen = _seen_by(lidar, named_course(course, seed), is_loop=name == "corridor loop")
            trials.append(
                Trial(
                    f"{name}, {lidar}",
                    _in_world(seen, world),
                    fault,
                    harmed,
                    is_example=number == 0,
                    draws=settings.draw,
                )
            )
    return trials


def _repetitions(
    config: RunConfig, settings: GroundObstacleConfig | FailuresConfig
) -> list[tuple[int, int]]:
    worlds = range(settings.first_world, settings.first_world + settings.worlds)
    seeds = range(config.seed, config.seed + settings.repetitions)
    return list(itertools.product(worlds, seeds))


def _in_world(course: Course, world: int) -> Course:
    return replace(course, world=replace(course.world, seed=world))


def _seen_by(name: str, course: Course, *, is_loop: bool) -> Course:
    """Return a course with a laser, in a place of suitable size."""
    lidar = LIDARS[name]
    if name != "kinect":
        beams = HOKUYO_BEAMS if name == "hokuyo" else lidar.beams
        return replace(course, lidar=replace(lidar, rate_hz=RATE_HZ, beams=beams))
    course = replace(course, lidar=lidar)
    if is_loop:
        return course
    people = min(course.people, SMALL_CROWD) if isinstance(course.people, int) else course.people
    return replace(course, world=replace(course.world, name=SMALL_WORLD), people=people)


def compare_with_obstacle(setup: Setup) -> Experiment:
    """Run ``ground-obstacle``; see ``run_trials``."""
    settings = setup.config.experiment.ground_obstacle
    title = "Fusion with and without a ground obstacle ([F16], Tables I to III)"
    config = with_settings(setup.config, "gmapping", particles=settings.particles)
    setup = replace(setup, config=config, processes=settings.processes or usable_cores())
    return run_trials("ground-obstacle", title, obstacle_trials(config), setup)


def compare_failures(setup: Setup) -> Experiment:
    """Run ``failures``; see ``run_trials``. ConfigError for an unknown course."""
    processes = setup.config.experiment.failures.processes or usable_cores()
    trials = failure_trials(setup.config)
    setup = replace(setup, processes=processes)
    return run_trials("failures", "Fusion where something fails", trials, setup)


def run_trials(name: str, title: str, trials: Sequence[Trial], setup: Setup) -> Experiment:
    """Run trials with different keys, and return the experiment; all draw maps or none."""
    found = run_all({trial.key: trial for trial in trials}, _work, setup)
    results = [(trial.condition, own) for trial, own in zip(trials, found, strict=True)]
    return fusion_experiment(name, title, results, draws=trials[0].draws)


def fusion_experiment(
    name: str, title: str, results: Sequence[tuple[str, RunResult]], *, draws: bool = False
) -> Experiment:
    """Return the experiment on fusion of trials.

    Compared are: [F16] errors of every two producers and fusions; the fused path with the
    producers' paths; the faces of the drawn map, or else of the vote of ``run``, with those of the
    producers' maps.
    """
    best = [fusions.CHOICE, fusions.HINDSIGHT]
    drawn = [*map(fusions.drawn_at, (*BUILT_IN, fusions.HINDSIGHT))]
    ours, others = (DRAWN, [RUN_VOTE, *drawn]) if draws else (RUN_VOTE, [])
    experiment = Experiment(
        name,
        title,
        [row for _, result in results for row in result.rows],
        ("error", "ate_rmse_m", "faces_f1"),
        {
            "error": list(itertools.combinations((*BUILT_IN, *fusions.FUSIONS), 2)),
            "ate_rmse_m": [(fusions.FUSED_PATH, other) for other in (*BUILT_IN, *best)],
            "faces_f1": [(ours, other) for other in (*BUILT_IN, *best, *others)],
        },
        inputs=BUILT_IN,
        fusions=fusions.FUSIONS,
        notes=[(condition, result.notes) for condition, result in results],
    )
    means = experiment.summaries["mean"].xs("error", level="figure")
    remarks = [
        f"{case}: {fusion} {percent(means[case, fusion] / means[case, fusions.alone(fusion)])} "
        "against fusing the others alone."
        for case in means.index.unique("case")
        for fusion in fusions.FUSIONS
        if (case, fusions.alone(fusion)) in means.index
    ]
    return replace(experiment, remarks=remarks)


def _work(trial: Trial, config: RunConfig, tell: Tell) -> RunResult:
    try:
        return measure_trial(trial, config, shared_device(config.device.device), tell)
    except SlamFusionError as error:
        raise SlamFusionError(f"{trial.key}: {error}") from None


def measure_trial(
    trial: Trial, config: RunConfig, device: ComputeDevice, tell: Tell | None = None
) -> RunResult:
    """Drive, run the producers, fuse their maps in every way, and measure all maps.

    If no two maps agree, the fallback map of ``run`` counts alone. A missing map is an unknown one.
    """
    config = replace(config, seed=trial.course.seed)
    recording = simulate(trial.course, device)
    truth = recording.world.grid
    faulty = FAULTS[trial.fault](recording.scans) if trial.fault else recording.scans
    fed = {name: faulty if trial.harmed in {"", name} else recording.scans for name in BUILT_IN}
    # A fault of all producers is a fault of the robot.
    seen = recording.scans if trial.harmed else faulty
    made = fusions.fuse_in_every_way(
        fusions.produce_maps(fed, config, device, tell),
        seen,
        config,
        device,
        harmed=trial.harmed,
        drawn_cell_m=truth.resolution if trial.draws else None,
    )
    found = {
        name: fusions.against_truth(grid, truth, config, device, same_heading=True)
        for name, grid in made.maps.items()
    }
    ate_m = made.path_errors(true_path(recording, seen))
    faces = {name: map_figures(item)["faces_f1"] or 0.0 for name, item in found.items()}
    figures: dict[str, dict[str, float]] = {
        name: {"error": item.error, "wall_f1": item.wall_f1 or 0.0, "faces_f1": faces[name]}
        for name, item in found.items()
    }
    for name, error_m in {**ate_m, **_best(ate_m, made.choice, min)}.items():
        figures.setdefault(name, {})["ate_rmse_m"] = error_m
    for name, share in _best(faces, made.choice, max).items():
        figures.setdefault(name, {})["faces_f1"] = share
    rows = [
        row
        for name, own in figures.items()
        for row in result_rows(trial.condition, trial.repetition, name, own)
    ]
    example = None
    if trial.is_example:
        differences = {name: item.difference for name, item in found.items()}
        example = packed_maps(differences, trial.course.world.resolution)
    return RunResult(rows, made.notes, example)


def _best(
    known: Mapping[str, float], choice: str, best: Callable[[Sequence[float]], float]
) -> dict[str, float]:
    """Return the figure of the chosen producer, and of the best in hindsight."""
    found = {}
    if choice in known:
        found[fusions.CHOICE] = known[choice]
    for name, names in (
        (fusions.HINDSIGHT, BUILT_IN),
        (fusions.drawn_at(fusions.HINDSIGHT), map(fusions.drawn_at, BUILT_IN)),
    ):
        own = [known[method] for method in names if method in known]
        if own:
            found[name] = best(own)
    return found


def true_path(recording: Recording, scans: Sequence[LogScan]) -> Trajectory:
    """Return the true poses of the remaining scans, which may have other stamps."""
    rows = {item.line: row for row, item in enumerate(recording.scans)}
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    kept = [rows[item.line] for item in scans]
    return Trajectory(stamps_s, recording.truth.poses[kept], "truth")


# Part of the drive over which the robot is kidnapped.
KIDNAPPED_FROM, KIDNAPPED_TO = 0.45, 0.55
# From this share on, the encoder reads distances too long and turns too small.
BROKEN_FROM, BROKEN_DISTANCE, BROKEN_TURN = 1.0 / 3.0, 1.4, 0.4
LOST_FROM = 0.5

Scans = Sequence[LogScan]


def kidnap(scans: Scans) -> tuple[LogScan, ...]:
    """Cut a part out of the drive, without a gap in time and odometry."""
    first, last = int(KIDNAPPED_FROM * len(scans)), int(KIDNAPPED_TO * len(scans))
    if not 0 < first < last < len(scans):
        return tuple(scans)
    before, after = scans[first - 1], scans[last]
    step_s = scans[first].scan.stamp_s - before.scan.stamp_s
    sooner_s = after.scan.stamp_s - before.scan.stamp_s - step_s
    moved = [
        replace(item, scan=replace(item.scan, stamp_s=item.scan.stamp_s - sooner_s))
        for item in scans[last:]
    ]
    if before.odometry is not None and after.odometry is not None:
        back = before.odometry.compose(after.odometry.inverse())
        moved = [
            replace(item, odometry=item.odometry and back.compose(item.odometry)) for item in moved
        ]
    return (*scans[:first], *moved)


def break_odometry(scans: Scans) -> tuple[LogScan, ...]:
    """Make distances too long and turns too small, in proportion to the motion, from a third on."""
    first = int(BROKEN_FROM * len(scans))
    fed, read, before = list(scans[:first]), None, None
    for item in scans[first:]:
        if item.odometry is None or before is None or read is None:
            read = item.odometry
        else:
            step = before.inverse().compose(item.odometry)
            read = read.compose(
                Pose2(
                    BROKEN_DISTANCE * step.x, BROKEN_DISTANCE * step.y, BROKEN_TURN * step.yaw_rad
                )
            )
        before = item.odometry
        fed.append(item if read is None else replace(item, odometry=read))
    return tuple(fed)


def lose(scans: Scans) -> tuple[LogScan, ...]:
    """Hang the laser upside down from half of the drive on, so that tracking is lost for good."""
    first = int(LOST_FROM * len(scans))
    lost = (replace(item, scan=item.scan.remounted("mirrored")) for item in scans[first:])
    return (*scans[:first], *lost)


FAULTS: dict[str, Callable[[Scans], tuple[LogScan, ...]]] = {
    "kidnap": kidnap,
    "break_odometry": break_odometry,
    "lose": lose,
}
