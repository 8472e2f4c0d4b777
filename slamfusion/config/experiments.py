"""Settings of the experiments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from slamfusion.config.core import Checked, option
from slamfusion.errors import ConfigError


@dataclass(frozen=True)
class OccupancyEstimatorConfig(Checked):
    """The experiment on tinySLAM's occupancy estimator, [H16] Table III."""

    seeds: int = option(20, "repetitions of every condition", low=1, high=1000)
    resolutions: tuple[float, ...] = option(
        (0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
        "cell sizes: first..last in steps of 0.1 m, or a list with commas",
        unit="m",
        low=0.005,
        high=1.0,
    )
    floors: int = option(1, "simulated office floors, drawn by the seeds from 1", low=0, high=100)

    def __post_init__(self) -> None:
        """Refuse an empty list of cell sizes."""
        super().__post_init__()
        if not self.resolutions:
            message = (
                "OccupancyEstimatorConfig.resolutions must be like 0.1..0.6 or 0.1,0.25, each in "
                "[0.005, 1] m, found none"
            )
            raise ConfigError(message)


@dataclass(frozen=True)
class CellModelsConfig(Checked):
    """The experiment on tinySLAM's cell models, [H16] Table I."""

    seeds: int = option(10, "repetitions of every condition", low=1, high=1000)
    floors: int = option(3, "simulated office floors, drawn by the seeds from 1", low=0, high=100)


@dataclass(frozen=True)
class GroundObstacleConfig(Checked):
    """The experiment on fusion with and without a ground obstacle, [F16] Tables I to III."""

    repetitions: int = option(
        30, "drives of each condition in each world; seeds from --seed on", low=1, high=10_000
    )
    worlds: int = option(3, "atriums that are driven in", low=1, high=1000)
    first_world: int = option(1, "seed of the first atrium; the others follow", low=0)
    particles: int = option(80, "particles of gmapping, as in [F16]", low=1, high=10_000)
    draw: bool = option(False, "also draw maps from the scans: at each path, and at the fused one")
    processes: int | None = option(
        None, "drives that run at the same time; default: one for each core", low=1, high=64
    )


@dataclass(frozen=True)
class FailuresConfig(Checked):
    """The experiment on fusion where drives or producers fail."""

    repetitions: int = option(
        3, "drives of each course in each world; seeds from --seed on", low=1, high=10_000
    )
    worlds: int = option(1, "worlds that each course is driven in", low=1, high=1000)
    first_world: int = option(1, "seed of the first world; the others follow", low=0)
    courses: tuple[str, ...] = option(("all",), "courses of the table, with commas, or all")
    lidars: tuple[Literal["kinect", "hokuyo", "rplidar", "lds01"], ...] = option(
        ("kinect", "hokuyo", "rplidar"), "lasers that drive each course, with commas"
    )
    draw: bool = option(False, "also draw maps from the scans: at each path, and at the fused one")
    processes: int | None = option(
        None, "drives that run at the same time; default: one for each core", low=1, high=64
    )


@dataclass(frozen=True)
class ExperimentConfig(Checked):
    """How often the experiments of the papers are repeated, and on what."""

    occupancy_estimator: OccupancyEstimatorConfig = OccupancyEstimatorConfig()
    cell_models_trajectories: CellModelsConfig = CellModelsConfig()
    ground_obstacle: GroundObstacleConfig = GroundObstacleConfig()
    failures: FailuresConfig = FailuresConfig()
