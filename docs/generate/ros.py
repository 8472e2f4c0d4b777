"""What the ROS nodes have: topics, services and parameters, for the pages and the launch files.

Tables for the pages, who sends what to whom, and ``launch_scripts/slamfusion.yaml``. Nothing here
needs ROS; a test holds the lists against the running nodes.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import yaml

from docs.generate.markdown import row
from slamfusion.cli.options import ConfigOption, config_fields, shown_default, shown_value
from slamfusion.config import (
    START_FORM,
    START_M,
    START_RAD,
    DeviceConfig,
    FusionConfig,
    FusionNodeConfig,
    LiveConfig,
    LogConfig,
    MapFileConfig,
    PlayerNodeConfig,
    ProducerNodeConfig,
)
from slamfusion.slam.registry import BUILT_IN, producer

__all__ = [
    "NODES",
    "SERVICES",
    "START_NAME",
    "TOPICS",
    "NameList",
    "Service",
    "Topic",
    "node_arrows",
    "node_parameters",
    "parameter_file",
    "parameter_table",
    "service_table",
    "topic_table",
]

PRODUCERS = BUILT_IN
NODES = (*PRODUCERS, "fusion", "player")


@dataclass(frozen=True)
class Topic:
    """A topic of one of our nodes.

    Attributes:
        name: relative unless it begins with a slash; NAME is the producer's name.
        type: of its messages.
        writers, readers: of our nodes; ``producers`` stands for the three.
        qos: what is written, or asked for where only others write it.
        text: what it carries.
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
    Topic("scan", "sensor_msgs/LaserScan", ("player",), ("producers",), SENSOR, "laser scans"),
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
        "NAME/map_metadata",
        "nav_msgs/MapMetaData",
        ("producers",),
        (),
        MAP,
        "its size and place",
    ),
    Topic(
        "NAME/pose",
        "geometry_msgs/PoseStamped",
        ("producers",),
        ("fusion", "player"),
        f"{STREAM}, liveliness lease 0.5 s",
        "the robot in the map's frame, one for every scan that was used, with its stamp",
    ),
    Topic("NAME/path", "nav_msgs/Path", ("producers",), (), MAP, "the path so far, corrected"),
    Topic("fused/map", "nav_msgs/OccupancyGrid", ("fusion",), (), MAP, "the fused map"),
    Topic(
        "fused/agreement",
        "nav_msgs/OccupancyGrid",
        ("fusion",),
        (),
        MAP,
        "share of the votes for each cell's value, in percent; -1 unknown; sent only while "
        "somebody listens, the last one at once to who comes late",
    ),
    Topic(
        "fused/pose",
        "geometry_msgs/PoseStamped",
        ("fusion",),
        (),
        STREAM,
        "the robot in fused_map, by the healthiest producer",
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

# The sections of each node's parameters with the prefix of their names.
SECTIONS: dict[str, tuple[tuple[str, Any], ...]] = {
    **{
        name: (("", ProducerNodeConfig), ("", DeviceConfig), (name, producer(name).config))
        for name in PRODUCERS
    },
    "fusion": (
        ("", FusionNodeConfig),
        ("", DeviceConfig),
        ("", MapFileConfig),
        ("live", LiveConfig),
        ("fusion", FusionConfig),
    ),
    "player": (("", PlayerNodeConfig), ("log", LogConfig)),
}
NAME_LISTS = {
    "fusion": (
        NameList(
            "inputs",
            tuple(f"{name}/map" for name in PRODUCERS),
            "what is fused: map topics, and file:PATH for saved maps; NAME=TOPIC gives a name of "
            "its own; may be changed while the node runs; default with discover: none but what is "
            "found",
        ),
    ),
    "player": (
        NameList(
            "wait_for",
            (),
            "producers that must answer the first scan, and in lockstep every one",
        ),
        NameList(
            "maps",
            (),
            "map topics that are written to the folder save at the end of the log; "
            "default: those of wait_for",
        ),
    ),
}

# Of the fusion node: one for each input.
START_NAME = "start.NAME"
START_TEXT = (
    "where the map frame of input NAME lies in one that all starts share (of one start alone: in "
    f"that of the reference or of the only other input): {START_FORM}; the input is searched only "
    "there until it has a place in the fused frame"
)


def node_parameters(node: str) -> Iterator[ConfigOption]:
    """Yield every parameter of a node that stands for a configuration field, in order."""
    for prefix, section in SECTIONS[node]:
        yield from config_fields(section, prefix)


def topic_table() -> str:
    """Return a Markdown table of every topic."""
    lines = ["| topic | type | from | to | quality of service | what |"]
    lines.append("| --- | --- | --- | --- | --- | --- |")
    for topic in TOPICS:
        cells = (
            f"`{topic.name}`",
            topic.type,
            ", ".join(topic.writers) or "-",
            ", ".join(topic.readers) or "-",
            topic.qos,
            topic.text,
        )
        lines.append(row(*cells))
    return "\n".join(lines)


# The data's way in the picture of the nodes.
WAY = ("player", "producers", "fusion", "users")


def node_arrows() -> dict[tuple[str, str], list[str]]:
    """Return the topics from each kind of node to each other, for a picture.

    The way is from the player by the producers and the fusion to whoever listens, who also gets
    what no later node of ours reads. What goes the other way (``/tf`` to everybody, and maps and
    poses to the player, who waits for them) and the topics that stand in for ``/tf`` where tf2_msgs
    is absent are left out.
    """
    arrows: dict[tuple[str, str], list[str]] = {}
    for topic in TOPICS:
        for writer in topic.writers if topic.needs_tf2 is not False else ():
            later = WAY[WAY.index(writer) + 1 : -1]
            for reader in [name for name in later if name in topic.readers] or WAY[-1:]:
                arrows.setdefault((writer, reader), []).append(topic.name)
    return arrows


def service_table() -> str:
    """Return a Markdown table of every service."""
    lines = ["| service | type | node | what |", "| --- | --- | --- | --- |"]
    lines += [row(f"`{item.name}`", item.type, item.node, item.text) for item in SERVICES]
    return "\n".join(lines)


def parameter_table() -> str:
    """Return a Markdown table of the parameters that are the nodes' own.

    Those of the sections (``tinyslam.``, ``live.``, ...) have the names of the configuration, whose
    table stands beside this one.
    """
    lines = ["| node | parameter | default | range | what |", "| --- | --- | --- | --- | --- |"]
    for title, node in (("producers", PRODUCERS[0]), ("fusion", "fusion"), ("player", "player")):
        for item in NAME_LISTS.get(node, ()):
            shown = ", ".join(item.default)
            lines.append(row(title, f"`{item.name}`", shown, "names", item.text))
        if node == "fusion":
            tolerances = f"tolerances {START_M:g} m, {START_RAD:g} rad"
            lines.append(row(title, f"`{START_NAME}`", tolerances, "3 or 5 numbers", START_TEXT))
        for option in node_parameters(node):
            if not option.section:
                own = (f"`{option.key}`", shown_default(option), _range(option))
                lines.append(row(title, *own, option.info.help))
    return "\n".join(lines)


# Tables by the names of their parts.
TABLES = {
    "ROS topics": topic_table,
    "ROS services": service_table,
    "ROS parameters": parameter_table,
}


HEAD = """\
# Parameters of every node, at their defaults; written by `python -m docs.generate`.
# Copy this file, change what your robot needs, leave out the rest, and name the copy with
# slamfusion.sh --params FILE, ros2 launch ... params_file:=FILE or --ros-args --params-file FILE.
# Each key holds for the node of this name in every namespace. A line that is commented out is left
# open: the words above it, or its profile, say what holds then. The expert settings stand in
# docs/reference/parameters.md.
"""


def parameter_file() -> str:
    """Return the text of ``launch_scripts/slamfusion.yaml``: the public parameters of every node.

    Parameters without a default are commented out.
    """
    lines = [HEAD]
    for node in NODES:
        lines += [f"/**/{node}:", "  ros__parameters:"]
        for item in NAME_LISTS.get(node, ()):
            lines += _comment(4, item.text)
            # Whoever starts the nodes sets these too.
            shown = yaml.safe_dump(list(item.default), default_flow_style=True).strip()
            lines.append(f"    # {item.name}: {shown}")
        if node == "fusion":
            lines += _comment(4, START_TEXT)
            lines += ["    # start:", f"    #   NAME: [0.0, 0.0, 0.0, {START_M}, {START_RAD}]"]
        tree: dict[str, Any] = {}
        for option in node_parameters(node):
            if option.info.level == "public":
                place = tree
                for part in option.section.split(".") if option.section else ():
                    place = place.setdefault(part, {})
                place[option.info.name] = option
        lines += [*_yaml_lines(tree, 4), ""]
    return "\n".join(lines)


def _yaml_lines(tree: dict[str, Any], indent: int) -> Iterator[str]:
    """Yield the lines of nested parameters."""
    pad = " " * indent
    leaves = [item for item in tree.values() if isinstance(item, ConfigOption)]
    for option in leaves:
        yield from _comment(indent, _said(option))
        value = option.info.default
        if value is None:
            shown = "" if option.default is None else _scalar(option.default)
            yield f"{pad}# {option.info.name}: {shown}".rstrip()
        else:
            yield f"{pad}{option.info.name}: {_scalar(value)}"
    for name, item in tree.items():
        if isinstance(item, ConfigOption):
            continue
        lines = list(_yaml_lines(item, indent + 2))
        # A section of comments alone would be a null, which is no parameter.
        is_empty = all(line.lstrip().startswith("#") for line in lines)
        yield f"{pad}# {name}:" if is_empty else f"{pad}{name}:"
        yield from lines


def _said(option: ConfigOption) -> str:
    """Return a parameter's help with its unit and range."""
    wanted = _range(option)
    unit = option.info.unit
    notes = ", ".join(filter(None, (unit, "" if wanted in {"yes, no", "text"} else wanted)))
    text = option.info.help.replace("`", "")
    return f"{text} ({notes})" if notes else text


def _comment(indent: int, text: str) -> list[str]:
    pad = " " * indent + "# "
    return textwrap.wrap(text, 100, initial_indent=pad, subsequent_indent=pad)


def _scalar(value: Any) -> str:
    """Return a value as YAML, a float with a point, so that ROS takes it for one."""
    if isinstance(value, float):
        return repr(value)
    return yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n").strip()


def _range(option: ConfigOption) -> str:
    info = option.info
    if info.choices:
        return " or ".join(info.choices)
    low, high = info.low, info.high
    if low is not None and high is not None:
        return f"{shown_value(low)} to {shown_value(high)}"
    if low is not None:
        return f"at least {shown_value(low)}"
    if high is not None:
        return f"at most {shown_value(high)}"
    return {bool: "yes, no", str: "text"}.get(info.kind, "")
