"""States of mappers in files: what decides how one goes on, checked on the way back in."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from slamfusion.config import to_mapping
from slamfusion.errors import SlamFusionError
from slamfusion.io import write_atomic
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.packing import pack, unpack

__all__ = ["read_state", "restore_health", "write_state"]

T = TypeVar("T")
# Name of the JSON part in the file.
RECORD = "record"


def write_state(path: Path, *, name: str, version: int, config: Any, seed: int, state: Any) -> None:
    """Write a state as an ``.npz`` file; whole or not at all.

    Args:
        path: the file.
        name: the mapper's.
        version: of what it writes.
        config: its settings; whoever goes on must have the same.
        seed: likewise.
        state: a dataclass, see ``slamfusion.slam.common.packing``.
    """
    values, arrays = pack(state)
    whole = {
        "state": values,
        "format": version,
        "name": name,
        "config": to_mapping(config),
        "seed": seed,
    }
    packed: dict[str, Any] = {
        RECORD: np.frombuffer(json.dumps(whole).encode(), dtype=np.uint8),
        **arrays,
    }
    file = io.BytesIO()
    np.savez(file, **packed)
    write_atomic(path, file.getvalue())


def read_state(path: Path, *, name: str, version: int, config: Any, seed: int, kind: type[T]) -> T:
    """Return the state, of a dataclass ``kind``, that ``write_state`` has written.

    Raises:
        SlamFusionError: no such state, one of another mapper or version, one made with other
            settings or another seed, or one that lacks a part.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        record: dict[str, Any] = json.loads(arrays[RECORD].tobytes())
        found_name, found_version = record["name"], record["format"]
    except OSError as error:
        message = f"{path}: cannot be read ({error.strerror or error})"
        raise SlamFusionError(message) from None
    except Exception:  # noqa: BLE001 - taking other files apart may end in anything
        message = f"{path}: not a whole state that `--save-state` has written"
        raise SlamFusionError(message) from None
    if (found_name, found_version) != (name, version):
        message = (
            f"{path}: wanted a state of {name}, format {version}, found {found_name}, "
            f"format {found_version}"
        )
        raise SlamFusionError(message)
    found = {"seed": seed, **_flat(to_mapping(config))}
    for key, value in {"seed": record["seed"], **_flat(record["config"])}.items():
        if found.get(key) != value:
            message = (
                f"{path}: was made with {key} = {value}, found {found.get(key)}; "
                "resume with the same settings"
            )
            raise SlamFusionError(message)
    try:
        return unpack(kind, record["state"], arrays)
    except KeyError as error:
        message = f"{path}: not a whole state, {error} is missing"
        raise SlamFusionError(message) from None


def restore_health(health: Health, saved: Health) -> None:
    """Let a record hold what a saved one of its kind does; it stays the same object."""
    vars(health).update(vars(saved))


def _flat(values: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Return nested settings by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{where}{key}."))
        else:
            flat[f"{where}{key}"] = value
    return flat
