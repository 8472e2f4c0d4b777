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
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

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

    def words(self) -> list[str]:
        """Return the ROS arguments, as launch_ros makes them."""
        words = ["-r", f"__node:={self.name}"] if self.name else []
        words += ["-r", f"__ns:=/{self.namespace}"] if self.namespace else []
        for item in self.parameters:
            if isinstance(item, str):
                words += ["--params-file", item]
                continue
            for key, value in item.items():
                shown = yaml.safe_dump(value, default_flow_style=True, width=1000)
                words += ["-p", f"{key}:={shown.splitlines()[0]}"]
        for old, new in self.remappings.items():
            words += ["-r", f"{old}:={new}"]
        return words


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


class _LaunchConfiguration:
    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: Context) -> str:
        return context.configurations[self.name]


class _PathJoin:
    def __init__(self, parts: Iterable[Any]) -> None:
        self.parts = list(parts)

    def perform(self, context: Context) -> str:
        return str(Path(*[context.text(part) for part in self.parts]))


class _Share:
    """The folder that colcon makes: config and launch files lie beside each other in ours."""

    def __init__(self, package: str) -> None:
        assert package == "slamfusion"

    def perform(self, _: Context) -> str:
        return str(SCRIPTS / "ament")


class _Environment:
    def __init__(self, name: str, default_value: str) -> None:
        self.name, self.default = name, default_value

    def perform(self, _: Context) -> str:
        return os.environ.get(self.name, self.default)


class _NotEquals:
    def __init__(self, one: Any, other: Any) -> None:
        self.pair = one, other

    def perform(self, context: Context) -> str:
        one, other = (context.text(item) for item in self.pair)
        return str(one != other).lower()


class _IfCondition:
    def __init__(self, value: Any) -> None:
        self.value = value

    def holds(self, context: Context) -> bool:
        said = context.text(self.value).lower()
        assert said in {"true", "false", "1", "0"}, said
        return said in {"true", "1"}


class _ParameterValue:
    def __init__(self, value: Any, value_type: type[Any]) -> None:
        self.text, self.kind = value, value_type

    def perform(self, context: Context) -> Any:
        said = context.text(self.text)
        return (
            {"true": True, "false": False}[said.lower()] if self.kind is bool else self.kind(said)
        )


class _Argument:
    def __init__(self, name: str, default_value: Any = None, description: str = "") -> None:
        assert description, name
        self.name, self.default = name, default_value

    def visit(self, context: Context) -> None:
        if self.name not in context.configurations:
            assert self.default is not None, f"the argument {self.name} must be given"
            context.configurations[self.name] = context.text(self.default)


class _Set:
    def __init__(self, name: str, value: Any) -> None:
        self.name, self.value = name, value

    def visit(self, context: Context) -> None:
        assert context.text(self.value), self.name


class _Include:
    def __init__(
        self,
        source: Any,
        launch_arguments: Iterable[tuple[str, Any]],
        condition: _IfCondition | None = None,
    ) -> None:
        self.source, self.arguments, self.condition = source, list(launch_arguments), condition

    def visit(self, context: Context) -> None:
        if self.condition is not None and not self.condition.holds(context):
            return
        given = {name: context.text(value) for name, value in self.arguments}
        path = Path(context.text(self.source))
        inner = _visited(path, context.configurations | given)
        unknown = given.keys() - declared(path)
        assert not unknown, f"{path.name} has no argument {unknown}"
        context.started += inner.started


class _Opaque:
    def __init__(self, function: Any) -> None:
        self.function = function

    def visit(self, context: Context) -> None:
        for item in self.function(context):
            item.visit(context)


class _Node:
    def __init__(
        self,
        *,
        package: str,
        executable: str,
        name: str = "",
        namespace: Any = "",
        parameters: Iterable[Any] = (),
        remappings: Iterable[tuple[str, Any]] = (),
        condition: _IfCondition | None = None,
        **others: Any,
    ) -> None:
        assert others.keys() <= {"output", "respawn", "respawn_delay", "arguments"}
        self.names = package, executable, name
        self.namespace, self.condition = namespace, condition
        self.parameters, self.remappings = list(parameters), list(remappings)

    def visit(self, context: Context) -> None:
        if self.condition is not None and not self.condition.holds(context):
            return
        parameters = [
            {key: context.value(value) for key, value in item.items()}
            if isinstance(item, dict)
            else context.text(item)
            for item in self.parameters
        ]
        remappings = {old: context.text(new) for old, new in self.remappings}
        context.started.append(
            Started(*self.names, context.text(self.namespace), parameters, remappings)
        )


MODULES: dict[str, dict[str, Any]] = {
    "launch": {"LaunchContext": Context, "LaunchDescription": list},
    "launch.actions": {
        "DeclareLaunchArgument": _Argument,
        "IncludeLaunchDescription": _Include,
        "OpaqueFunction": _Opaque,
        "SetEnvironmentVariable": _Set,
    },
    "launch.conditions": {"IfCondition": _IfCondition},
    "launch.launch_description_sources": {"PythonLaunchDescriptionSource": lambda path: path},
    "launch.substitutions": {
        "EnvironmentVariable": _Environment,
        "LaunchConfiguration": _LaunchConfiguration,
        "NotEqualsSubstitution": _NotEquals,
        "PathJoinSubstitution": _PathJoin,
    },
    "launch_ros": {},
    "launch_ros.actions": {"Node": _Node},
    "launch_ros.parameter_descriptions": {"ParameterValue": _ParameterValue},
    "launch_ros.substitutions": {"FindPackageShare": _Share},
}


@contextmanager
def _importable() -> Iterator[None]:
    """Let the launch files import what they name."""
    before = {name: sys.modules.get(name) for name in MODULES}
    for name, content in MODULES.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module


def _entities(path: Path) -> list[Any]:
    with _importable():
        entities = runpy.run_path(str(path))["generate_launch_description"]()
    assert isinstance(entities, list)
    return entities


def declared(path: Path) -> set[str]:
    """Return the names of a file's arguments."""
    return {item.name for item in _entities(path) if isinstance(item, _Argument)}


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
