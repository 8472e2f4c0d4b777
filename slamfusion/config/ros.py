"""Settings of the ROS nodes: their parameters."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from slamfusion.config.core import Checked, option
from slamfusion.config.run import Deskew, LaserMounting, deskew_option, sweep_option
from slamfusion.errors import ConfigError

# A word of a topic's name with wildcards that at least one name fits.
_PART = r"\[!?[^]/]+\]"
_WORD = re.compile(rf"([A-Za-z_*?]|{_PART})([A-Za-z0-9_*?]|{_PART})*")


@dataclass(frozen=True)
class NodeConfig(Checked):
    """A node's settings, in which every frame has a name."""

    def __post_init__(self) -> None:
        """Refuse values outside the declared range, and frames without a name."""
        super().__post_init__()
        for name, value in vars(self).items():
            if name.endswith("_frame") and value is not None and not value.strip("/ "):
                raise ConfigError(f"{name}: wanted the name of a frame, found {value!r}")


@dataclass(frozen=True)
class ScanNodeConfig(NodeConfig):
    """How a node reads the scans, the laser's place and the odometry."""

    odometry_source: Literal["topic", "tf", "none"] = option(
        "topic",
        "odometry from nav_msgs/Odometry on `odom`, from the transforms between odom_frame and "
        "base_frame, or none",
    )
    odometry_wait_s: float = option(
        0.5,
        "a scan waits this long for the odometry of its time, then it is matched without",
        low=0.0,
        high=10.0,
    )
    base_frame: str = option("base_link", "the robot's frame")
    odom_frame: str = option("odom", "the odometry frame")
    laser_source: Literal["tf", "parameter"] = option(
        "tf",
        "where the laser sits on the robot: by the transforms, or by laser_x, laser_y, laser_yaw",
    )
    laser_x: float = option(0.0, "the laser is this far ahead of the robot's origin", unit="m")
    laser_y: float = option(0.0, "the laser is this far to the left of it", unit="m")
    laser_yaw: float = option(0.0, "the laser looks this far to the left", unit="rad")
    laser: LaserMounting = option(
        "as-given",
        "how the laser sits, where the transforms say otherwise: mirrored (upside down, or it "
        "turns the other way) or backward",
    )
    deskew: Deskew = deskew_option()
    sweep_s: float | None = sweep_option()
    reset_back_s: float = option(
        1.0,
        "several scans in a row that are older than the last one by more start a new map; other "
        "older scans are dropped",
        low=0.0,
        high=1e6,
    )


@dataclass(frozen=True)
class ProducerNodeConfig(ScanNodeConfig):
    """The ROS node of a producer; not part of ``RunConfig``, whose sections it has too."""

    map_frame: str | None = option(
        None,
        "frame of the map; default: the node's name and _map, after the node's namespace where it "
        "has one",
    )
    scan_queue: int = option(
        20, "scans that may wait; when one more comes the oldest is dropped", low=1, high=10_000
    )
    map_update_interval_s: float | None = option(
        None,
        "the map is published this often; default: gmapping's map_update_interval, else 1 s",
        low=0.0,
        high=1e6,
    )
    publish_tf: bool = option(
        False,
        "send the transform from the map's frame to odom_frame (to base_frame without odometry); "
        "one node alone may",
    )
    scans_stale_s: float = option(
        2.0, "no scan for this long is named in the diagnostics", low=0.1, high=1e6
    )
    seed: int = option(0, "seed of every random number", low=0)


@dataclass(frozen=True)
class FusionNodeConfig(ScanNodeConfig):
    """The ROS node of the fusion; not part of ``RunConfig``, whose sections it has too."""

    fused_frame: str = option("fused_map", "frame of the fused map")
    discover: str | None = option(
        None,
        "map topics (nav_msgs/OccupancyGrid) that fit this become inputs as they appear, named by "
        "their namespace: */map, or several with commas; * stands for one word between slashes, ** "
        "for any number; default: none",
    )
    discovery_rate_hz: float = option(
        0.5, "new map topics are looked for this often", low=0.001, high=10.0
    )
    max_publish_rate_hz: float = option(5.0, "greatest rate of fused maps", low=0.001, high=1000.0)
    publish_tf: bool = option(
        False,
        "send the transform from fused_frame to odom_frame, by the pose of the healthiest input "
        "and the odometry; no other node may",
    )
    correction_speed: float = option(
        0.2,
        "greatest speed at which the transform to odom_frame corrects the robot; above the drift "
        "of its odometry, below what its controller can follow",
        unit="m/s",
        low=1e-3,
        high=1e3,
    )
    correction_turn: float = option(
        0.2, "greatest turning rate of these corrections", unit="rad/s", low=1e-3, high=1e3
    )
    draw: bool = option(
        True,
        "if scans and poses of the inputs arrive, draw the fused map from the scans at the fused "
        "path; maps without poses vote with it",
    )
    on_new_place: Literal["ask", "reset", "keep"] = option(
        "ask",
        "when the scans show that the robot was carried away, or is on another floor: ask for a "
        "reset in the diagnostics, reset at once, or keep the map and only name it",
    )
    save_path: str = option(
        "fused_map",
        "save_map writes this path with .yaml and .pgm; it must stay in the folder that the node "
        "was started with",
    )
    state_path: str | None = option(
        None,
        "file that keeps fused frame, transforms and last map over a restart; default: nothing "
        "is kept",
    )
    lost_after_s: float = option(
        3.0,
        "an input is lost if its process shows no sign of life, or no node publishes it, for "
        "this long",
        low=0.1,
        high=1e6,
    )
    page: bool = option(
        False, "show everything in the browser while it happens; its address is logged"
    )
    page_host: str = option(
        "127.0.0.1",
        "address of the page; with any but this machine's own, everyone on the network can look",
    )
    page_port: int = option(
        8642, "the page is served on this port; 0: any that is free", low=0, high=65535
    )

    def __post_init__(self) -> None:
        """Refuse also patterns that no topic can fit."""
        super().__post_init__()
        for pattern in self.patterns:
            if not all(_WORD.fullmatch(word) for word in pattern.removeprefix("/").split("/")):
                raise ConfigError(
                    f"discover: no topic can fit {pattern!r}; wanted a name such as */map or "
                    "/robot*/map, or several with commas"
                )

    @property
    def patterns(self) -> tuple[str, ...]:
        """The patterns of ``discover``."""
        return tuple(part.strip() for part in self.discover.split(",")) if self.discover else ()


@dataclass(frozen=True)
class PlayerNodeConfig(NodeConfig):
    """The ROS node that plays a log; not part of ``RunConfig``."""

    file: str | None = option(None, "the log or bag")
    rate: float = option(1.0, "times as fast as it was recorded", low=1e-3, high=1e4)
    loop: bool = option(False, "restart at the end; time jumps back")
    lockstep: bool = option(
        False, "send the next scan when every producer of wait_for has published its last pose"
    )
    lockstep_timeout_s: float = option(
        30.0, "give up when a producer has not answered for this long", low=0.1, high=1e6
    )
    start_timeout_s: float = option(
        30.0, "wait this long for the listeners before the first scan", low=0.0, high=1e6
    )
    odometry: Literal["topic", "tf", "both", "none"] = option(
        "both", "how odometry is sent: on `odom`, as transforms, both, or not at all"
    )
    base_frame: str = option("base_link", "the robot's frame")
    odom_frame: str = option("odom", "the odometry frame")
    laser_frame: str = option("laser", "the laser's frame")
    publish_clock: bool = option(True, "send the log's time on /clock, for use_sim_time")
    save: str | None = option(
        None, "folder: after the last scan the newest map of every topic in `maps` is written here"
    )
