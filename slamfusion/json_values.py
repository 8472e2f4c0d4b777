"""Records and nested values as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

# Metadata of a field with a record whose keys replace the field.
FLAT = {"flat": True}


def printed_with(name: str) -> dict[str, str]:
    """Return the metadata of a field that is printed where the field of this name is not None."""
    return {"with": name}


def record_keys(record: Any) -> dict[str, Any]:
    """Return the keys of a record (a dataclass) with their values.

    Fields with ``repr=False`` are not printed; the keys of a record in a field with the metadata
    ``FLAT`` replace that field, and None has no keys. A method ``to_json`` replaces all this.
    """
    if hasattr(record, "to_json"):
        found: Any = record.to_json()
        return record_keys(found) if is_dataclass(found) else found
    keys: dict[str, Any] = {}
    for item in fields(record):
        value = getattr(record, item.name)
        if item.metadata == FLAT:
            keys |= {} if value is None else record_keys(value)
        elif item.repr:
            partner = item.metadata.get("with")
            if partner is None or getattr(record, partner) is not None:
                keys[item.name] = value
    return keys


def plain(value: Any) -> Any:
    """Return records and nested values for JSON: no NumPy, paths, NaN or infinity."""
    if is_dataclass(value):
        value = record_keys(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
