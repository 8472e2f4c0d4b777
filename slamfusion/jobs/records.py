"""Parts of what several commands print with ``--json``, how it is written, and its JSON Schema.

A type ``...Document`` is a whole document, in the module that fills it. It consists of dataclasses
(see ``slamfusion.json_values``) and types ``...Json`` with more or fewer keys. The text under a key
is its meaning and unit. ``python -m tests.support.make_schema`` makes ``schema.json`` of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, TypedDict

from slamfusion.config import RunConfig
from slamfusion.json_values import plain
from slamfusion.version import versions


class FailureDocument(TypedDict):
    """All that a command prints that failed before it had anything to tell; exit code 1."""

    error: str
    """What was wrong, in one line."""


@dataclass(frozen=True)
class Settings:
    """What a result depends on besides its inputs."""

    config: RunConfig
    """The settings in effect, as --config takes them."""
    versions: Mapping[str, str | None] = field(init=False, default_factory=versions)
    """Versions of Python, of this package and of those it stands on; null: not installed."""


@dataclass(frozen=True)
class Circumstances:
    """What a computed result depends on besides its inputs."""

    device: str
    """What computed it, in words."""
    seed: int = field(init=False)
    """Seed of every random number."""
    config: RunConfig
    """The settings in effect, as --config takes them."""
    versions: Mapping[str, str | None] = field(init=False, default_factory=versions)
    """Versions of Python, of this package and of those it stands on; null: not installed."""

    def __post_init__(self) -> None:
        """Take the seed from the settings."""
        vars(self)["seed"] = self.config.seed


class MethodMeanJson(TypedDict):
    """The means of a method's figures over its cases; of seeds, those of each case come first."""

    method: str
    """The method."""
    cases: int
    """Cases that it was measured in."""
    figures: Mapping[str, float]
    """Means of the figures that are defined in each of these cases, by name."""


class RepetitionsJson(TypedDict):
    """The figures of a method in one case over several seeds."""

    case: str
    """The case."""
    method: str
    """The method."""
    seeds: int
    """Repetitions."""
    figures: Mapping[str, float]
    """Means of the figures that are defined in each of these, by name."""
    std: Mapping[str, float]
    """Their sample standard deviations (divided by N - 1)."""


@dataclass(frozen=True)
class Summaries:
    """Figures of several maps or paths as means."""

    means: Sequence[MethodMeanJson]
    """The figures of each method over its cases."""
    repetitions: Sequence[RepetitionsJson]
    """The figures of each method over the seeds of one case; empty where none has several."""


def record_bytes(document: Any) -> bytes:
    """Return a document as the indented UTF-8 text of a JSON file; NaN and infinity become null."""
    return (json.dumps(plain(document), indent=2, allow_nan=False) + "\n").encode()


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for a table; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{round(value, digits) + 0.0:.{digits}f}"  # no -0.000


def spread(mean: float, deviation: float, digits: int) -> str:
    """Return a mean with its deviation; without, where there is none."""
    text = number(deviation, digits)
    return number(mean, digits) if text == "-" else f"{number(mean, digits)} ± {text}"


def p_text(p_value: float | None) -> str:
    """Return a p-value for a table: three decimals, or ``<0.001``; a dash where there is none."""
    return "<0.001" if p_value is not None and p_value < 0.001 else number(p_value)


def load_schema(what: str | None = None) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of what commands print with ``--json``.

    ``$defs`` holds an entry for each command, its words joined by hyphens (``graph-optimize``), and
    one for each record, in CapWords.

    Args:
        what: the words of a command, e.g. ``graph optimize``, or the name of a record, e.g.
            ``RunRecord``; None: any command's document.

    Raises:
        KeyError: there is no such command or record.
    """
    text = resources.files("slamfusion.jobs").joinpath("schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    if what is None:
        return schema
    name = what.replace(" ", "-")
    if name not in schema["$defs"]:
        raise KeyError(what)
    return {
        **{key: value for key, value in schema.items() if key != "anyOf"},
        "$ref": f"#/$defs/{name}",
    }


class ShowDocument(TypedDict):
    """What ``slamfusion show`` prints when it starts."""

    url: str
    """Address of the page."""
    maps: list[str]
    """Names of the maps that it shows."""


class LiveLineJson(TypedDict):
    """What a running node says of itself or of an input; a line of its diagnostics."""

    name: str
    """Of the input, or fusion."""
    level: str
    """ok, warn, error or stale."""
    message: str
    """Why, for people."""
    figures: Mapping[str, str]
    """Figures by name, with their units, as the node writes them."""


class LiveStatusDocument(TypedDict):
    """``slamfusion live status``."""

    node: str
    """The node that answered, with its namespace."""
    fusion: LiveLineJson
    """What it says of the fusion."""
    inputs: Sequence[LiveLineJson]
    """What it says of each input."""


class LiveAnswerDocument(TypedDict):
    """``slamfusion live save``, ``reset``, ``set``, ``add`` and ``remove``."""

    success: bool
    """Whether it was done."""
    message: str
    """What was done, or why not; of ``save`` the file."""
