"""Fields with help, unit, range and level; configurations from and to nested plain values."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, Union, overload

from slamfusion.errors import ConfigError, shown

T = TypeVar("T")

# The profile with the values of an algorithm's authors.
PUBLISHED = "published"

# Larger integers fit no record and no library.
INTEGER_MAX = 2**63 - 1
# Most numbers of a list ``first..last``.
LIST_MAX = 10_000

# Limit of coordinates, metres.
FARTHEST = 1e7
# Limit of angles, radians: two turns; a larger number is most likely in degrees.
YAW_MOST_RAD = 4.0 * math.pi
# Step of a list ``first..last``, in the unit of the field.
LIST_STEP = 0.1


# Units by the end of a field's name.
_UNITS = {
    "_rad_s": "rad/s",
    "_deg_s": "deg/s",
    "_rad_m": "rad/m",
    "_mps": "m/s",
    "_hz": "Hz",
    "_percent": "%",
    "_rad": "rad",
    "_deg": "deg",
    "_m": "m",
    "_s": "s",
}


def option(
    default: Any,
    text: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    level: Literal["public", "expert"] = "public",
    flag: str = "",
) -> Any:
    """Declare a configuration field with its description and inclusive range.

    Args:
        unit: default: by the end of the name, e.g. ``_m``.
        low, high: default: open; 0 to 1 for a name that ends in ``_share``.
        level: expert fields are read from files alone.
        flag: its option on the command line, if it is not the field's name.
    """
    metadata = {"help": text, "unit": unit, "low": low, "high": high, "level": level, "flag": flag}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class FieldInfo:
    """A field's description for the command line, ROS and the documentation.

    Attributes:
        kind: bool, int, float or str: of the value, or of each value of a list.
        is_optional: may be None.
        help: without a capital and a full stop.
        low, high: inclusive range; None: open.
        choices: allowed words; empty: any.
        level: ``public`` fields are options of commands, ``expert`` ones only in files.
        flag: its option on the command line; empty: made from the name.
    """

    name: str
    kind: type[Any]
    is_list: bool
    is_optional: bool
    default: Any
    help: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    level: str
    flag: str


# By class, as configurations are built and checked often.
_INFOS: dict[type[Any], tuple[FieldInfo, ...]] = {}


def field_infos(config_class: type[Any]) -> tuple[FieldInfo, ...]:
    """Return the leaf fields of a configuration class, in order; sections are left out."""
    if config_class in _INFOS:
        return _INFOS[config_class]
    hints = typing.get_type_hints(config_class)
    infos = []
    for item in dataclasses.fields(config_class):
        if not item.metadata:
            continue
        said = {key: value for key, value in item.metadata.items() if value not in {None, ""}}
        unit = next((unit for end, unit in _UNITS.items() if item.name.endswith(end)), "")
        known: dict[str, Any] = {
            "unit": "" if "_per_" in item.name else unit,
            "low": 0.0 if item.name.endswith("_share") else None,
            "high": 1.0 if item.name.endswith("_share") else None,
            "flag": "",
        }
        form = _form(hints[item.name])
        infos.append(FieldInfo(name=item.name, default=item.default, **form, **(known | said)))
    return _INFOS.setdefault(config_class, tuple(infos))


def _form(hint: Any) -> dict[str, Any]:
    """Read an annotation: ``T``, ``Literal[...]`` or ``tuple[T, ...]``, each ``| None``."""
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in {Union, types.UnionType}:
        first = next(part for part in parts if part is not type(None))
        return _form(first) | {"is_optional": True}
    if typing.get_origin(hint) is tuple:
        return _form(parts[0]) | {"is_list": True}
    is_word = typing.get_origin(hint) is Literal
    kind, choices = (str, parts) if is_word else (hint, ())
    return {"kind": kind, "choices": choices, "is_list": False, "is_optional": False}


def checked_value(info: FieldInfo, value: Any, where: str) -> Any:
    """Return a value as a field's type.

    Args:
        where: its name in messages, e.g. ``'--seed'`` or ``node graph: graph.matcher.beams``.

    Raises:
        ConfigError: a wrong type, not one of the choices, or out of range.
    """
    right = _coerce(value, info, where)
    _check_value(where, info, right)
    return right


def _check_value(where: str, info: FieldInfo, value: Any) -> None:
    if value == () != info.default:
        raise ConfigError(f"{where}: wanted one value at least, found none")
    low = -math.inf if info.low is None else info.low
    high = math.inf if info.high is None else info.high
    for item in value if info.is_list and value is not None else (value,):
        if item is None:
            continue
        if info.choices and item not in info.choices:
            words = ", ".join(info.choices)
            raise ConfigError(f"{where}: must be one of {words}, found {shown(item)}")
        if (info.low, info.high) != (None, None) and not low <= item <= high:
            unit = f" {info.unit}" if info.unit else ""
            limits = f"[{low:g}, {high:g}]{unit}"
            raise ConfigError(f"{where}: must lie in {limits}, found {shown(item)}")


class Checked:
    """Checks every field against its declared range and choices after construction."""

    def __post_init__(self) -> None:
        for info in field_infos(type(self)):
            _check_value(info.name, info, getattr(self, info.name))


@dataclass(frozen=True)
class ConfigOption:
    """A leaf field of a configuration and its place in the tree.

    Attributes:
        section: dotted place of its section.
        info: the field, with the tree's value as its default.
        filled: the profile's value for an open field; else None.
        published: value of the published profile; None for a field outside of profiles.
    """

    section: str
    info: FieldInfo
    filled: Any = None
    published: Any = None

    @property
    def key(self) -> str:
        """Dotted place in the configuration tree."""
        return f"{self.section}.{self.info.name}".lstrip(".")

    @property
    def parameter(self) -> str:
        """Name of the value in the command's arguments."""
        return "config_" + self.key.replace(".", "_")

    @property
    def default(self) -> Any:
        """Value without any option or file, from the profile if open; may be None."""
        return self.filled if self.info.default is None else self.info.default

    @property
    def flag(self) -> str:
        """Name of the option on the command line."""
        return self.info.flag or "--" + self.info.name.replace("_", "-")

    def shown_default(self) -> str:
        """Return the default with its unit; empty without one."""
        if self.default is None:
            return ""
        unit = "" if isinstance(self.default, bool) else self.info.unit
        return f"{shown_value(self.default)} {unit}".strip()


def config_fields(config: Any, section: str = "") -> Iterator[ConfigOption]:
    """Yield every leaf field of a configuration tree, in order, sections first to last."""
    whole = config() if isinstance(config, type) else config
    # A section with profiles has ``profile``, and ``chosen`` for the values of its open fields.
    own = whole.chosen() if hasattr(whole, "chosen") else whole
    published = dataclasses.replace(whole, profile=PUBLISHED).chosen() if own is not whole else None
    for info in field_infos(type(whole)):
        is_open = published is not None and info.default is None
        yield ConfigOption(
            section,
            dataclasses.replace(info, default=getattr(whole, info.name)),
            getattr(own, info.name),
            getattr(published, info.name) if is_open else None,
        )
    for item in dataclasses.fields(whole):
        value = getattr(whole, item.name)
        sections = {item.name: value}
        if isinstance(value, Mapping):
            sections = {f"{item.name}.{name}": own for name, own in value.items()}
        for name, below in sections.items():
            if dataclasses.is_dataclass(below):
                yield from config_fields(below, f"{section}.{name}".lstrip("."))


def shown_value(value: Any) -> str:
    """Return a setting's value for help and pages."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ",".join(map(shown_value, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def with_values(config: T, values: Mapping[str, Any], section: str = "") -> T:
    """Return a configuration with other values of leaf fields, by their dotted places.

    Args:
        values: of the right types, see ``checked_value``.
        section: place of ``config``, with which the places start.

    Raises:
        ConfigError: values contradict each other.
    """

    def changed(own: Any, place: str) -> Any:
        if place in values:
            return values[place]
        if isinstance(own, Mapping):
            return {name: changed(below, f"{place}.{name}") for name, below in own.items()}
        return with_values(own, values, place) if dataclasses.is_dataclass(own) else own

    whole: Any = config
    places = {item.name: f"{section}.{item.name}".lstrip(".") for item in dataclasses.fields(whole)}
    changes = {name: changed(getattr(whole, name), place) for name, place in places.items()}
    return typing.cast("T", dataclasses.replace(whole, **changes))


@overload
def from_mapping(config: type[T], values: Any, where: str = ...) -> T: ...


@overload
def from_mapping(config: T, values: Any, where: str = ...) -> T: ...


def from_mapping(config: Any, values: Any, where: str = "config") -> Any:
    """Build a configuration from nested plain values.

    Args:
        config: a configuration class, or an instance with the defaults.
        values: nested mappings, as read from YAML; missing keys keep their defaults.
        where: the source in messages, e.g. the file's path.

    Raises:
        ConfigError: an unknown key, a wrong type or range.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: wanted a mapping of settings, found {type(values).__name__}")
    is_class = isinstance(config, type)
    config_class = config if is_class else type(config)
    hints = typing.get_type_hints(config_class)
    infos = {info.name: info for info in field_infos(config_class)}
    known = {item.name for item in dataclasses.fields(config)}
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            options = () if is_class else config_fields(config)
            homes = [item.key for item in options if item.key.endswith(f".{key}")]
            near = difflib.get_close_matches(shown(key), known, n=1, cutoff=0.0)
            advice = f"it stands in a section: {' or '.join(homes)}" if homes else ""
            advice = advice or f"the nearest known one is {near[0]!r}"
            raise ConfigError(f"{where}: unknown key {shown(key)}; {advice}")
        hint = hints[key]
        if hint == Mapping[str, Any]:
            given = {} if is_class else getattr(config, key)
            arguments[key] = _sections(given, value, f"{where}: {key}")
        elif typing.get_origin(hint) is Mapping:
            # The user's own names and values; the class checks them.
            arguments[key] = {} if value is None else value
        elif dataclasses.is_dataclass(hint):
            # A section's defaults may differ from its class's.
            section = getattr(config, key, hint)
            arguments[key] = from_mapping(section, value, f"{where}: {key}")
        elif key in infos:
            arguments[key] = _coerce(value, infos[key], f"{where}: {key}")
        else:
            arguments[key] = _value(hint, value, f"{where}: {key}")
    try:
        return config(**arguments) if is_class else dataclasses.replace(config, **arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _value(hint: Any, value: Any, where: str) -> Any:
    """Return a value that is no option: a text or number, a list of sections or of rows."""
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in {Union, types.UnionType}:
        if value is None and type(None) in parts:
            return None
        kinds: list[Any] = [part for part in parts if part is not type(None)]
        kinds.sort(key=lambda part: bool(typing.get_args(part)) != isinstance(value, list))
        if not typing.get_args(kinds[0]) and type(value) is not kinds[0]:
            words = " or ".join("a list" if typing.get_args(it) else it.__name__ for it in kinds)
            raise ConfigError(f"{where}: wanted {words}, found {shown(value)}")
        return _value(kinds[0], value, where)
    if typing.get_origin(hint) is tuple and parts[-1] is Ellipsis:
        if not isinstance(value, list):
            raise ConfigError(f"{where}: wanted a list, found {shown(value)}")
        items = enumerate(value, start=1)
        return tuple(_value(parts[0], item, f"{where}: number {n}") for n, item in items)
    if typing.get_origin(hint) is tuple:
        row = value if isinstance(value, list) else []
        numbers = [item for item in row if type(item) in {int, float} and abs(item) < FARTHEST]
        if len(row) != len(parts) or len(numbers) != len(parts):
            wanted = f"{len(parts)} numbers in metres and radians"
            raise ConfigError(f"{where}: wanted {wanted}, found {shown(value)}")
        return tuple(map(float, numbers))
    if dataclasses.is_dataclass(hint):
        return from_mapping(hint, value, where)
    if type(value) is not hint:
        raise ConfigError(f"{where}: wanted {hint.__name__}, found {shown(value)}")
    return value


def _sections(known: Mapping[str, Any], values: Any, where: str) -> dict[str, Any]:
    """Return named sections with the changes in ``values``; see ``from_mapping``."""
    if values is None:
        values = {}
    if not isinstance(values, dict):
        message = f"{where}: wanted a mapping of names to settings, found {type(values).__name__}"
        raise ConfigError(message)
    for name in values:
        if name not in known:
            message = (
                f"{where}: unknown name {shown(name)}; wanted some of {', '.join(known) or '-'}"
            )
            raise ConfigError(message)
    changed = {
        name: from_mapping(known[name], own, f"{where}: {name}") for name, own in values.items()
    }
    return {**known, **changed}


def _coerce(value: Any, info: FieldInfo, where: str) -> Any:
    if value is None and info.is_optional:
        return None
    if info.is_list:
        items = _split_list(value, info.kind) if isinstance(value, str) else value
        items = items if isinstance(items, (list, tuple)) else [items]
        return tuple(_coerced(item, info, where) for item in items)
    return _coerced(value, info, where)


def _coerced(value: Any, info: FieldInfo, where: str) -> Any:
    """Return one value as the declared kind; choices are checked later."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    is_usable = not is_number or isinstance(value, float) or abs(value) <= INTEGER_MAX
    if info.kind is float and is_number and is_usable:
        return float(value)
    if info.kind is not float and type(value) is info.kind and is_usable:
        return value
    if info.kind is str and is_number and not (info.choices or info.is_list):
        return str(value)  # an index, or seconds
    if value is False and "no" in info.choices:  # YAML 1.1 reads a bare no as false
        return "no"
    one = " or ".join(info.choices) or info.kind.__name__
    words = f"a list of {one}" if info.is_list else one
    message = f"{where}: wanted {words}{' or None' * info.is_optional}, found {shown(value)}"
    raise ConfigError(message)


def _split_list(text: str, kind: type[Any]) -> list[Any]:
    """Return the values of a text: separated by commas, or ``first..last`` in steps of 0.1.

    ``kind`` is str, int or float; a text without such values is returned as the only one.
    """
    if kind is str:
        return [part.strip() for part in text.split(",") if part.strip()] or [text]
    try:
        if ".." in text:
            first, last = (float(part) for part in text.split(".."))
            steps = int((last - first) / LIST_STEP + 1e-6)
            if not 0 <= steps < LIST_MAX:
                return [text]
            return [kind(round(first + LIST_STEP * step, 6)) for step in range(steps + 1)]
        return [kind(part) for part in text.split(",")]
    except (ValueError, OverflowError):
        return [text]
