"""RViz, Foxglove, node graph and parameter file show topics, frames and settings that we have."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
import yaml

from docs.generate.marks import COMMAND, PICTURE
from docs.generate.picture import node_picture
from docs.generate.ros import parameter_file
from slamfusion.config import FusionNodeConfig
from slamfusion.palette import NAMED
from slamfusion.ros.interface import NODES, PRODUCERS, TOPICS
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
    "PoseWithCovariance": "geometry_msgs/PoseWithCovarianceStamped",
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


def test_paths_have_the_colours_of_their_names(rviz: dict[str, Any], foxglove: dict[str, Any]):
    wanted = {f"{name}/path": NAMED[name] for name in PRODUCERS} | {"fused/pose": NAMED["fused"]}
    shown = {
        item["Topic"]["Value"]: tuple(map(int, item["Color"].split("; ")))
        for item in rviz["Displays"]
        if item["Class"].endswith(("/Path", "/PoseWithCovariance"))
    }
    assert shown == wanted
    view = foxglove["configById"]["3D!map"]["topics"]
    for name, rgb in wanted.items():
        look = view[f"/{name}"]
        colours = {look["color"]} if "color" in look else set(look["gradient"])
        assert colours == {f"#{bytes(rgb).hex()}ff"}, name


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
    assert all(".pose.pose." in path for path in plotted)


def test_the_picture_of_the_nodes_is_up_to_date():
    assert PICTURE.read_text(encoding="utf-8") == node_picture(), f"run: {COMMAND}"


def test_every_panel_of_the_foxglove_layout_is_placed(foxglove: dict[str, Any]):
    def placed(item: dict[str, Any] | str) -> Iterator[str]:
        if isinstance(item, str):
            yield item
        else:
            yield from placed(item["first"])
            yield from placed(item["second"])

    assert set(placed(foxglove["layout"])) == set(foxglove["configById"])


def test_the_parameter_file_is_up_to_date():
    wanted = parameter_file()
    assert (SCRIPTS / "slamfusion.yaml").read_text() == wanted, f"run: {COMMAND}"
    nodes = {key.rpartition("/")[2]: value for key, value in yaml.safe_load(wanted).items()}
    assert tuple(nodes) == NODES
    assert all(value["ros__parameters"] for value in nodes.values())
