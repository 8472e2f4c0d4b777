"""RViz configuration, Foxglove layout and node graph show topics and frames that we have."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
import yaml

from docs.generate.ros import PRODUCERS, SERVICES, TOPICS, node_graph
from slamfusion.config import FusionNodeConfig
from tests.cli.command import ROOT

SCRIPTS = ROOT / "launch_scripts"
# Every topic of ours with its type, NAME filled in.
TYPES = {
    topic.name.replace("NAME", name).lstrip("/"): topic.type
    for topic in TOPICS
    for name in PRODUCERS
}
DISPLAYS = {
    "Map": "nav_msgs/OccupancyGrid",
    "Path": "nav_msgs/Path",
    "Pose": "geometry_msgs/PoseStamped",
    "LaserScan": "sensor_msgs/LaserScan",
}
SHOWN = {f"{name}/{what}" for name in PRODUCERS for what in ("map", "path")} | {
    "fused/map",
    "fused/agreement",
    "fused/pose",
    "scan",
}


@pytest.fixture
def rviz() -> dict[str, Any]:
    return yaml.safe_load((SCRIPTS / "slamfusion.rviz").read_text(encoding="utf-8"))[
        "Visualization Manager"
    ]


@pytest.fixture
def foxglove() -> dict[str, Any]:
    return json.loads((SCRIPTS / "foxglove-layout.json").read_text(encoding="utf-8"))


def test_rviz_shows_our_topics_with_their_types(rviz: dict[str, Any]):
    shown = {}
    for display in rviz["Displays"]:
        if "Topic" not in display:
            continue
        name, kind = display["Topic"]["Value"], display["Class"].rpartition("/")[2]
        assert TYPES[name] == DISPLAYS[kind], name
        shown[name] = display["Topic"]
    assert set(shown) == SHOWN
    for name, topic in shown.items():
        is_kept = name.endswith(("/map", "/path", "agreement"))
        assert (topic["Durability Policy"] == "Transient Local") == is_kept, name


def test_rviz_looks_from_the_fused_frame(rviz: dict[str, Any]):
    assert rviz["Global Options"]["Fixed Frame"] == FusionNodeConfig().fused_frame
    assert any(item["Class"].endswith("/TF") for item in rviz["Displays"])


def test_foxglove_shows_our_topics_from_the_fused_frame(foxglove: dict[str, Any]):
    panels = foxglove["configById"]
    view = panels["3D!map"]
    assert {name.lstrip("/") for name in view["topics"]} == SHOWN
    assert view["followTf"] == FusionNodeConfig().fused_frame
    assert panels["DiagnosticSummary!health"]["topicToRender"].lstrip("/") in TYPES
    plotted = [item["value"] for item in panels["Plot!pose"]["paths"]]
    assert all(path.partition(".")[0] == "/fused/pose" for path in plotted)
    assert TYPES["fused/pose"] == "geometry_msgs/PoseStamped"


def test_the_picture_of_the_nodes_has_every_topic_on_its_arrows():
    fence, kind, *lines, end = node_graph().splitlines()
    assert (fence, kind, end) == ("```mermaid", "flowchart LR", "```")
    declared = [re.match(r" *(?:subgraph )?(\w+)[(\[]", line) for line in lines]
    boxes = {found[1] for found in declared if found}
    assert {f"{name}_node" for name in PRODUCERS} < boxes
    # A word of the language would end the picture.
    assert not boxes & {"graph", "subgraph", "end", "class", "style", "click", "default"}
    arrow = re.compile(r"    (\w+) (?:--|-\.) \"(.*)\" (?:-->|\.->) (\w+)")
    drawn = {(found[1], found[3]): found[2] for line in lines if (found := arrow.fullmatch(line))}
    assert {name for pair in drawn for name in pair} < boxes
    labels = {pair: label.split("<br>") for pair, label in drawn.items()}
    assert labels["player", "producers"] == ["scan", "odom", "/tf", "/tf_static"]
    assert labels["producers", "fusion"] == ["NAME/map", "NAME/pose"]
    assert {"fused/map", "fused/pose", "/tf"} < set(labels["fusion", "users"])
    for topic in TOPICS:
        writers = {writer for (writer, _), names in labels.items() if topic.name in names}
        assert writers == (set() if topic.needs_tf2 is False else set(topic.writers)), topic.name
    assert all(service.name in node_graph() for service in SERVICES)


def test_every_panel_of_the_foxglove_layout_is_placed(foxglove: dict[str, Any]):
    def placed(item: dict[str, Any] | str) -> Iterator[str]:
        if isinstance(item, str):
            yield item
        else:
            yield from placed(item["first"])
            yield from placed(item["second"])

    assert set(placed(foxglove["layout"])) == set(foxglove["configById"])
