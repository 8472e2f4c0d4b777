"""The launch files, without ROS: every name in them is one that the code has.

``launch`` is not on the package index, so the files are read, not run.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from slamfusion.cli import executables
from slamfusion.cli.node import NODES
from slamfusion.cli.ros_tables import NAME_LISTS, TOPICS, node_parameters
from tests.cli.command import ROOT

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


def text(call: ast.Call, name: str) -> str:
    """A keyword argument that is a text."""
    return str(ast.literal_eval(keyword(call, name)))


def own_node(path: Path) -> ast.Call:
    """The one node of ours that a file starts itself."""
    (node,) = [call for call in calls(path, "Node") if text(call, "package") == "slamfusion"]
    return node


def declared(path: Path) -> set[str]:
    return {ast.literal_eval(call.args[0]) for call in calls(path, "DeclareLaunchArgument")}


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


@pytest.mark.parametrize("path", SINGLE, ids=lambda path: path.name)
def test_a_node_is_started_by_names_that_exist(path: Path):
    name = path.name.removesuffix(".launch.py")
    node = own_node(path)
    assert text(node, "name") == name
    assert text(node, "executable") == f"{name}_node"
    assert hasattr(executables, f"{name}_node")
    parameters = {option.key for option in node_parameters(name)} | {"use_sim_time"}
    parameters |= {item.name for item in NAME_LISTS.get(name, ())}
    given = [item for item in keyword(node, "parameters").elts if isinstance(item, ast.Dict)]
    assert given
    for item in given:
        assert {ast.literal_eval(key) for key in item.keys if key is not None} <= parameters
    group = "producers" if name in {"tinyslam", "gmapping", "graph"} else name
    read = {topic.name for topic in TOPICS if group in topic.readers}
    remappings = keyword(node, "remappings")
    for pair in [] if remappings is None else remappings.elts:
        assert ast.literal_eval(pair.elts[0]) in read
    # A player that ends has played its log; every other node is to come back.
    assert (keyword(node, "respawn") is not None) == (name != "player")


def test_the_whole_system_includes_every_file_with_arguments_that_it_has():
    path = ROOT / "launch_scripts" / "slamfusion.launch.py"
    tree = ast.parse(path.read_text(encoding="utf-8"))
    dicts = {
        item.targets[0].id: item.value
        for item in ast.walk(tree)
        if isinstance(item, ast.Assign)
        and isinstance(item.targets[0], ast.Name)
        and isinstance(item.value, (ast.Dict, ast.DictComp))
    }

    def keys(item: ast.AST) -> set[str]:
        """The keys of a dictionary, with those of the ones that are unpacked in it."""
        if isinstance(item, ast.Name):
            return keys(dicts[item.id])
        if isinstance(item, ast.DictComp):
            return set(ast.literal_eval(item.generators[0].iter))
        assert isinstance(item, ast.Dict)
        found: set[str] = set()
        for key, value in zip(item.keys, item.values, strict=True):
            found |= keys(value) if key is None else {ast.literal_eval(key)}
        return found

    included = {}
    for call in calls(path, "IncludeLaunchDescription"):
        (file,) = strings(call.args[0])
        included[file] = keys(keyword(call, "launch_arguments").func.value)
    assert set(included) == {item.name for item in SINGLE}
    for file, given in included.items():
        assert given == declared(path.parent / file), file


def test_colcon_installs_every_file_and_the_files_beside_them():
    ament = ROOT / "launch_scripts" / "ament"
    assert {item.name for item in (ament / "launch").iterdir()} == {path.name for path in FILES}
    for item in [*(ament / "launch").iterdir(), *(ament / "config").iterdir()]:
        assert item.resolve() == ROOT / "launch_scripts" / item.name
    named = {part for path in FILES for part in strings(ast.parse(path.read_text("utf-8")))}
    config = {item.name for item in (ament / "config").iterdir()}
    assert {name for name in named if name.endswith((".yaml", ".rviz"))} <= config
