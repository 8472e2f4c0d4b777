"""Pages and files about the ROS nodes: tables, and ``launch_scripts/slamfusion.yaml``."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any

import yaml

from docs.generate.markdown import row
from slamfusion.config import START_M, START_RAD, ConfigOption, shown_value
from slamfusion.ros.interface import (
    NAME_LISTS,
    NODES,
    PRODUCERS,
    SERVICES,
    START_NAME,
    START_TEXT,
    TOPICS,
    node_parameters,
)

__all__ = ["node_arrows", "parameter_file", "parameter_table", "service_table", "topic_table"]


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
    poses to the player, who waits for them), the topics that stand in for ``/tf`` where tf2_msgs is
    absent, and updates of a map are left out.
    """
    arrows: dict[tuple[str, str], list[str]] = {}
    for topic in TOPICS:
        if topic.needs_tf2 is False or topic.name.endswith("_updates"):
            continue
        for writer in topic.writers:
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
                own = (f"`{option.key}`", option.shown_default(), _range(option))
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
