"""A node's parameters, declared from the fields of a configuration dataclass.

Names are those of ``--config`` files, a producer's below its name: ``NAME.resolution``,
``NAME.matcher.beams``. Description, range, default and level come from the field; a value is
checked by building the dataclass.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from slamfusion.config import (
    START_M,
    START_RAD,
    FieldInfo,
    checked_start,
    checked_value,
    config_fields,
    with_values,
)
from slamfusion.errors import ConfigError, SlamFusionError, shown
from slamfusion.io.yaml_file import read_yaml
from slamfusion.ros.interface import START_TEXT, NameList

T = TypeVar("T")

INT64 = 2**63 - 1
START = "start."


class TypedNode(Node):  # type: ignore[misc]  # rclpy is untyped
    """A node whose parameters keep their types when a change is refused, with plain reasons.

    rclpy changes a dynamic parameter's type with each attempt, and forgets an unset parameter.
    """

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all or none; the services of ROS tools come here too."""
        for item in parameter_list:
            reason = ""
            if not self.has_parameter(item.name):
                near = nearest_parameter(self, item.name)
                reason = f"unknown parameter; the nearest known one is {near!r}"
            elif self.describe_parameter(item.name).read_only:
                reason = "it is read-only; start the node with it"
            elif item.type_ == Parameter.Type.NOT_SET:
                reason = "wanted a value; it cannot be unset"
            if reason:
                reason = f"{_where(self)}: {item.name}: {reason}"
                return SetParametersResult(successful=False, reason=reason)
        result = super().set_parameters_atomically(parameter_list)
        for item in parameter_list:
            if self.has_parameter(item.name):
                held = self.get_parameter(item.name)
                self.describe_parameter(item.name).type = held.type_.value
        return result

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """Set one after the other."""
        return [self.set_parameters_atomically([item]) for item in parameter_list]


def given_parameters(node: Any) -> Mapping[str, Any]:
    """Return the parameters of the command line and parameter files, by name."""
    return {name: item.value for name, item in getattr(node, "_parameter_overrides", {}).items()}


def declare(
    node: Any,
    section: T,
    prefix: str = "",
    *,
    changeable: Collection[str] = (),
    on_change: Callable[[T], None] | None = None,
) -> T:
    """Declare every field of a configuration as a parameter and return the set values.

    Args:
        section: gives the defaults. Nested sections become ``prefix.section.field``.
        prefix: before every name, e.g. a producer's name.
        changeable: names that may be changed at run time; the others are read-only.
        on_change: called in the executor's thread with the whole new configuration.

    Raises:
        ConfigError: a value of the wrong type, out of range, or in conflict with another.
    """
    infos = {item.key: item.info for item in config_fields(section, prefix)}
    where, given = _where(node), given_parameters(node)
    for name, info in infos.items():
        # Before ROS does, for a message with the unit.
        checked_value(info, given.get(name, info.default), f"{where}: {name}")
        descriptor = _descriptor(info, is_changeable=name in changeable)
        node.declare_parameter(name, info.default, descriptor)

    def built(changed: dict[str, Any]) -> T:
        values = {
            name: checked_value(
                info, changed.get(name, node.get_parameter(name).value), f"{where}: {name}"
            )
            for name, info in infos.items()
        }
        try:
            return with_values(section, values, prefix)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def own(changes: list[Any]) -> dict[str, Any]:
        return {item.name: item.value for item in changes if item.name in infos}

    def as_floats(changes: list[Any]) -> list[Any]:
        """Accept a number without a point for a float field."""
        return [
            Parameter(item.name, value=float(item.value))
            if item.type_ == Parameter.Type.INTEGER
            and item.name in infos
            and infos[item.name].kind is float
            else item
            for item in changes
        ]

    def check(changes: list[Any]) -> SetParametersResult:
        return outcome(lambda: own(changes) and built(own(changes)))

    def take(changes: list[Any]) -> None:
        if own(changes) and on_change is not None:
            on_change(built({}))

    if changeable:
        node.add_pre_set_parameters_callback(as_floats)
        node.add_on_set_parameters_callback(check)
        node.add_post_set_parameters_callback(take)
    return built({})


def declare_names(
    node: Any,
    names: NameList,
    default: Collection[str] | None = None,
    *,
    check: Callable[[tuple[str, ...]], object] | None = None,
    on_change: Callable[[tuple[str, ...]], None] | None = None,
) -> tuple[str, ...]:
    """Declare a parameter that is a list of names, and return it.

    Args:
        default: None: that of ``names``.
        check: called in the executor's thread with new names; refuses them by a SlamFusionError.
            None: the parameter is read-only.

    Raises:
        ConfigError: neither a list of texts nor a text with commas.
    """

    def read(value: Any) -> tuple[str, ...]:
        try:
            return names_of(value)
        except ConfigError as error:
            raise ConfigError(f"{_where(node)}: {names.name}: {error}") from None

    def each(function: Callable[[tuple[str, ...]], object], changes: list[Any]) -> None:
        for item in changes:
            if item.name == names.name:
                function(read(item.value))

    descriptor = ParameterDescriptor(
        description=names.text, read_only=check is None, dynamic_typing=True
    )
    default = names.default if default is None else default
    given = read(node.declare_parameter(names.name, [*default] or None, descriptor).value)
    if check is not None and on_change is not None:
        node.add_on_set_parameters_callback(lambda changes: outcome(lambda: each(check, changes)))
        node.add_post_set_parameters_callback(lambda changes: each(on_change, changes))
    return given


def names_of(given: Any) -> tuple[str, ...]:
    """Return the names in a parameter, a list or one text with commas; else ConfigError."""
    if isinstance(given, str):
        given = given.split(",")
    names = list(given) if isinstance(given, (list, tuple)) else [given] * (given is not None)
    if not all(isinstance(item, str) for item in names):
        raise ConfigError(f"wanted a list of names, found {shown(given)}")
    return tuple(item.strip() for item in names if item.strip())


def declare_starts(
    node: Any, names: Collection[str], *, may_come: bool = False
) -> dict[str, tuple[float, ...]]:
    """Declare a read-only parameter ``start.NAME`` for each input, and return those that are set.

    With ``may_come`` other inputs may be added, with starts.

    Returns:
        3 or 5 numbers by name: x, y in m, yaw in rad, and tolerances in m and rad.

    Raises:
        ConfigError: no such input, another count of numbers, one that is not finite, or a negative
            tolerance.
    """
    names = [*names]
    for given in sorted(given_parameters(node)):
        name = given.removeprefix(START)
        if name == given or name in names:
            continue
        if not may_come:
            message = f"{_where(node)}: {given} names no input; the inputs are {', '.join(names)}"
            raise ConfigError(message)
        names.append(name)
    text = f"{START_TEXT}; tolerances unless given: {START_M:g} m, {START_RAD:g} rad (public)"
    descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=True)
    values = {name: node.declare_parameter(START + name, None, descriptor).value for name in names}
    return {
        name: checked_start(value, f"{_where(node)}: {START}{name}")
        for name, value in values.items()
        if value is not None
    }


def unknown_parameters(node: Any) -> list[str]:
    """Return a sentence for each given parameter that the node does not have; ROS is silent."""
    return [
        f"unknown parameter {name!r} is not used; the nearest known one is "
        f"{nearest_parameter(node, name)!r}"
        for name in sorted(given_parameters(node))
        if not (node.has_parameter(name) or name.startswith("qos_overrides."))
    ]


def missed_sections(node: Any, arguments: Sequence[str]) -> list[str]:
    """Return a sentence for each parameter file that names the node wrongly; ROS is silent.

    A file may be that of many nodes. It is meant for this one if a section has nearly its name.
    """
    own = str(node.get_fully_qualified_name())
    sentences = []
    for option, file in pairwise(arguments):
        if option != "--params-file":
            continue
        sections: list[str] = []
        with suppress(SlamFusionError, OSError):  # ROS has read it, and forgives more
            sections += _sections(read_yaml(Path(file), ConfigError, "parameters", as_text=True))
        if any(fnmatchcase(own, name.replace("/**", "*")) for name in sections):
            continue
        last = {name: name.rpartition("/")[2] for name in sections}
        near = [
            name for name in sections if difflib.get_close_matches(last[name], [node.get_name()])
        ]
        if near:
            sentences.append(
                f"{file}: nothing of it is used: this node is {own!r}, and the file has sections "
                f"for {', '.join(map(repr, near))}; rename one to {own!r} or '/**'"
            )
    return sentences


def _sections(values: Any, name: str = "") -> Iterator[str]:
    """Yield the name of the nodes, with namespace and wildcards, of each section of a file."""
    for key, below in values.items() if isinstance(values, dict) else ():
        if key == "ros__parameters":
            yield name
        else:
            yield from _sections(below, f"{name}/{str(key).strip('/')}")


def nearest_parameter(node: Any, name: str) -> str:
    """Return the parameter of a node whose name is most like a name."""
    known = list(getattr(node, "_parameters", {}))
    return str(difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0])


def outcome(check: Callable[[], object]) -> SetParametersResult:
    """Return whether new values pass a check, or why it refused them by a SlamFusionError."""
    try:
        check()
    except SlamFusionError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _descriptor(info: FieldInfo, *, is_changeable: bool) -> ParameterDescriptor:
    unit = f" [{info.unit}]" if info.unit else ""
    descriptor = ParameterDescriptor(
        description=f"{info.help}{unit} ({info.level})",
        additional_constraints=f"one of: {', '.join(info.choices)}" if info.choices else "",
        read_only=not is_changeable,
        # Floats may be given without a point, and fields may be None; the value is checked.
        dynamic_typing=True,
    )
    if info.low is None and info.high is None:
        return descriptor
    if info.kind is int:
        low = -INT64 if info.low is None else int(info.low)
        high = INT64 if info.high is None else int(info.high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    elif info.kind is float:
        least = -sys.float_info.max if info.low is None else float(info.low)
        most = sys.float_info.max if info.high is None else float(info.high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=least, to_value=most)]
    return descriptor


def _where(node: Any) -> str:
    return f"node {node.get_name()}"
