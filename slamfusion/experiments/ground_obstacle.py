"""Tables I to III of [F16]: the error of the maps with and without an obstacle on the ground.

The robot turns by 360 degrees, drives forward, over the obstacle where there is one, and turns by
360 degrees again, with a Kinect's narrow view. Drives are paired: one seed gives the same errors of
odometry and laser, and the same producers, with and without the obstacle.

Source: Fernandes and Alexandre, *SLAMfusion: Fusing SLAM Methods for Improved Robustness*, 2016.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.experiments.error_table import ErrorTable
from slamfusion.experiments.trials import Trial, run_trials
from slamfusion.fleet import Scheduler
from slamfusion.sim import named_course
from slamfusion.slam.registry import with_settings

__all__ = ["CONDITIONS", "NAME", "compare_with_obstacle", "obstacle_trials"]

NAME = "ground-obstacle"
TITLE = "Fusion with and without a ground obstacle ([F16], Tables I to III)"
COURSE = "f16"
CONDITIONS = {"no obstacle": False, "obstacle": True}


def obstacle_trials(config: RunConfig) -> list[Trial]:
    """Return every drive of the experiment; the first of each condition is the example.

    Args:
        config: drives and worlds in ``experiment.ground_obstacle``; the first seed.
    """
    settings = config.experiment.ground_obstacle
    trials = []
    for condition, obstacles in CONDITIONS.items():
        for world in range(settings.first_world, settings.first_world + settings.worlds):
            for seed in range(config.seed, config.seed + settings.repetitions):
                course = named_course(COURSE, seed)
                course = replace(
                    course, world=replace(course.world, seed=world), obstacles=obstacles
                )
                is_example = world == settings.first_world and seed == config.seed
                trials.append(
                    Trial(
                        condition, course, world, seed, is_example=is_example, draws=settings.draw
                    )
                )
    return trials


def compare_with_obstacle(
    config: RunConfig,
    folder: Path,
    progress: Callable[[str, int, int], None] | None = None,
    scheduler: Scheduler | None = None,
) -> ErrorTable:
    """Run every drive that ``folder`` does not hold yet, and return the errors of all.

    Args:
        config: settings of experiment, producers and fusion.
        folder: keeps what is done.
        progress: told the drives that are done.
        scheduler: runs the drives; default: as many processes as the settings say.

    Raises:
        SlamFusionError: a drive failed.
    """
    settings = config.experiment.ground_obstacle
    config = with_settings(config, "gmapping", particles=settings.particles)
    records = run_trials(
        obstacle_trials(config),
        config,
        folder,
        processes=settings.processes,
        scheduler=scheduler,
        progress=progress,
    )
    return ErrorTable(TITLE, tuple(records))
