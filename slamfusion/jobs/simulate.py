"""A robot's log of a drawn place, with the truth."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamfusion import sim
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.jobs.inputs import Progress, device_for, is_yaml
from slamfusion.jobs.records import Settings
from slamfusion.json_values import FLAT


@dataclass(frozen=True)
class OdometryEndError:
    """How far odometry alone is off at the end of a drive."""

    translation_m: float
    """Distance, metres."""
    rotation_deg: float
    """Size of the turn, degrees."""


@dataclass(frozen=True)
class SimulatedWorld:
    """A drawn place."""

    name: str
    """What kind of place."""
    width_m: float
    """Metres in x."""
    height_m: float
    """Metres in y."""
    resolution: float
    """Metres per cell."""
    people: int
    """People who walk in it."""
    obstacles: int
    """Obstacles that are in no map."""
    glass_cells: int
    """Cells of glass, which the laser often passes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedDrive:
    """A simulated drive; the document of ``slamfusion simulate``."""

    recording: sim.Recording = field(repr=False)
    name: str
    """The course."""
    scans: int
    """Scans of the log."""
    beams: int
    """Readings of a scan."""
    duration_s: float
    """Length of the drive, seconds."""
    path_m: float
    """Its true path, metres."""
    waypoints_left_out: int
    """Planned waypoints that the robot cannot drive to."""
    no_return_share: float
    """Share of the readings without an echo, 0 to 1."""
    odometry_end_error: OdometryEndError
    """How far odometry alone is off at the end."""
    world: SimulatedWorld
    """The place."""
    files: Sequence[Path] = ()
    """What was written."""
    device: str
    """What computed it, in words."""
    seed: int
    """Seed of every random number."""
    time_s: float
    """Wall time of the simulation, seconds."""
    settings: Settings = field(metadata=FLAT)


def choose_course(course: str | Path, config: RunConfig, *, seed: int | None = None) -> sim.Course:
    """Return the course of a name or a YAML file, changed by ``config.simulate``.

    Raises:
        SimulationError: there is no such course, or the file is damaged.
    """
    path = Path(course)
    if is_yaml(path) or path.is_file():
        chosen = sim.load_course(path, config.seed)
        if seed is not None:
            chosen = replace(chosen, seed=seed)
    else:
        chosen = sim.named_course(str(course), config.seed)
    return sim.with_overrides(chosen, config.simulate)


def simulate_course(
    course: str | Path | sim.Course,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    progress: Progress | None = None,
) -> SimulatedDrive:
    """Simulate a robot that drives a course, given as for ``choose_course`` or by its result.

    Raises:
        SimulationError: there is no such course, or it cannot be driven.
    """
    config = config or RunConfig()
    chosen = course if isinstance(course, sim.Course) else choose_course(course, config)
    device = device_for(config, device)
    begun_s = time.perf_counter()
    made = sim.simulate(chosen, device, progress)
    end = made.truth.pose(-1).inverse().compose(made.odometry().pose(-1))
    grid = made.world.grid
    clear = sum(int(item.scan.is_clear().sum()) for item in made.scans)
    return SimulatedDrive(
        recording=made,
        name=chosen.name,
        scans=len(made.scans),
        beams=chosen.lidar.beams,
        duration_s=made.duration_s(),
        path_m=made.truth.path_length_m(),
        waypoints_left_out=len(made.left_out),
        no_return_share=clear / sum(len(item.scan) for item in made.scans),
        odometry_end_error=OdometryEndError(
            math.hypot(end.x, end.y), math.degrees(abs(end.yaw_rad))
        ),
        world=SimulatedWorld(
            name=chosen.world.name,
            width_m=grid.width * grid.resolution,
            height_m=grid.height * grid.resolution,
            resolution=grid.resolution,
            people=len(made.world.people),
            obstacles=len(made.world.obstacles),
            glass_cells=int(made.world.glass.sum()),
        ),
        device=device.name,
        seed=made.course.seed,
        time_s=time.perf_counter() - begun_s,
        settings=Settings(config),
    )


def save_simulated_drive(drive: SimulatedDrive, folder: str | Path) -> SimulatedDrive:
    """Write the log, the truth and the course, all or none; return the drive with its files."""
    return replace(drive, files=sim.write_recording(drive.recording, folder))
