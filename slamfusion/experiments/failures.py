"""Fusion where something fails: the place, the drive, or one of the producers.

Each course is driven with each laser; with a Kinect most of them in a small place. A fault of the
drive befalls all producers; broken odometry and a laser upside down befall one of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from slamfusion.config import PlaceName, RunConfig
from slamfusion.errors import ConfigError
from slamfusion.experiments.page import Experiment
from slamfusion.experiments.runs import Setup
from slamfusion.experiments.trials import Trial, run_trials
from slamfusion.sim import Course, named_course
from slamfusion.sim.lidar import LIDARS

TITLE = "Fusion where something fails"
# Drives are brisk, and so lasers that see far sweep seldom: fewer scans of as much place.
RATE_HZ = 5.0
HOKUYO_BEAMS = 361
# A Kinect sees 4 m: but for the loop it drives in [F16]'s atrium, where four are a crowd.
SMALL_WORLD: PlaceName = "atrium"
SMALL_CROWD = 4


@dataclass(frozen=True)
class Failure:
    """A way to fail.

    Attributes:
        course: of ``slamfusion.sim.COURSES``.
        fault: of ``slamfusion.experiments.faults.FAULTS``; empty: what the course does suffices.
        harmed: the producer that it befalls; empty: all.
    """

    course: str
    fault: str = ""
    harmed: str = ""


FAILURES: dict[str, Failure] = {
    "corridor loop": Failure("loop"),
    "glass": Failure("glass"),
    "people": Failure("crowd"),
    "slip": Failure("slip"),
    "kidnapping": Failure("loop", "kidnap"),
    "broken odometry": Failure("loop", "break_odometry", "gmapping"),
    "lost for good": Failure("loop", "lose", "tinyslam"),
}


def failure_trials(config: RunConfig) -> list[Trial]:
    """Return every drive of the experiment.

    Args:
        config: drives, worlds, courses and lasers in ``experiment.failures``; the first seed.

    Raises:
        ConfigError: an unknown course or laser.
    """
    settings = config.experiment.failures
    wanted = tuple(FAILURES) if settings.courses == ("all",) else settings.courses
    names = _known(wanted, tuple(FAILURES), "course")
    lidars = _known(settings.lidars, tuple(LIDARS), "laser")
    trials = []
    for name, lidar in itertools.product(names, lidars):
        failure = FAILURES[name]
        for world in range(settings.first_world, settings.first_world + settings.worlds):
            for seed in range(config.seed, config.seed + settings.repetitions):
                course = named_course(failure.course, seed)
                course = replace(course, world=replace(course.world, seed=world))
                course = _seen_by(lidar, course, is_loop=failure == FAILURES["corridor loop"])
                trials.append(
                    Trial(
                        f"{name}, {lidar}",
                        course,
                        world,
                        seed,
                        failure.fault,
                        failure.harmed,
                        is_example=world == settings.first_world and seed == config.seed,
                        draws=settings.draw,
                    )
                )
    return trials


def compare_failures(setup: Setup) -> Experiment:
    """Run the experiment; see ``run_trials``.

    Raises:
        ConfigError: an unknown course or laser.
    """
    settings, trials = setup.config.experiment.failures, failure_trials(setup.config)
    return run_trials("failures", TITLE, trials, settings, setup)


def _seen_by(name: str, course: Course, *, is_loop: bool) -> Course:
    """Return a course for a laser: with it, and of a size that suits it."""
    lidar = LIDARS[name]
    if name != "kinect":
        beams = HOKUYO_BEAMS if name == "hokuyo" else lidar.beams
        return replace(course, lidar=replace(lidar, rate_hz=RATE_HZ, beams=beams))
    course = replace(course, lidar=lidar)
    if is_loop:
        return course
    people = min(course.people, SMALL_CROWD) if isinstance(course.people, int) else course.people
    return replace(course, world=replace(course.world, name=SMALL_WORLD), people=people)


def _known(given: Sequence[str], known: tuple[str, ...], what: str) -> list[str]:
    """Return the names of a list, each once."""
    names = list(dict.fromkeys(given))
    for name in names:
        if name not in known:
            message = f"no {what} {name!r}; wanted some of {', '.join(known)}, with commas"
            raise ConfigError(message)
    return names
