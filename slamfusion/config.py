"""The one configuration tree: frozen dataclasses, all defaults here and nowhere else.

Every field carries its help text, unit, range and level (``public`` or ``expert``) as metadata.
The command line builds its options from them and the README its tables.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import yaml

from slamfusion.errors import ConfigError

__all__ = [
    "AlignConfig",
    "DeviceConfig",
    "EvaluateConfig",
    "FieldInfo",
    "FusionConfig",
    "LogConfig",
    "NormalizeConfig",
    "RunConfig",
    "TinySlamConfig",
    "TrajectoryConfig",
    "VoteConfig",
    "field_infos",
    "from_mapping",
    "load_config",
    "to_mapping",
]

T = TypeVar("T")


def option(
    default: Any,
    text: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    level: str = "public",
) -> Any:
    """Declare a configuration field with its description, unit and inclusive range."""
    metadata = {
        "help": text,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
        "level": level,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class FieldInfo:
    """What the command line, ROS and the README need to know of one field."""

    name: str
    type: Any
    default: Any
    help: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    level: str


def field_infos(config_class: type[Any]) -> list[FieldInfo]:
    """Return the leaf fields of a configuration class, in order; nested classes are left out."""
    hints = typing.get_type_hints(config_class)
    infos = []
    for item in dataclasses.fields(config_class):
        if dataclasses.is_dataclass(hints[item.name]):
            continue
        meta = item.metadata
        infos.append(
            FieldInfo(
                name=item.name,
                type=hints[item.name],
                default=item.default,
                help=meta["help"],
                unit=meta["unit"],
                low=meta["low"],
                high=meta["high"],
                choices=meta["choices"],
                level=meta["level"],
            )
        )
    return infos


def _check_value(owner: str, info: FieldInfo, value: Any) -> None:
    """Raise ConfigError when ``value`` is outside the field's declared choices or range."""
    if value is None:
        return
    if info.choices and value not in info.choices:
        message = f"{owner}.{info.name} must be one of {', '.join(info.choices)}, found {value!r}"
        raise ConfigError(message)
    if info.low is None and info.high is None:
        return
    low = -math.inf if info.low is None else info.low
    high = math.inf if info.high is None else info.high
    if not low <= value <= high:
        unit = f" {info.unit}" if info.unit else ""
        message = f"{owner}.{info.name} must lie in [{low:g}, {high:g}]{unit}, found {value!r}"
        raise ConfigError(message)


class _Checked:
    """Checks every field against its declared range and choices after construction."""

    def __post_init__(self) -> None:
        """Refuse values outside the declared range, by name."""
        for info in field_infos(type(self)):
            _check_value(type(self).__name__, info, getattr(self, info.name))


@dataclass(frozen=True)
class NormalizeConfig(_Checked):
    """From occupancy in percent to unknown / free / occupied on one resolution."""

    occupied_percent: float = option(
        65.0, "a cell at or above this is occupied", unit="%", low=0.0, high=100.0
    )
    free_percent: float = option(
        25.0, "a cell at or below this is free", unit="%", low=0.0, high=100.0
    )
    resolution: float | None = option(
        None, "cell size to bring every input to; default: the finest input's", unit="m", low=1e-4
    )

    def __post_init__(self) -> None:
        """Refuse thresholds that cross."""
        super().__post_init__()
        if self.free_percent >= self.occupied_percent:
            message = (
                f"free_percent ({self.free_percent:g}) must be below "
                f"occupied_percent ({self.occupied_percent:g}); swap them"
            )
            raise ConfigError(message)


@dataclass(frozen=True)
class AlignConfig(_Checked):
    """The search for the rigid motion between two grids, and when to believe it."""

    window_yaw_rad: float = option(
        math.pi, "search yaw within +- this of the start", unit="rad", low=0.0, high=math.pi
    )
    window_m: float | None = option(
        None, "search shifts within this of the start; default: everywhere", unit="m", low=0.0
    )
    step: int | None = option(
        None, "run the fixed-step search of [F16] with this first step instead", unit="cells", low=1
    )
    shared_frame: bool = option(
        False,
        "the maps share their start frame: of equally good answers believe one near the identity",
    )
    prove: bool = option(
        True, "prove the answer the best of the search set, or say how far it may be off"
    )
    deadline_s: float = option(2.0, "stop proving a pair after this long", unit="s", low=0.0)
    coarse_cells: int = option(
        44, "cells on the longest side of the coarsest grid", low=16, high=512, level="expert"
    )
    candidates: int = option(24, "coarse peaks that are refined", low=1, high=64, level="expert")
    proof_points: int = option(
        1024, "wall points that the proof scores", low=16, high=8192, level="expert"
    )
    proof_sigma_cells: float = option(
        4.0,
        "width of the wall likelihood in the proof's score",
        unit="cells",
        low=0.5,
        high=32.0,
        level="expert",
    )


@dataclass(frozen=True)
class VoteConfig(_Checked):
    """How aligned grids decide a cell."""

    mode: str = option(
        "majority",
        "majority, weighted by agreement, or log-odds of the kept probabilities",
        choices=("majority", "weighted", "log-odds"),
    )
    unknown: str = option(
        "auto",
        "unknown as a value, as an abstention, or auto: a value with exactly three voters",
        choices=("auto", "value", "abstain"),
    )
    extent: str = option(
        "reference",
        "fused cells: those of the reference grid, or of the union of all accepted grids",
        choices=("reference", "union"),
    )


@dataclass(frozen=True)
class FusionConfig(_Checked):
    """Normalise, align, agree on a group, vote."""

    normalize: NormalizeConfig = NormalizeConfig()
    align: AlignConfig = AlignConfig()
    vote: VoteConfig = VoteConfig()
    reference: str | None = option(
        None, "name or index (from 0) of the reference; default: the smallest known box"
    )
    require_all: bool = option(False, "fail when any input is rejected")


@dataclass(frozen=True)
class EvaluateConfig(_Checked):
    """Measures of a map against the truth."""

    tolerance_m: float = option(
        0.1, "a wall this near a true wall counts as found", unit="m", low=0.0
    )


@dataclass(frozen=True)
class LogConfig(_Checked):
    """Reading logs and bags."""

    scan_topic: str | None = option(None, "laser topic of a bag; default: its only one")
    odom_topic: str | None = option(
        None, "odometry topic of a bag; default: its only one, or else the transforms"
    )
    base_frame: str | None = option(
        None, "the robot's frame in a bag's transforms; default: base_footprint or base_link"
    )
    odom_frame: str = option("odom", "the odometry frame in a bag's transforms")
    no_return_m: float | None = option(
        None,
        "readings at or above this saw nothing; default: found from the log",
        unit="m",
        low=0.1,
    )
    index_period_s: float = option(
        0.1, "time between scans where the stamps are broken", unit="s", low=1e-3, high=60.0
    )


@dataclass(frozen=True)
class TrajectoryConfig(_Checked):
    """Measures of a trajectory against the truth."""

    tolerance_s: float = option(0.01, "poses this near in time belong together", unit="s", low=0.0)


@dataclass(frozen=True)
class TinySlamConfig(_Checked):
    """tinySLAM [H16]: a Monte-Carlo scan matcher on one map."""

    resolution: float = option(0.05, "cell size of the map", unit="m", low=0.005, high=1.0)
    cell_model: str = option("mean", "how a cell joins its observations", choices=("base", "mean"))
    occupancy_estimator: str = option(
        "constant",
        "what a hit says of its cell: always the same, or the area behind the beam's normal",
        choices=("constant", "area"),
    )


@dataclass(frozen=True)
class DeviceConfig(_Checked):
    """Which device computes."""

    device: str = option(
        "auto", "auto, numpy, an index of `slamfusion devices`, or part of a device's name"
    )


@dataclass(frozen=True)
class RunConfig(_Checked):
    """Everything that decides a result; written beside every result."""

    fusion: FusionConfig = FusionConfig()
    log: LogConfig = LogConfig()
    tinyslam: TinySlamConfig = TinySlamConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    trajectory: TrajectoryConfig = TrajectoryConfig()
    device: DeviceConfig = DeviceConfig()
    seed: int = option(0, "seed of every random number", low=0)


def to_mapping(config: Any) -> dict[str, Any]:
    """Return a configuration as nested plain values, ready for YAML or JSON."""
    return dataclasses.asdict(config)


def from_mapping(config_class: type[T], values: Any, where: str = "config") -> T:
    """Build a configuration from nested plain values.

    Args:
        config_class: one of the dataclasses of this module.
        values: nested mappings, as read from YAML; missing keys keep their defaults.
        where: what the messages call the source, e.g. the file's path.

    Raises:
        ConfigError: an unknown key (the nearest known one is named), a wrong type or range.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        message = f"{where}: wanted a mapping of settings, found {type(values).__name__}"
        raise ConfigError(message)
    hints = typing.get_type_hints(config_class)
    known = {item.name: item for item in dataclasses.fields(config_class)}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.0)
            message = f"{where}: unknown key {key!r}; the nearest known one is {near[0]!r}"
            raise ConfigError(message)
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            arguments[key] = from_mapping(hint, value, f"{where}: {key}")  # type: ignore[arg-type]
        else:
            arguments[key] = _coerce(value, hint, f"{where}: {key}")
    try:
        return config_class(**arguments)
    except ConfigError as error:
        message = f"{where}: {error}"
        raise ConfigError(message) from None


def load_config(path: str | Path) -> RunConfig:
    """Read a ``RunConfig`` from a YAML file; see ``from_mapping`` for the errors."""
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        message = f"{path}: not YAML ({' '.join(str(error).split())}); mend the file"
        raise ConfigError(message) from None
    return from_mapping(RunConfig, values, str(path))


def _coerce(value: Any, hint: Any, where: str) -> Any:
    """Return ``value`` as the declared type, or say what was wanted."""
    allowed = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if value is None and type(None) in allowed:
        return None
    for wanted in allowed:
        if wanted is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        if wanted is not float and type(value) is wanted:
            return value
    names = " or ".join(getattr(item, "__name__", str(item)) for item in allowed)
    message = f"{where}: wanted {names}, found {value!r}"
    raise ConfigError(message)
