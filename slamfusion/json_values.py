"""Records and nested values as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

# Metadata of a field with a record whose keys replace the field; None has no keys.
FLAT = {"flat": True}
# Metadata of a field with a pose, which is printed as its numbers, metres and radians.
POSE = {"pose": True}
POSE_KEYS = ("dx_m", "dy_m", "yaw_rad")


def flat_or_null(kind: type) -> dict[str, Any]:
    """Return the metadata of a field as ``FLAT``; of None, the keys of a record are null."""
    return {**FLAT, "kind": kind}


def printed_as(key: str) -> dict[str, str]:
    """Return the metadata of a field that is printed under another key."""
    return {"key": key}


def printed_with(name: str) -> dict[str, str]:
    """Return the metadata of a field that is printed where the field of this name is not None."""
    return {"with": name}


def record_keys(record: Any) -> dict[str, Any]:
    """Return the keys of a record (a dataclass) with their values.

    Fields with ``repr=False`` are not printed, and metadata says what else differs. A class with
    ``UNDER`` has the fields that it adds to its base in a mapping under that key. A method
    ``to_json`` replaces all this.
    """
    if hasattr(record, "to_json"):
        other: Any = record.to_json()
        return record_keys(other) if is_dataclass(other) else other
    found: dict[str, Any] = {}
    added: dict[str, Any] = {}
    under = getattr(record, "UNDER", None)
    own = type(record).__annotations__ if under else ()
    for item in fields(record):
        keys = added if item.name in own else found
        value, how = getattr(record, item.name), item.metadata
        if "flat" in how:
            nulls = dict.fromkeys(printed_names(how["kind"])) if "kind" in how else {}
            keys |= nulls if value is None else record_keys(value)
        elif "pose" in how:
            keys |= zip(POSE_KEYS, (value.x, value.y, value.yaw_rad), strict=True)
        elif item.repr and ("with" not in how or getattr(record, how["with"]) is not None):
            keys[how.get("key", item.name)] = value
    return {**found, under: added} if under else found


def printed_names(kind: type) -> list[str]:
    """Return the keys of a record that has none with more or fewer of them."""
    names: list[str] = []
    for item in fields(kind):
        if "pose" in item.metadata:
            names += POSE_KEYS
        elif item.repr:
            names.append(item.metadata.get("key", item.name))
    return names


def dotted(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, by dotted keys; an empty one is a value."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        is_group = isinstance(value, Mapping) and value
        found |= dotted(value, f"{prefix}{key}.") if is_group else {f"{prefix}{key}": value}
    return found


def plain(value: Any) -> Any:
    """Return records and nested values for JSON: no NumPy, paths, NaN or infinity."""
    if is_dataclass(value):
        value = record_keys(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # an array or a number of NumPy, which loads slowly
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
