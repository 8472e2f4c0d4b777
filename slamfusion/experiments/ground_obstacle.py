"""Tables I to III of [F16]: the error of the maps with and without an obstacle on the ground.

The robot turns by 360 degrees, drives forward, over the obstacle where there is one, and turns by
360 degrees again, with a Kinect's narrow view. Drives are paired: one seed gives the same errors of
odometry and laser, and the same producers, with and without the obstacle.

Source: Fernandes and Alexandre, *SLAMfusion: Fusing SLAM Methods for Improved Robustness*, 2016.
"""

from __future__ import annotations

from dataclasses import replace

from slamfusion.config import RunConfig
from slamfusion.experiments.page import Experiment
from slamfusion.experiments.runs import Setup
from slamfusion.experiments.trials import Trial, run_trials
from slamfusion.sim import named_course
from slamfusion.slam.registry import with_settings

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


def compare_with_obstacle(setup: Setup) -> Experiment:
    """Run the experiment; see ``run_trials``."""
    settings = setup.config.experiment.ground_obstacle
    trials = obstacle_trials(setup.config)
    config = with_settings(setup.config, "gmapping", particles=settings.particles)
    return run_trials("ground-obstacle", TITLE, trials, settings, replace(setup, config=config))
