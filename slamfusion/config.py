"""The one configuration tree: frozen dataclasses, all defaults here and nowhere else.

Every field carries its help text, unit, range and level (``public`` or ``expert``) as metadata.
The command line builds its options from them and the README its tables.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, overload

import yaml

from slamfusion.errors import ConfigError

__all__ = [
    "GMAPPING_PROFILES",
    "ActionConfig",
    "AlignConfig",
    "CellModelsConfig",
    "DeviceConfig",
    "DriveConfig",
    "EvaluateConfig",
    "ExperimentConfig",
    "FieldInfo",
    "FusionConfig",
    "FusionNodeConfig",
    "GmappingConfig",
    "GraphConfig",
    "GraphOptimizerConfig",
    "LidarConfig",
    "LiveConfig",
    "LogConfig",
    "MapFileConfig",
    "MatcherConfig",
    "NormalizeConfig",
    "ObstacleConfig",
    "OccupancyEstimatorConfig",
    "PersonConfig",
    "PlayerNodeConfig",
    "ProducerNodeConfig",
    "RunConfig",
    "SimulateConfig",
    "TinySlamConfig",
    "TrajectoryConfig",
    "VoteConfig",
    "WorldConfig",
    "checked_value",
    "field_infos",
    "from_mapping",
    "load_config",
    "to_mapping",
]

T = TypeVar("T")


def option(
    default: Any,
    text: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    level: str = "public",
) -> Any:
    """Declare a configuration field with its description, unit and inclusive range."""
    metadata = {
        "help": text,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
        "level": level,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class FieldInfo:
    """What the command line, ROS and the README need to know of one field."""

    name: str
    type: Any
    default: Any
    help: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    level: str


def field_infos(config_class: type[Any]) -> list[FieldInfo]:
    """Return the leaf fields of a configuration class, in order; nested classes are left out."""
    hints = typing.get_type_hints(config_class)
    infos = []
    for item in dataclasses.fields(config_class):
        if dataclasses.is_dataclass(hints[item.name]):
            continue
        meta = item.metadata
        infos.append(
            FieldInfo(
                name=item.name,
                type=hints[item.name],
                default=item.default,
                help=meta["help"],
                unit=meta["unit"],
                low=meta["low"],
                high=meta["high"],
                choices=meta["choices"],
                level=meta["level"],
            )
        )
    return infos


def checked_value(info: FieldInfo, value: Any, where: str) -> Any:
    """Return a value as a field's type, or say by a name of the caller's what is wrong with it.

    Args:
        info: the field.
        value: as read from YAML or given by ROS.
        where: what the messages call it, e.g. ``node graph: graph.matcher.beams``.

    Raises:
        ConfigError: a wrong type, not one of the choices, or out of range.
    """
    right = _coerce(value, info.type, where)
    _check_value(where, info, right)
    return right


def _check_value(where: str, info: FieldInfo, value: Any) -> None:
    """Raise ConfigError when ``value`` is outside the field's declared choices or range."""
    if value is None:
        return
    if info.choices and value not in info.choices:
        message = f"{where} must be one of {', '.join(info.choices)}, found {value!r}"
        raise ConfigError(message)
    if info.low is None and info.high is None:
        return
    low = -math.inf if info.low is None else info.low
    high = math.inf if info.high is None else info.high
    if not low <= value <= high:
        unit = f" {info.unit}" if info.unit else ""
        message = f"{where} must lie in [{low:g}, {high:g}]{unit}, found {value!r}"
        raise ConfigError(message)


class _Checked:
    """Checks every field against its declared range and choices after construction."""

    def __post_init__(self) -> None:
        """Refuse values outside the declared range, by name."""
        for info in field_infos(type(self)):
            _check_value(f"{type(self).__name__}.{info.name}", info, getattr(self, info.name))


@dataclass(frozen=True)
class NormalizeConfig(_Checked):
    """From occupancy in percent to unknown / free / occupied on one resolution."""

    occupied_percent: float = option(
        65.0, "a cell at or above this is occupied", unit="%", low=0.0, high=100.0
    )
    free_percent: float = option(
        25.0, "a cell at or below this is free", unit="%", low=0.0, high=100.0
    )
    resolution: float | None = option(
        None, "cell size to bring every input to; default: the finest input's", unit="m", low=1e-4
    )

    def __post_init__(self) -> None:
        """Refuse thresholds that cross."""
        super().__post_init__()
        if self.free_percent >= self.occupied_percent:
            message = (
                f"free_percent ({self.free_percent:g}) must be below "
                f"occupied_percent ({self.occupied_percent:g}); swap them"
            )
            raise ConfigError(message)


@dataclass(frozen=True)
class AlignConfig(_Checked):
    """The search for the rigid motion between two grids, and when to believe it."""

    window_yaw_rad: float = option(
        math.pi, "search yaw within +- this of the start", unit="rad", low=0.0, high=math.pi
    )
    window_m: float | None = option(
        None, "search shifts within this of the start; default: everywhere", unit="m", low=0.0
    )
    step: int | None = option(
        None, "run the fixed-step search of [F16] with this first step instead", unit="cells", low=1
    )
    shared_frame: bool = option(
        False,
        "the maps share their start frame: of equally good answers believe one near the identity",
    )
    prove: bool = option(
        True, "prove the answer the best of the search set, or say how far it may be off"
    )
    deadline_s: float = option(2.0, "stop proving a pair after this long", unit="s", low=0.0)
    coarse_cells: int = option(
        44, "cells on the longest side of the coarsest grid", low=16, high=512, level="expert"
    )
    candidates: int = option(24, "coarse peaks that are refined", low=1, high=64, level="expert")
    proof_points: int = option(
        1024, "wall points that the proof scores", low=16, high=8192, level="expert"
    )
    proof_sigma_cells: float = option(
        4.0,
        "width of the wall likelihood in the proof's score",
        unit="cells",
        low=0.5,
        high=32.0,
        level="expert",
    )


@dataclass(frozen=True)
class VoteConfig(_Checked):
    """How aligned grids decide a cell."""

    mode: str = option(
        "majority",
        "majority; consensus of those that know, without doubled walls; weighted by agreement; or "
        "log-odds of the kept probabilities",
        choices=("majority", "consensus", "weighted", "log-odds"),
    )
    unknown: str = option(
        "auto",
        "unknown as a value, as an abstention, or auto: a value with exactly three voters",
        choices=("auto", "value", "abstain"),
    )
    extent: str = option(
        "reference",
        "fused cells: those of the reference grid, or of the union of all accepted grids",
        choices=("reference", "union"),
    )
    double_reach_m: float = option(
        0.4,
        "consensus: a wall of one input alone this near to one of several is its double",
        unit="m",
        low=0.0,
        high=10.0,
        level="expert",
    )
    solid_walls: bool = option(
        True,
        "consensus and log-odds: walls have a back of one unknown cell, and no disputed front",
        level="expert",
    )


@dataclass(frozen=True)
class FusionConfig(_Checked):
    """Normalise, align, agree on a group, vote."""

    normalize: NormalizeConfig = NormalizeConfig()
    align: AlignConfig = AlignConfig()
    vote: VoteConfig = VoteConfig()
    reference: str | None = option(
        None, "name or index (from 0) of the reference; default: the smallest known box"
    )
    require_all: bool = option(False, "fail when any input is rejected")


@dataclass(frozen=True)
class LiveConfig(_Checked):
    """Fusing maps that arrive again and again."""

    minimum_inputs: int = option(
        2,
        "so many inputs must agree before anything is fused; 1 takes a single input as it is",
        low=1,
        high=32,
    )
    stale_after_s: float = option(
        30.0,
        "an input whose last map is older than another's by more votes no more",
        unit="s",
        low=0.1,
    )
    extent: str = option(
        "union",
        "fused cells: those of the reference, or of all inputs that ever voted",
        choices=("reference", "union"),
    )
    search_share: float = option(
        0.7,
        "a tracked score below this share of what the full search gave calls for a new one",
        low=0.0,
        high=1.0,
    )
    search_pause_s: float = option(
        2.0, "full searches of one input are at least this far apart", unit="s", low=0.0
    )
    jump_m: float = option(
        0.5,
        "a transform that moves an input's centre this far must be found twice in a row",
        unit="m",
        low=0.0,
    )
    jump_rad: float = option(
        0.05, "the same for a turn", unit="rad", low=0.0, high=math.pi, level="expert"
    )
    confirm_s: float = option(
        3.0,
        "a map that jumped and has not changed since is searched again after this time, or after "
        "its second message, in another way; where that finds the same it is believed",
        unit="s",
        low=0.0,
        level="expert",
    )
    pose_apart_m: float = option(
        1.0,
        "poses of one robot farther apart than this contradict each other; see pose_apart_s",
        unit="m",
        low=0.0,
        level="expert",
    )
    pose_apart_rad: float = option(
        0.35, "the same for a turn", unit="rad", low=0.0, high=math.pi, level="expert"
    )
    pose_apart_s: float = option(
        3.0,
        "for this long poses must be apart to take a vote, and together to give it back",
        unit="s",
        low=0.0,
        level="expert",
    )
    hold_cells: float = option(
        0.6,
        "a transform that moves every corner of an input by less is left as it was",
        unit="cells",
        low=0.0,
        high=10.0,
        level="expert",
    )
    track_share: float = option(
        0.01,
        "align again once this share of the wall cells has changed",
        low=0.0,
        high=1.0,
        level="expert",
    )
    steady_share: float = option(
        0.75,
        "a new map belongs to its old transform where this share of the old walls still stands",
        low=0.0,
        high=1.0,
        level="expert",
    )
    track_cells: int = option(
        4_000_000,
        "cells aligned again while a new map waits to be fused; what is larger waits for a pause",
        unit="cells",
        low=1,
        level="expert",
    )


@dataclass(frozen=True)
class EvaluateConfig(_Checked):
    """Measures of a map against the truth."""

    tolerance_m: float = option(
        0.1, "a wall this near a true wall counts as found", unit="m", low=0.0
    )


@dataclass(frozen=True)
class MapFileConfig(_Checked):
    """Reading saved maps."""

    legacy_unknown: bool = option(
        False,
        "read the grey 205 of saved maps, which map savers write for unknown, as unknown also "
        "where free_thresh takes it for free",
    )


@dataclass(frozen=True)
class LogConfig(_Checked):
    """Reading logs and bags."""

    scan_topic: str | None = option(None, "laser topic of a bag; default: its only one")
    odom_topic: str | None = option(
        None, "odometry topic of a bag; default: its only one, or else the transforms"
    )
    base_frame: str | None = option(
        None, "the robot's frame in a bag's transforms; default: base_footprint or base_link"
    )
    odom_frame: str = option("odom", "the odometry frame in a bag's transforms")
    no_return_m: float | None = option(
        None,
        "readings at or above this saw nothing; default: found from the log",
        unit="m",
        low=0.1,
    )
    index_period_s: float = option(
        0.1, "time between scans where the stamps are broken", unit="s", low=1e-3, high=60.0
    )


@dataclass(frozen=True)
class TrajectoryConfig(_Checked):
    """Measures of a trajectory against the truth."""

    tolerance_s: float = option(0.01, "poses this near in time belong together", unit="s", low=0.0)
    alignment: str = option(
        "se2",
        "bring the estimate onto the truth by a rigid motion first, or take both frames for one",
        choices=("se2", "none"),
    )
    rpe_delta: float = option(
        1.0, "what one pair of poses of the relative error spans, in --rpe-unit", low=1e-3
    )
    rpe_unit: str = option(
        "frames",
        "matched poses, metres along the truth, or seconds",
        choices=("frames", "m", "s"),
    )
    odometry_tolerance_m: float = option(
        0.005,
        "an odometry row this near (metres, and radians of heading) is a scan's own",
        unit="m",
        low=1e-6,
        high=0.5,
        level="expert",
    )


@dataclass(frozen=True)
class MatcherConfig(_Checked):
    """The search for the pose at which a scan fits the map, from where the robot may have gone."""

    beams: int = option(
        120, "hits of a scan that the matcher looks at", low=8, high=4096, level="expert"
    )
    first_poses: int = option(
        256, "poses drawn in the matcher's first, wide look", low=16, high=65536, level="expert"
    )
    climbers: int = option(
        6, "poses of the first look from where a climb starts", low=1, high=64, level="expert"
    )
    rounds: int = option(
        4, "rounds of a climb, 16 steps tried each", low=1, high=32, level="expert"
    )
    sigma_m: float = option(
        0.1, "spread of the first look", unit="m", low=0.001, high=10.0, level="expert"
    )
    sigma_m_per_m: float = option(
        0.15, "the same for each metre of odometry", low=0.0, high=10.0, level="expert"
    )
    sigma_rad: float = option(
        0.05, "spread of the first look", unit="rad", low=0.001, high=3.2, level="expert"
    )
    sigma_rad_per_rad: float = option(
        0.2, "the same for each radian of odometry", low=0.0, high=10.0, level="expert"
    )
    prior_weight_xy: float = option(
        0.04, "score lost one spread beside the guessed place", low=0.0, high=1.0, level="expert"
    )
    prior_weight_yaw: float = option(
        0.005, "the same for the guessed heading", low=0.0, high=1.0, level="expert"
    )
    drift_loss: float = option(
        0.05,
        "score lost by believing that the robot went on as it went, against its odometry",
        low=0.0,
        high=1.0,
        level="expert",
    )


@dataclass(frozen=True)
class TinySlamConfig(_Checked):
    """tinySLAM [H16]: a Monte-Carlo scan matcher on one map."""

    matcher: MatcherConfig = MatcherConfig()
    resolution: float = option(0.05, "cell size of the map", unit="m", low=0.005, high=1.0)
    cell_model: str = option("mean", "how a cell joins its observations", choices=("base", "mean"))
    occupancy_estimator: str = option(
        "constant",
        "what a hit says of its cell: always the same, or the area behind the beam's normal",
        choices=("constant", "area"),
    )
    hole_width_m: float = option(
        0.6, "width of the valley around a hit that the matcher sees", unit="m", low=0.0, high=5.0
    )
    quality: float | None = option(
        None,
        "how much of an observation a cell believes; default: 1 for mean, 0.3 for base",
        low=0.01,
        high=1.0,
    )
    quality_moved: float = option(
        0.5,
        "the quality is multiplied by this where the matcher moved the pose far",
        low=0.0,
        high=1.0,
    )
    usable_range_m: float = option(
        30.0, "longer readings are not used", unit="m", low=0.1, high=1000.0
    )
    occupied_share: float = option(
        0.3, "a cell whose mean value reaches this is published as occupied", low=0.05, high=0.95
    )
    matcher_free_value: float = option(
        0.2, "what the matcher's map learns of a passed cell", low=0.0, high=0.5, level="expert"
    )


# gmapping's own names hide built-in ones inside the class below.
_Word: TypeAlias = str

# What a field of ``GmappingConfig`` that is left open becomes.
GMAPPING_PROFILES: dict[str, dict[str, Any]] = {
    "published": {
        "particles": 30,
        "delta": 0.05,
        "sigma": 0.05,
        "kernelSize": 1,
        "lstep": 0.05,
        "astep": 0.05,
        "iterations": 5,
        "lsigma": 0.075,
        "ogain": 3.0,
        "lskip": 0,
        "minimumScore": 0.0,
        "srr": 0.1,
        "srt": 0.2,
        "str": 0.1,
        "stt": 0.2,
        "linearUpdate": 1.0,
        "angularUpdate": 0.5,
        "temporalUpdate": -1.0,
        "resampleThreshold": 0.5,
        "llsamplerange": 0.01,
        "llsamplestep": 0.01,
        "lasamplerange": 0.005,
        "lasamplestep": 0.005,
        "occ_thresh": 0.25,
        "map_update_interval": 5.0,
        "match_every_scan": False,
        "climb_loss": 0.0,
        "memory_budget": 0.0,
    },
    "own": {},
}
GMAPPING_PROFILES["own"] = {
    **GMAPPING_PROFILES["published"],
    "kernelSize": 2,
    "sigma": 0.01,
    "lsigma": 0.02,
    "srr": 0.05,
    "srt": 0.05,
    "str": 0.05,
    "stt": 0.05,
    "linearUpdate": 0.3,
    "angularUpdate": 0.2,
    "match_every_scan": True,
    "climb_loss": 0.005,
    "memory_budget": 480.0,
}


@dataclass(frozen=True)
class GmappingConfig(_Checked):
    """gmapping [G07]: a Rao-Blackwellised particle filter, parameters under their published names.

    A field left open takes the value of its profile; see ``chosen``.
    """

    matcher: MatcherConfig = MatcherConfig()
    profile: _Word = option(
        "own",
        "values of what is left open: our own defaults, or those published with gmapping",
        choices=tuple(GMAPPING_PROFILES),
    )
    particles: int | None = option(None, "particles", low=1, high=10_000)
    delta: float | None = option(None, "cell size of the map", unit="m", low=0.005, high=1.0)
    sigma: float | None = option(
        None, "a hit this far from a wall, squared, counts 1/e", unit="m^2", low=1e-5, high=10.0
    )
    kernelSize: int | None = option(
        None, "a hit looks for walls this many cells around its own", unit="cells", low=0, high=3
    )
    lstep: float | None = option(None, "first step of the climb", unit="m", low=1e-4, high=1.0)
    astep: float | None = option(None, "first step of the climb", unit="rad", low=1e-4, high=1.0)
    iterations: int | None = option(None, "times that the climb halves its steps", low=0, high=20)
    lsigma: float | None = option(
        None, "variance of a hit's distance in the likelihood", unit="m^2", low=1e-4, high=10.0
    )
    ogain: float | None = option(
        None, "weights are evened out by this, times the particles", low=1e-3, high=1e3
    )
    lskip: int | None = option(
        None, "beams passed over after each that the likelihood looks at", low=0, high=1000
    )
    minimumScore: float | None = option(
        None, "least sum over the hits for which a match is believed", low=0.0, high=1e6
    )
    srr: float | None = option(None, "odometry: metres of error for a metre", low=0.0, high=10.0)
    srt: float | None = option(None, "odometry: radians of error for a metre", low=0.0, high=10.0)
    str: float | None = option(None, "odometry: metres of error for a radian", low=0.0, high=10.0)
    stt: float | None = option(None, "odometry: radians of error for a radian", low=0.0, high=10.0)
    linearUpdate: float | None = option(
        None, "weigh and map after this way", unit="m", low=0.0, high=100.0
    )
    angularUpdate: float | None = option(
        None, "weigh and map after this turn", unit="rad", low=0.0, high=10.0
    )
    temporalUpdate: float | None = option(
        None, "weigh and map after this long; below 0 never", unit="s", low=-1.0, high=1e6
    )
    resampleThreshold: float | None = option(
        None,
        "resample when fewer of the particles than this share are effective",
        low=0.0,
        high=1.0,
    )
    llsamplerange: float | None = option(
        None, "proposal: poses this far around the match", unit="m", low=0.0, high=1.0
    )
    llsamplestep: float | None = option(
        None, "proposal: from one pose to the next", unit="m", low=1e-4, high=1.0
    )
    lasamplerange: float | None = option(
        None, "proposal: headings this far around the match", unit="rad", low=0.0, high=1.0
    )
    lasamplestep: float | None = option(
        None, "proposal: from one heading to the next", unit="rad", low=1e-4, high=1.0
    )
    occ_thresh: float | None = option(
        None,
        "a cell is a wall when more than this share of its beams ended in it",
        low=0.0,
        high=1.0,
    )
    map_update_interval: float | None = option(
        None, "a node publishes its map this often", unit="s", low=0.0, high=1e6
    )
    maxUrange: float | None = option(
        None,
        "farther hits are not used, their beams are free up to here; default: 80 m, at most 98 % "
        "of the laser's longest range",
        unit="m",
        low=0.1,
        high=1000.0,
    )
    maxRange: float | None = option(
        None,
        "beams that read this or more are left out; default: the laser's longest range",
        unit="m",
        low=0.1,
        high=10_000.0,
    )
    match_every_scan: bool | None = option(
        None,
        "follow the robot by every scan, not only by those that are weighed and mapped; always "
        "so without odometry",
    )
    climb_loss: float | None = option(
        None,
        "score lost by a climb that ends one spread of the motion model beside what it expects",
        low=0.0,
        high=1.0,
    )
    memory_budget: float | None = option(
        None,
        "when the maps of all particles come near to this, the better half of them goes on; 0 for "
        "no limit",
        unit="MB",
        low=0.0,
        high=1e6,
    )
    motion_model: _Word = option(
        "differential", "how the robot moves", choices=("differential", "bicycle")
    )
    wheel_base: float = option(0.3, "bicycle: between the axles", unit="m", low=0.05, high=10.0)
    steering_sigma: float = option(
        0.05, "bicycle: error of the steering angle", unit="rad", low=0.0, high=1.0
    )
    odometry: _Word = option("poses", "use the log's odometry, or none", choices=("poses", "none"))
    expectation: _Word = option(
        "motion",
        "without odometry the next pose starts from the previous motion, or from the pose as [B16]",
        choices=("motion", "pose"),
    )

    def chosen(self) -> GmappingConfig:
        """Return the configuration with what is left open filled in by the profile."""
        values = GMAPPING_PROFILES[self.profile]
        left_open = {key: value for key, value in values.items() if getattr(self, key) is None}
        return dataclasses.replace(self, **left_open)


@dataclass(frozen=True)
class GraphConfig(_Checked):
    """Graph SLAM [O09, K10, H16c]; names are open_karto's where the meaning is the same."""

    matcher: MatcherConfig = MatcherConfig(beams=400)
    resolution: float = option(0.05, "cell size of the maps", unit="m", low=0.005, high=1.0)
    minimum_travel_distance: float = option(
        0.3, "a scan becomes a node after this way", unit="m", low=0.0, high=100.0
    )
    minimum_travel_heading: float = option(
        0.2, "a scan becomes a node after this turn", unit="rad", low=0.0, high=10.0
    )
    scan_buffer_size: int = option(
        12, "nodes that a submap holds; half of them overlap the next one", low=2, high=10_000
    )
    correlation_search_space_smear_deviation: float = option(
        0.1, "deviation of the likelihood around a hit", unit="m", low=0.005, high=1.0
    )
    do_loop_closing: bool = option(True, "look for places where the robot has been before")
    loop_search_maximum_distance: float = option(
        4.0, "a closure is looked for with submaps this near", unit="m", low=0.0, high=1000.0
    )
    loop_search_space_dimension: float = option(
        8.0,
        "side of the widest window that is searched for a closure",
        unit="m",
        low=0.1,
        high=200.0,
    )
    coarse_search_angle_offset: float = option(
        0.349, "half the angle of that window", unit="rad", low=0.01, high=3.2
    )
    loop_match_minimum_chain_size: int = option(
        6, "a submap of fewer nodes closes no loop", low=1, high=10_000
    )
    loop_match_minimum_response: float = option(
        0.5, "least mean wall value under the hits of a closure", low=0.0, high=1.0
    )
    loop_match_maximum_variance: float = option(
        0.04,
        "a closure that leaves the place open by more is none",
        unit="m^2",
        low=1e-6,
        high=100.0,
    )
    min_pass_through: int = option(
        2, "a cell that fewer beams have crossed is unknown", low=1, high=1000
    )
    occupancy_threshold: float = option(
        0.1,
        "a cell is a wall when more than this share of its beams ended in it",
        low=0.0,
        high=1.0,
    )
    usable_range_m: float = option(
        30.0, "longer readings are not used", unit="m", low=0.1, high=1000.0
    )
    odometry: str = option("poses", "use the log's odometry, or none", choices=("poses", "none"))


@dataclass(frozen=True)
class WorldConfig(_Checked):
    """A simulated place."""

    name: str = option(
        "office",
        "which drawn place, or map for a map file",
        choices=(
            *("office", "corridor", "hall", "atrium", "yard"),
            *("ring-100", "ring-300", "wings", "pillars", "rooms"),
            "map",
        ),
    )
    map: str | None = option(None, "map file of the world `map`; from the course file's folder")
    seed: int | None = option(None, "seed of the drawing; default: the run's seed", low=0)
    resolution: float = option(
        0.05, "cell size of a drawn truth; a map file has its own", unit="m", low=0.01, high=0.25
    )
    wall_height_m: float = option(
        2.5, "beams of a tilted laser pass over walls at this", unit="m", low=0.1, high=20.0
    )
    glass_share: float = option(0.0, "share of the wall cells that are glass", low=0.0, high=1.0)


@dataclass(frozen=True)
class LidarConfig(_Checked):
    """A planar laser: what it can see, how it errs, and where it sits."""

    model: str = option("hokuyo", "its kind", choices=("kinect", "hokuyo", "rplidar"))
    beams: int = option(541, "beams in a sweep", low=1, high=100_000)
    view_rad: float = option(
        math.radians(270.0), "angle from first to last beam", unit="rad", low=0.0, high=math.tau
    )
    clockwise: bool = option(False, "the first beam is the leftmost one")
    rate_hz: float = option(10.0, "sweeps a second", unit="Hz", low=0.1, high=100.0)
    range_min_m: float = option(0.1, "nearer things are too close", unit="m", low=0.0, high=10.0)
    range_max_m: float = option(30.0, "farther things are not seen", unit="m", low=0.1, high=1000.0)
    noise_m: float = option(
        0.01, "standard deviation of a range at 0 m", unit="m", low=0.0, high=1.0
    )
    noise_per_m: float = option(0.0005, "what a metre of range adds to it", low=0.0, high=1.0)
    noise_per_m2: float = option(
        0.0, "what the square of a metre of range adds to it", unit="1/m", low=0.0, high=1.0
    )
    dropout_share: float = option(0.001, "share of readings that fail", low=0.0, high=1.0)
    dropout_far_share: float = option(
        0.0,
        "share of readings at the longest range that fail beside these; falls with the square of "
        "the range",
        low=0.0,
        high=1.0,
    )
    outlier_share: float = option(
        0.0005, "share of readings that stop short anywhere on their way", low=0.0, high=1.0
    )
    mixed_share: float = option(
        0.2, "share of readings at an edge in depth that lie between both sides", low=0.0, high=1.0
    )
    glass_return_share: float = option(
        0.9, "share of beams that glass sends back when met head-on", low=0.0, high=1.0
    )
    glass_angle_rad: float = option(
        0.35,
        "glass met at this angle or more from its normal lets every beam pass",
        unit="rad",
        low=0.01,
        high=math.pi / 2.0,
    )
    mount_x_m: float = option(
        0.1, "laser ahead of the robot's origin", unit="m", low=-10.0, high=10.0
    )
    mount_y_m: float = option(
        0.0, "laser left of the robot's origin", unit="m", low=-10.0, high=10.0
    )
    mount_yaw_rad: float = option(
        0.0, "turn of the laser on the robot", unit="rad", low=-math.tau, high=math.tau
    )
    height_m: float = option(0.25, "laser above the floor", unit="m", low=0.01, high=10.0)


@dataclass(frozen=True)
class DriveConfig(_Checked):
    """How a robot moves, and how its odometry errs."""

    model: str = option("differential", "its kind", choices=("differential", "bicycle", "tracks"))
    radius_m: float = option(
        0.2, "disc that holds the robot; keeps off walls", unit="m", low=0.01, high=5.0
    )
    speed_mps: float = option(0.6, "speed on a free way", unit="m/s", low=0.01, high=10.0)
    turn_rate_rad_s: float = option(1.0, "turning speed at most", unit="rad/s", low=0.01, high=10.0)
    acceleration_mps2: float = option(
        0.8, "change of speed at most", unit="m/s^2", low=0.01, high=100.0
    )
    wheelbase_m: float = option(0.3, "bicycle: between the axles", unit="m", low=0.05, high=5.0)
    steer_max_rad: float = option(
        0.6, "bicycle: steering angle at most", unit="rad", low=0.05, high=1.4
    )
    track_m: float = option(0.4, "tracks: between left and right", unit="m", low=0.05, high=5.0)
    slip_left: float = option(
        0.0, "tracks: share of the left track's motion that is lost", low=0.0, high=0.9
    )
    slip_right: float = option(
        0.0, "tracks: share of the right track's motion that is lost", low=0.0, high=0.9
    )
    travel_noise: float = option(
        0.02, "error of the way after a metre; grows with the square root", low=0.0, high=1.0
    )
    travel_turn_noise: float = option(
        0.005, "error of the way in metres after a turn of a radian", low=0.0, high=1.0
    )
    turn_noise: float = option(
        0.02, "error of a turn of a radian; grows with the square root", low=0.0, high=1.0
    )
    turn_travel_noise: float = option(
        0.01, "error of the heading in radians after a metre", low=0.0, high=1.0
    )
    travel_bias: float = option(
        0.01, "share by which odometry reads the way too long", low=-0.5, high=0.5
    )
    turn_bias: float = option(
        0.01, "share by which odometry reads turns too large", low=-0.5, high=0.5
    )
    turn_travel_bias: float = option(
        0.001, "what odometry turns by itself in a metre", unit="rad/m", low=-0.5, high=0.5
    )


@dataclass(frozen=True)
class ObstacleConfig(_Checked):
    """A cable or low ramp on the floor, [F16]'s ground obstacle: wheels slip, the body tilts."""

    x_m: float = option(0.0, "its middle in the map frame", unit="m", low=-1e7, high=1e7)
    y_m: float = option(0.0, "its middle in the map frame", unit="m", low=-1e7, high=1e7)
    yaw_rad: float = option(
        0.0, "direction straight across it", unit="rad", low=-math.tau, high=math.tau
    )
    across_m: float = option(
        0.6, "way across it on which it is felt", unit="m", low=0.01, high=10.0
    )
    along_m: float = option(1.6, "its length", unit="m", low=0.01, high=100.0)
    slip_share: float = option(
        0.3, "share of the wheels' motion that is lost on it", low=-0.9, high=0.9
    )
    kick_rad_m: float = option(
        0.15, "turn that a metre on it adds unseen by the wheels", unit="rad/m", low=-3.0, high=3.0
    )
    pitch_rad: float = option(
        0.09, "tilt of the body at most: nose up, then down", unit="rad", low=0.0, high=0.7
    )


@dataclass(frozen=True)
class PersonConfig(_Checked):
    """Someone who walks about."""

    speed_mps: float = option(1.0, "walking speed", unit="m/s", low=0.05, high=5.0)
    body: str = option(
        "legs", "what the laser meets: two legs, or one body", choices=("legs", "disc")
    )
    distance_m: float = option(
        0.7, "stands still rather than come this near to the robot", unit="m", low=0.0, high=10.0
    )


@dataclass(frozen=True)
class ActionConfig(_Checked):
    """One command of a script, as the wheels measure it: a turn, a straight way, or a wait."""

    turn_deg: float = option(
        0.0, "turn on the spot, counter-clockwise", unit="deg", low=-36e3, high=36e3
    )
    speed_deg_s: float = option(90.0, "speed of a turn", unit="deg/s", low=0.1, high=1000.0)
    forward_m: float = option(
        0.0, "straight way; negative goes backwards", unit="m", low=-1e4, high=1e4
    )
    speed_mps: float = option(0.5, "speed of a straight way", unit="m/s", low=0.001, high=10.0)
    wait_s: float = option(0.0, "stand still", unit="s", low=0.0, high=3600.0)

    def __post_init__(self) -> None:
        """Refuse a command that is none, or more than one."""
        super().__post_init__()
        given = [name for name in ("turn_deg", "forward_m", "wait_s") if getattr(self, name)]
        if len(given) != 1:
            found = " and ".join(given) or "none of them"
            message = f"a command is one of turn_deg, forward_m and wait_s, found {found}"
            raise ConfigError(message)

    @property
    def duration_s(self) -> float:
        """How long it takes."""
        turn_s = abs(self.turn_deg) / self.speed_deg_s
        return turn_s + abs(self.forward_m) / self.speed_mps + self.wait_s


@dataclass(frozen=True)
class SimulateConfig(_Checked):
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
    lidar: str | None = option(None, "laser on the robot", choices=("kinect", "hokuyo", "rplidar"))
    drive: str | None = option(
        None, "how the robot moves", choices=("differential", "bicycle", "tracks")
    )
    obstacle: bool | None = option(
        None, "a cable on the way, over which wheels slip and the laser tilts"
    )
    people: int | None = option(None, "people who walk about", low=0, high=100)
    glass_share: float | None = option(
        None, "share of the wall cells that are glass", low=0.0, high=1.0
    )


@dataclass(frozen=True)
class OccupancyEstimatorConfig(_Checked):
    """The experiment on tinySLAM's occupancy estimator, [H16] Table III."""

    seeds: int = option(20, "repetitions of every condition", low=1, high=1000)
    resolutions: str = option(
        "0.1..0.6", "cell sizes: first..last in steps of 0.1 m, or a list with commas", unit="m"
    )
    floors: int = option(1, "simulated office floors, drawn by the seeds from 1", low=0, high=100)

    def __post_init__(self) -> None:
        """Refuse what is no list of cell sizes."""
        super().__post_init__()
        self.sizes_m()

    def sizes_m(self) -> tuple[float, ...]:
        """Return the cell sizes in metres, in the order given.

        Raises:
            ConfigError: no such list, or a size outside of what tinySLAM takes.
        """
        try:
            if ".." in self.resolutions:
                first, last = (float(part) for part in self.resolutions.split(".."))
                steps = int((last - first) / 0.1 + 1e-6) if 0.0 < first <= last <= 1.0 else -1
                sizes = tuple(round(first + 0.1 * step, 6) for step in range(steps + 1))
            else:
                sizes = tuple(float(part) for part in self.resolutions.split(","))
        except ValueError:
            sizes = ()
        if not sizes or not all(0.005 <= size <= 1.0 for size in sizes):
            message = (
                f"OccupancyEstimatorConfig.resolutions must be like 0.1..0.6 or 0.1,0.25, each in "
                f"[0.005, 1] m, found {self.resolutions!r}"
            )
            raise ConfigError(message)
        return sizes


@dataclass(frozen=True)
class CellModelsConfig(_Checked):
    """The experiment on tinySLAM's cell models, [H16] Table I."""

    seeds: int = option(10, "repetitions of every condition", low=1, high=1000)
    floors: int = option(3, "simulated office floors, drawn by the seeds from 1", low=0, high=100)


@dataclass(frozen=True)
class GroundObstacleConfig(_Checked):
    """The experiment on fusion with and without a ground obstacle, [F16] Tables I to III."""

    repetitions: int = option(
        30, "drives of each condition in each world; seeds from --seed on", low=1, high=10_000
    )
    worlds: int = option(3, "atriums that are driven in", low=1, high=1000)
    first_world: int = option(1, "seed of the first atrium; the others follow", low=0)
    particles: int = option(80, "particles of gmapping, as in [F16]", low=1, high=10_000)
    processes: int | None = option(
        None, "drives that run at the same time; default: one for each core", low=1, high=64
    )


@dataclass(frozen=True)
class FailuresConfig(_Checked):
    """The experiment on fusion where drives or producers fail."""

    repetitions: int = option(
        3, "drives of each course in each world; seeds from --seed on", low=1, high=10_000
    )
    worlds: int = option(1, "worlds that each course is driven in", low=1, high=1000)
    first_world: int = option(1, "seed of the first world; the others follow", low=0)
    courses: str = option("all", "courses of the table, with commas, or all")
    lidars: str = option("kinect,hokuyo,rplidar", "lasers that drive each course, with commas")
    processes: int | None = option(
        None, "drives that run at the same time; default: one for each core", low=1, high=64
    )


@dataclass(frozen=True)
class ExperimentConfig(_Checked):
    """How often the experiments of the papers are repeated, and on what."""

    occupancy_estimator: OccupancyEstimatorConfig = OccupancyEstimatorConfig()
    cell_models_trajectories: CellModelsConfig = CellModelsConfig()
    ground_obstacle: GroundObstacleConfig = GroundObstacleConfig()
    failures: FailuresConfig = FailuresConfig()


@dataclass(frozen=True)
class GraphOptimizerConfig(_Checked):
    """The optimiser of pose graphs in files."""

    robust: str = option(
        "consensus",
        "how false closures are found: by those that bear each other out, by graduated "
        "non-convexity, by dynamic covariance scaling; or none, and all are believed",
        choices=("consensus", "gnc", "dcs", "none"),
    )
    start: str = option(
        "best",
        "start from the file's poses, the odometry, the chordal relaxation, or the best of them",
        choices=("best", "given", "odometry", "chordal"),
    )
    max_iterations: int = option(
        100, "steps of a descent at most", low=1, high=100_000, level="expert"
    )
    tolerance: float = option(
        1e-5,
        "a descent ends after a step that promises to lower chi-square by a smaller share",
        low=0.0,
        high=0.1,
        level="expert",
    )


@dataclass(frozen=True)
class SideBySideConfig(_Checked):
    """The main job: several producers on one log, side by side, then their fusion."""

    producers: str = option("tinyslam,gmapping,graph", "which producers run, with commas")
    processes: int | None = option(
        None, "producers at work at once; default: as many as there are cores", low=1, high=64
    )
    time_limit_s: float | None = option(
        None, "stop a producer that takes longer and leave it out", unit="s", low=0.1, high=1e7
    )
    path_gap_m: float = option(
        1.0,
        "leave out a producer whose path, laid into the fused map, is this far from the others'",
        unit="m",
        low=0.05,
        high=100.0,
        level="expert",
    )


@dataclass(frozen=True)
class ProducerNodeConfig(_Checked):
    """The ROS node of a producer; not part of ``RunConfig``, whose sections it has beside these."""

    odometry_source: str = option(
        "topic",
        "odometry from nav_msgs/Odometry on `odom`, from the transforms between odom_frame and "
        "base_frame, or none",
        choices=("topic", "tf", "none"),
    )
    odometry_wait_s: float = option(
        0.5,
        "a scan waits this long for the odometry of its time, then it is matched without",
        unit="s",
        low=0.0,
        high=10.0,
    )
    base_frame: str = option("base_link", "the robot's frame")
    odom_frame: str = option("odom", "the odometry frame")
    map_frame: str | None = option(None, "frame of the map; default: the node's name and _map")
    laser_source: str = option(
        "tf",
        "where the laser sits on the robot: by the transforms, or by laser_x, laser_y, laser_yaw",
        choices=("tf", "parameter"),
    )
    laser_x: float = option(0.0, "the laser is this far ahead of the robot's origin", unit="m")
    laser_y: float = option(0.0, "the laser is this far to the left of it", unit="m")
    laser_yaw: float = option(0.0, "the laser looks this far to the left", unit="rad")
    scan_queue: int = option(
        20, "scans that may wait; when one more comes the oldest is dropped", low=1, high=10_000
    )
    map_update_interval_s: float | None = option(
        None,
        "the map is published this often; default: gmapping's map_update_interval, else 1 s",
        unit="s",
        low=0.0,
        high=1e6,
    )
    path_poses: int = option(
        2000, "the published path has at most this many poses", low=2, high=1_000_000
    )
    publish_tf: bool = option(
        False,
        "send the transform from the map's frame to odom_frame (to base_frame without odometry); "
        "one node alone may",
    )
    scans_stale_s: float = option(
        2.0, "no scan for this long is named in the diagnostics", unit="s", low=0.1, high=1e6
    )
    reset_back_s: float = option(
        1.0,
        "several scans in a row that are older than the last one by more begin a new map; a single "
        "one, or one that is older by less, is left out",
        unit="s",
        low=0.0,
        high=1e6,
    )
    seed: int = option(0, "seed of every random number", low=0)


@dataclass(frozen=True)
class FusionNodeConfig(_Checked):
    """The ROS node of the fusion; not part of ``RunConfig``, whose sections it has beside these."""

    fused_frame: str = option("fused_map", "frame of the fused map")
    max_publish_rate_hz: float = option(
        5.0, "the fused map is published at most so often", unit="Hz", low=0.001, high=1000.0
    )
    publish_tf: bool = option(
        False,
        "send the transform from fused_frame to odom_frame, by the pose of the healthiest input "
        "and the odometry; no other node may",
    )
    odometry_source: str = option(
        "topic",
        "for publish_tf: odometry from nav_msgs/Odometry on `odom`, or from the transforms between "
        "odom_frame and base_frame",
        choices=("topic", "tf"),
    )
    base_frame: str = option("base_link", "the robot's frame")
    odom_frame: str = option("odom", "the odometry frame")
    save_path: str = option(
        "fused_map",
        "save_map writes this path with .yaml and .pgm; a change leads nowhere but into the folder "
        "that the node was started with",
    )
    state_path: str | None = option(
        None,
        "file that keeps fused frame, transforms and last map, so that a restart goes on with "
        "them; default: nothing is kept",
    )
    lost_after_s: float = option(
        3.0,
        "an input whose process shows no sign of life, or that nobody publishes, for this long is "
        "lost",
        unit="s",
        low=0.1,
        high=1e6,
    )


@dataclass(frozen=True)
class PlayerNodeConfig(_Checked):
    """The ROS node that plays a log; not part of ``RunConfig``."""

    file: str | None = option(None, "the log or bag")
    rate: float = option(1.0, "times as fast as it was recorded", low=1e-3, high=1e4)
    loop: bool = option(False, "begin again at the end; time jumps back")
    lockstep: bool = option(
        False, "send the next scan when every producer of wait_for has told its pose at the last"
    )
    lockstep_timeout_s: float = option(
        30.0, "give up when a producer has not answered for this long", unit="s", low=0.1, high=1e6
    )
    start_timeout_s: float = option(
        30.0, "wait this long for the listeners before the first scan", unit="s", low=0.0, high=1e6
    )
    odometry: str = option(
        "both",
        "how odometry is sent: on `odom`, as transforms, both, or not at all",
        choices=("topic", "tf", "both", "none"),
    )
    base_frame: str = option("base_link", "the robot's frame")
    odom_frame: str = option("odom", "the odometry frame")
    laser_frame: str = option("laser", "the laser's frame")
    publish_clock: bool = option(True, "send the log's time on /clock, for use_sim_time")
    save: str | None = option(
        None, "folder: after the last scan the newest map of every topic in `maps` is written here"
    )
    save_timeout_s: float = option(
        20.0,
        "wait this long for the maps that hold the last scan, then write what came",
        unit="s",
        low=0.0,
        high=1e6,
    )


@dataclass(frozen=True)
class DeviceConfig(_Checked):
    """Which device computes."""

    device: str = option(
        "auto", "auto, numpy, an index of `slamfusion devices`, or part of a device's name"
    )


@dataclass(frozen=True)
class RunConfig(_Checked):
    """Everything that decides a result; written beside every result."""

    fusion: FusionConfig = FusionConfig()
    live: LiveConfig = LiveConfig()
    log: LogConfig = LogConfig()
    map_files: MapFileConfig = MapFileConfig()
    tinyslam: TinySlamConfig = TinySlamConfig()
    gmapping: GmappingConfig = GmappingConfig()
    graph: GraphConfig = GraphConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    trajectory: TrajectoryConfig = TrajectoryConfig()
    simulate: SimulateConfig = SimulateConfig()
    experiment: ExperimentConfig = ExperimentConfig()
    graph_optimizer: GraphOptimizerConfig = GraphOptimizerConfig()
    run: SideBySideConfig = SideBySideConfig()
    device: DeviceConfig = DeviceConfig()
    seed: int = option(0, "seed of every random number", low=0)


def to_mapping(config: Any) -> dict[str, Any]:
    """Return a configuration as nested plain values, ready for YAML or JSON."""
    return dataclasses.asdict(config)


@overload
def from_mapping(config: type[T], values: Any, where: str = ...) -> T: ...


@overload
def from_mapping(config: T, values: Any, where: str = ...) -> T: ...


def from_mapping(config: Any, values: Any, where: str = "config") -> Any:
    """Build a configuration from nested plain values.

    Args:
        config: one of the dataclasses of this module, or one that holds what is not said.
        values: nested mappings, as read from YAML; missing keys keep their defaults.
        where: what the messages call the source, e.g. the file's path.

    Raises:
        ConfigError: an unknown key (the nearest known one is named), a wrong type or range.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        message = f"{where}: wanted a mapping of settings, found {type(values).__name__}"
        raise ConfigError(message)
    is_class = isinstance(config, type)
    hints = typing.get_type_hints(config if is_class else type(config))
    known = {item.name for item in dataclasses.fields(config)}
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.0)
            message = f"{where}: unknown key {key!r}; the nearest known one is {near[0]!r}"
            raise ConfigError(message)
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            # A section's defaults may be others than its class's.
            section = getattr(config, key, hint)
            arguments[key] = from_mapping(section, value, f"{where}: {key}")
        else:
            arguments[key] = _coerce(value, hint, f"{where}: {key}")
    try:
        return config(**arguments) if is_class else dataclasses.replace(config, **arguments)
    except ConfigError as error:
        message = f"{where}: {error}"
        raise ConfigError(message) from None


def load_config(path: str | Path, base: RunConfig | None = None) -> RunConfig:
    """Read a ``RunConfig`` from a YAML file; see ``from_mapping`` for the errors.

    Args:
        path: the file.
        base: holds what the file does not say; default: the defaults.
    """
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        message = f"{path}: not YAML ({' '.join(str(error).split())}); mend the file"
        raise ConfigError(message) from None
    return from_mapping(RunConfig() if base is None else base, values, str(path))


def _coerce(value: Any, hint: Any, where: str) -> Any:
    """Return ``value`` as the declared type, or say what was wanted."""
    allowed = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if value is None and type(None) in allowed:
        return None
    for wanted in allowed:
        if wanted is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        if wanted is not float and type(value) is wanted:
            return value
    names = " or ".join(getattr(item, "__name__", str(item)) for item in allowed)
    message = f"{where}: wanted {names}, found {value!r}"
    raise ConfigError(message)
