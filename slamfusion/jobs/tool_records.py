"""What the commands beside the main work print with ``--json``: typed documents.

These are ``graph optimize``, ``simulate``, ``devices`` and ``doctor``.

The text below a key is its meaning and unit; the published JSON Schema carries it (see
``slamfusion.jobs.records``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

from slamfusion.compute.records import DeviceInfo, PoclState
from slamfusion.jobs.records import CircumstancesJson, SettingsJson


class GraphOptimizeDocument(SettingsJson):
    """``slamfusion graph optimize``."""

    file: str
    """The pose graph."""
    nodes: int
    """Its vertices."""
    edges: int
    """Its edges."""
    closures: int
    """Of the edges, the ones that close a loop."""
    fixed: Sequence[int]
    """Ids of the vertices that were held."""
    has_poses: bool
    """Whether the file gave the vertices poses; else they were laid along the odometry."""
    skipped_lines: Mapping[str, int]
    """Lines that were not understood, by kind."""
    chi2_start: float
    """Chi-square before, of all edges."""
    chi2: float
    """Chi-square after, of the edges that are no outliers."""
    chi2_all: float
    """Chi-square after, of all edges."""
    iterations: int
    """Steps of the solver."""
    converged: bool
    """Whether the last step changed next to nothing."""
    doubted: Sequence[tuple[int, int]]
    """Ids of both ends of the outliers: closures taken to be false."""
    time_s: float
    """Wall time of the optimisation, seconds."""
    output: str | None
    """The file that the graph was written to."""
    tum: str | None
    """The file that the poses were written to."""


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


class ShowDocument(TypedDict):
    """What ``slamfusion show`` prints when it has begun."""

    url: str
    """Address of the page."""
    maps: list[str]
    """Names of the maps that it shows."""


class LiveLineJson(TypedDict):
    """What a running node says of itself or of an input; a line of its diagnostics."""

    name: str
    """Of the input, or fusion."""
    level: str
    """ok, warn, error or stale."""
    message: str
    """Why, for people."""
    figures: Mapping[str, str]
    """Figures by name, with their units, as the node writes them."""


class LiveStatusDocument(TypedDict):
    """``slamfusion live status``."""

    node: str
    """The node that answered, with its namespace."""
    fusion: LiveLineJson
    """What it says of the fusion."""
    inputs: Sequence[LiveLineJson]
    """What it says of each input."""


class LiveAnswerDocument(TypedDict):
    """``slamfusion live save``, ``reset``, ``set``, ``add`` and ``remove``."""

    success: bool
    """Whether it was done."""
    message: str
    """What was done, or why not; of ``save`` the file."""


class DevicesDocument(TypedDict):
    """``slamfusion devices``."""

    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""


class SelfTestJson(TypedDict):
    """A test of the kernels."""

    name: str
    """What was tested."""
    passed: bool
    """Whether it computes as it should."""
    detail: str
    """What was found."""


class DoctorDocument(TypedDict):
    """``slamfusion doctor``; exit code 1 where it is not ``ok``."""

    ok: bool
    """Whether nothing is wrong."""
    problems: Sequence[str]
    """What is wrong and what to do, a sentence each."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""
    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""
    pocl: PoclState | None
    """What became of the PoCL that came with the package; null where no OpenCL was looked at."""
    device: str | None
    """The one that was tested, in words; null where it cannot be opened."""
    self_test: Sequence[SelfTestJson]
    """The tests of the kernels."""
    install: Mapping[str, str]
    """What to install, by maker of the device."""
