"""The interface of the nodes: topics, services and parameters, for help, pages and launch files.

Nothing here needs ROS; a test compares the lists with the running nodes.
"""

from __future__ import annotations

import re
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


LATCHED = "reliable, transient local, depth 1"


def _rows(table: str) -> Iterator[list[str]]:
    """Yield the cells of each row of a table; its last cell stands on indented lines."""
    for row in re.split(r"\n(?! )", table.strip()):
        cells, *text = row.split("\n")
        yield [*cells.split(" | "), " ".join(line.strip() for line in text)]


def _topic(name: str, kind: str, *cells: str) -> Topic:
    named = {"-": "", "all": "producers fusion player"}
    writers, readers = (tuple(named.get(group, group).split()) for group in cells[:2])
    qos, *needs, text = cells[2:]
    needs_tf2 = needs[0] == "with tf2" if needs else None
    return Topic(name, kind, writers, readers, qos.replace("latched", LATCHED), text, needs_tf2)


# Name, type, writers, readers, quality of service, whether it depends on tf2_msgs; then the text.
TOPICS = tuple(
    _topic(*cells)
    for cells in _rows("""
scan | sensor_msgs/LaserScan | player | producers fusion | best effort
    laser scans
odom | nav_msgs/Odometry | player | producers fusion | best effort
    odometry, unless it is taken from the transforms
NAME/map | nav_msgs/OccupancyGrid | producers | fusion player | latched
    the map of one SLAM, in frame NAME_map (in a namespace robot1/NAME_map)
NAME/map_updates | map_msgs/OccupancyGridUpdate | - | fusion | reliable | with tf2
    what changed of a map, from costmaps and SLAMs of others; where map_msgs is installed
NAME/map_metadata | nav_msgs/MapMetaData | producers | - | latched
    its size and place
NAME/pose | geometry_msgs/PoseStamped | producers | fusion player | reliable, liveliness lease 0.5 s
    the robot in the map's frame, one for every scan that was used, with its stamp; the fusion
    accepts PoseWithCovarianceStamped, too
NAME/path | nav_msgs/Path | producers | - | latched
    the path so far, corrected; the fusion listens while it hears scans
fused/map | nav_msgs/OccupancyGrid | fusion | - | latched
    the fused map
fused/map_updates | map_msgs/OccupancyGridUpdate | fusion | - | reliable | with tf2
    the box of fused/map that changed, unless the map has grown; where map_msgs is installed
fused/agreement | nav_msgs/OccupancyGrid | fusion | - | latched
    share of the votes for each cell's value, in percent; -1 unknown; sent only while a node
    listens; a late listener gets the last one at once
fused/pose | geometry_msgs/PoseWithCovarianceStamped | fusion | - | reliable
    the robot in fused_map: matched to the walls along the fused path where scans are heard, else by
    the healthiest producer, with the spread of the voters' poses as covariance
fused/path | nav_msgs/Path | fusion | - | latched
    the fused path so far, corrected as the scans ask for it; sent only while a node listens, as the
    player that saves fused/map does, and only where scans are heard
/diagnostics | diagnostic_msgs/DiagnosticArray | all | - | reliable
    how each node and each input is, once a second
/clock | rosgraph_msgs/Clock | player | - | reliable
    the log's time
/tf | tf2_msgs/TFMessage | fusion player | all | reliable | with tf2
    fused_map to the frame of every map, odom to base_link of a log; more with publish_tf
/tf_static | tf2_msgs/TFMessage | fusion player | all | latched | with tf2
    base_link to the laser of a log
transforms | geometry_msgs/TransformStamped | fusion player | all | reliable | no tf2
    the same as /tf where tf2_msgs is absent
transforms_static | geometry_msgs/TransformStamped | fusion player | all | latched | no tf2
    the same as /tf_static where tf2_msgs is absent
""")
)

# Name, type, node; then the text.
SERVICES = tuple(
    Service(*cells)
    for cells in _rows("""
get_map | nav_msgs/GetMap | fusion
    answers the last fused map
save_map | std_srvs/Trigger | fusion
    writes it to save_path, into a folder that is there; answers the path, or why not
save_map_as | rcl_interfaces/SetParametersAtomically | fusion
    the same with path, format (pgm, png, bmp), mode (trinary, scale, raw), free_thresh and
    occupied_thresh, each if given; the path stays in the folder of save_path
load_map | nav_msgs/LoadMap | fusion
    a saved map becomes an input, or is read again; answers it, or that there is none
reset | std_srvs/Trigger | fusion
    the newest maps begin a new fused frame; the kept state is removed
""")
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
