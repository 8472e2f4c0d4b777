"""A robot's log of a drawn place, with the truth."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.jobs.documents import settings_used
from slamfusion.jobs.inputs import Progress, device_for
from slamfusion.jobs.records import CircumstancesJson
from slamfusion.sim import (
    Course,
    Recording,
    load_course,
    named_course,
    simulate,
    with_overrides,
    write_recording,
)

SUFFIXES = {".yaml", ".yml"}


class OdometryEndErrorJson(TypedDict):
    """How far odometry alone is off at the end of a drive."""

    translation_m: float
    """Distance, metres."""
    rotation_deg: float
    """Size of the turn, degrees."""


class SimulatedWorldJson(TypedDict):
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


class SimulatedDriveJson(TypedDict):
    """A simulated drive in numbers."""

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
    odometry_end_error: OdometryEndErrorJson
    """How far odometry alone is off at the end."""
    world: SimulatedWorldJson
    """The place."""


class SimulateDocument(SimulatedDriveJson, CircumstancesJson):
    """``slamfusion simulate``."""

    files: Sequence[str]
    """What was written."""
    time_s: float
    """Wall time, seconds."""


@dataclass(frozen=True, eq=False)
class SimulatedDrive:
    """A simulated drive.

    Attributes:
        recording: the scans, the odometry, the truth, and the course with all that was chosen.
        begun_s: when the simulation began, seconds of ``time.perf_counter``.
    """

    recording: Recording
    config: RunConfig
    device: str
    begun_s: float

    def figures(self) -> SimulatedDriveJson:
        """Return what was made, in numbers."""
        recording = self.recording
        truth, odometry = recording.truth, recording.odometry()
        end = truth.pose(-1).inverse().compose(odometry.pose(-1))
        beams = sum(len(item.scan) for item in recording.scans)
        clear = sum(int(item.scan.is_clear().sum()) for item in recording.scans)
        grid = recording.world.grid
        return {
            "name": recording.course.name,
            "scans": len(recording.scans),
            "beams": recording.course.lidar.beams,
            "duration_s": recording.duration_s(),
            "path_m": truth.path_length_m(),
            "waypoints_left_out": len(recording.left_out),
            "no_return_share": clear / beams,
            "odometry_end_error": {
                "translation_m": math.hypot(end.x, end.y),
                "rotation_deg": math.degrees(abs(end.yaw_rad)),
            },
            "world": {
                "name": recording.course.world.name,
                "width_m": grid.width * grid.resolution,
                "height_m": grid.height * grid.resolution,
                "resolution": grid.resolution,
                "people": len(recording.world.people),
                "obstacles": len(recording.world.obstacles),
                "glass_cells": int(recording.world.glass.sum()),
            },
        }


def choose_course(course: str | Path, config: RunConfig, *, seed: int | None = None) -> Course:
    """Return the course of a name or a YAML file, changed as ``config.simulate`` says.

    Raises:
        SimulationError: there is no such course, or the file is damaged.
        OSError: the file cannot be opened.
    """
    path = Path(course)
    if path.suffix.lower() in SUFFIXES or path.is_file():
        chosen = load_course(path, config.seed)
        if seed is not None:
            chosen = replace(chosen, seed=seed)
    else:
        chosen = named_course(str(course), config.seed)
    return with_overrides(chosen, config.simulate)


def simulate_course(
    course: str | Path | Course,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    progress: Progress | None = None,
) -> SimulatedDrive:
    """Simulate a robot that drives a course.

    Args:
        course: as ``choose_course`` gives it, or what that takes.

    Raises:
        SimulationError: there is no such course, or it cannot be driven.
        DeviceError: the device cannot be opened.
    """
    config = config or RunConfig()
    chosen = course if isinstance(course, Course) else choose_course(course, config)
    device = device_for(config, device)
    begun_s = time.perf_counter()
    return SimulatedDrive(simulate(chosen, device, progress), config, device.name, begun_s)


def save_simulated_drive(drive: SimulatedDrive, folder: str | Path) -> SimulateDocument:
    """Write the log, the truth and the course, all of them or none; see ``write_recording``.

    Returns:
        What ``slamfusion simulate`` prints as JSON; it names the files.

    Raises:
        MapFileError: a file cannot be written; nothing was changed.
    """
    files = write_recording(drive.recording, folder)
    return {
        **drive.figures(),
        "files": [str(path) for path in files],
        "device": drive.device,
        "seed": drive.recording.course.seed,
        "time_s": time.perf_counter() - drive.begun_s,
        **settings_used(drive.config),
    }
