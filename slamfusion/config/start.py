"""Starts as settings have them: where the map frames of inputs are expected, and how surely."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from slamfusion.errors import StartError, shown

# How far a map may lie from its start where the start does not say: what a person who points at a
# plan, or a robot that is put onto a mark, is off by.
START_M = 2.0
START_RAD = 0.35
START_FORM = "x,y,yaw or x,y,yaw,metres,radians"
POSE, POSE_AND_TOLERANCES = 3, 5
YAW = 2
DEGREES = "deg"


def checked_start(given: Any, where: str) -> tuple[float, ...]:
    """Return a start as 3 numbers (x, y in m, yaw in rad) or 5 (and tolerances in m and rad).

    Args:
        given: numbers, or a text of them with commas between, as in a file or a parameter. The yaw
            may be in degrees: ``46.4deg``.
        where: what the messages call it.

    Raises:
        StartError: not so many numbers, one that is not finite, or a tolerance below 0.
    """
    parts = given.split(",") if isinstance(given, str) else given
    is_row = isinstance(parts, Sequence) and not isinstance(parts, bytes)
    if not is_row or any(isinstance(part, bool) for part in parts):
        message = f"{where}: wanted {START_FORM}, found {shown(given)}"
        raise StartError(message)
    try:
        values = tuple(
            _yaw_rad(part) if place == YAW else float(part) for place, part in enumerate(parts)
        )
    except (TypeError, ValueError, OverflowError):
        message = f"{where}: wanted {START_FORM}, all numbers, found {_shown(parts)}"
        raise StartError(message) from None
    if len(values) not in {POSE, POSE_AND_TOLERANCES}:
        message = f"{where}: wanted {START_FORM}, found {len(values)} numbers: {_shown(parts)}"
        raise StartError(message)
    if not all(map(math.isfinite, values)):
        message = f"{where}: wanted {START_FORM}, all finite, found {_shown(parts)}"
        raise StartError(message)
    if any(value < 0.0 for value in values[POSE:]):
        message = f"{where}: the tolerances must be at least 0, found {_shown(parts[POSE:])}"
        raise StartError(message)
    return values


def checked_starts(given: Any, where: str = "start") -> dict[str, tuple[float, ...]]:
    """Return starts by the names of inputs; see ``checked_start``.

    Raises:
        StartError: no mapping of names to starts, or one of them is refused.
    """
    if not isinstance(given, Mapping):
        message = f"{where}: wanted names of inputs with {START_FORM} each, found {shown(given)}"
        raise StartError(message)
    named = {name if isinstance(name, str) else shown(name): own for name, own in given.items()}
    return {name: checked_start(own, f"{where}: {name}") for name, own in named.items()}


def _yaw_rad(given: Any) -> float:
    """Return a yaw in radians; text that ends in ``deg`` is in degrees."""
    if isinstance(given, str) and given.strip().endswith(DEGREES):
        return math.radians(float(given.strip().removesuffix(DEGREES)))
    return float(given)


def _shown(parts: Sequence[Any]) -> str:
    return ",".join(
        (" ".join(part.split()) if isinstance(part, str) else shown(part))[:40]
        for part in parts[:10]
    )
