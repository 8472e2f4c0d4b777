"""Reads launch files as ``ros2 launch`` does, as far as ours go.

ROS's ``launch`` is not on the package index (the one there is another program), so the few names
that the files import are given here. What they are started with is theirs; ``ros2 launch`` itself
is not tried by this.
"""

from __future__ import annotations

import os
import runpy
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

from tests.cli.command import ROOT

SCRIPTS = ROOT / "launch_scripts"


@dataclass
class Started:
    """One node that a launch file starts.

    Attributes:
        package, executable, name, namespace: as given.
        parameters: paths of files and mappings, in their order.
        remappings: from and to.
    """

    package: str
    executable: str
    name: str
    namespace: str
    parameters: list[str | dict[str, Any]]
    remappings: dict[str, str]


class Context:
    """The arguments of a launch, and what it has started."""

    def __init__(self, configurations: Mapping[str, str]) -> None:
        self.configurations = dict(configurations)
        self.started: list[Started] = []

    def text(self, value: Any) -> str:
        """Return a text, or a substitution's value."""
        if isinstance(value, (list, tuple)):
            return "".join(self.text(item) for item in value)
        return str(value.perform(self)) if hasattr(value, "perform") else str(value)

    def value(self, value: Any) -> Any:
        """Return a parameter's value with its type."""
        return value.perform(self) if hasattr(value, "perform") else value


class Made:
    """An object that a launch file makes, with the arguments that it was made of."""

    def __init__(self, kind: str, *args: Any, **given: Any) -> None:
        self.kind, self.args, self.given = kind, args, given

    def perform(self, context: Context) -> Any:
        """Return the value of a substitution, condition or parameter."""
        return VALUES[self.kind](context, *self.args, **self.given)

    def visit(self, context: Context) -> None:
        """Do what an action does, if its condition holds."""
        condition = self.given.pop("condition", None)
        if condition is None or condition.perform(context):
            ACTIONS[self.kind](context, *self.args, **self.given)


def _truth(context: Context, value: Any) -> bool:
    return {"true": True, "1": True, "false": False, "0": False}[context.text(value).lower()]


def _typed(context: Context, value: Any, value_type: Callable[[str], Any]) -> Any:
    return _truth(context, value) if value_type is bool else value_type(context.text(value))


# Config and launch files lie beside each other in the folder that colcon makes of ours.
VALUES: dict[str, Callable[..., Any]] = {
    "EnvironmentVariable": lambda _, name, default_value: os.environ.get(name, default_value),
    "FindPackageShare": lambda _, package: {"slamfusion": SCRIPTS / "ament"}[package],
    "IfCondition": _truth,
    "LaunchConfiguration": lambda context, name: context.configurations[name],
    "NotEqualsSubstitution": lambda context, *both: len({context.text(one) for one in both}) == 2,
    "ParameterValue": _typed,
    "PathJoinSubstitution": lambda context, parts: str(Path(*map(context.text, parts))),
}


def _declare(context: Context, name: str, *, description: str, default_value: Any = None) -> None:
    assert description, name
    if name not in context.configurations:
        assert default_value is not None, f"the argument {name} must be given"
        context.configurations[name] = context.text(default_value)


def _set(context: Context, name: str, value: Any) -> None:
    assert context.text(value), name


def _include(context: Context, path: Any, launch_arguments: Iterable[tuple[str, Any]]) -> None:
    given = {name: context.text(value) for name, value in launch_arguments}
    path = Path(context.text(path))
    assert given.keys() <= declared(path), path.name
    context.started += _visited(path, context.configurations | given).started


def _call(context: Context, function: Callable[[Context], Iterable[Made]]) -> None:
    for item in function(context):
        item.visit(context)


def _start(context: Context, package: str, executable: str, **given: Any) -> None:
    known = {"name", "namespace", "parameters", "remappings"}
    assert given.keys() - known <= {"output", "respawn", "respawn_delay", "arguments"}
    parameters = [
        {key: context.value(value) for key, value in item.items()}
        if isinstance(item, dict)
        else context.text(item)
        for item in given["parameters"]
    ]
    remappings = {old: context.text(new) for old, new in given["remappings"]}
    name, namespace = given.get("name", ""), context.text(given["namespace"])
    context.started.append(Started(package, executable, name, namespace, parameters, remappings))


ACTIONS: dict[str, Callable[..., None]] = {
    "DeclareLaunchArgument": _declare,
    "IncludeLaunchDescription": _include,
    "Node": _start,
    "OpaqueFunction": _call,
    "SetEnvironmentVariable": _set,
}
MODULES: dict[str, dict[str, Any]] = {
    "launch": {"LaunchContext": Context, "LaunchDescription": list},
    "launch.launch_description_sources": {"PythonLaunchDescriptionSource": lambda path: path},
}
for module, kinds in {
    "launch.actions": "DeclareLaunchArgument IncludeLaunchDescription OpaqueFunction "
    "SetEnvironmentVariable",
    "launch.conditions": "IfCondition",
    "launch.substitutions": "EnvironmentVariable LaunchConfiguration NotEqualsSubstitution "
    "PathJoinSubstitution",
    "launch_ros": "",
    "launch_ros.actions": "Node",
    "launch_ros.parameter_descriptions": "ParameterValue",
    "launch_ros.substitutions": "FindPackageShare",
}.items():
    MODULES[module] = {kind: partial(Made, kind) for kind in kinds.split()}


def _entities(path: Path) -> list[Made]:
    modules = {name: types.ModuleType(name) for name in MODULES}
    for name, module in modules.items():
        vars(module).update(MODULES[name])
    with mock.patch.dict(sys.modules, modules):
        entities: list[Made] = runpy.run_path(str(path))["generate_launch_description"]()
    return entities


def declared(path: Path) -> set[str]:
    """Return the names of a file's arguments."""
    return {item.args[0] for item in _entities(path) if item.kind == "DeclareLaunchArgument"}


def _visited(path: Path, configurations: Mapping[str, str]) -> Context:
    context = Context(configurations)
    for item in _entities(path):
        item.visit(context)
    return context


def started(file: str, **arguments: str) -> dict[str, Started]:
    """Return every node that ``ros2 launch slamfusion FILE name:=value ...`` starts, by name."""
    context = _visited(SCRIPTS / file, arguments)
    assert arguments.keys() <= declared(SCRIPTS / file)
    return {item.name or item.executable: item for item in context.started}
