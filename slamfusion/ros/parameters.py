"""A node's parameters, declared from the fields of a configuration dataclass.

Names are those of the YAML files of ``--config``, of a producer those below its name:
``NAME.resolution``, ``NAME.matcher.beams``. Description, range, default and level come from the
field. A value is checked by building the dataclass: what that refuses is refused here, in its
words.
"""

from __future__ import annotations

import dataclasses
import difflib
import sys
import typing
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterValueException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from slamfusion.config import (
    START_FORM,
    START_M,
    START_RAD,
    FieldInfo,
    checked_start,
    checked_value,
    field_infos,
)
from slamfusion.errors import ConfigError, SlamFusionError

T = TypeVar("T")

INT64 = 2**63 - 1
START = "start."


class TypedNode(Node):  # type: ignore[misc]  # rclpy is untyped
    """A node whose parameters keep their types when a change is refused.

    Where the type may change rclpy takes over that of each value that is tried, refused or not, and
    forgets a parameter that is unset.
    """

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all or none; the services of ROS tools come here too."""
        for item in parameter_list:
            if item.type_ == Parameter.Type.NOT_SET and self.has_parameter(item.name):
                reason = f"{_where(self)}: {item.name}: wanted a value; it cannot be unset"
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


def declare(
    node: Any,
    section: T,
    prefix: str = "",
    *,
    changeable: Collection[str] = (),
    on_change: Callable[[T], None] | None = None,
) -> T:
    """Declare every field of a configuration as a parameter and return what was set.

    Args:
        section: a configuration whose values are the defaults. Nested sections become
            ``prefix.section.field``.
        prefix: before every name, e.g. a producer's name; empty for none.
        changeable: names of fields (dotted below ``section``, without the prefix) that may be
            changed while the node runs; the others are read-only.
        on_change: called in the executor's thread with the whole new configuration after a change
            was accepted.

    Returns:
        The configuration, with what the command line and parameter files said.

    Raises:
        ConfigError: a value of the wrong type, out of its range, or refused beside the others.
    """
    config_class = type(section)
    unknown = sorted(set(changeable) - set(parameter_names(config_class)))
    if unknown:
        message = f"{config_class.__name__} has no field {unknown[0]!r} that could be changeable"
        raise ValueError(message)
    fields = _Fields(node, prefix, frozenset(changeable))
    fields.declare(section, "")
    current: T = _built(config_class, fields.tree(), prefix, _where(node))

    def check(changes: list[Any]) -> SetParametersResult:
        values = fields.changed(changes)
        if not values:
            return SetParametersResult(successful=True)
        try:
            _built(config_class, fields.tree(values), prefix, _where(node))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def take(changes: list[Any]) -> None:
        if fields.changed(changes) and on_change is not None:
            on_change(_built(config_class, fields.tree(), prefix, _where(node)))

    if changeable:
        node.add_pre_set_parameters_callback(fields.as_floats)
        node.add_on_set_parameters_callback(check)
        node.add_post_set_parameters_callback(take)
    return current


def declare_names(
    node: Any,
    name: str,
    default: Collection[str],
    text: str,
    *,
    check: Callable[[tuple[str, ...]], object] | None = None,
    on_change: Callable[[tuple[str, ...]], None] | None = None,
) -> tuple[str, ...]:
    """Declare a parameter that is a list of names, and return it.

    Args:
        name: of the parameter.
        default: the names unless others are given.
        text: the description.
        check: called in the executor's thread with names that it is to be changed to; refuses them
            by a SlamFusionError. None: the parameter is read-only.
        on_change: called there with the new names after a change was accepted.

    Returns:
        The names; one text may be given instead of a list, its names parted by commas.

    Raises:
        ConfigError: neither a text nor a list of texts.
    """

    def read(parameter: Any) -> tuple[str, ...]:
        try:
            return names_of(parameter.value)
        except ConfigError as error:
            raise ConfigError(f"{_where(node)}: {name}: {error}") from None

    def each(function: Callable[[tuple[str, ...]], object], changes: list[Any]) -> None:
        for item in changes:
            if item.name == name:
                function(read(item))

    def accept(changes: list[Any]) -> SetParametersResult:
        try:
            each(check or len, changes)
        except SlamFusionError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    descriptor = ParameterDescriptor(description=text, read_only=check is None, dynamic_typing=True)
    given = read(node.declare_parameter(name, [*default] or None, descriptor))
    if check is not None:
        node.add_on_set_parameters_callback(accept)
        node.add_post_set_parameters_callback(partial(each, on_change or len))
    return given


def names_of(given: Any) -> tuple[str, ...]:
    """Return the names that a parameter holds, a list or one text with commas.

    Raises:
        ConfigError: it is neither.
    """
    if isinstance(given, str):
        given = given.split(",")
    names = list(given) if isinstance(given, (list, tuple)) else [given] * (given is not None)
    if not all(isinstance(item, str) for item in names):
        raise ConfigError(f"wanted a list of names, found {given!r}")
    return tuple(item.strip() for item in names if item.strip())


def declare_starts(
    node: Any, names: Collection[str], *, may_come: bool = False
) -> dict[str, tuple[float, ...]]:
    """Declare a read-only parameter ``start.NAME`` for each input, and return those that are set.

    Args:
        names: of the inputs.
        may_come: whether others may come, whose starts are told already.

    Returns:
        3 or 5 numbers by name: x, y in m, yaw in rad, and tolerances in m and rad.

    Raises:
        ConfigError: one names no input, has another count of numbers, one that is not finite, or a
            negative tolerance.
    """
    names = [*names]
    for given in sorted(getattr(node, "_parameter_overrides", {})):
        if not given.startswith(START) or given.removeprefix(START) in names:
            continue
        if may_come:
            names.append(given.removeprefix(START))
        else:
            message = f"{_where(node)}: {given} names no input; the inputs are {', '.join(names)}"
            raise ConfigError(message)
    text = (
        f"where the map frame of this input lies in one that all starts share: {START_FORM} in m "
        f"and rad; tolerances unless given: {START_M:g} m, {START_RAD:g} rad (public)"
    )
    descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=True)
    starts = {}
    for name in names:
        value = node.declare_parameter(f"{START}{name}", None, descriptor).value
        if value is not None:
            starts[name] = checked_start(value, f"{_where(node)}: {START}{name}")
    return starts


def unknown_parameters(node: Any) -> list[str]:
    """Return a sentence for each parameter that was given and that the node does not have.

    ROS passes over these in silence.
    """
    given = getattr(node, "_parameter_overrides", {})
    sentences = []
    for name in sorted(given):
        if node.has_parameter(name) or name.startswith("qos_overrides."):
            continue
        known = list(getattr(node, "_parameters", {}))
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
        hint = f"; the nearest known one is {near[0]!r}" if near else ""
        sentences.append(f"unknown parameter {name!r} is not used{hint}")
    return sentences


def parameter_names(config_class: type[Any], prefix: str = "") -> list[str]:
    """Return the names that ``declare`` gives to the fields of a class, in its order."""
    hints = typing.get_type_hints(config_class)
    names = [_joined(prefix, info.name) for info in field_infos(config_class)]
    for item in dataclasses.fields(config_class):
        if dataclasses.is_dataclass(hints[item.name]):
            names += parameter_names(hints[item.name], _joined(prefix, item.name))
    return names


class _Fields:
    """The declared fields of one section, by their dotted names without the prefix."""

    def __init__(self, node: Any, prefix: str, changeable: frozenset[str]) -> None:
        self._node = node
        self._prefix = prefix
        self._changeable = changeable
        self._names: list[str] = []
        # Full names of those that are floats.
        self._floats: set[str] = set()

    def declare(self, default: Any, below: str) -> None:
        """Declare the leaf fields of a (nested) section, then its sections."""
        for info in field_infos(type(default)):
            name = _joined(below, info.name)
            descriptor = self._descriptor(info, name)
            full = _joined(self._prefix, name)
            try:
                self._node.declare_parameter(full, getattr(default, info.name), descriptor)
            except InvalidParameterValueException:
                # ROS's range; ours say it with the unit.
                given = getattr(self._node, "_parameter_overrides", {})[full].value
                where = f"{_where(self._node)}: {full}"
                checked_value(info, given, where)
                raise ConfigError(f"{where}: {given!r} is out of range") from None
            except (ParameterException, ValueError) as error:
                raise ConfigError(f"{_where(self._node)}: {full}: {error}") from None
            if info.kind is float:
                self._floats.add(full)
            self._names.append(name)
        for item in dataclasses.fields(default):
            value = getattr(default, item.name)
            if dataclasses.is_dataclass(value):
                self.declare(value, _joined(below, item.name))

    def tree(self, changed: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return the values as nested mappings.

        Args:
            changed: values to take instead of the node's own, by name without the prefix.
        """
        tree: dict[str, Any] = {}
        for name in self._names:
            value = self._node.get_parameter(_joined(self._prefix, name)).value
            *sections, leaf = name.split(".")
            place = tree
            for section in sections:
                place = place.setdefault(section, {})
            place[leaf] = value if changed is None else changed.get(name, value)
        return tree

    def changed(self, parameters: list[Any]) -> dict[str, Any]:
        """Return the values of those parameters that are ours, by name without the prefix."""
        own = {_joined(self._prefix, name): name for name in self._names}
        return {own[item.name]: item.value for item in parameters if item.name in own}

    def as_floats(self, parameters: list[Any]) -> list[Any]:
        """Return parameters, a number without a point as a float where the field is one."""
        return [
            Parameter(item.name, value=float(item.value))
            if item.name in self._floats and item.type_ == Parameter.Type.INTEGER
            else item
            for item in parameters
        ]

    def _descriptor(self, info: FieldInfo, name: str) -> ParameterDescriptor:
        """Return what ROS tools show of a field."""
        unit = f" [{info.unit}]" if info.unit else ""
        wanted = f"one of: {', '.join(info.choices)}" if info.choices else ""
        descriptor = ParameterDescriptor(
            description=f"{info.help}{unit} ({info.level})",
            additional_constraints=wanted,
            read_only=name not in self._changeable,
            # A number without a point may be given for a float, and a field may be left open;
            # the type is checked with the value.
            dynamic_typing=True,
        )
        has_range = info.low is not None or info.high is not None
        if not has_range:
            return descriptor
        if info.kind is int:
            low = -INT64 if info.low is None else int(info.low)
            high = INT64 if info.high is None else int(info.high)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
        elif info.kind is float:
            largest = sys.float_info.max
            descriptor.floating_point_range = [
                FloatingPointRange(
                    from_value=float(-largest if info.low is None else info.low),
                    to_value=float(largest if info.high is None else info.high),
                    step=0.0,
                )
            ]
        return descriptor


def _built(section: Any, values: Mapping[str, Any], prefix: str, where: str) -> Any:
    """Return a configuration of a section's class; every name in a message is the whole one.

    Args:
        section: a configuration dataclass.
        values: of all its fields, nested.
        prefix: name of the section, e.g. ``graph.matcher``; empty at the top.
        where: before every message.

    Raises:
        ConfigError: a value of the wrong type, out of its range, or refused beside the others.
    """
    hints = typing.get_type_hints(section)
    arguments = {
        info.name: checked_value(info, values[info.name], f"{where}: {_joined(prefix, info.name)}")
        for info in field_infos(section)
    }
    for item in dataclasses.fields(section):
        if item.name not in arguments:
            name = _joined(prefix, item.name)
            arguments[item.name] = _built(hints[item.name], values[item.name], name, where)
    try:
        return section(**arguments)
    except ConfigError as error:
        message = f"{where}: {prefix}: {error}" if prefix else f"{where}: {error}"
        raise ConfigError(message) from None


def _joined(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


def _where(node: Any) -> str:
    return f"node {node.get_name()}"
