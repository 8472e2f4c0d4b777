"""The interface of the nodes: topics, services and parameters, for help, pages and launch files.

Nothing here needs ROS; a test compares the lists with the running nodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from slamfusion.config import (
    START_FORM,
    ConfigOption,
    DeviceConfig,
    FusionConfig,
    FusionNodeConfig,
    LiveConfig,
    LogConfig,
    MapFileConfig,
    PlayerNodeConfig,
    ProducerNodeConfig,
    config_fields,
)
from slamfusion.slam.registry import BUILT_IN, producer

PRODUCERS = BUILT_IN
NODES = (*PRODUCERS, "fusion", "player")


@dataclass(frozen=True)
class Topic:
    """A topic of our nodes.

    Attributes:
        name: relative unless it starts with a slash; NAME is the producer's name.
        writers, readers: of our nodes; ``producers`` stands for the three.
        qos: what is written, or asked for where only others write it.
        needs_tf2: only there where tf2_msgs is (a sourced ROS's messages); None: no matter.
    """

    name: str
    type: str
    writers: tuple[str, ...]
    readers: tuple[str, ...]
    qos: str
    text: str
    needs_tf2: bool | None = None


@dataclass(frozen=True)
class Service:
    """A service of one of our nodes, apart from those that every node has for its parameters."""

    name: str
    type: str
    node: str
    text: str


@dataclass(frozen=True)
class NameList:
    """A parameter that is a list of names, which no configuration field stands for."""

    name: str
    default: tuple[str, ...]
    text: str


SENSOR, STREAM = "best effort", "reliable"
MAP = "reliable, transient local, depth 1"

TOPICS = (
    Topic(
        "scan", "sensor_msgs/LaserScan", ("player",), ("producers", "fusion"), SENSOR, "laser scans"
    ),
    Topic(
        "odom",
        "nav_msgs/Odometry",
        ("player",),
        ("producers", "fusion"),
        SENSOR,
        "odometry, unless it is taken from the transforms",
    ),
    Topic(
        "NAME/map",
        "nav_msgs/OccupancyGrid",
        ("producers",),
        ("fusion", "player"),
        MAP,
        "the map of one SLAM, in frame NAME_map (in a namespace robot1/NAME_map)",
    ),
    Topic(
        "NAME/map_updates",
        "map_msgs/OccupancyGridUpdate",
        (),
        ("fusion",),
        STREAM,
        "what changed of a map, from costmaps and SLAMs of others; where map_msgs is installed",
        needs_tf2=True,
    ),
    Topic(
        "NAME/map_metadata", "nav_msgs/MapMetaData", ("producers",), (), MAP, "its size and place"
    ),
    Topic(
        "NAME/pose",
        "geometry_msgs/PoseStamped",
        ("producers",),
        ("fusion", "player"),
        f"{STREAM}, liveliness lease 0.5 s",
        "the robot in the map's frame, one for every scan that was used, with its stamp",
    ),
    Topic(
        "NAME/path",
        "nav_msgs/Path",
        ("producers",),
        (),
        MAP,
        "the path so far, corrected; the fusion listens while it hears scans",
    ),
    Topic("fused/map", "nav_msgs/OccupancyGrid", ("fusion",), (), MAP, "the fused map"),
    Topic(
        "fused/map_updates",
        "map_msgs/OccupancyGridUpdate",
        ("fusion",),
        (),
        STREAM,
        "the box of fused/map that changed, unless the map has grown; where map_msgs is installed",
        needs_tf2=True,
    ),
    Topic(
        "fused/agreement",
        "nav_msgs/OccupancyGrid",
        ("fusion",),
        (),
        MAP,
        "share of the votes for each cell's value, in percent; -1 unknown; sent only while "
        "a node listens; a late listener gets the last one at once",
    ),
    Topic(
        "fused/pose",
        "geometry_msgs/PoseWithCovarianceStamped",
        ("fusion",),
        (),
        STREAM,
        "the robot in fused_map: matched to the walls along the fused path where scans are heard, "
        "else by the healthiest producer, with the spread of the voters' poses as covariance",
    ),
    Topic(
        "fused/path",
        "nav_msgs/Path",
        ("fusion",),
        (),
        MAP,
        "the fused path so far, corrected as the scans ask for it; sent only while a node "
        "listens, as the player that saves fused/map does, and only where scans are heard",
    ),
    Topic(
        "/diagnostics",
        "diagnostic_msgs/DiagnosticArray",
        ("producers", "fusion", "player"),
        (),
        STREAM,
        "how each node and each input is, once a second",
    ),
    Topic("/clock", "rosgraph_msgs/Clock", ("player",), (), STREAM, "the log's time"),
    Topic(
        "/tf",
        "tf2_msgs/TFMessage",
        ("fusion", "player"),
        ("producers", "fusion", "player"),
        STREAM,
        "fused_map to the frame of every map, odom to base_link of a log; more with publish_tf",
        needs_tf2=True,
    ),
    Topic(
        "/tf_static",
        "tf2_msgs/TFMessage",
        ("fusion", "player"),
        ("producers", "fusion", "player"),
        MAP,
        "base_link to the laser of a log",
        needs_tf2=True,
    ),
    Topic(
        "transforms",
        "geometry_msgs/TransformStamped",
        ("fusion", "player"),
        ("producers", "fusion", "player"),
        STREAM,
        "the same as /tf where tf2_msgs is absent",
        needs_tf2=False,
    ),
    Topic(
        "transforms_static",
        "geometry_msgs/TransformStamped",
        ("fusion", "player"),
        ("producers", "fusion", "player"),
        MAP,
        "the same as /tf_static where tf2_msgs is absent",
        needs_tf2=False,
    ),
)

SERVICES = (
    Service("get_map", "nav_msgs/GetMap", "fusion", "answers the last fused map"),
    Service(
        "save_map",
        "std_srvs/Trigger",
        "fusion",
        "writes it to save_path, into a folder that is there; answers the path, or why not",
    ),
    Service(
        "save_map_as",
        "rcl_interfaces/SetParametersAtomically",
        "fusion",
        "the same with path, format (pgm, png, bmp), mode (trinary, scale, raw), free_thresh and "
        "occupied_thresh, each if given; the path stays in the folder of save_path",
    ),
    Service(
        "load_map",
        "nav_msgs/LoadMap",
        "fusion",
        "a saved map becomes an input, or is read again; answers it, or that there is none",
    ),
    Service(
        "reset",
        "std_srvs/Trigger",
        "fusion",
        "the newest maps begin a new fused frame; the kept state is removed",
    ),
)

INPUTS = NameList(
    "inputs",
    tuple(f"{name}/map" for name in PRODUCERS),
    "what is fused: map topics, and file:PATH for saved maps; NAME=TOPIC gives a name of its own; "
    "may be changed while the node runs; default with discover: none but what is found",
)
WAIT_FOR = NameList(
    "wait_for", (), "producers that must answer the first scan, and in lockstep every one"
)
MAPS = NameList(
    "maps",
    (),
    "map topics that are written to the folder save at the end of the log; default: those of "
    "wait_for",
)
NAME_LISTS = {"fusion": (INPUTS,), "player": (WAIT_FOR, MAPS)}

# Of the fusion node: one for each input.
START_NAME = "start.NAME"
START_TEXT = (
    "where the map frame of input NAME lies in one that all starts share (of one start alone: in "
    f"that of the reference or of the only other input): {START_FORM}; the input is searched only "
    "there until it has a place in the fused frame"
)


def node_parameters(node: str) -> Iterator[ConfigOption]:
    """Yield every parameter of a node that stands for a configuration field, in order.

    Raises:
        SlamFusionError: there is no producer of this name, or it is broken.
    """
    sections: list[tuple[str, Any]] = [("", PlayerNodeConfig), ("log", LogConfig)]
    if node == "fusion":
        sections = [("", FusionNodeConfig), ("", DeviceConfig), ("", MapFileConfig)]
        sections += [("live", LiveConfig), ("fusion", FusionConfig)]
    elif node != "player":
        sections = [("", ProducerNodeConfig), ("", DeviceConfig), (node, producer(node).config)]
    for prefix, section in sections:
        yield from config_fields(section, prefix)
