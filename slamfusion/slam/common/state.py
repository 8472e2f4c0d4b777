"""States of producers in files: what decides how one goes on, checked on the way back in."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.config import to_mapping
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io import write_atomic
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.tracking import Tracker

__all__ = [
    "health_record",
    "pose_record",
    "read_state",
    "recorded_pose",
    "restore_health",
    "restore_tracker",
    "tracker_record",
    "write_state",
]

Arrays = dict[str, npt.NDArray[Any]]


def write_state(
    path: Path,
    *,
    name: str,
    version: int,
    config: Any,
    seed: int,
    record: dict[str, Any],
    arrays: Arrays,
) -> None:
    """Write a state as an ``.npz`` file; whole or not at all.

    Args:
        path: the file.
        name: the producer's.
        version: of what it writes.
        config: its settings; whoever goes on must have the same.
        seed: likewise.
        record: plain values.
        arrays: everything else.
    """
    whole = {
        **record,
        "format": version,
        "name": name,
        "config": to_mapping(config),
        "seed": seed,
    }
    packed: dict[str, Any] = {
        "record": np.frombuffer(json.dumps(whole).encode(), dtype=np.uint8),
        **arrays,
    }
    file = io.BytesIO()
    np.savez(file, **packed)
    write_atomic(path, file.getvalue())


def read_state(
    path: Path, *, name: str, version: int, config: Any, seed: int
) -> tuple[dict[str, Any], Arrays]:
    """Return record and arrays of a state that ``write_state`` has written.

    Raises:
        SlamFusionError: no such state, one of another producer or version, or one made with other
            settings or another seed.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        record: dict[str, Any] = json.loads(arrays["record"].tobytes())
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
    return record, arrays


def health_record(health: Health) -> dict[str, Any]:
    """Return a health record as plain values."""
    values = {
        item.name: getattr(health, item.name)
        for item in dataclasses.fields(health)
        if item.name != "skips"
    }
    return {"values": values, "skips": [dict(health.skips.counts), dict(health.skips.lines)]}


def restore_health(health: Health, record: dict[str, Any]) -> None:
    """Take over what ``health_record`` returned."""
    for name, value in record["values"].items():
        setattr(health, name, value)
    counts, lines = record["skips"]
    health.skips.counts.update(counts)
    health.skips.lines.update({key: list(value) for key, value in lines.items()})


def tracker_record(tracker: Tracker) -> dict[str, Any]:
    """Return where a tracker is, as plain values; its draws are the generator's state."""
    return {
        "rng": tracker.rng.bit_generator.state,
        "poses": [pose_record(p) for p in (tracker.pose, tracker.odometry, tracker.step)],
        "numbers": [tracker.step_s, tracker.stamp_s, tracker.running_mean_score],
    }


def restore_tracker(tracker: Tracker, record: dict[str, Any]) -> None:
    """Take over what ``tracker_record`` returned; the generator is the tracker's own."""
    tracker.rng.bit_generator.state = record["rng"]
    tracker.pose, tracker.odometry, step = (recorded_pose(values) for values in record["poses"])
    tracker.step = step or IDENTITY
    tracker.step_s, tracker.stamp_s, tracker.running_mean_score = record["numbers"]


def pose_record(pose: Pose2 | None) -> list[float] | None:
    """Return a pose as plain numbers."""
    return None if pose is None else [pose.x, pose.y, pose.yaw_rad]


def recorded_pose(values: list[float] | None) -> Pose2 | None:
    """Return the pose of ``pose_record``."""
    return None if values is None else Pose2(*values)


def _flat(values: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Return nested settings by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{where}{key}."))
        else:
            flat[f"{where}{key}"] = value
    return flat
