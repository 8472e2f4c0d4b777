"""The launch files: every name in them is one that the code has, and what they start fits together.

``launch`` is not on the package index, so they are read: by ``launch_reader``. Where a sourced ROS
has ``ros2 launch``, that reads them, too.
"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from slamfusion.ros.interface import NAME_LISTS, NODES, PRODUCERS, TOPICS, node_parameters
from tests.cli.command import ROOT
from tests.launch.launch_reader import declared, started

FILES = sorted((ROOT / "launch_scripts").glob("*.launch.py"))
SINGLE = [path for path in FILES if path.name != "slamfusion.launch.py"]


def calls(path: Path, name: str) -> Iterator[ast.Call]:
    """The calls of a name in a file."""
    for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(item, ast.Call) and isinstance(item.func, ast.Name) and item.func.id == name:
            yield item


def keyword(call: ast.Call, name: str) -> Any:
    """The node of a keyword argument, None where it is not given."""
    return next((item.value for item in call.keywords if item.arg == name), None)


def strings(item: ast.AST) -> set[str]:
    return {
        part.value
        for part in ast.walk(item)
        if isinstance(part, ast.Constant) and isinstance(part.value, str)
    }


def test_there_is_one_file_for_each_node_and_one_for_all():
    assert [path.name.removesuffix(".launch.py") for path in FILES] == sorted(
        [*NODES, "slamfusion"]
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_file_compiles_and_uses_only_what_it_declares(path: Path):
    compile(path.read_text(encoding="utf-8"), path, "exec")
    known = declared(path)
    assert known
    used = [call.args[0] for call in calls(path, "LaunchConfiguration")]
    assert {ast.literal_eval(item) for item in used if isinstance(item, ast.Constant)} <= known


@pytest.mark.skipif(
    shutil.which("ros2") is None, reason="no ros2 launch: source a ROS; a stand-in reads the files"
)
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_ros2_launch_reads_the_same_arguments(path: Path):
    command = ["ros2", "launch", str(path), "--show-args"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60.0)
    assert done.returncode == 0, done.stderr
    assert set(re.findall(r"^ *'(\w+)':", done.stdout, re.MULTILINE)) == declared(path)


@pytest.mark.parametrize("path", SINGLE, ids=lambda path: path.name)
def test_a_node_is_started_by_names_that_exist(path: Path):
    name = path.name.removesuffix(".launch.py")
    needed = {"log": "a.log", "wait_for": "tinyslam"} if name == "player" else {}
    frames = {"frame_prefix": "robot1/", "odom_frame": "wheels"}
    (node,) = started(path.name, **needed, **frames).values()
    assert (node.package, node.executable, node.name) == ("slamfusion", f"{name}_node", name)
    known = {option.key for option in node_parameters(name)} | {"use_sim_time"}
    known |= {item.name for item in NAME_LISTS.get(name, ())}
    file, *settings = node.parameters
    assert Path(str(file)).resolve() == ROOT / "launch_scripts" / "slamfusion.yaml"
    given: dict[str, Any] = {}
    for item in settings:
        assert isinstance(item, dict)
        given |= item
    assert given.keys() <= known
    group = "producers" if name in PRODUCERS else name
    own = {topic.name for topic in TOPICS if group in (*topic.readers, *topic.writers)}
    assert {"/tf", "/tf_static", "odom"} <= node.remappings.keys() <= own
    # Frames: every one has the prefix, but for one that is named itself.
    assert given["odom_frame"] == "wheels"
    wanted = {"base_frame": "robot1/base_link"}
    wanted |= {"map_frame": f"robot1/{name}_map"} if name in PRODUCERS else {}
    wanted |= {"fused_frame": "robot1/fused_map"} if name == "fusion" else {}
    wanted |= {"laser_frame": "robot1/laser"} if name == "player" else {}
    assert wanted.items() <= given.items()
    # What is not said stays as the file has it.
    (plain,) = started(path.name, **needed).values()
    said = {key for item in plain.parameters if isinstance(item, dict) for key in item}
    assert not said & {"base_frame", "odom_frame", *wanted}
    # A player that ends has played its log; every other node is to come back.
    (call,) = calls(path, "Node")
    assert (keyword(call, "respawn") is not None) == (name != "player")


def test_the_whole_system_starts_every_node_and_a_player_that_waits_for_all():
    assert set(started("slamfusion.launch.py")) == {*PRODUCERS, "fusion"}
    every = {"scan": "front/scan", "odom": "wheels", "namespace": "robot1", "base_frame": "foot"}
    nodes = started("slamfusion.launch.py", log="a.log", rviz="true", rate="2", **every)
    assert set(nodes) == {*NODES, "rviz2"}
    player = [item for item in nodes["player"].parameters if isinstance(item, dict)]
    given = {key: value for item in player for key, value in item.items()}
    assert given["wait_for"].split(",") == list(PRODUCERS)
    assert given["start_timeout_s"] >= 60.0
    assert (given["file"], given["rate"]) == ("a.log", 2.0)
    for name in NODES:
        node = nodes[name]
        assert node.namespace == "robot1"
        assert node.remappings["odom"] == "wheels"
        assert node.remappings.get("scan", "front/scan") == "front/scan"
        assert {"base_frame": "foot"} in [
            {key: value for key, value in item.items() if key == "base_frame"}
            for item in node.parameters
            if isinstance(item, dict)
        ]
    robot = started(
        "slamfusion.launch.py", log="a.log", rviz="true", tf="tf", tf_static="tf_static"
    )
    for node in robot.values():
        assert (node.remappings["/tf"], node.remappings["/tf_static"]) == ("tf", "tf_static")


def test_every_argument_of_a_file_reaches_it_through_the_whole_system():
    path = ROOT / "launch_scripts" / "slamfusion.launch.py"
    own = declared(path)
    for item in SINGLE:
        assert declared(item) - {"wait_for"} <= own, item.name


def test_colcon_installs_every_file_and_the_files_beside_them():
    ament = ROOT / "launch_scripts" / "ament"
    assert {item.name for item in (ament / "launch").iterdir()} == {path.name for path in FILES}
    for item in [*(ament / "launch").iterdir(), *(ament / "config").iterdir()]:
        assert item.resolve() == ROOT / "launch_scripts" / item.name
    named = {part for path in FILES for part in strings(ast.parse(path.read_text("utf-8")))}
    config = {item.name for item in (ament / "config").iterdir()}
    assert {name for name in named if name.endswith((".yaml", ".rviz"))} <= config
