"""``RunConfig``: everything that decides a result; from the fusion to the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from slamfusion.config.core import YAW_MOST_RAD, Checked, option
from slamfusion.errors import ConfigError, StartError, shown

# How maps vote; and how a fused map comes to be, by such a vote or drawn from scans.
VoteMode: TypeAlias = Literal["consensus", "majority"]
FusionMode: TypeAlias = Literal[VoteMode, "drawn"]

# What a setting calls the map with the smallest known box.
SMALLEST = "smallest"


@dataclass(frozen=True)
class NormalizeConfig(Checked):
    """From occupancy in percent to unknown / free / occupied on one resolution."""

    occupied_percent: float = option(
        65.0, "a cell at or above this is occupied", low=0.0, high=100.0
    )
    free_percent: float = option(25.0, "a cell at or below this is free", low=0.0, high=100.0)
    resolution: float | None = option(
        None,
        "cell size to bring every input to; default: the finest input's",
        unit="m",
        low=1e-4,
        flag="--fused-resolution",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.free_percent >= self.occupied_percent:
            raise ConfigError(
                f"free_percent ({self.free_percent:g}) must be below "
                f"occupied_percent ({self.occupied_percent:g}); change one of them"
            )


@dataclass(frozen=True)
class AlignConfig(Checked):
    """The search for the rigid motion between two grids, and when to believe it."""

    window_yaw_rad: float = option(
        math.pi, "search yaw within +- this of the start", low=0.0, high=math.pi
    )
    window_m: float | None = option(
        None, "search shifts within this of the start; default: everywhere", low=0.0
    )
    step: int | None = option(
        None,
        "run the fixed-step search of [F16] with this first step instead; never onto a true map",
        unit="cells",
        low=1,
    )
    shared_frame: bool = option(
        False,
        "the maps share their start frame: of equally good answers prefer one near the identity",
    )
    coarse_cells: int = option(
        60, "cells on the longest side of the coarsest grid", low=16, high=512, level="expert"
    )


@dataclass(frozen=True)
class VoteConfig(Checked):
    """How aligned grids decide a cell."""

    mode: FusionMode = option(
        "consensus",
        "consensus: maps that agree decide, walls are voted for with a tolerance; majority of each "
        "cell, as in [F16]; or drawn (run alone) from all scans at the fused path",
    )
    unknown: Literal["auto", "value", "abstain"] = option(
        "auto", "majority: unknown as a value, as an abstention, or auto: a value with three voters"
    )
    extent: Literal["reference", "union"] = option(
        "union",
        "fused cells: the union of all maps that fit, or those of the reference alone; drawn is "
        "always a union",
    )


@dataclass(frozen=True)
class FusionConfig(Checked):
    """Normalise, align, agree on a group, vote."""

    normalize: NormalizeConfig = NormalizeConfig()
    align: AlignConfig = AlignConfig()
    vote: VoteConfig = VoteConfig()
    reference: str | None = option(
        None,
        "reference map: a name, an index from 0, or smallest (the smallest known box); default: "
        "the first that fits, live the smallest",
    )
    require_all: bool = option(False, "fail when any input is rejected")
    keep_duplicates: bool = option(
        False, "saved maps of equal cells, resolution and origin each have a vote, as in [F16]"
    )


@dataclass(frozen=True)
class LiveConfig(Checked):
    """Fusing maps that arrive again and again."""

    minimum_inputs: int = option(
        2,
        "inputs that must agree before anything is fused; 1 takes a single input as it is",
        low=1,
        high=32,
    )
    stale_after_s: float = option(
        30.0, "an input does not vote if its last map is older than another's by more", low=0.1
    )
    extent: Literal["reference", "union"] = option(
        "union", "fused cells: those of the reference, or of all inputs that ever voted"
    )
    search_share: float = option(
        0.7,
        "an input is searched again when it explains less than this share of the common walls that "
        "it explained when it was searched",
    )
    search_pause_s: float = option(2.0, "least time between full searches of one input", low=0.0)
    jump_m: float = option(
        0.5,
        "a transform that moves an input's centre this far must be found twice in a row",
        low=0.0,
    )
    confirm_s: float = option(
        3.0,
        "a map that jumped and has not changed since is searched again after this time, or after "
        "its second message, in another way; it is accepted if that finds the same",
        low=0.0,
        level="expert",
    )


@dataclass(frozen=True)
class EvaluateConfig(Checked):
    """Measures of a map against the truth."""

    tolerance_m: float = option(0.1, "a wall this near a true wall counts as found", low=0.0)


LidarName: TypeAlias = Literal["kinect", "hokuyo", "rplidar", "lds01"]


@dataclass(frozen=True)
class SimulateConfig(Checked):
    """What a simulated drive changes of its course; unset, the course decides."""

    world: str | None = option(
        None,
        "drawn place (office, corridor, hall, atrium, yard, ring-100, ring-300, wings, pillars, "
        "rooms), or a map file",
    )
    world_seed: int | None = option(None, "seed of the drawn place; default: the run's seed", low=0)
    resolution: float | None = option(
        None, "cell size of the drawn truth", unit="m", low=0.01, high=0.25
    )
    lidar: LidarName | None = option(None, "laser on the robot")
    drive: Literal["differential", "bicycle", "tracks"] | None = option(None, "how the robot moves")
    obstacle: bool | None = option(
        None, "a cable on the way, over which wheels slip and the laser tilts"
    )
    people: int | None = option(None, "people who walk about", low=0, high=100)
    glass_share: float | None = option(None, "share of the wall cells that are glass")


@dataclass(frozen=True)
class GraphOptimizerConfig(Checked):
    """The optimiser of pose graphs in files."""

    robust: Literal["consensus", "gnc", "dcs", "none"] = option(
        "consensus",
        "how false closures are found: by those that support each other, by graduated "
        "non-convexity, by dynamic covariance scaling; or none, and all are accepted",
    )
    start: Literal["best", "given", "odometry", "chordal"] = option(
        "best",
        "start from the file's poses, the odometry, the chordal relaxation, or the best of them",
    )


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
    lidars: tuple[LidarName, ...] = option(
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


# Default tolerances of a start: a person pointing at a plan, or a robot placed on a mark.
START_M = 2.0
START_RAD = 0.35
START_FORM = "x,y,yaw or x,y,yaw,metres,radians"
POSE, POSE_AND_TOLERANCES = 3, 5
ANGLES = {2: "yaw", 4: "tolerance of the yaw"}
DEGREES = "deg"


def checked_start(given: Any, where: str) -> tuple[float, ...]:
    """Return a start as 3 numbers (x, y in m, yaw in rad) or 5 (and tolerances in m and rad).

    Args:
        given: numbers, or a text of them with commas. Angles may be in degrees: ``46.4deg``.

    Raises:
        StartError: another count of numbers, one that is not finite, a negative tolerance, or an
            angle of more than two turns.
    """
    parts = given.split(",") if isinstance(given, str) else given
    is_row = isinstance(parts, Sequence) and not isinstance(parts, bytes)
    values: tuple[float, ...] = ()
    if is_row and not any(isinstance(part, bool) for part in parts):
        with suppress(TypeError, ValueError, OverflowError):
            values = tuple(
                _angle_rad(part) if place in ANGLES else float(part)
                for place, part in enumerate(parts)
            )
    is_right = len(values) in {POSE, POSE_AND_TOLERANCES} and all(map(math.isfinite, values))
    if not is_right or any(value < 0.0 for value in values[POSE:]):
        found = ",".join(map(_shown, parts[:10])) if is_row else shown(given)
        wanted = f"wanted {START_FORM}, all finite, tolerances from 0"
        raise StartError(f"{where}: {wanted}; found {found}")
    for place, value in enumerate(values):
        if place in ANGLES and abs(value) > YAW_MOST_RAD:
            raise StartError(
                f"{where}: the {ANGLES[place]} must lie within {YAW_MOST_RAD:.2f} radians, found "
                f"{value:g}; if these are degrees, write {value:g}{DEGREES}"
            )
    return values


def checked_starts(given: Any) -> dict[str, tuple[float, ...]]:
    """Return starts by the names of inputs; StartError if refused, see ``checked_start``."""
    if not isinstance(given, Mapping):
        raise StartError(
            f"start: wanted names of inputs with {START_FORM} each, found {shown(given)}"
        )
    named = {name if isinstance(name, str) else shown(name): own for name, own in given.items()}
    return {name: checked_start(own, f"start: {name}") for name, own in named.items()}


def _angle_rad(given: Any) -> float:
    """Return an angle in radians; text that ends in ``deg`` is in degrees."""
    if isinstance(given, str) and given.strip().endswith(DEGREES):
        return math.radians(float(given.strip().removesuffix(DEGREES)))
    return float(given)


def _shown(part: Any) -> str:
    return (" ".join(part.split()) if isinstance(part, str) else shown(part))[:40]


# The page of a report, its numbered pictures, and the formats of pictures.
PAGE, PICTURES = "report.html", "[0-9][0-9]-*"
PICTURE_FORMS = ("png", "svg", "pdf")


@dataclass(frozen=True)
class MapFileConfig(Checked):
    """Reading saved maps."""

    legacy_unknown: bool = option(
        False,
        "read the grey 205 of saved maps, which map savers write for unknown, as unknown also "
        "where free_thresh takes it for free",
    )


# Real mounting of a laser, if transforms or the order of its ranges differ.
LaserMounting = Literal["as-given", "mirrored", "backward"]
# Whether the beams of a sweep are moved to its stamp.
Deskew = Literal["auto", "no"]


def deskew_option() -> Any:
    """Declare whether scans are deskewed, of logs and of nodes."""
    return option(
        "auto",
        "move the beams of a sweep to its stamp by the robot's motion: auto (where that matters) "
        "or no",
    )


def sweep_option() -> Any:
    """Declare how long a sweep takes, of logs and of nodes."""
    return option(
        None,
        "time from the first to the last beam of a sweep; default: by the time_increment of the "
        "scans, if plausible",
        unit="s",
        low=-10.0,
        high=10.0,
    )


@dataclass(frozen=True)
class LogConfig(Checked):
    """Reading logs and bags."""

    scan_topic: str | None = option(None, "laser topic of a bag; default: its only one")
    odom_topic: str | None = option(
        None,
        "odometry topic of a bag, tf for the transforms, or none; default: its only one, or else "
        "the transforms",
    )
    tf_topic: str | None = option(
        None, "transforms of a bag of several robots, e.g. /robot1/tf; default: the laser's own"
    )
    base_frame: str | None = option(
        None, "the robot's frame in a bag's transforms; default: base_footprint or base_link"
    )
    odom_frame: str = option("odom", "the odometry frame in a bag's transforms")
    no_return_m: float | None = option(
        None, "readings at or above this are no return; default: found from the log", low=0.1
    )
    laser: LaserMounting = option(
        "as-given",
        "how the laser sits, where log and transforms say otherwise: mirrored (upside down, or it "
        "turns the other way) or backward",
    )
    deskew: Deskew = deskew_option()
    sweep_s: float | None = sweep_option()
    axes: Literal["robot", "camera"] = option(
        "robot", "axes of a TUM file: of a robot (x ahead, z up) or of a camera (z ahead, y down)"
    )
    quaternion: Literal["xyzw", "wxyz"] = option(
        "xyzw", "order in which a TUM file has its quaternions"
    )
    index_period_s: float = option(
        0.1, "time between scans where the stamps are broken", low=1e-3, high=60.0
    )


@dataclass(frozen=True)
class TrajectoryConfig(Checked):
    """Measures of a trajectory against the truth."""

    tolerance_s: float = option(0.01, "poses this near in time belong together", low=0.0)
    pose_topic: str | None = option(
        None,
        "for a bag given as the truth: a topic of PoseStamped, PoseWithCovarianceStamped or "
        "Odometry, or tf; default: the odometry of its scans, or its only such topic",
    )
    time_offset: str = option(
        "0",
        "seconds to add to the times of the truth and of paths given for a log, if their clock "
        "differs; auto finds them by the motion",
    )
    alignment: Literal["se2", "none"] = option(
        "se2",
        "align the estimate with the truth by a rigid motion first, or use both frames as they are",
    )
    rpe_delta: float = option(
        1.0, "distance between the two poses of a relative error, in --rpe-unit", low=1e-3
    )
    rpe_unit: Literal["frames", "m", "s"] = option(
        "frames", "matched poses, metres along the truth, or seconds"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            is_known = self.time_offset == "auto" or math.isfinite(float(self.time_offset))
        except ValueError:
            is_known = False
        if not is_known:
            message = f"time_offset: wanted seconds or auto, found {shown(self.time_offset)}"
            raise ConfigError(message)


@dataclass(frozen=True)
class SideBySideConfig(Checked):
    """The main job: several producers on one log, side by side, then their fusion."""

    producers: tuple[str, ...] = option(
        (), "which producers run, with commas; default: those that are built in"
    )
    processes: int | None = option(
        None, "producers that run at once; default: one for each core", low=1, high=64
    )
    time_limit_s: float | None = option(
        None, "leave out a producer that takes longer, its start included", low=0.1, high=1e7
    )
    draw: bool = option(
        False, "also draw a map from all scans at the fused path, in addition to the vote"
    )


@dataclass(frozen=True)
class DeviceConfig(Checked):
    """Which device computes."""

    device: str = option(
        "auto", "where to compute: auto, numpy, an index or part of a name of `slamfusion devices`"
    )


@dataclass(frozen=True)
class ReportConfig(Checked):
    """What reports write in addition to their pages."""

    pictures: tuple[Literal["svg", "pdf"], ...] = option(
        (), "also write the pictures of a report as svg, pdf, or both (svg,pdf)"
    )


@dataclass(frozen=True)
class RunConfig(Checked):
    """Everything that decides a result; written with every result.

    ``producers`` holds the settings of producers by name, each a dataclass of its own; one that is
    not in it has its defaults (``slamfusion.slam.registry`` knows them all).

    ``start`` holds the expected poses of inputs' map frames by name: x, y in m, yaw in rad, and, if
    others than the defaults, the tolerances in m and rad; see ``slamfusion.align.starts``.
    """

    fusion: FusionConfig = FusionConfig()
    live: LiveConfig = LiveConfig()
    log: LogConfig = LogConfig()
    map_files: MapFileConfig = MapFileConfig()
    producers: Mapping[str, Any] = field(default_factory=dict)
    evaluate: EvaluateConfig = EvaluateConfig()
    trajectory: TrajectoryConfig = TrajectoryConfig()
    simulate: SimulateConfig = SimulateConfig()
    experiment: ExperimentConfig = ExperimentConfig()
    graph_optimizer: GraphOptimizerConfig = GraphOptimizerConfig()
    run: SideBySideConfig = SideBySideConfig()
    report: ReportConfig = ReportConfig()
    device: DeviceConfig = DeviceConfig()
    seed: int = option(0, "seed of every random number", low=0)
    start: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "start", checked_starts(self.start))
