"""Settings of the producers, of their scan matcher, and of the pose graph's optimiser."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from slamfusion.config.core import Checked, option

CellModel: TypeAlias = Literal["base", "mean"]
OccupancyEstimator: TypeAlias = Literal["constant", "area"]


@dataclass(frozen=True)
class MatcherConfig(Checked):
    """The search for the pose at which a scan fits the map, from where the robot may have gone."""

    beams: int = option(
        120, "hits of a scan that the matcher looks at", low=8, high=4096, level="expert"
    )
    jump_m: float = option(
        5.0,
        "a longer step of the odometry between two scans is a reset and rejected; more for a "
        "robot that is fast or scans seldom",
        low=0.01,
        high=10_000.0,
        level="expert",
    )


@dataclass(frozen=True)
class TinySlamConfig(Checked):
    """tinySLAM [H16]: a Monte-Carlo scan matcher on one map."""

    matcher: MatcherConfig = MatcherConfig()
    resolution: float = option(0.05, "cell size of the map", unit="m", low=0.005, high=1.0)
    cell_model: CellModel = option("mean", "how a cell joins its observations")
    occupancy_estimator: OccupancyEstimator = option(
        "constant", "occupancy of a hit's cell: constant, or by the area behind the beam's normal"
    )
    hole_width_m: float = option(
        0.6, "width of the valley around a hit that the matcher sees", low=0.0, high=5.0
    )
    quality: float | None = option(
        None,
        "weight of an observation in a cell; default: 1 for mean, 0.3 for base",
        low=0.01,
        high=1.0,
    )
    usable_range_m: float = option(30.0, "longer readings are not used", low=0.1, high=1000.0)


# What a field of ``GmappingConfig`` that is left open becomes: as published, and our own.
_GMAPPING_VALUES: dict[str, tuple[Any, Any]] = {
    "particles": (30, 30),
    "delta": (0.05, 0.05),
    "sigma": (0.05, 0.01),
    "kernelSize": (1, 2),
    "lstep": (0.05, 0.05),
    "astep": (0.05, 0.05),
    "iterations": (5, 5),
    "lsigma": (0.075, 0.02),
    "ogain": (3.0, 3.0),
    "lskip": (0, 0),
    "minimumScore": (0.0, 0.0),
    "srr": (0.1, 0.05),
    "srt": (0.2, 0.05),
    "str": (0.1, 0.05),
    "stt": (0.2, 0.05),
    "linearUpdate": (1.0, 0.3),
    "angularUpdate": (0.5, 0.2),
    "temporalUpdate": (-1.0, -1.0),
    "resampleThreshold": (0.5, 0.5),
    "llsamplerange": (0.01, 0.01),
    "llsamplestep": (0.01, 0.01),
    "lasamplerange": (0.005, 0.005),
    "lasamplestep": (0.005, 0.005),
    "occ_thresh": (0.25, 0.25),
    "map_update_interval": (5.0, 5.0),
    "match_every_scan": (False, True),
    "climb_loss": (0.0, 0.005),
    "memory_budget": (0.0, 480.0),
}
GMAPPING_PROFILES: dict[str, dict[str, Any]] = {
    profile: {key: values[place] for key, values in _GMAPPING_VALUES.items()}
    for place, profile in enumerate(("published", "own"))
}


@dataclass(frozen=True)
class GmappingConfig(Checked):
    """gmapping [G07]: a Rao-Blackwellised particle filter, parameters under their published names.

    A field left open takes the value of its profile; see ``chosen``.
    """

    matcher: MatcherConfig = MatcherConfig()
    profile: Literal["published", "own"] = option(
        "own",
        "values of parameters that are not set: our own defaults, or those published with gmapping",
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
        None, "least sum over the hits for which a match is accepted", low=0.0, high=1e6
    )
    srr: float | None = option(None, "odometry: metres of error for a metre", low=0.0, high=10.0)
    srt: float | None = option(None, "odometry: radians of error for a metre", low=0.0, high=10.0)
    str: float | None = option(None, "odometry: metres of error for a radian", low=0.0, high=10.0)
    stt: float | None = option(None, "odometry: radians of error for a radian", low=0.0, high=10.0)
    linearUpdate: float | None = option(
        None, "weigh and map after this distance", unit="m", low=0.0, high=100.0
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
        flag="--occ_thresh",
    )
    map_update_interval: float | None = option(
        None,
        "a node publishes its map this often",
        unit="s",
        low=0.0,
        high=1e6,
        flag="--map_update_interval",
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
        "score lost by a climb that ends one spread of the motion model from what it expects",
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
    motion_model: Literal["differential", "bicycle"] = option("differential", "how the robot moves")
    wheel_base: float = option(0.3, "bicycle: between the axles", unit="m", low=0.05, high=10.0)
    steering_sigma: float = option(
        0.05, "bicycle: error of the steering angle", unit="rad", low=0.0, high=1.0
    )
    odometry: Literal["poses", "none"] = option(
        "poses", "use the log's odometry, or none", flag="--use-odometry"
    )
    expectation: Literal["motion", "pose"] = option(
        "motion",
        "without odometry the next pose starts from the previous motion, or from the pose as [B16]",
    )

    def chosen(self) -> GmappingConfig:
        """Return the configuration with what is left open filled in by the profile."""
        values = GMAPPING_PROFILES[self.profile]
        left_open = {key: value for key, value in values.items() if getattr(self, key) is None}
        return dataclasses.replace(self, **left_open)


@dataclass(frozen=True)
class GraphConfig(Checked):
    """Graph SLAM [O09, K10, H16c]; names are open_karto's where the meaning is the same."""

    matcher: MatcherConfig = MatcherConfig(beams=400)
    resolution: float = option(0.05, "cell size of the maps", unit="m", low=0.005, high=1.0)
    minimum_travel_distance: float = option(
        0.3, "a scan becomes a node after this distance", unit="m", low=0.0, high=100.0
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
        4.0,
        "submaps within this distance are searched for closures",
        unit="m",
        low=0.0,
        high=1000.0,
    )
    loop_search_space_dimension: float = option(
        8.0,
        "side of the widest window that is searched for a closure",
        unit="m",
        low=0.1,
        high=200.0,
    )
    loop_match_minimum_chain_size: int = option(
        6, "submaps with fewer nodes are not searched for closures", low=1, high=10_000
    )
    loop_match_minimum_response: float = option(
        0.5, "least mean wall value under the hits of a closure", low=0.0, high=1.0
    )
    loop_match_maximum_variance: float = option(
        0.04,
        "a closure with a greater variance of the place is rejected",
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
    usable_range_m: float = option(30.0, "longer readings are not used", low=0.1, high=1000.0)
    odometry: Literal["poses", "none"] = option(
        "poses", "use the log's odometry, or none", flag="--use-odometry"
    )
